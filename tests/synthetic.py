"""Tiny keyframe files in the real schema, and a tiny agent: what the trainer's tests run on."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from baselines.agent import AgentSpec, Network, Recipe
from baselines.batch import Batch, Inputs, Prediction
from baselines.scene.sight import ViewSight
from baselines.text import TextSpec, Tokens, text_spec
from sacil_tasks.interface import SCENE_BOUNDS, Keyframe, Observation
from sacil_tasks.keyframes import Episode, KeyframeDemo, KeyframeMeta, write_keyframes

SIZES = ("small", "medium", "large")
DOWN = np.array([0.0, 1.0, 0.0, 0.0])
KEYFRAMES = 3


def write_file(
    data: Path, task: str, *, demos: int = 6, partition: str = "train", seed: int = 0
) -> Path:
    """Write `<data>/canon/<partition>/keyframes/<task>.h5`; sizes take turns."""
    rng = np.random.default_rng([seed, len(task)])
    path = data / "canon" / partition / "keyframes" / f"{task}.h5"
    meta = KeyframeMeta(
        task=task,
        env_id="Synthetic-v1",
        split="canon",
        partition=partition,
        scene_set=0,
        suites={"slice": [task]},
        code_version="test",
        demos_sha256="0" * 64,
    )
    write_keyframes(path, [demo(rng, index) for index in range(demos)], meta)
    return path


def demo(rng: np.random.Generator, index: int) -> KeyframeDemo:
    """Go above a candidate, down to it, and up again."""
    target = index % 3
    candidates = np.array([[0, -0.2, -0.2], [0, 0, -0.2], [0, 0.2, -0.2]])
    candidates += SCENE_BOUNDS.center_in_base
    candidates[:, 0] += rng.uniform(-0.1, 0.1, 3)
    heights = (0.1, 0.0, 0.2)
    keyframes = [
        Keyframe(candidates[target] + [0, 0, height], DOWN, step == 0, step == 1)
        for step, height in enumerate(heights)
    ]
    return KeyframeDemo(
        episode=Episode(
            instruction=f"lift  the {SIZES[target]} block" + " please" * (index % 2),
            slots={"size": SIZES[target]},
            variation=target,
            template=index % 2,
            scene_index=index,
            env_seed=index,
            sizes_m=np.array([0.03, 0.04, 0.05], np.float32),
        ),
        observations=[observation(rng, step) for step in range(KEYFRAMES + 1)],
        keyframes=keyframes,
        targets=[target] * KEYFRAMES,
        candidate_in_base=np.repeat(candidates[None], KEYFRAMES + 1, 0).astype(np.float32),
    )


def observation(rng: np.random.Generator, step: int) -> Observation:
    """Four cameras that look straight down at noise; a quarter of the pixels saw nothing."""
    camera = np.diag([1.0, -1.0, -1.0, 1.0])
    camera[:3, 3] = SCENE_BOUNDS.center_in_base
    camera[2, 3] += 0.6
    depth = rng.integers(500, 900, (4, 128, 128))
    return Observation(
        rgb=rng.integers(0, 256, (4, 128, 128, 3), np.uint8),
        depth_mm=np.where(rng.random(depth.shape) < 0.25, 0, depth).astype(np.uint16),
        intrinsics=np.tile(np.float32([[128, 0, 64], [0, 128, 64], [0, 0, 1]]), (4, 1, 1)),
        camera_in_base=np.tile(camera.astype(np.float32), (4, 1, 1)),
        tcp_in_base=np.r_[SCENE_BOUNDS.center_in_base, DOWN].astype(np.float32),
        gripper_open=step < 2,
        step=step,
        max_steps=25,
    )


class Letters:
    """Stands in for the encoder `minilm`: a token a word, its letters counted."""

    spec = text_spec("minilm")

    def encode(self, sentence: str) -> Tokens:
        tokens = np.zeros((len(sentence.split()), self.spec.dim), np.float16)
        for row, word in enumerate(sentence.split()):
            np.add.at(tokens[row], [ord(letter) for letter in word], 1)
        return tokens


@dataclass(frozen=True, kw_only=True)
class TinyConfig:
    """A linear network over pooled views, with dropout so that randomness shows."""

    pixels: int = 16
    goals: bool = False
    dropout: float = 0.3
    recipe: Recipe = field(default_factory=lambda: Recipe(batch=4, samples=48, warmup_steps=2))


class Tiny(Network):
    """Regresses the position; enough to see what the trainer does."""

    def __init__(self, config: TinyConfig, text: TextSpec) -> None:
        super().__init__()
        self.sight = ViewSight(config.pixels)
        self.goal_sight = self.sight if config.goals else None
        self.dropout = nn.Dropout(config.dropout)
        self.position = nn.Linear(5 * 7 + 2 + text.dim, 3)

    def forward(self, inputs: Inputs) -> torch.Tensor:
        pooled = inputs.scene.views.mean((-1, -2)).flatten(1)
        words = inputs.text.sum(1) / inputs.text_mask.sum(1, keepdim=True)
        return self.position(self.dropout(torch.cat([pooled, inputs.proprio, words], 1)))

    def loss(self, batch: Batch) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        position = (self(batch.inputs) - batch.labels.position_in_cube).square().mean()
        goal = position * 0 if batch.goal is None else batch.goal.views.mean()
        terms = {"position": position, "goal": goal, "never": torch.tensor(torch.nan)}
        return position + 0 * goal, {name: term.detach() for name, term in terms.items()}

    def act(self, inputs: Inputs) -> Prediction:
        position = self(inputs)
        flags = torch.zeros(len(position), dtype=torch.bool)
        down = torch.tensor(DOWN, dtype=torch.float32).expand(len(position), 4)
        return Prediction(position, down, flags, flags)


AGENT = AgentSpec(
    name="tiny",
    presets={"cpu": TinyConfig(), "paper": TinyConfig(pixels=24)},
    variants={"goals": lambda config: replace(config, goals=True)},
    create=Tiny,
)
