"""Put two of three cups over pegs of the cup holder, in the order in which they are named."""

from typing import ClassVar

from sacil_tasks.spec import Fixture, TaskSpec
from sacil_tasks.tasks.place_cup import PlaceCupEnv

SPEC = TaskSpec(
    name="place_cups",
    suites=("dual",),
    family="cup",
    slots=("first", "second"),
    templates=(
        "place the {first} cup on the cup holder, then the {second} cup",
        "put the {first} cup and then the {second} cup on the holder",
        "move the {first} cup, then the {second} cup, to the holder",
    ),
    held_out_templates=("before the {second} cup, hang the {first} one",),
    keyframes=12,
    spacing_m=0.13,
    yaw_limit_deg=180.0,
    region_m=((-0.22, 0.05), (0.0, 0.28)),
    fixture=Fixture(xy_m=(-0.06, -0.20), shift_m=0.03, yaw_deg=((-20.0, 20.0),)),
    clutter_region_m=((-0.24, 0.09), (0.0, 0.31)),
)


class PlaceCupsEnv(PlaceCupEnv):
    """
    **Task Description:**
    Three cups that differ in size only stand upside down on the table, beside a holder with three
    pegs. Put the two whose sizes are named over pegs, in the order named. D-pegs.

    **Randomizations:**
    - those of `PlaceCupEnv`

    **Success Conditions:**
    - both named cups were picked up in the order named and are at rest over pegs, as in
      `PlaceCupEnv`; both are let go
    - the third is not over a peg
    - strictly: the third was neither acquired nor displaced
    """

    task: ClassVar[TaskSpec] = SPEC
