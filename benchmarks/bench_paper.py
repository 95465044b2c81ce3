"""Do the published sizes train fast? Each network against a plain version of itself, in one run.

    python benchmarks/bench_paper.py [--agents rvt rvt2 ...] [--rounds 3] [--threads 2]

Forward and backward of the `paper` presets in fp32, with their dropout and 77 text tokens of 512
numbers. The plain version has the same weights and writes every step out: products as PyTorch
takes them, scores of attention with their mask as whole matrices, queries, keys and values one
after the other, the padding of short sentences, convolutions of up-sampled and of joined maps,
products after gathering, channels before pixels in memory. Rounds of both take turns, so that a
busy machine disturbs both alike; the ratio is one of processor time. What differs between them is
said beside it, or the comparison would be void. Last, the heatmap decoder against scoring every
cell of the grid.
"""

import resource
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro
from bench_views import observe
from einops import rearrange
from torch import Tensor
from torch.nn import functional

from baselines import heatmap
from baselines.agent import Network, agent_modules, find_agent
from baselines.agents import act3d, hiveformer, polarnet, rvt, rvt2
from baselines.batch import Batch, Inputs, Labels
from baselines.layers import attention, pointnet, rotary, stems, unet
from baselines.layers.products import FullWidth
from baselines.layers.stems import leaky
from baselines.loader import inputs_of
from baselines.rotation import canonical_yaw, quaternion_to_bins
from baselines.scene.sight import Moment
from baselines.scene.views import VIEWS, project
from baselines.text import TextSpec
from baselines.trainer import keep_freed_memory
from sacil_agent.agents import sacil
from sacil_tasks.errors import run_command
from sacil_tasks.interface import MAX_KEYFRAMES, Observation

TEXT = TextSpec(name="clip", dim=512, max_tokens=77, fingerprint="")
BATCHES = {"act3d": 4, "hiveformer": 4, "polarnet": 4}
DEFAULT_BATCH = 3
TOLERANCE = 1e-4
PLANES = 8
"""Planes of the grid that the brute-force decoder scores at a time."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What to time."""

    agents: tuple[str, ...] = tuple(sorted(agent_modules()))
    """One line each."""

    rounds: int = 3
    """Timed steps of each version, after one of each that warms up."""

    threads: int = 2
    """Threads of torch."""

    batch: int | None = None
    """Samples of a step; those the official code was timed with unless given."""

    pixels: int = 220
    """Side of the heatmaps to decode; 0 for none."""

    keep_memory: bool = False
    """Let both versions reuse freed memory, as training does; else the system clears it anew."""


def plain_attend(
    q: Tensor, k: Tensor, v: Tensor, *, bias: Tensor | None = None, dropout: float = 0.0
) -> Tensor:
    """Attention with every score, and the mask of each, in memory."""
    scores = q @ k.mT * q.shape[-1] ** -0.5
    if bias is not None:
        scores = scores + bias.expand_as(scores).clone()
    return functional.dropout(scores.softmax(-1), dropout, training=dropout > 0) @ v


def plain_across(
    self: attention.Attention, x: Tensor, context: Tensor, bias: Tensor | None = None
) -> Tensor:
    """Queries, keys and values by three products."""
    parts = zip((x, context, context), self.to_qkv.weight.chunk(3), strict=True)
    q, k, v = (self._heads(functional.linear(y, weight), 1)[0] for y, weight in parts)
    return self._read(q, k, v, bias)


def plain_itself(self: attention.Attention, x: Tensor, bias: Tensor | None = None) -> Tensor:
    """The same for self-attention."""
    return plain_across(self, x, x, bias)


def plain_feed_forward(self: attention.FeedForward, x: Tensor) -> Tensor:
    """The gate as autograd takes it."""
    value, gate = self.rise(x).chunk(2, dim=-1)
    return self.fall(value * functional.gelu(gate))


