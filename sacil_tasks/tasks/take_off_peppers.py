"""Take two of three peppers off the scale, in the order in which their sizes are named."""

from typing import ClassVar

from sacil_tasks.spec import Fixture, TaskSpec
from sacil_tasks.tasks.take_off_pepper import TakeOffPepperEnv

SPEC = TaskSpec(
    name="take_off_peppers",
    suites=("dual",),
    family="pepper",
    slots=("first", "second"),
    templates=(
        "take the {first} pepper off the scales, then the {second} pepper",
        "remove the {first} pepper and then the {second} pepper from the tray",
        "move the {first} pepper to the table, then the {second} pepper",
    ),
    held_out_templates=("clear the {first} pepper first and the {second} one after",),
    keyframes=12,
    spacing_m=0.12,
    yaw_limit_deg=45.0,
    fixture=Fixture(
        xy_m=(-0.06, -0.18),
        shift_m=0.03,
        yaw_deg=((-20.0, 20.0), (160.0, 200.0)),
        spots_m=((-0.09, -0.055), (0.09, -0.055), (0.0, 0.07)),
        spot_shift_m=0.012,
    ),
    clutter_region_m=((0.09, 0.13), (0.08, 0.30)),
)


class TakeOffPeppersEnv(TakeOffPepperEnv):
    """
    **Task Description:**
    Three bell peppers that differ in size only stand on the pan of a scale. Take the two whose
    sizes are named off the scale, in the order named, and set them down on the table.

    **Randomizations:**
    - those of `TakeOffPepperEnv`

    **Success Conditions:**
    - both named peppers were picked up in the order named, lie at rest on the table beside the pan
      and are let go
    - the third is not on the table
    - strictly: the third was neither acquired nor displaced
    """

    task: ClassVar[TaskSpec] = SPEC
