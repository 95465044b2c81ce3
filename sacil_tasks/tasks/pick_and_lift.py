"""Pick up the block of the named size and bring it to a sphere in the air."""

from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Actor, Pose
from torch import Tensor

from sacil_tasks import props
from sacil_tasks.interface import Keyframe
from sacil_tasks.poses import downwards, grasp_height_m
from sacil_tasks.scenes import Layout
from sacil_tasks.spec import TaskSpec
from sacil_tasks.table import SizedTableEnv

SPEC = TaskSpec(
    name="pick_and_lift",
    suites=("slice", "single"),
    family="block",
    slots=("size",),
    templates=(
        "pick up the {size} block and raise it to the target",
        "grasp the {size} block and lift it to the target",
        "lift the {size} block up to the sphere",
        "bring the {size} block to the target",
    ),
    held_out_templates=(
        "fetch the {size} cube and hold it at the ball",
        "the target is waiting for the {size} block, take it there",
    ),
    keyframes=4,
    spacing_m=0.13,
    yaw_limit_deg=45.0,
)

GOAL_RADIUS_M = 0.04
GOAL_TOLERANCE_M = 0.05


class PickAndLiftEnv(SizedTableEnv):
    """
    **Task Description:**
    Three cubes that differ in size only lie on the table. Pick up the one whose size is named and
    hold it inside the pale sphere.

    **Randomizations:**
    - cube positions are uniform in [-0.22, 0.05] x [-0.28, 0.28], at least 0.13 m apart
    - cube headings are uniform in +-45 degrees
    - the sphere's centre is uniform over the same rectangle, 0.20 to 0.30 m above the table
    - sizes are three neighbouring rungs of a ladder, jittered; which cube has which is uniform
    - one colour for all cubes, out of 20; in half of the training scenes each has its own

    **Success Conditions:**
    - the named cube's centre is within 0.05 m of the sphere's centre
    - the named cube is held between the fingers
    - strictly: no other cube was acquired or displaced
    """

    task: ClassVar[TaskSpec] = SPEC

    def _build_candidate(self, index: int, name: str, size_m: float, rgb: props.Rgb) -> Actor:
        return props.build_block(self.scene, index, name, size_m, rgb)

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        return sizes_m / 2

    def _load_extras(self) -> None:
        self.goal = props.build_goal(self.scene, "goal", GOAL_RADIUS_M)

    def _place_extras(self, env_idx: Tensor, layouts: list[Layout]) -> None:
        goals_m = self._to_tensor([layout.goal_m for layout in layouts])
        self.goal.set_pose(Pose.create_from_pq(goals_m))

    def _get_obs_extra(self, info: dict) -> dict[str, Tensor]:
        extra = super()._get_obs_extra(info)
        if self.obs_mode_struct.use_state:
            extra["goal_position"] = self.goal.pose.p
        return extra

    def _lenient_success(self, targets: Int[Tensor, "b n"]) -> Bool[Tensor, "b"]:
        gaps_m = (self._sensor.positions() - self.goal.pose.p[:, None]).norm(dim=-1)
        return self._pick((gaps_m <= GOAL_TOLERANCE_M) & self.events.grasped, targets)

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        edge_m, (at, yaw) = self.sizes_m[choice[0]], self._start_pose(choice[0])
        above = np.array([at[0], at[1], edge_m + 0.08])
        grasp = np.array([at[0], at[1], grasp_height_m(edge_m)])
        lift = grasp + np.array([0, 0, 0.10])
        goal = self.goal.pose.p[0].cpu().numpy() + np.array([0, 0, grasp[2] - edge_m / 2])
        return [
            downwards(above, yaw, gripper_open=True, ignore_collisions=False),
            downwards(grasp, yaw, gripper_open=False, ignore_collisions=True),
            downwards(lift, yaw, gripper_open=False, ignore_collisions=True),
            downwards(goal, yaw, gripper_open=False, ignore_collisions=False),
        ]
