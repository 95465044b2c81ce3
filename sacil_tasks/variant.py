"""A split at work in the simulator: what it builds, adds, leaves out and lets be heard."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Pose
from torch import Tensor

from sacil_tasks import props, wording
from sacil_tasks.contents import clutter_xy_m, draw_contents
from sacil_tasks.instructions import Slots
from sacil_tasks.scenes import Layout
from sacil_tasks.spec import TaskSpec
from sacil_tasks.splits import SPLITS

AWAY_M = (10.0, 0.0, -5.0)
"""From a place on the table to the one on the shelf: in no camera's view, out of reach."""

_SHELF_HALF_M = (1.0, 1.5, 0.05)

_BUILD: dict[str, Callable[[ManiSkillScene, int, str, float, props.Rgb], Actor]] = {
    "block": props.build_block,
    "cup": props.build_cup,
}
_HEIGHT_M: dict[str, Callable[[float], float]] = {
    "block": lambda size_m: size_m,
    "cup": props.cup_height_m,
}


class Variant:
    """The contents of all parallel scenes under one split, until they are rebuilt."""

    def __init__(self, task: TaskSpec, split: str, seeds: Iterable[int]) -> None:
        """Draw what is to be built; nothing is built yet."""
        self.split = split
        self._task, self._rules = task, SPLITS[split]
        self._contents = [draw_contents(task, split, int(seed)) for seed in seeds]
        self._clutters = [it.clutter for it in self._contents if it.clutter is not None]
        self._clutter: Actor | None = None

    @property
    def labels(self) -> Int64[np.ndarray, "b 3"]:
        """Rank of each candidate's size."""
        return np.stack([content.labels for content in self._contents])

    @property
    def sizes_m(self) -> Float64[np.ndarray, "b 3"]:
        """Size of each candidate."""
        return np.stack([content.sizes_m for content in self._contents])

    def rgb(self, k: int) -> list[Float64[np.ndarray, "3"]]:
        """Colour of candidate `k` in every scene."""
        return [content.rgb[k] for content in self._contents]

    def present(self, named: Bool[Tensor, "b 3"]) -> Bool[Tensor, "b 3"]:
        """Candidates that are on the table when those `named` are."""
        if self._rules.objects == "named":
            return named
        present = np.stack([content.present for content in self._contents])
        return torch.as_tensor(present, device=named.device)

    def build(self, scene: ManiSkillScene) -> None:
        """Build what only this split has; after all else, so that no other split notices."""
        if self._rules.clutter:
            self._clutter = props.build_each(
                scene, "clutter", lambda i, name: self._build_clutter(scene, i, name)
            )
        if self._rules.objects != "all":
            _build_shelf(scene)

    def place(self, env_idx: Tensor, layouts: Sequence[Layout], seeds: Sequence[int]) -> None:
        """Stand the clutter upright on the table."""
        if self._clutter is None:
            return
        rows = []
        for i, layout, seed in zip(env_idx.tolist(), layouts, seeds, strict=True):
            clutter = self._clutters[i]
            height_m = _HEIGHT_M[clutter.family](clutter.size_m)
            rows.append([*clutter_xy_m(self._task, layout, seed), height_m / 2])
        position = torch.as_tensor(rows, dtype=torch.float32, device=env_idx.device)
        self._clutter.set_pose(Pose.create_from_pq(position))

    def say(self, i: int, slots: Slots, template: int, seed: int) -> str:
        """The instruction of scene `i`."""
        colour_of = self._contents[i].colour_of
        return wording.say(self._task, self.split, slots, template, seed=seed, colour_of=colour_of)

    def clutter_in_world(self) -> Float32[np.ndarray, "n 3"]:
        """Where the clutter of environment 0 is now (m); n is 0 or 1."""
        if self._clutter is None:
            return np.zeros((0, 3), dtype=np.float32)
        return self._clutter.pose.p[:1].cpu().numpy()

    def _build_clutter(self, scene: ManiSkillScene, i: int, name: str) -> Actor:
        clutter, rgb = self._clutters[i], self._contents[i].rgb[0]
        return _BUILD[clutter.family](scene, i, name, clutter.size_m, rgb.tolist())


def _build_shelf(scene: ManiSkillScene) -> Actor:
    """Where candidates lie that are left out; nobody sees it."""
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=_SHELF_HALF_M)
    x, y, z = AWAY_M
    builder.initial_pose = sapien.Pose([x, y, z - _SHELF_HALF_M[2]])
    return builder.build_static(name="shelf")
