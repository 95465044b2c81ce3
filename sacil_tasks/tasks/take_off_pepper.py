"""Take the pepper of the named size off the scale and set it down on the table."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int
from mani_skill.utils.structs import Actor
from torch import Tensor

from sacil_tasks import fixtures, props
from sacil_tasks.interface import Keyframe
from sacil_tasks.placing import PlacingEnv, seen_from
from sacil_tasks.poses import downwards, grasp_height_m
from sacil_tasks.spec import Fixture, TaskSpec

SPEC = TaskSpec(
    name="take_off_pepper",
    suites=("single",),
    family="pepper",
    slots=("size",),
    templates=(
        "take the {size} pepper off the scales",
        "remove the {size} pepper from the scales and place it on the table",
        "lift the {size} pepper off the tray and set it down on the table",
        "move the {size} pepper to the table",
    ),
    held_out_templates=(
        "unload the {size} pepper",
        "the {size} pepper should not be weighed, put it on the table",
    ),
    keyframes=6,
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

DROP_XY_M = ((-0.06, 0.14), (-0.06, 0.27))
"""Where the expert sets down the first and the second pepper."""


class TakeOffPepperEnv(PlacingEnv):
    """
    **Task Description:**
    Three bell peppers that differ in size only stand on the pan of a scale. Take the one whose
    size is named off the scale and set it down on the table.

    **Randomizations:**
    - the scale stands within 0.03 m of (-0.06, -0.18) along each axis, turned by up to 20 degrees
    - peppers stand within 0.012 m of three spots of the pan along each axis, in any order; the
      pattern of the spots is turned by half a turn in half of the scenes
    - pepper headings are uniform in +-45 degrees
    - sizes are three neighbouring rungs of a ladder, jittered; which pepper has which is uniform
    - one colour for all peppers, out of 20; in half of the training scenes each has its own

    **Success Conditions:**
    - the named pepper was picked up, lies at rest on the table beside the pan and is let go
    - no other pepper is on the table
    - strictly: no other pepper was acquired or displaced
    """

    task: ClassVar[TaskSpec] = SPEC

    def _build_candidate(self, index: int, name: str, size_m: float, rgb: props.Rgb) -> Actor:
        return props.build_pepper(self.scene, index, name, size_m, rgb)

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        return fixtures.PAN_TOP_M + props.pepper_height_m(sizes_m) / 2

    def _load_extras(self) -> None:
        self.fixture = fixtures.build_scale(self.scene, "scale")

    def _receptacles(self) -> Int[Tensor, "b 3"]:
        """0: the table beside the pan; upright or not, but not under the table."""
        positions = self._sensor.positions()
        beside_m = seen_from(self.fixture, positions)[..., :2].abs()
        beside = (beside_m > beside_m.new_tensor(fixtures.PAN_HALF_M)).any(-1)
        height_m = positions[..., 2]
        on_table = (height_m > 0) & (height_m < 0.6 * self._sizes_m + 0.01)
        return (on_table & beside).long() - 1

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        keyframes = []
        for k, spot_m in zip(choice, DROP_XY_M, strict=False):
            (x, y, _), _ = self._start_pose(k)
            yaw, height_m = self._roomy_yaw(k), props.pepper_height_m(self.sizes_m[k])
            grasp_m = grasp_height_m(height_m)
            high, low = np.array([x, y, 0.30]), np.array([x, y, fixtures.PAN_TOP_M + grasp_m])
            # Closing along x, so that the palm stays clear of a pepper set down before.
            over, down = np.array([*spot_m, 0.25]), np.array([*spot_m, grasp_m + 0.006])
            keyframes += [
                downwards(high, yaw, gripper_open=True, ignore_collisions=False),
                downwards(low, yaw, gripper_open=False, ignore_collisions=True),
                downwards(high, yaw, gripper_open=False, ignore_collisions=True),
                downwards(over, np.pi / 2, gripper_open=False, ignore_collisions=False),
                downwards(down, np.pi / 2, gripper_open=True, ignore_collisions=True),
                downwards(over, np.pi / 2, gripper_open=True, ignore_collisions=True),
            ]
        return keyframes
