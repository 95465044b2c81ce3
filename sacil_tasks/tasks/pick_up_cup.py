"""Pick up the cup of the named size."""

from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Actor
from torch import Tensor

from sacil_tasks import props
from sacil_tasks.interface import Keyframe
from sacil_tasks.poses import downwards, grasp_height_m
from sacil_tasks.spec import TaskSpec
from sacil_tasks.table import SizedTableEnv

SPEC = TaskSpec(
    name="pick_up_cup",
    suites=("slice", "single"),
    family="cup",
    slots=("size",),
    templates=(
        "pick up the {size} cup",
        "grasp the {size} cup and lift it",
        "raise the {size} cup",
        "lift the {size} cup off the table",
    ),
    held_out_templates=(
        "hand me the {size} cup",
        "take hold of the {size} mug and raise it",
    ),
    keyframes=3,
    spacing_m=0.13,
    yaw_limit_deg=180.0,
)

LIFTED_M = 0.10


class PickUpCupEnv(SizedTableEnv):
    """
    **Task Description:**
    Three upright cups that differ in size only stand on the table. Pick up the one whose size is
    named.

    **Randomizations:**
    - cup positions are uniform in [-0.22, 0.05] x [-0.28, 0.28], at least 0.13 m apart
    - handles point anywhere
    - sizes are three neighbouring rungs of a ladder, jittered; which cup has which is uniform
    - one colour for all cups, out of 20; in half of the training scenes each has its own

    **Success Conditions:**
    - the lowest point of the named cup is at least 0.10 m above the table
    - the named cup is held between the fingers
    - strictly: no other cup was acquired or displaced
    """

    task: ClassVar[TaskSpec] = SPEC

    def _build_candidate(self, index: int, name: str, size_m: float, rgb: props.Rgb) -> Actor:
        return props.build_cup(self.scene, index, name, size_m, rgb)

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        return props.cup_height_m(sizes_m) / 2

    def _lenient_success(self, targets: Int[Tensor, "b n"]) -> Bool[Tensor, "b"]:
        lifted = self._lowest_points_m() >= LIFTED_M
        return self._pick(lifted & self.events.grasped, targets)

    def _lowest_points_m(self) -> Float[Tensor, "b 3"]:
        """Height of each cup's lowest point, the cup taken as a cylinder."""
        upright = (1 - 2 * self._sensor.quaternions()[..., 1:3].square().sum(-1)).clamp(-1, 1)
        reach_m = (
            props.cup_height_m(self._sizes_m) * upright.abs()
            + self._sizes_m * (1 - upright.square()).sqrt()
        )
        return self._sensor.positions()[..., 2] - reach_m / 2

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        height_m = props.cup_height_m(self.sizes_m[choice[0]])
        at, heading = self._start_pose(choice[0])
        yaw = props.cup_grasp_yaw(heading)
        grasp = np.array([at[0], at[1], grasp_height_m(height_m)])
        above = np.array([at[0], at[1], height_m + 0.08])
        lift = grasp + np.array([0, 0, 0.20])
        return [
            downwards(above, yaw, gripper_open=True, ignore_collisions=False),
            downwards(grasp, yaw, gripper_open=False, ignore_collisions=True),
            downwards(lift, yaw, gripper_open=False, ignore_collisions=True),
        ]
