"""Random batches and tiny configs: what the tests of every network share."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from synthetic import observation
from torch import Tensor

from baselines.agent import Network, agent_modules, find_agent
from baselines.batch import Batch, Inputs, Labels
from baselines.loader import inputs_of
from baselines.rotation import canonical_yaw, quaternion_to_bins
from baselines.scene.cloud import point_maps
from baselines.scene.sight import Moment, Sight
from baselines.scene.views import cube_from_base
from baselines.text import TextSpec

TEXT = TextSpec(name="minilm", dim=16, max_tokens=8, fingerprint="0" * 64)

TINY: dict[str, Any] = {
    "pixels": 32,
    "pyramid": (8, 8, 8),
    "stem_channels": 16,
    "lowered_channels": 16,
    "proprio_channels": 16,
    "head_hidden": (64, 64),
    "convex_channels": 16,
    "width": 32,
    "heads": 2,
    "head_width": 16,
    "hidden": 32,
    "points": 256,
    "stages": (128, 64, 32, 16),
    "neighbours": 8,
    "embedding": 48,
    "trunk_channels": (16, 16, 16),
    "channels": (8, 8, 8, 8),
    "pose_channels": 16,
    "dropout": 0.0,
}
"""Sizes by field name; a config takes those it has."""


def registered() -> list[str]:
    """Every agent and every `agent:variant`."""
    names = []
    for agent in sorted(agent_modules()):
        spec, _ = find_agent(agent)
        names += [agent, *(f"{agent}:{variant}" for variant in spec.variants)]
    return names


def tiny(config: Any) -> Any:
    """`config` at sizes that train in seconds, in full precision."""
    known = {field.name for field in fields(config)}
    sizes = {name: size for name, size in TINY.items() if name in known}
    return replace(config, **sizes, recipe=replace(config.recipe, precision="fp32"))


def make_batch(sight: Sight, *, size: int = 4, goals: Sight | None = None, seed: int = 0) -> Batch:
    """A random batch: two tasks with sizes by turns; sentences of 2 to 6 tokens.

    Where to go is red, the rest is grey noise.
    """
    rng = np.random.default_rng(seed)
    index = torch.arange(size)
    task, slot = index % 2, index // 2 % 3
    moments, targets = zip(*(_painted(rng) for _ in index), strict=True)
    turns = canonical_yaw(Rotation.random(size, rng).as_quat(scalar_first=True))
    return Batch(
        inputs=make_inputs(sight, size=size, seed=seed, moments=moments),
        labels=Labels(
            position_in_cube=torch.tensor(np.stack(targets)),
            quaternion_wxyz=torch.tensor(turns, dtype=torch.float32),
            rotation_bins=torch.from_numpy(quaternion_to_bins(turns)),
            gripper_open=torch.tensor(rng.integers(2, size=size)),
            ignore_collisions=torch.tensor(rng.integers(2, size=size)),
        ),
        task=task,
        meaning=3 * task + slot,
        trajectory=index,
        first=index % 3 == 0,
        goal=None if goals is None else goals.look(random_moments(size, seed + 1)),
    )


def make_inputs(
    sight: Sight, *, size: int = 4, seed: int = 0, moments: Sequence[Moment] | None = None
) -> Inputs:
    """Random words for `moments`, by default random ones."""
    rng = np.random.default_rng(seed + 2)
    mask = np.arange(TEXT.max_tokens) < 2 + np.arange(size)[:, None] % 5
    words = rng.normal(size=(size, TEXT.max_tokens, TEXT.dim)).astype(np.float32)
    seen = moments or random_moments(size, seed)
    return inputs_of(sight, seen, words * mask[..., None], mask)


def random_moments(size: int, seed: int = 0) -> list[Moment]:
    """Observations of noise at different steps, each with a history."""
    rng = np.random.default_rng(seed)
    episode = [observation(rng, step) for step in range(4)]
    return [Moment(episode[i % 4], before=episode[: i % 4], seed=i) for i in range(size)]


def blank_moments(size: int, points: int = 0) -> list[Moment]:
    """Observations that show nothing, or so many points."""
    seen = observation(np.random.default_rng(0), 0)
    depth_mm = np.zeros_like(seen.depth_mm)
    depth_mm[0, 64, 64 : 64 + points] = 600
    return [Moment(replace(seen, depth_mm=depth_mm)) for _ in range(size)]


def _painted(rng: np.random.Generator) -> tuple[Moment, np.ndarray]:
    """Grey noise with a red spot, and where in the cube the spot is."""
    seen = observation(rng, int(rng.integers(3)))
    row, column = rng.integers(32, 96, 2)
    spot = slice(row - 4, row + 5), slice(column - 4, column + 5)
    rgb, depth_mm = np.repeat(seen.rgb[..., :1] // 4, 3, -1), seen.depth_mm.copy()
    rgb[:, *spot], depth_mm[:, *spot] = (255, 0, 0), rng.integers(550, 850)
    maps, _ = point_maps(depth_mm, seen.intrinsics, seen.camera_in_base, cube_from_base())
    return Moment(replace(seen, rgb=rgb, depth_mm=depth_mm)), maps[0, :, row, column]


def row(part: Any, index: int) -> Any:
    """One sample of a dataclass of tensors, as a batch of one."""
    return rows(part, slice(index, index + 1))


def rows(part: Any, which: slice) -> Any:
    """Some samples of a dataclass of tensors."""
    if is_dataclass(part):
        return replace(part, **{name: rows(value, which) for name, value in vars(part).items()})
    return None if part is None else part[which]


def changed(inputs: Inputs, **values: Tensor) -> Inputs:
    """The inputs with some fields exchanged."""
    return replace(inputs, **values)


def gradients(network: Network) -> dict[str, Tensor]:
    """Gradients by parameter name, of the parameters that have one."""
    named = network.named_parameters()
    return {name: p.grad.clone() for name, p in named if p.grad is not None}
