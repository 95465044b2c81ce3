"""Samples -> batches: choose, move, look, label.

Runs on the training thread: on one core a second thread would win nothing.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from baselines.agent import Recipe
from baselines.batch import Batch, Inputs, Labels, proprio
from baselines.distributed import share
from baselines.rotation import canonical_yaw, quaternion_to_bins
from baselines.samples import KeyframeSet, Sample, stream
from baselines.scene import augment
from baselines.scene.sight import Moment, Sight
from baselines.scene.views import apply_affine, cube_from_base
from baselines.text import SentenceTable, pad
from sacil_tasks.interface import Observation


class Loader:
    """Makes the batch of any step; holds no state that a step changes."""

    def __init__(
        self,
        keyframes: KeyframeSet,
        text: SentenceTable,
        *,
        sight: Sight,
        recipe: Recipe,
        seed: int,
        goal_sight: Sight | None = None,
    ) -> None:
        """`goal_sight` looks at the observation that each sample leads to."""
        self.keyframes = keyframes
        self._text = text
        self._sight = sight
        self._recipe = recipe
        self._seed = seed
        self._goal_sight = goal_sight
        sentences = {e.instruction for shard in keyframes.shards for e in shard.episodes}
        self._text_length = max(len(text[sentence]) for sentence in sentences)

    def batch(self, step: int) -> Batch:
        """This rank's share of the training batch of `step`: a pure function of seed and `step`.

        Every rank draws all rows and moves, so that they do not depend on the number of ranks, and
        makes tensors of its own. Goals have their own random stream (D-goal), so they never change
        what behaviour cloning sees.
        """
        rng = stream(self._seed, step, "rows")
        samples = self.keyframes.draw(rng, self._recipe.batch, self._recipe.choice_share)
        own, shown = share(len(samples)), self._moved(samples, step, "moves")
        batch = self._assemble(samples[own], shown[own])
        if self._goal_sight is None:
            return batch
        goals = self._moved(self._next(samples), step, "goals")
        return replace(batch, goal=self._goal_sight.look(goals[own]))

    def plain(self, samples: Sequence[Sample]) -> Batch:
        """A batch of these samples without augmentation or goals."""
        moments = [
            Moment(self.keyframes.shards[s.shard].observation(s.row), before=self._before(s))
            for s in samples
        ]
        return self._assemble(samples, moments)

    def _moved(self, samples: Sequence[Sample], step: int, name: str) -> list[Moment]:
        """Each sample with a move of its own; `name` is the stream that it is drawn from."""
        rng, points = stream(self._seed, step, name), stream(self._seed, step, "points")
        return [self._moment(sample, rng, int(points.integers(2**31))) for sample in samples]

    def _moment(self, sample: Sample, rng: np.random.Generator, seed: int) -> Moment:
        shard = self.keyframes.shards[sample.shard]
        pivot = shard.target_in_base(sample.row)[:3]
        move = augment.draw(rng, pivot, self._recipe.augment)
        return Moment(shard.observation(sample.row), move, self._before(sample), seed)

    def _before(self, sample: Sample) -> Sequence[Observation]:
        if not self._sight.remembers:
            return ()
        return self.keyframes.shards[sample.shard].before(sample.row)

    def _next(self, samples: Sequence[Sample]) -> list[Sample]:
        shards = self.keyframes.shards
        return [Sample(s.shard, int(shards[s.shard].columns["next_index"][s.row])) for s in samples]

    def _assemble(self, samples: Sequence[Sample], moments: Sequence[Moment]) -> Batch:
        keyframes, shards = self.keyframes, self.keyframes.shards
        episodes = [keyframes.episode(sample) for sample in samples]
        trajectories = [s.shard << 32 | e for s, e in zip(samples, episodes, strict=True)]
        firsts = [
            s.row == shards[s.shard].first_rows[e] for s, e in zip(samples, episodes, strict=True)
        ]
        return Batch(
            inputs=self._inputs(samples, moments),
            labels=self._labels(samples, moments),
            task=torch.tensor([sample.shard for sample in samples]),
            meaning=torch.tensor([keyframes.meaning_ids[keyframes.meaning(s)] for s in samples]),
            trajectory=torch.tensor(trajectories),
            first=torch.tensor(firsts),
        )

    def _inputs(self, samples: Sequence[Sample], moments: Sequence[Moment]) -> Inputs:
        words = pad([self._text[self._sentence(s)] for s in samples], self._text_length)
        return inputs_of(self._sight, moments, *words)

    def _sentence(self, sample: Sample) -> str:
        shard = self.keyframes.shards[sample.shard]
        return shard.episodes[self.keyframes.episode(sample)].instruction

    def _labels(self, samples: Sequence[Sample], moments: Sequence[Moment]) -> Labels:
        shards = self.keyframes.shards
        poses = np.stack(
            [
                moment.move.move_pose(shards[s.shard].columns["keyframe_in_base"][s.row])
                for s, moment in zip(samples, moments, strict=True)
            ]
        )
        position, turn = apply_affine(cube_from_base(), poses[:, :3]), canonical_yaw(poses[:, 3:])
        return Labels(
            position_in_cube=torch.from_numpy(position.astype(np.float32)),
            quaternion_wxyz=torch.from_numpy(turn.astype(np.float32)),
            rotation_bins=torch.from_numpy(quaternion_to_bins(turn)),
            gripper_open=self._flags(samples, "keyframe_open"),
            ignore_collisions=self._flags(samples, "keyframe_ignore_collisions"),
        )

    def _flags(self, samples: Sequence[Sample], column: str) -> Tensor:
        shards = self.keyframes.shards
        return torch.tensor([int(shards[s.shard].columns[column][s.row]) for s in samples])


def inputs_of(
    sight: Sight,
    moments: Sequence[Moment],
    text: Float32[np.ndarray, "b t e"],
    text_mask: Bool[np.ndarray, "b t"],
) -> Inputs:
    """What a network is given, in training and when it acts."""
    seen = [moment.seen for moment in moments]
    state = [proprio(gripper_open=o.gripper_open, step=o.step, max_steps=o.max_steps) for o in seen]
    return Inputs(
        scene=sight.look(moments),
        gripper_in_cube=torch.from_numpy(np.stack([m.gripper_in_cube for m in moments])),
        step=torch.tensor([o.step for o in seen]),
        proprio=torch.tensor(state),
        text=torch.from_numpy(text),
        text_mask=torch.from_numpy(text_mask),
    )
