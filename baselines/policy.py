"""A trained network as a policy: observation -> virtual views -> network -> keyframe."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from baselines import checkpoint as checkpoints
from baselines.batch import Inputs, Prediction, proprio
from baselines.checkpoint import Checkpoint
from baselines.cloud import unproject
from baselines.text import Tokens, pad
from baselines.views import base_from_cube, cube_from_base, render_views
from sacil_tasks.interface import Keyframe, Observation


@dataclass(frozen=True)
class Instruction:
    """The memory of an episode: its words, as the network reads them."""

    tokens: Tokens


class KeyframePolicy:
    """Implements `sacil_tasks.interface.Policy` for any network with a checkpoint."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        """Act with the network of `checkpoint`, on its device, in evaluation mode."""
        self.checkpoint_sha256 = checkpoint.sha256
        self._network = checkpoint.network.eval()
        self._text = checkpoint.text
        self._pixels: int = checkpoint.identity.config.pixels
        self._device = next(checkpoint.network.parameters()).device

    def begin(self, instruction: str) -> Instruction:
        """Embed the words; sentences the checkpoint does not know need the text encoder.

        Raises:
            UsageError: the encoder is missing, another one, or the sentence is too long.
        """
        return Instruction(self._text[instruction])

    @torch.inference_mode()
    def act(
        self, observations: Sequence[Observation], memories: Sequence[Instruction]
    ) -> tuple[list[Keyframe], list[Instruction]]:
        """Choose the next keyframe of each episode; no row depends on another."""
        prediction = self._network.act(self._inputs(observations, memories))
        return _keyframes(prediction), list(memories)

    def _inputs(
        self, observations: Sequence[Observation], memories: Sequence[Instruction]
    ) -> Inputs:
        text, mask = pad([memory.tokens for memory in memories])
        views = np.stack([_views(seen, self._pixels) for seen in observations])
        state = [
            proprio(gripper_open=o.gripper_open, step=o.step, max_steps=o.max_steps)
            for o in observations
        ]
        return Inputs(
            views=self._tensor(views),
            proprio=self._tensor(np.array(state, np.float32)),
            text=self._tensor(text),
            text_mask=self._tensor(mask),
        )

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self._device)


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


def _views(seen: Observation, pixels: int) -> Float32[np.ndarray, "5 7 h w"]:
    """Virtual views of what the cameras see, without augmentation."""
    cloud = unproject(seen.rgb, seen.depth_mm, seen.intrinsics, seen.camera_in_base)
    return render_views(cloud.xyz_in_base, cloud.rgb, cube_from_base(), pixels)


def _keyframes(prediction: Prediction) -> list[Keyframe]:
    """Rows of a prediction as keyframes in the base frame."""
    positions = base_from_cube(prediction.position_in_cube).double().cpu().numpy()
    quaternions = prediction.quaternion_wxyz.double().cpu().numpy()
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    opens, ignores = prediction.gripper_open.tolist(), prediction.ignore_collisions.tolist()
    rows = zip(positions, quaternions, opens, ignores, strict=True)
    return [Keyframe(*row) for row in rows]
