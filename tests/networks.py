"""Random batches and tiny configs: what the tests of every network share."""

from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from baselines.agent import Network
from baselines.batch import Batch, Inputs, Labels
from baselines.text import TextSpec

TEXT = TextSpec(name="minilm", dim=16, max_tokens=8, fingerprint="0" * 64)

TINY: dict[str, Any] = {
    "pixels": 32,
    "pyramid": (8, 8, 8),
    "stem_channels": 16,
    "lowered_channels": 16,
    "proprio_channels": 16,
    "head_hidden": (64, 64),
    "width": 32,
    "heads": 2,
    "head_width": 16,
    "hidden": 32,
    "dropout": 0.0,
}
"""Sizes by field name; a config takes those it has."""


def tiny(config: Any) -> Any:
    """`config` at sizes that train in seconds, in full precision."""
    known = {field.name for field in fields(config)}
    sizes = {name: size for name, size in TINY.items() if name in known}
    return replace(config, **sizes, recipe=replace(config.recipe, precision="fp32"))


def make_batch(pixels: int, *, size: int = 4, goals: bool = True, seed: int = 0) -> Batch:
    """A random batch: two tasks with sizes by turns; sentences of 2 to 6 tokens."""
    rng = torch.Generator().manual_seed(seed)
    index = torch.arange(size)
    task, slot = index % 2, index // 2 % 3
    return Batch(
        inputs=make_inputs(pixels, size=size, seed=seed),
        labels=Labels(
            position_in_cube=1.6 * torch.rand(size, 3, generator=rng) - 0.8,
            rotation_bins=torch.randint(72, (size, 3), generator=rng),
            gripper_open=torch.randint(2, (size,), generator=rng),
            ignore_collisions=torch.randint(2, (size,), generator=rng),
        ),
        goal_views=random_views(size, pixels, rng) if goals else None,
        task=task,
        meaning=3 * task + slot,
        trajectory=index,
        first=index % 3 == 0,
    )


def make_inputs(pixels: int, *, size: int = 4, seed: int = 0) -> Inputs:
    """Random views, words and proprioception."""
    rng = torch.Generator().manual_seed(seed + 1)
    lengths = 2 + torch.arange(size) % 5
    mask = torch.arange(TEXT.max_tokens) < lengths[:, None]
    words = torch.randn(size, TEXT.max_tokens, TEXT.dim, generator=rng)
    return Inputs(
        views=random_views(size, pixels, rng),
        proprio=torch.rand(size, 2, generator=rng),
        text=words * mask[..., None],
        text_mask=mask,
    )


def random_views(size: int, pixels: int, rng: torch.Generator) -> Tensor:
    """Noise in the shape of virtual views."""
    return 2 * torch.rand(size, 5, 7, pixels, pixels, generator=rng) - 1


def row(inputs: Inputs, index: int) -> Inputs:
    """One sample of a batch, as a batch of one."""
    return Inputs(**{name: value[index : index + 1] for name, value in vars(inputs).items()})


def changed(inputs: Inputs, **values: Tensor) -> Inputs:
    """The inputs with some fields exchanged."""
    return replace(inputs, **values)


def gradients(network: Network) -> dict[str, Tensor]:
    """Gradients by parameter name, of the parameters that have one."""
    named = network.named_parameters()
    return {name: p.grad.clone() for name, p in named if p.grad is not None}
