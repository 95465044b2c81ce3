"""Push two of three buttons, in the order in which their sizes are named."""

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Articulation, Link, Pose
from torch import Tensor

from sacil_tasks import props
from sacil_tasks.interface import Keyframe
from sacil_tasks.poses import downwards
from sacil_tasks.scenes import Layout
from sacil_tasks.simulation import writing_state
from sacil_tasks.sizes import CANDIDATES
from sacil_tasks.spec import TaskSpec
from sacil_tasks.table import SizedTableEnv

SPEC = TaskSpec(
    name="push_buttons",
    suites=("slice", "dual"),
    family="button",
    slots=("first", "second"),
    templates=(
        "push the {first} button, then push the {second} button",
        "press the {first} button, then the {second} one",
        "push down the {first} button and after that the {second} button",
    ),
    held_out_templates=("hit the {first} button first and the {second} button second",),
    keyframes=6,
    spacing_m=0.15,
    yaw_limit_deg=45.0,
)

PRESSED_M = -0.003
LATCHED_M = -0.006
PARKED_M = -0.1
_CAP_TOP_M = props.BUTTON_BASE_M + props.BUTTON_CAP_M


class PushButtonsEnv(SizedTableEnv):
    """
    **Task Description:**
    Three buttons that differ in size only are fixed to the table. Push the two whose sizes are
    named, in the order named. A pushed button stays down and gets a green mark.

    **Randomizations:**
    - button positions are uniform in [-0.22, 0.05] x [-0.28, 0.28], at least 0.15 m apart
    - button headings are uniform in +-45 degrees
    - sizes are three neighbouring rungs of a ladder, jittered; which button has which is uniform
    - one colour for all caps, out of 20; in half of the training scenes each has its own

    **Success Conditions:**
    - both named caps were pushed down by more than 3 mm, in the order named
    - strictly: the third was not pushed
    """

    task: ClassVar[TaskSpec] = SPEC

    def _build_candidate(
        self, index: int, name: str, size_m: float, rgb: props.Rgb
    ) -> Articulation:
        return props.build_button(self.scene, index, name, size_m, rgb)

    def _rest_height_m(self, sizes_m: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        return torch.zeros_like(sizes_m)

    def _load_extras(self) -> None:
        self.markers = [props.build_marker(self.scene, f"marker_{k}") for k in range(CANDIDATES)]

    def _place_extras(self, env_idx: Tensor, layouts: list[Layout]) -> None:
        for button in self.candidates:
            button.set_qpos(torch.zeros((len(env_idx), 1)))
        self._show_pressed(env_idx)

    def _touchable(self) -> list[Link]:
        return [button.links_map["cap"] for button in self.candidates]

    def _update_events(self) -> None:
        self._touch_and_carry()
        travel_m = torch.cat([button.qpos for button in self.candidates], dim=-1)
        if self.events.handle(travel_m < PRESSED_M).any():
            with writing_state(self.scene):
                self._show_pressed(torch.arange(self.num_envs, device=self.device))

    def _show_pressed(self, env_idx: Tensor) -> None:
        """Hold pressed caps down and mark them; called at the few steps at which this changes."""
        pressed = self.events.handle_order[env_idx] > 0
        for k, (button, marker) in enumerate(zip(self.candidates, self.markers, strict=True)):
            down = pressed[:, k]
            button.active_joints[0].set_drive_target(torch.where(down, LATCHED_M, 0.0))
            position = self.events.start[env_idx, k]
            position[:, 2] = torch.where(down, _CAP_TOP_M + LATCHED_M, PARKED_M)
            marker.set_pose(Pose.create_from_pq(position))

    def _lenient_success(self, targets: Int[Tensor, "b n"]) -> Bool[Tensor, "b"]:
        first, second = self.events.handle_order.gather(1, targets).unbind(-1)
        return (first > 0) & (second > first)

    def set_state_dict(self, state: dict, env_idx: Tensor | None = None) -> None:
        """Restore presses too: drive targets are not part of ManiSkill's state."""
        super().set_state_dict(state, env_idx)
        with writing_state(self.scene):
            # During a reset ManiSkill writes to the environments being reset only.
            self._show_pressed(self.scene._reset_mask.nonzero()[:, 0])  # noqa: SLF001

    def _expert_keyframes(self, choice: tuple[int, ...]) -> list[Keyframe]:
        keyframes = []
        for k in choice:
            (x, y, _), _ = self._start_pose(k)
            above, press = np.array([x, y, 0.10]), np.array([x, y, 0.0395])
            keyframes += [
                downwards(above, 0.0, gripper_open=False, ignore_collisions=False),
                downwards(press, 0.0, gripper_open=False, ignore_collisions=True),
                downwards(above, 0.0, gripper_open=False, ignore_collisions=True),
            ]
        return keyframes