def whole_text(inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Text with its padding."""
    return inputs.text, inputs.text_mask


def plain_conv_of_upsampled(x: Tensor, layer: torch.nn.Conv2d, scale: int) -> Tensor:
    """A convolution at full resolution."""
    return layer(functional.interpolate(x, scale_factor=scale, mode="bilinear"))


def plain_side_by_side(layer: torch.nn.Conv2d, *maps: Tensor) -> Tensor:
    """A convolution of the joined map."""
    return layer(torch.cat(maps, dim=1))


def plain_unet_decoder(self: unet.UnetDecoder, grid: Tensor, skips: list[Tensor]) -> Tensor:
    """Up-samples all channels last, and then reads the heatmap."""
    x = leaky(self.norms[0](self.first(grid)))
    for merge, norm, skip in zip(self.merges, self.norms[1:], skips[::-1], strict=True):
        x = leaky(norm(merge(unet.doubled(x), skip)))
    return self.heat(unet.doubled(x))[:, 0]


def plain_turns(
    points_m: Tensor, width: int, rad_per_m: float, span: float
) -> tuple[Tensor, Tensor]:
    """Cosines and sines."""
    code = rotary.turns(points_m, width, rad_per_m, span)
    return code.real.contiguous(), code.imag.contiguous()


def plain_turned(x: Tensor, code: tuple[Tensor, Tensor] | None) -> Tensor:
    """Both halves of the channels times cosines and sines."""
    if code is None:
        return x
    (cos, sin), (first, second) = code, x.chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, first * sin + second * cos], dim=-1)


def plain_memories(self: rotary.Reader, context: rotary.Context) -> list[rotary.Context]:
    """Each block projects the context itself."""
    return [context] * len(self.blocks)


def plain_relative(
    self: rotary.RelativeAttention, x: Tensor, code: Any, context: rotary.Context
) -> Tensor:
    """Queries, keys and values by three products; halves of the channels are turned."""
    heads = "b n (two h p) -> b h n (two p)"
    q = rearrange(plain_turned(self.to_q(x), code), heads, two=2, h=self.heads)
    k = plain_turned(self.to_k(context.tokens), context.code)
    k = rearrange(k, heads, two=2, h=self.heads)
    v = rearrange(self.to_v(context.tokens), "b n (h d) -> b h n d", h=self.heads)
    read = plain_attend(q, k, v, bias=context.bias)
    return self.to_out(rearrange(read, "b h q d -> b q (h d)"))


def plain_gathered(features: Tensor, index: Tensor) -> Tensor:
    """Rows by plain indexing."""
    return features[torch.arange(len(features))[:, None, None], index.long()]


def plain_abstraction(
    self: pointnet.SetAbstraction, features: Tensor, xyz: Tensor, near: Tensor
) -> Tensor:
    """Neighbours are gathered, then each is lifted; the strongest is a maximum over one axis."""
    count = near.shape[1]
    offsets = (plain_gathered(xyz, near) - xyz[:, :count, None]) / self.radius
    joined = self.lift(plain_gathered(features, near)) + self.offset(offsets)
    said = self.neighbours(joined.flatten(0, 2)).unflatten(0, near.shape)
    return functional.relu(self.norm(said.amax(2) + self.skip(features[:, :count])))


def plain_propagation(
    self: pointnet.FeaturePropagation, coarse: Tensor, fine: Tensor, parents: Tensor, shares: Tensor
) -> Tensor:
    """Coarse features are spread, then projected."""
    spread = pointnet.interpolated(coarse, parents, shares)
    return self.mix(self.coarse(spread) + self.fine(fine))


def plain_informed(
    self: hiveformer.HiveFormer, tokens: Tensor, memory: Tensor, inputs: Inputs
) -> Tensor:
    """Histories padded to the longest."""
    word_kind, visual_kind = self.kinds()
    seen = (memory + visual_kind).flatten(1, 2)
    real = inputs.scene.happened.repeat_interleave(memory.shape[2], dim=1)
    context = torch.cat([seen, self.words(inputs.text) + word_kind], dim=1)
    bias = attention.padding_bias(torch.cat([real, inputs.text_mask], dim=1))
    return self._transformed(tokens, context, bias)


def plain_convex_mix(cells: Tensor, shares: Tensor) -> Tensor:
    """The nine shares of every pixel times its cells, each product in memory."""
    side = round((shares.shape[1] / rvt2.NEIGHBOURS) ** 0.5)
    weights = rearrange(shares, "n (k i j) y x -> n k i j y x", k=rvt2.NEIGHBOURS, i=side)
    around = functional.unfold(cells, 3, padding=1).view(*weights.shape[:2], *cells.shape[-2:])
    mixed = (weights.softmax(1) * around[:, :, None, None]).sum(1)
    return rearrange(mixed, "n i j y x -> n 1 (y i) (x j)")


PLAIN: list[tuple[Any, str, Any]] = [
    *((module, "attend", plain_attend) for module in (attention, pointnet, hiveformer)),
    *((module, "trimmed_text", whole_text) for module in (rvt, sacil, hiveformer, polarnet, act3d)),
    *((module, "side_by_side", plain_side_by_side) for module in (stems, unet)),
    (attention.Attention, "forward", plain_itself),
    (attention.Attention, "across", plain_across),
    (attention.FeedForward, "forward", plain_feed_forward),
    (act3d, "turns", plain_turns),
    (rotary.Reader, "memories", plain_memories),
    (rotary.RelativeAttention, "forward", plain_relative),
    (stems, "conv_of_upsampled", plain_conv_of_upsampled),
    (unet.UnetDecoder, "forward", plain_unet_decoder),
    (pointnet, "gathered", plain_gathered),
    (pointnet.SetAbstraction, "forward", plain_abstraction),
    (pointnet.FeaturePropagation, "forward", plain_propagation),
    (hiveformer.HiveFormer, "_informed", plain_informed),
    (rvt2, "convex_mix", plain_convex_mix),
    (torch, "channels_last", torch.contiguous_format),
]
"""Where, what, and what stands there in the plain version."""


@contextmanager
def plain() -> Iterator[None]:
    """The plain version of every network."""
    with ExitStack() as stack:
        for owner, name, value in PLAIN:
            stack.enter_context(patch.object(owner, name, value))
        yield


def seen_at(step: int) -> Observation:
    """The same table at every step."""
    rgb, depth_mm, intrinsics, poses = observe()
    return Observation(
        rgb=rgb,
        depth_mm=depth_mm,
        intrinsics=intrinsics,
        camera_in_base=poses,
        tcp_in_base=np.array([0.45, 0.0, 0.3, 0.0, 1.0, 0.0, 0.0], np.float32),
        gripper_open=True,
        step=step,
        max_steps=MAX_KEYFRAMES,
    )


def make_batch(network: Network, size: int) -> Batch:
    """Synthetic observations of a table with boxes, sentences of 8 to 12 tokens."""
    rng = np.random.default_rng(0)
    episode = [seen_at(step) for step in range(4)]
    moments = [Moment(episode[i % 4], before=episode[: i % 4], seed=i) for i in range(size)]
    mask = np.arange(TEXT.max_tokens) < 8 + np.arange(size)[:, None] % 5
    words = rng.normal(size=(*mask.shape, TEXT.dim)).astype(np.float32) * mask[..., None]
    turns = canonical_yaw(np.tile([0.0, 1.0, 0.0, 0.0], (size, 1)))
    index = torch.arange(size)
    labels = Labels(
        position_in_cube=torch.from_numpy(rng.uniform(-0.5, 0.5, (size, 3))).float(),
        quaternion_wxyz=torch.from_numpy(turns).float(),
        rotation_bins=torch.from_numpy(quaternion_to_bins(turns)),
        gripper_open=index % 2,
        ignore_collisions=index % 2,
    )
    goal = None if network.goal_sight is None else network.goal_sight.look(moments)
    inputs = inputs_of(network.sight, moments, words, mask)
    return Batch(inputs, labels, index, index, index, index % 2 == 0, goal)


def learn(network: Network, batch: Batch) -> dict[str, Tensor]:
    """Forward and backward; the loss and its terms."""
    torch.manual_seed(0)
    network.zero_grad(set_to_none=True)
    loss, terms = network.loss(batch)
    loss.backward()
    return {"loss": loss.detach(), **terms}


def difference(network: Network, batch: Batch) -> tuple[float, float]:
    """Between both versions without dropout: the largest of a loss term, and of a gradient as a
    share of the largest number in its tensor."""
    network.eval()
    with FullWidth():
        ours, gradients = learn(network, batch), gradients_of(network)
    with plain():
        theirs = learn(network, batch)
    network.train()
    terms = max(float((ours[n] - theirs[n]).abs().nan_to_num()) for n in ours)
    largest = max(float(gradient.abs().max()) for gradient in gradients.values())
    shares = [
        float((gradient - other).abs().max() / gradient.abs().max().clamp(min=1e-3 * largest))
        for gradient, other in zip(gradients.values(), gradients_of(network).values(), strict=True)
    ]
    return terms, max(shares)


def gradients_of(network: Network) -> dict[str, Tensor]:
    """Those of the last step, by parameter."""
    return {n: p.grad for n, p in network.named_parameters() if p.grad is not None}


def time_agent(name: str, config: BenchConfig) -> str:
    """One line of the table."""
    torch.set_num_threads(config.threads)
    if config.keep_memory:
        keep_freed_memory()
    torch.manual_seed(0)
    spec, variant = find_agent(name)
    network = spec.create(spec.config("paper", variant), TEXT).train()
    size = config.batch or BATCHES.get(name, DEFAULT_BATCH)
    batch = make_batch(network, size)
    terms, gradients = difference(network, batch)
    wall: list[list[float]] = [[], []]
    core: list[list[float]] = [[], []]
    for _ in range(config.rounds):
        for version in range(2):
            starts = time.perf_counter(), time.process_time()
            with plain() if version else FullWidth():
                learn(network, batch)
            wall[version].append(time.perf_counter() - starts[0])
            core[version].append(time.process_time() - starts[1])
    seconds, cores = map(statistics.median, wall), [statistics.median(times) for times in core]
    times = "".join(f"{second:10.2f}" for second in (*seconds, *cores))
    agree = f"{terms:10.0e}{gradients:10.0e}" + ("" if terms <= TOLERANCE else "  VOID")
    return f"{name:<14}{size:>5}{times}{cores[1] / cores[0]:9.2f}x{agree}"


def brute_force(logits: Tensor) -> Tensor:
    """The decoder with a score for every cell, some planes of the grid at a time."""
    heights = logits.flatten(-2).log_softmax(-1).view_as(logits)[0]
    pixels = logits.shape[-1]
    line = (torch.arange(pixels) + 0.5) * 2 / pixels - 1
    best, cell = -torch.inf, torch.zeros(3)
    for planes in line.split(PLANES):
        cells = torch.cartesian_prod(planes, line, line)
        scores = scores_at(cells, heights)
        if scores.max() > best:
            best, cell = float(scores.max()), cells[scores.argmax()]
    around = [line[(line - x).abs() < (heatmap.REFINE_CELLS + 0.5) * 2 / pixels] for x in cell]
    near = torch.cartesian_prod(*around)
    return scores_at(near, heights).softmax(0) @ near


def scores_at(cells: Tensor, heights: Tensor) -> Tensor:
    """Sum of the views' heights where they show the cells."""
    u, v = (project(cells, heights.shape[-1]) - 0.5).round().long().unbind(-1)
    return sum((heights[k, v[:, k], u[:, k]] for k in range(len(VIEWS))), torch.zeros(len(cells)))


def time_decoder(decode: Callable[[Tensor], Tensor], pixels: int) -> tuple[float, float, Tensor]:
    """Milliseconds of a core, MiB on top of what was there before, and the point."""
    torch.set_num_threads(1)
    label = torch.tensor([[0.1, -0.2, -0.3]])
    decode((heatmap.target_heatmaps(label, 20) + 1e-6).log())  # compiles
    logits = (heatmap.target_heatmaps(label, pixels) + 1e-6).log()
    logits = logits + 0.1 * torch.randn(logits.shape, generator=torch.Generator().manual_seed(0))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    times = []
    for _ in range(5):
        start = time.process_time()
        point = decode(logits)
        times.append(1000 * (time.process_time() - start))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return statistics.median(times), (peak - before) / 2**10, point.flatten()


def in_child(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call it in a fresh process, whose memory is its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def main(config: BenchConfig) -> None:
    """Time everything and print as it comes."""
    print(f"{'':<19}{'seconds':>20}{'core-seconds':>20}{'':10}{'differ by':>20}")
    heads = ("ours", "plain", "ours", "plain", "ratio", "terms", "gradients")
    print(f"{'agent':<14}{'batch':>5}" + "".join(f"{head:>10}" for head in heads), flush=True)
    for name in config.agents:
        print(in_child(time_agent, name, config), flush=True)
    if config.pixels:
        print(f"\ndecoding {len(VIEWS)} heatmaps of {config.pixels} px   ms       MiB")
        points = []
        for label, decode in (("ours", heatmap.decode), ("every cell", brute_force)):
            took_ms, added_mib, point = in_child(time_decoder, decode, config.pixels)
            points.append(point)
            print(f"{label:<30}{took_ms:8.2f}{added_mib:10.0f}", flush=True)
        print(f"points differ by {float((points[0] - points[1]).abs().max()):.0e}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchConfig, description=__doc__)))
