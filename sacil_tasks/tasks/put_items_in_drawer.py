"""Open the named drawer and put two of three items into it, in the order named."""

from typing import ClassVar

from sacil_tasks.spec import Fixture, TaskSpec
from sacil_tasks.tasks.put_item_in_drawer import PutItemInDrawerEnv

SPEC = TaskSpec(
    name="put_items_in_drawer",
    suites=("dual",),
    family="block",
    slots=("first", "second"),
    receptacles={"drawer": ("bottom", "middle", "top")},
    templates=(
        "put the {first} item in the {drawer} drawer, then the {second} item",
        "open the {drawer} drawer and place the {first} item and then the {second} item inside",
        "leave the {first} item and after it the {second} item in the {drawer} drawer",
    ),
    held_out_templates=("fill the {drawer} drawer: {first} cube first, {second} cube next",),
    keyframes=17,
    spacing_m=0.11,
    yaw_limit_deg=45.0,
    fixture=Fixture(
        xy_m=(-0.10, -0.05),
        shift_m=0.02,
        yaw_deg=((100.0, 116.0),),
        spots_m=((-0.09, -0.085), (-0.09, 0.085), (-0.21, 0.0)),
        spot_shift_m=0.012,
    ),
    clutter_region_m=((0.11, 0.14), (0.02, 0.14)),
)


class PutItemsInDrawerEnv(PutItemInDrawerEnv):
    """
    **Task Description:**
    Three cubes that differ in size only lie on a cabinet with three drawers. Open the drawer that
    is named and put the two cubes whose sizes are named into it, in the order named.

    With `reset(options={"drawer_open": True})` the named drawer is open from the start; the
    expert's first four keyframes are then of no use.

    **Randomizations:**
    - those of `PutItemInDrawerEnv`

    **Success Conditions:**
    - both named cubes were picked up in the order named, are at rest inside the named drawer and
      are let go
    - the third is in no drawer; drawers that were not named may be open
    - strictly: the third was neither acquired nor displaced
    """

    task: ClassVar[TaskSpec] = SPEC
