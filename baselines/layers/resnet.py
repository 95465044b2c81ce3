"""The image trunk of CLIP's RN50, up to its last stage.

A stem of three convolutions, and strides that average. Parameters bear the names of OpenAI's
release, so that its weights fit; pickled weights are never read.
"""

from pathlib import Path

from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers.stems import Maps
from sacil_tasks.errors import UsageError

NORM_GROUPS = 32


class ResNet50(nn.Module):
    """Trained from scratch with group norm, or CLIP's as it is (D-act3d-trunk)."""

    first_stride = 2
    """Pixels of a side of the finest map's cells; each further map doubles them."""

    channels = (64, 256, 512, 1024, 2048)

    def __init__(self, *, frozen: bool) -> None:
        """`frozen` makes room for CLIP's weights: fill it with `load_clip`."""
        super().__init__()
        self.frozen = frozen
        self.conv1 = nn.Conv2d(3, 32, 3, 2, 1, bias=False)
        self.bn1 = _norm(32, frozen=frozen)
        self.conv2 = nn.Conv2d(32, 32, 3, 1, 1, bias=False)
        self.bn2 = _norm(32, frozen=frozen)
        self.conv3 = nn.Conv2d(32, 64, 3, 1, 1, bias=False)
        self.bn3 = _norm(64, frozen=frozen)
        self.layer1 = _stage(64, 64, 3, stride=1, frozen=frozen)
        self.layer2 = _stage(256, 128, 4, stride=2, frozen=frozen)
        self.layer3 = _stage(512, 256, 6, stride=2, frozen=frozen)
        self.layer4 = _stage(1024, 512, 3, stride=2, frozen=frozen)
        if frozen:
            self.requires_grad_(requires_grad=False).eval()

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Maps:
        """The stem's map before it is pooled, then that of each stage."""
        x = functional.relu(self.bn1(self.conv1(images)))
        x = functional.relu(self.bn2(self.conv2(x)))
        maps = [functional.relu(self.bn3(self.conv3(x)))]
        x = functional.avg_pool2d(maps[0], 2)
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
            maps.append(x)
        return maps

    def train(self, mode: bool = True) -> "ResNet50":  # noqa: FBT001, FBT002
        """Statistics of a frozen trunk stay those of CLIP (D-act3d-frozen)."""
        return super().train(mode and not self.frozen)

    def load_clip(self, path: Path) -> None:
        """Take over CLIP's weights from a safetensors file; other tensors in it are left out.

        Raises:
            UsageError: the file is missing, foreign, or holds another network.
        """
        try:
            weights = load_file(path)
            # Every other tensor decides what is seen; the count of batches decides nothing.
            names = [n for n in self.state_dict() if not n.endswith("num_batches_tracked")]
            self.load_state_dict({n: weights[f"visual.{n}"] for n in names}, strict=False)
        except (OSError, SafetensorError, KeyError, RuntimeError) as error:
            raise UsageError(
                f"{path} does not hold the image tower of CLIP's RN50 in OpenAI's names "
                f"({error}). Convert the release to safetensors, or leave --clip-weights out to "
                "train the trunk from scratch."
            ) from error


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions beside a shortcut; a stride is an average."""

    def __init__(self, fan_in: int, planes: int, *, stride: int, frozen: bool) -> None:
        """Four times `planes` channels come out."""
        super().__init__()
        fan_out = 4 * planes
        self.stride = stride
        self.conv1 = nn.Conv2d(fan_in, planes, 1, bias=False)
        self.bn1 = _norm(planes, frozen=frozen)
        self.conv2 = nn.Conv2d(planes, planes, 3, 1, 1, bias=False)
        self.bn2 = _norm(planes, frozen=frozen)
        self.conv3 = nn.Conv2d(planes, fan_out, 1, bias=False)
        self.bn3 = _norm(fan_out, frozen=frozen)
        self.downsample: nn.Module = nn.Identity()
        if stride > 1 or fan_in != fan_out:
            shortcut = nn.Conv2d(fan_in, fan_out, 1, bias=False)
            self.downsample = nn.Sequential(shortcut, _norm(fan_out, frozen=frozen))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n _ _ _"]:
        """The next map."""
        y = functional.relu(self.bn1(self.conv1(x)))
        y = functional.avg_pool2d(functional.relu(self.bn2(self.conv2(y))), self.stride)
        shortcut = self.downsample(functional.avg_pool2d(x, self.stride))
        return functional.relu(self.bn3(self.conv3(y)) + shortcut)


def _stage(fan_in: int, planes: int, blocks: int, *, stride: int, frozen: bool) -> nn.Sequential:
    first = Bottleneck(fan_in, planes, stride=stride, frozen=frozen)
    rest = [Bottleneck(4 * planes, planes, stride=1, frozen=frozen) for _ in range(blocks - 1)]
    return nn.Sequential(first, *rest)


def _norm(channels: int, *, frozen: bool) -> nn.Module:
    """CLIP's batch norm for CLIP's statistics; group norm where batches are small."""
    return nn.BatchNorm2d(channels) if frozen else nn.GroupNorm(NORM_GROUPS, channels)
