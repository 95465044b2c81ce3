"""What an agent is, and how it is found by name.

An agent is one file in `baselines/agents` or `sacil_agent/agents` with a module attribute
`AGENT = AgentSpec(...)`. Names come from the file names, so a listing imports nothing.
"""

import importlib
import importlib.util
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn

from baselines.batch import Batch, Inputs, Prediction
from baselines.configs import Fraction, Natural, Positive, Share, check_numbers
from baselines.scene.augment import AugmentConfig
from baselines.scene.sight import Sight
from baselines.text import TextSpec
from sacil_tasks.errors import UsageError, find_name

AGENT_PACKAGES = ("baselines.agents", "sacil_agent.agents")
"""Where agents live; named, not imported, because `sacil_agent` builds on this package."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a network is trained (D-recipe); shared by all agents so that tables compare methods."""

    samples: int = 120_000
    """Behaviour-cloning samples in all: the budget, whatever the machine's speed."""

    batch: int = 16
    """Samples of one step."""

    choice_share: Share | None = 0.6
    """Share of samples that show a keyframe at which the words decide where to go: the first one
    of each candidate to be handled (D-choice-share); None draws all keyframes alike."""

    lr: Positive = 6e-3
    """Peak learning rate of LAMB; settled on `val` (RVT's rule for its own size: 1e-4 a sample)."""

    warmup_steps: Natural = 200
    """Steps of linear warm-up before the cosine."""

    weight_decay: float = 1e-6
    """Decoupled weight decay on every tensor."""

    ema_decay: Fraction = 0.998
    """Decay of the weight average that is saved and evaluated; 0 takes the raw weights."""

    rotation_weight: float = 3.0
    """Weight of the rotation loss against the other terms."""

    rotation_sigma_bins: float = 1.5
    """Width of the circular Gaussian over the 72 rotation bins; 0 gives one-hot labels."""

    heatmap_sigma_px: Positive = 1.5
    """Width of the Gaussian over a view's pixels."""

    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """Random rigid moves of cloud and action together."""

    image_noise: float = 0.0
    """Largest amplitude of the uniform noise added to virtual views (RVT: 0.1)."""

    precision: Literal["fp32", "bf16"] = "fp32"
    """Arithmetic of forward and backward; weights and optimiser are always fp32."""

    text: str = "minilm"
    """Frozen text encoder: `minilm`, or `clip:<hub id or local folder>`."""

    def __post_init__(self) -> None:
        """Reject values that cannot train.

        Raises:
            UsageError: names the field, what it may be and what came.
        """
        check_numbers(self)
        if self.batch < 2:
            raise UsageError(f"recipe.batch must be at least 2 (two sizes), not {self.batch}.")
        if self.samples < self.batch:
            raise UsageError(
                f"recipe.samples ({self.samples}) is less than a batch ({self.batch})."
            )


def weighed(
    terms: Mapping[str, Tensor], weights: Mapping[str, float]
) -> tuple[Tensor, dict[str, Tensor]]:
    """Sum of a loss's terms, each times its weight (1 where none is given), and the bare terms."""
    total = torch.stack([weights.get(name, 1.0) * term for name, term in terms.items()]).sum()
    return total, {name: term.detach() for name, term in terms.items()}


class AgentConfig(Protocol):
    """What the trainer reads of an agent's config: a frozen dataclass of the agent's own."""

    @property
    def recipe(self) -> Recipe:
        """How to train it."""


class Network(nn.Module):
    """A keyframe predictor; dropout draws from torch's global generator, seeded every step."""

    sight: Sight
    """What it reads of a scene."""

    goal_sight: Sight | None = None
    """What `loss` reads of `Batch.goal`; None if it reads no goals."""

    @property
    def device(self) -> torch.device:
        """Where it computes; without weights on the CPU."""
        return next((weight.device for weight in self.parameters()), torch.device("cpu"))

    def load_pretrained(self) -> None:
        """Read weights made elsewhere, if there are any; called when a training run begins.

        Checkpoints hold them, so a trained network never needs their files.
        """

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The training loss, and its terms and diagnostics as detached scalars.

        A term that does not exist for this batch (an accuracy over no pairs) is NaN and is left
        out of the logged mean.
        """
        raise NotImplementedError

    def act(self, inputs: Inputs) -> Prediction:
        """The keyframe chosen for each observation; call in `eval` mode without gradients."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class AgentSpec:
    """Everything the trainer and the policies need to know about one agent."""

    name: str
    presets: Mapping[str, Any]
    """Named configs; the first is the default."""

    create: Callable[[Any, TextSpec], Network]
    """Config and text encoder's spec to a freshly initialised network."""

    variants: Mapping[str, Callable[[Any], Any]] = field(default_factory=dict)
    """Named ablations, each a change of the config."""

    def config(self, preset: str, variant: str | None = None) -> Any:
        """The config of `preset`, changed by `variant`.

        Raises:
            UsageError: no such preset or variant.
        """
        config = self.presets[find_name(preset, self.presets, f"preset of {self.name}")]
        return config if variant is None else self._change(variant)(config)

    def check_variant(self, variant: str | None, config: Any) -> None:
        """Refuse a config that is not what the variant's name says.

        Raises:
            UsageError: no such variant, or one of the fields that it sets has another value.
        """
        if variant is None:
            return
        given, meant = vars(config), vars(self._change(variant)(config))
        if wrong := [name for name in given if given[name] != meant[name]]:
            raise UsageError(
                f"{self.name}:{variant} means {', '.join(f'{n} {meant[n]}' for n in wrong)}, not "
                f"{', '.join(str(given[n]) for n in wrong)}. Take the agent without its variant."
            )

    def _change(self, variant: str) -> Callable[[Any], Any]:
        return self.variants[find_name(variant, self.variants, f"variant of {self.name}")]


@cache
def agent_modules() -> dict[str, str]:
    """Agent names and their modules, from the file names; nothing is imported."""
    found = {}
    for package in AGENT_PACKAGES:
        spec = importlib.util.find_spec(package)
        folders = spec.submodule_search_locations if spec else None
        for module in pkgutil.iter_modules(folders or []):
            found[module.name] = f"{package}.{module.name}"
    return found


def find_agent(name: str) -> tuple[AgentSpec, str | None]:
    """The spec of `name`, and the variant of `name:variant`.

    Raises:
        UsageError: no such agent or variant.
    """
    base, _, variant = name.partition(":")
    module = agent_modules()[find_name(base, agent_modules(), "agent")]
    spec: AgentSpec = importlib.import_module(module).AGENT
    if variant:
        find_name(variant, spec.variants, f"variant of {base}")
    elif name.endswith(":"):
        raise UsageError(f"'{name}' names no variant. Known: {', '.join(sorted(spec.variants))}.")
    return spec, variant or None
