"""Tasks that put what is named somewhere: what they share beyond the table."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from mani_skill.utils.structs import Actor, Articulation, Link, Pose
from torch import Tensor

from sacil_tasks.poses import roomy_yaw, upright
from sacil_tasks.scenes import Layout
from sacil_tasks.sizes import CANDIDATES
from sacil_tasks.table import SizedTableEnv


class PlacingEnv(SizedTableEnv):
    """Base of tasks that end with the named candidates lying where they belong.

    A task builds `fixture` in `_load_extras` and tells in `_receptacles` where candidates lie.
    """

    fixture: Actor | Articulation
    """The furniture that `task.fixture` places."""

    def _place_extras(self, env_idx: Tensor, layouts: list[Layout]) -> None:
        place = self._to_tensor([layout.fixture for layout in layouts])
        position = torch.cat([place[:, :2], torch.zeros_like(place[:, :1])], dim=-1)
        self.fixture.set_pose(Pose.create_from_pq(position, upright(place[:, 2])))

    def _lenient_success(self, targets: Int[Tensor, "b n"]) -> Bool[Tensor, "b"]:
        """All named ones rest where they belong, let go, in order of pick-up; no other is there."""
        order = self.events.handle_order.gather(1, targets)
        in_order = (order > 0).all(-1) & (order.diff(dim=-1) > 0).all(-1)
        if not (self._sensor.batched or in_order.any()):
            return in_order
        places = self._receptacles()
        still = torch.stack([candidate.is_static(0.01) for candidate in self.candidates], dim=-1)
        done = self._belongs(places) & still & ~self.events.grasped.any(-1, keepdim=True)
        return in_order & done.gather(1, targets).all(-1) & ~((places >= 0) & self._unnamed).any(-1)

    def _belongs(self, places: Int[Tensor, "b 3"]) -> Bool[Tensor, "b 3"]:
        """Whether a candidate that lies in a place (-1: in none) is where a named one should be."""
        return places >= 0

    def _get_obs_extra(self, info: dict) -> dict[str, Tensor]:
        extra = super()._get_obs_extra(info)
        if self.obs_mode_struct.use_state:
            extra["fixture_pose"] = self.fixture.pose.raw_pose
        return extra

    def _roomy_yaw(self, k: int) -> float:
        """Gripper yaw for candidate `k` of environment 0, away from the other two."""
        (here, heading), *others = [
            self._start_pose(i % CANDIDATES) for i in range(k, k + CANDIDATES)
        ]
        return roomy_yaw(heading, np.array([position[:2] - here[:2] for position, _ in others]))

    def _on_fixture(self, point_m: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        """A point of the fixture's frame in the world, in environment 0."""
        matrix = self.fixture.pose.to_transformation_matrix()[0].cpu().numpy().astype(np.float64)
        return matrix[:3, :3] @ point_m + matrix[:3, 3]

    def _fixture_yaw(self) -> float:
        """Heading of the fixture (rad) in environment 0."""
        ahead = self._on_fixture(np.array([1.0, 0.0, 0.0])) - self._on_fixture(np.zeros(3))
        return float(np.arctan2(ahead[1], ahead[0]))


def seen_from(
    frame: Actor | Articulation | Link, points_m: Float[Tensor, "b n 3"]
) -> Float[Tensor, "b n 3"]:
    """Points of the world in the frame of a body."""
    matrix = frame.pose.to_transformation_matrix()
    return (points_m - matrix[:, None, :3, 3]) @ matrix[:, :3, :3]
