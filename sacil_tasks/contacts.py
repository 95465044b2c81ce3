"""Finger forces on the candidates, cheap enough to be read after every control step."""

import numpy as np
import torch
from jaxtyping import Float
from mani_skill.agents.robots import Panda
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.geometry.rotation_conversions import quaternion_apply
from mani_skill.utils.structs import Actor, Link
from torch import Tensor


class FingerContacts:
    """Reads forces between both fingers and the three candidates of every environment."""

    def __init__(self, scene: ManiSkillScene, agent: Panda, candidates: list[Actor | Link]) -> None:
        """Watch the fingers of `agent` and these candidates; lives as long as the scene."""
        self._scene = scene
        self._hand = agent.tcp
        self._fingers = (agent.finger1_link, agent.finger2_link)
        self._candidates = candidates
        if not scene.gpu_sim_enabled:
            self._finger_of = _bodies(self._fingers)
            self._candidate_of = _bodies(candidates)

    def forces_n(self) -> Float[Tensor, "b 2 3 3"] | None:
        """Force of each finger on each candidate (N, world frame); None if none touches."""
        if self._scene.gpu_sim_enabled:
            return self._batched_forces_n()
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
        """Direction in the world along which the left finger opens."""
        axis = torch.tensor([[0.0, 1.0, 0.0]], device=self._scene.device)
        quaternion = self._hand.pose.q
        return quaternion_apply(quaternion, axis.expand(len(quaternion), 3))

    def _batched_forces_n(self) -> Float[Tensor, "b 2 3 3"]:
        return torch.stack(
            [
                torch.stack(
                    [self._scene.get_pairwise_contact_forces(f, c) for c in self._candidates], dim=1
                )
                for f in self._fingers
            ],
            dim=1,
        )


def _bodies(objects: tuple[Link, ...] | list[Actor | Link]) -> dict:
    return {body: k for k, item in enumerate(objects) for body in item._bodies}  # noqa: SLF001
