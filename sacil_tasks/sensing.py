"""Where candidates are and how fingers press on them, cheap enough for every control step.

On one CPU environment a control step takes a quarter of a millisecond, so what is read after each
goes past ManiSkill's batched views, straight to the few bodies that matter.
"""

from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from mani_skill.agents.robots import Panda
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation, Link
from torch import Tensor

Candidate: TypeAlias = Actor | Articulation


class CandidateSensor:
    """Reads positions of the candidates and finger forces on them, for every environment."""

    def __init__(
        self,
        scene: ManiSkillScene,
        agent: Panda,
        candidates: list[Candidate],
        touchable: list[Actor | Link],
    ) -> None:
        """Watch `candidates`, of each of which the fingers act on one body in `touchable`.

        Lives as long as the scene.
        """
        self.batched = scene.gpu_sim_enabled
        """True on the GPU, where asking whether something changed costs more than using it."""
        self._scene = scene
        self._hand = agent.tcp
        self._fingers = [agent.finger1_link, agent.finger2_link]
        self._candidates = candidates
        self._touchable = touchable
        if not self.batched:
            self._entities = [item._objs[0] for item in candidates]  # noqa: SLF001
            self._finger_of = _bodies(self._fingers)
            self._candidate_of = _bodies(touchable)

    def positions(self) -> Float[Tensor, "b 3 3"]:
        """Candidate origins now, in the world frame (m)."""
        if self.batched:
            return torch.stack([candidate.pose.p for candidate in self._candidates], dim=1)
        return torch.from_numpy(np.array([[entity.pose.p for entity in self._entities]]))

    def quaternions(self) -> Float[Tensor, "b 3 4"]:
        """Candidate orientations now, wxyz in the world frame."""
        if self.batched:
            return torch.stack([candidate.pose.q for candidate in self._candidates], dim=1)
        return torch.from_numpy(np.array([[entity.pose.q for entity in self._entities]]))

    def forces_n(self) -> Float[Tensor, "b 2 3 3"] | None:
        """Force of each finger on each candidate (N, world frame); None if none touches."""
        if self.batched:
            return torch.stack([self._finger_forces_n(finger) for finger in self._fingers], dim=1)
        impulses = np.zeros((1, 2, 3, 3), dtype=np.float32)
        touched = False
        for contact in self._scene.get_contacts():
            first, second = contact.bodies
            sign = 1.0
            if first in self._candidate_of:
                first, second, sign = second, first, -1.0
            finger, candidate = self._finger_of.get(first), self._candidate_of.get(second)
            if finger is None or candidate is None:
                continue
            touched = True
            for point in contact.points:
                impulses[0, finger, candidate] += sign * point.impulse
        return torch.from_numpy(impulses / self._scene.timestep) if touched else None

    def closing(self) -> Float[Tensor, "b 3"]:
        """Direction in the world from the right finger to the left one: y of the gripper."""
        w, x, y, z = self._hand.pose.q.unbind(-1)
        return torch.stack(
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1
        )

    def _finger_forces_n(self, finger: Link) -> Float[Tensor, "b 3 3"]:
        forces_n = [self._scene.get_pairwise_contact_forces(finger, c) for c in self._touchable]
        return torch.stack(forces_n, dim=1)


def _bodies(items: list[Link] | list[Actor | Link]) -> dict:
    return {body: k for k, item in enumerate(items) for body in item._bodies}  # noqa: SLF001
