"""A trained network as a policy: observation -> its sight -> network -> keyframe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from baselines import checkpoint as checkpoints
from baselines.batch import Prediction, moved
from baselines.checkpoint import Checkpoint
from baselines.loader import inputs_of
from baselines.scene.sight import Moment
from baselines.scene.views import base_from_cube
from baselines.text import Tokens, pad
from sacil_tasks.interface import Keyframe, Observation


@dataclass(frozen=True)
class Memory:
    """What an episode has been so far, as far as the network wants to know."""

    tokens: Tokens
    """The instruction as the network reads it."""

    before: tuple[Observation, ...] = ()
    """Earlier observations; none unless the network's sight remembers."""


class KeyframePolicy:
    """Implements `sacil_tasks.interface.Policy` for any network with a checkpoint."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        """Act with the network of `checkpoint`, on its device, in evaluation mode."""
        self.checkpoint_sha256 = checkpoint.sha256
        self._network = checkpoint.network.eval()
        self._text = checkpoint.text

    def begin(self, instruction: str) -> Memory:
        """Embed the words; sentences the checkpoint does not know need the text encoder.

        Raises:
            UsageError: the encoder is missing, another one, or the sentence is too long.
        """
        return Memory(self._text[instruction])

    @torch.inference_mode()
    def act(
        self, observations: Sequence[Observation], memories: Sequence[Memory]
    ) -> tuple[list[Keyframe], list[Memory]]:
        """Choose the next keyframe of each episode; no row depends on another."""
        pairs = list(zip(observations, memories, strict=True))
        moments = [Moment(seen, before=memory.before) for seen, memory in pairs]
        words = pad([memory.tokens for memory in memories])
        inputs = inputs_of(self._network.sight, moments, *words)
        prediction = self._network.act(moved(inputs, self._network.device))
        return _keyframes(prediction), [self._remembering(*pair) for pair in pairs]

    def _remembering(self, seen: Observation, memory: Memory) -> Memory:
        if not self._network.sight.remembers:
            return memory
        return replace(memory, before=(*memory.before, seen))


def load_policy(
    agent: str, *, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None
) -> KeyframePolicy:
    """The policy of `agent` for `tasks`; without `checkpoint`, the released one that covers them.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    name = f"{agent}:{variant}" if variant else agent
    folder = checkpoint or checkpoints.find_released(name, tasks)
    return KeyframePolicy(checkpoints.load(folder, agent=name, tasks=tasks))


def _keyframes(prediction: Prediction) -> list[Keyframe]:
    """Rows of a prediction as keyframes in the base frame."""
    positions = base_from_cube(prediction.position_in_cube).double().cpu().numpy()
    quaternions = prediction.quaternion_wxyz.double().cpu().numpy()
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    opens, ignores = prediction.gripper_open.tolist(), prediction.ignore_collisions.tolist()
    rows = zip(positions, quaternions, opens, ignores, strict=True)
    return [Keyframe(*row) for row in rows]
