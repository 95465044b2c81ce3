"""Put the cup of the named size over a peg of the cup holder."""

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from mani_skill.utils.structs import Actor
from torch import Tensor

from sacil_tasks import fixtures, props
from sacil_tasks.interface import Keyframe
from sacil_tasks.placing import PlacingEnv, seen_from
from sacil_tasks.poses import downwards, grasp_height_m
from sacil_tasks.spec import Fixture, TaskSpec

SPEC = TaskSpec(
    name="place_cup",
    suites=("single",),
    family="cup",
    slots=("size",),
    templates=(
        "place the {size} cup on the cup holder",
        "put the {size} cup on the holder",
        "move the {size} cup from the table to the cup holder",
        "pick up the {size} cup and set it on a peg",
    ),
    held_out_templates=(
        "hang the {size} mug up on the rack",
        "the {size} cup belongs on the holder",
    ),
    keyframes=6,
    spacing_m=0.13,
    yaw_limit_deg=180.0,
    region_m=((-0.22, 0.05), (0.0, 0.28)),
    fixture=Fixture(xy_m=(-0.06, -0.20), shift_m=0.03, yaw_deg=((-20.0, 20.0),)),
    clutter_region_m=((-0.24, 0.09), (0.0, 0.31)),
)

CARRY_M = 0.22
"""Height of the gripper while it carries a cup."""

SEATED_M = 0.006
"""Largest gap between rim and plate."""

_UPSIDE_DOWN = -np.cos(np.deg2rad(10))
"""A cup that leans less points down at least this much."""


class PlaceCupEnv(PlacingEnv):
    """
    **Task Description:**
    Three cups that differ in size only stand upside down on the table, beside a holder with three
    pegs. Put the one whose size is named over a peg. D-pegs.

    **Randomizations:**
    - cup positions are uniform in [-0.22, 0.05] x [0, 0.28], at least 0.13 m apart
    - handles point anywhere
    - the holder stands within 0.03 m of (-0.06, -0.20) along each axis, turned by up to 20 degrees
    - sizes are three neighbouring rungs of a ladder, jittered; which cup has which is uniform
    - one colour for all cups, out of 20; in half of the training scenes each has its own

    **Success Conditions:**
    - the named cup was picked up and is at rest over a peg: the peg is inside it, its rim lies on
      the plate, it leans by less than 10 degrees; it is let go
    - no other cup is over a peg
    - strictly: no other cup was acquired or displaced
    """

    task: ClassVar[TaskSpec] = SPEC

    def _build_candidate(self, index: int, name: str, size_m: float, rgb: props.Rgb) -> Actor:
        return props.build_cup(self.scene, index, name, size_m, rgb)

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        return props.cup_height_m(sizes_m) / 2

    def _rest_quaternions(self, yaw_rad: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 4"]:
        """Upside down: half a turn about the handle's axis."""
        nothing = torch.zeros_like(yaw_rad)
        return torch.stack([nothing, (yaw_rad / 2).cos(), (yaw_rad / 2).sin(), nothing], dim=-1)

    def _load_extras(self) -> None:
        self.fixture = fixtures.build_rack(self.scene, "rack")

    def _receptacles(self) -> Int[Tensor, "b 3"]:
        """Which peg each cup is over."""
        seen_m = seen_from(self.fixture, self._sensor.positions())
        pegs_m = seen_m.new_tensor([[x_m, 0.0] for x_m in fixtures.PEGS_M])
        nearest = (seen_m[..., None, :2] - pegs_m).norm(dim=-1).min(-1)
        rim_m = seen_m[..., 2] - props.cup_height_m(self._sizes_m) / 2
        flat = (rim_m - fixtures.PLATE_TOP_M).abs() < SEATED_M
        upright = 1 - 2 * self._sensor.quaternions()[..., 1:3].square().sum(-1)
        seated = flat & (nearest.values < self._sizes_m / 2) & (upright < _UPSIDE_DOWN)
        return torch.where(seated, nearest.indices, -1)

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        keyframes = []
        row_yaw = self._fixture_yaw()
        # The hand opens across the row: the palm would reach over a neighbouring peg's cup.
        for k, peg_m in zip(choice, fixtures.PEGS_M, strict=False):
            height_m = props.cup_height_m(self.sizes_m[k])
            at, heading = self._start_pose(k)
            yaw = props.cup_grasp_yaw(heading)
            grasp_m = grasp_height_m(height_m)
            peg = self._on_fixture(np.array([peg_m, 0.0, fixtures.PLATE_TOP_M]))
            above, high = np.array([*at[:2], height_m + 0.08]), np.array([*at[:2], CARRY_M])
            over = np.array([*peg[:2], CARRY_M])
            grasp = np.array([*at[:2], grasp_m])
            down = peg + np.array([0.0, 0.0, grasp_m + 0.004])
            keyframes += [
                downwards(above, yaw, gripper_open=True, ignore_collisions=False),
                downwards(grasp, yaw, gripper_open=False, ignore_collisions=True),
                downwards(high, yaw, gripper_open=False, ignore_collisions=True),
                downwards(over, row_yaw, gripper_open=False, ignore_collisions=False),
                downwards(down, row_yaw, gripper_open=True, ignore_collisions=True),
                downwards(over, row_yaw, gripper_open=True, ignore_collisions=True),
            ]
        return keyframes
