"""Samples -> batches: unproject, augment, draw the virtual views, label.

Runs on the training thread: on one core a second thread would win nothing.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from baselines import augment
from baselines.agent import Recipe
from baselines.augment import Augmentation
from baselines.batch import Batch, Inputs, Labels, proprio
from baselines.cloud import unproject
from baselines.rotation import canonical_yaw, quaternion_to_bins
from baselines.samples import KeyframeSet, Sample, stream
from baselines.text import SentenceTable, pad
from baselines.views import CHANNELS, VIEWS, cube_from_base, render_views

Move: TypeAlias = Callable[[Float32[np.ndarray, "7"]], Augmentation]
"""Chooses how a scene is moved, given the pose its move pivots on."""

STILL = Augmentation(0.0, np.zeros(3))


class Loader:
    """Makes the batch of any step; holds no state that a step changes."""

    def __init__(
        self,
        keyframes: KeyframeSet,
        text: SentenceTable,
        *,
        pixels: int,
        recipe: Recipe,
        seed: int,
        goals: bool,
    ) -> None:
        """`goals` asks for the views of the observation each sample leads to."""
        self.keyframes = keyframes
        self._text = text
        self._pixels = pixels
        self._recipe = recipe
        self._seed = seed
        self._goals = goals
        sentences = {e.instruction for shard in keyframes.shards for e in shard.episodes}
        self._text_length = max(len(text[sentence]) for sentence in sentences)

    def batch(self, step: int) -> Batch:
        """The training batch of `step`: a pure function of the seed and `step`.

        Goals have their own random stream (D-goal), so they never change what behaviour cloning
        sees.
        """
        rng = stream(self._seed, step, "rows")
        samples = self.keyframes.draw(rng, self._recipe.batch, self._recipe.choice_share)
        views, moves = self.views(samples, self._mover(step, "moves"))
        goals = None
        if self._goals:
            goals, _ = self.views(self._next(samples), self._mover(step, "goals"))
        if self._recipe.image_noise:
            self._add_noise([views] if goals is None else [views, goals], step)
        return self._assemble(samples, views, moves, goals)

    def plain(self, samples: Sequence[Sample]) -> Batch:
        """A batch of these samples without augmentation, noise or goals."""
        views, moves = self.views(samples, lambda _: STILL)
        return self._assemble(samples, views, moves, None)

    def _mover(self, step: int, name: str) -> Move:
        rng = stream(self._seed, step, name)
        return lambda pivot: augment.draw(rng, pivot[:3], self._recipe.augment)

    def _next(self, samples: Sequence[Sample]) -> list[Sample]:
        shards = self.keyframes.shards
        return [Sample(s.shard, int(shards[s.shard].columns["next_index"][s.row])) for s in samples]

    def views(self, samples: Sequence[Sample], mover: Move) -> tuple[Tensor, list[Augmentation]]:
        """Views of each sample's scene after its own move, and the moves."""
        side = self._pixels
        views = np.empty((len(samples), len(VIEWS), len(CHANNELS), side, side), np.float32)
        moves = []
        for sample, out in zip(samples, views, strict=True):
            shard = self.keyframes.shards[sample.shard]
            move = mover(shard.target_in_base(sample.row))
            seen = shard.observation(sample.row)
            cloud = unproject(seen.rgb, seen.depth_mm, seen.intrinsics, seen.camera_in_base)
            render_views(cloud.xyz_in_base, cloud.rgb, move.to_cube(), side, out)
            moves.append(move)
        return torch.from_numpy(views), moves

    def _add_noise(self, views: Sequence[Tensor], step: int) -> None:
        """RVT's image noise, in place: one amplitude a batch, then uniform on every value."""
        rng = stream(self._seed, step, "noise")
        for tensor in views:
            amplitude = np.float32(rng.uniform(0, self._recipe.image_noise))
            unit = rng.random(tuple(tensor.shape), np.float32)
            tensor.add_(torch.from_numpy(amplitude * (2 * unit - 1))).clamp_(-1, 1)

    def _assemble(
        self,
        samples: Sequence[Sample],
        views: Tensor,
        moves: Sequence[Augmentation],
        goals: Tensor | None,
    ) -> Batch:
        keyframes, shards = self.keyframes, self.keyframes.shards
        episodes = [keyframes.episode(sample) for sample in samples]
        trajectories = [s.shard << 32 | e for s, e in zip(samples, episodes, strict=True)]
        firsts = [
            s.row == shards[s.shard].first_rows[e] for s, e in zip(samples, episodes, strict=True)
        ]
        return Batch(
            inputs=self._inputs(samples, views),
            labels=self._labels(samples, moves),
            goal_views=goals,
            task=torch.tensor([sample.shard for sample in samples]),
            meaning=torch.tensor([keyframes.meaning_ids[keyframes.meaning(s)] for s in samples]),
            trajectory=torch.tensor(trajectories),
            first=torch.tensor(firsts),
        )

    def _inputs(self, samples: Sequence[Sample], views: Tensor) -> Inputs:
        seen = [self.keyframes.shards[s.shard].observation(s.row) for s in samples]
        text, mask = pad([self._text[self._sentence(s)] for s in samples], self._text_length)
        state = [
            proprio(gripper_open=o.gripper_open, step=o.step, max_steps=o.max_steps) for o in seen
        ]
        return Inputs(
            views=views,
            proprio=torch.tensor(state),
            text=torch.from_numpy(text),
            text_mask=torch.from_numpy(mask),
        )

    def _sentence(self, sample: Sample) -> str:
        shard = self.keyframes.shards[sample.shard]
        return shard.episodes[self.keyframes.episode(sample)].instruction

    def _labels(self, samples: Sequence[Sample], moves: Sequence[Augmentation]) -> Labels:
        shards = self.keyframes.shards
        poses = np.stack(
            [
                move.move_pose(shards[s.shard].columns["keyframe_in_base"][s.row])
                for s, move in zip(samples, moves, strict=True)
            ]
        )
        to_cube = cube_from_base()
        position = poses[:, :3] @ to_cube[:, :3].T + to_cube[:, 3]
        return Labels(
            position_in_cube=torch.from_numpy(position.astype(np.float32)),
            rotation_bins=torch.from_numpy(quaternion_to_bins(canonical_yaw(poses[:, 3:]))),
            gripper_open=self._flags(samples, "keyframe_open"),
            ignore_collisions=self._flags(samples, "keyframe_ignore_collisions"),
        )

    def _flags(self, samples: Sequence[Sample], column: str) -> Tensor:
        shards = self.keyframes.shards
        return torch.tensor([int(shards[s.shard].columns[column][s.row]) for s in samples])
