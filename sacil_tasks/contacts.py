"""What the robot bumps into: an expert is clean only if it touches nothing it need not touch."""

from collections.abc import Callable, Sequence

import numpy as np
from mani_skill.agents.robots import Panda
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link
from sapien import physx

BRUSH_N = 0.2
"""Weaker contacts are not counted."""

_BASE_LINK = "panda_link0"
"""Stands on the table for good."""


class ContactLog:
    """Unwanted contacts since `restart`, read after each step of the simulation.

    Fingers may touch what a task lets them touch; nothing else of the robot may touch anything.
    Contacts can be listed on the CPU only; on the GPU the log stays empty.
    """

    def __init__(
        self, scene: ManiSkillScene, agent: Panda, touchable: Sequence[Actor | Link]
    ) -> None:
        """Watch the robot, whose fingers may touch `touchable`; lives as long as the scene."""
        self.forces_n: dict[tuple[str, str], float] = {}
        """Largest force (N) by robot link and what it touched."""
        self._scene = scene
        links = [link for name, link in agent.robot.links_map.items() if name != _BASE_LINK]
        self._robot = _bodies(links)
        self._fingers = _bodies([agent.finger1_link, agent.finger2_link])
        self._touchable = _bodies(touchable)

    def restart(self) -> None:
        """Forget the last episode."""
        self.forces_n.clear()

    def look(self, handles: Callable[[], Sequence[Link]]) -> None:
        """Take in the contacts now; fingers may touch `handles` too, asked for where it matters."""
        if self._scene.gpu_sim_enabled:
            return
        for contact in self._scene.get_contacts():
            first, second = contact.bodies
            if (first in self._robot) == (second in self._robot):
                continue
            link, thing = (first, second) if first in self._robot else (second, first)
            if link in self._fingers and (thing in self._touchable or thing in _bodies(handles())):
                continue
            self._note(link.entity.name, thing.entity.name, contact)

    def _note(self, link: str, thing: str, contact: physx.PhysxContact) -> None:
        impulse = np.sum([point.impulse for point in contact.points], axis=0)
        force_n = float(np.linalg.norm(impulse)) / self._scene.timestep
        if force_n > max(BRUSH_N, self.forces_n.get((link, thing), 0.0)):
            self.forces_n[link, thing] = force_n


def _bodies(items: Sequence[Actor | Link]) -> set[physx.PhysxRigidBaseComponent]:
    """ManiSkill has no public way to the bodies behind its batched objects."""
    return {item._bodies[0] for item in items}  # noqa: SLF001
