"""Act3D (Gervet et al., CoRL 2023), re-implemented from its published sizes.

    camera images -> trunk, feature pyramid -> a coarse and a fine map, each cell at its 3D point
    three times, in ever smaller regions: ghost points -> what each reads of the cells around it
          -> product with a query that reads the same -> the best ghost is the next guess
    last guess = position; rotation, gripper, collision from the last query

Cells and ghosts are told apart only by where they lie relative to each other (rotary attention,
section 3), so all three levels share their weights. In training a ball is drawn around the
label, while fine cells and query follow the guess, as published. Of the hand only its position
is read. The preset `paper` has the published sizes; `cpu` keeps the steps at a size one core can
train, and its image trunk is trained from scratch (D-act3d-trunk).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.agent import AgentSpec, Network, Recipe, weighed
from baselines.batch import Batch, Inputs, Prediction
from baselines.configs import Natural, Odd, Positive, check_numbers
from baselines.layers import ghosts
from baselines.layers.attention import padding_bias
from baselines.layers.multiview import trimmed_text
from baselines.layers.regression import POSE, UNTURNED, Regressed
from baselines.layers.resnet import ResNet50
from baselines.layers.rotary import Context, Reader, Turns, turns
from baselines.layers.trunks import Pyramid, SmallTrunk, normalised
from baselines.policy import KeyframePolicy, load_policy
from baselines.scene.sight import CameraSight, Pictures
from baselines.text import TextSpec
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import SCENE_BOUNDS

METRES = SCENE_BOUNDS.side_m / 2
"""Length of one unit of cube coordinates."""


@dataclass(frozen=True, kw_only=True)
class Act3dConfig:
    """Sizes of Act3D; the defaults are the `cpu` preset (D-act3d-size)."""

    trunk: Literal["small", "resnet50"] = "small"
    """Image trunk: `small`, for one core, or `resnet50`, CLIP's."""

    trunk_channels: tuple[int, ...] = (32, 64, 128)
    """Channels of the small trunk's maps at strides 4, 8, ..."""

    clip_weights: str = ""
    """Safetensors file with CLIP's RN50, which then stays frozen; empty trains from scratch."""

    levels: tuple[Natural, Natural] = (1, 0)
    """Maps of the trunk, counted from the finest, that coarse and fine cells come from."""

    output_kernel: Odd = 1
    """Kernel of the pyramid's output convolutions."""

    embedding: int = 96
    """Width of every token."""

    heads: int = 4
    """Attention heads; each takes a multiple of 6 channels, a pair for each axis."""

    first_query: Literal["hand", "nowhere"] = "hand"
    """Where the query is while there is no guess (D-act3d-query)."""

    blocks: tuple[int, int, int] = (1, 1, 2)
    """Blocks of the modules that read words, that read as ghosts, and that read as the query."""

    rotary_rad_per_m: float = 100.0
    """Fastest turn of the rotary code (D-act3d-rotary)."""

    rotary_span: Positive = 100.0
    """How many times faster that is than the slowest one, nearly (D-act3d-span)."""

    coarse_cells: int = 768
    """Coarse cells that are read: those nearest to the centre of the cube. Of 1024, this is more
    than lie in the cube, but for clutter (D-act3d-cells)."""

    fine_cells: int = 256
    """Fine cells that are read: those nearest to the guess."""

    radii_m: tuple[Positive, ...] = (0.08, 0.02)
    """Radius of the ball of ghosts at each level after the first."""

    ghosts_learning: int = 128
    """Ghosts of each level in training."""

    ghosts_acting: tuple[int, ...] = (2000, 1000, 1000)
    """Ghosts of each level when acting."""

    label_spread_m: Positive = 0.01
    """Distance from the label at which a ghost's target falls by a factor e."""

    recipe: Recipe = field(
        default_factory=lambda: Recipe(lr=3e-3, precision="bf16", augment=UNTURNED)
    )
    """How to train (D-act3d-recipe)."""

    def __post_init__(self) -> None:
        """Check that the sizes fit each other.

        Raises:
            UsageError: a number makes no network, heads would split pairs, a level lacks its map,
                its ghosts or its ball, or weights are given that the trunk does not read.
        """
        check_numbers(self)
        if self.trunk == "small" and max(self.levels) >= len(self.trunk_channels):
            raise UsageError(
                f"--levels {self.levels} asks for more maps than the {len(self.trunk_channels)} of "
                "--trunk-channels, which are counted from 0."
            )
        if self.trunk == "small" and self.clip_weights:
            raise UsageError("--clip-weights need --trunk resnet50; the small one has none.")
        if self.embedding % (6 * self.heads):
            raise UsageError(
                f"an embedding of {self.embedding} does not give each of {self.heads} heads a "
                "multiple of 6 channels. Change --embedding or --heads."
            )
        if len(self.ghosts_acting) != len(self.radii_m) + 1:
            raise UsageError(
                f"{len(self.radii_m)} balls make {len(self.radii_m) + 1} levels, but "
                f"--ghosts-acting has {len(self.ghosts_acting)} counts. Give one for each level."
            )


CPU = Act3dConfig()

PAPER = Act3dConfig(
    trunk="resnet50",
    levels=(1, 0),
    output_kernel=3,
    embedding=120,
    heads=4,
    first_query="nowhere",
    blocks=(2, 2, 2),
    rotary_rad_per_m=1.0,
    rotary_span=10_000.0,
    coarse_cells=4096,
    fine_cells=4096,
    ghosts_learning=333,
    ghosts_acting=(3333, 3333, 3333),
    recipe=Recipe(
        samples=133_000 * 18,
        batch=18,
        choice_share=None,
        lr=1.8e-3,
        warmup_steps=2000,
        ema_decay=0.0,
        rotation_weight=10.0,
    ),
)
"""Published sizes at the paper's budget for all agents (its section 4.1)."""


@dataclass(frozen=True)
class Cells:
    """Cells of a feature map, lifted to where they lie."""

    tokens: Float[Tensor, "b n d"]
    xyz_in_cube: Float[Tensor, "b n 3"]
    seen: Bool[Tensor, "b n"]

    def nearest(self, center: Float[Tensor, "b 3"], count: int) -> "Cells":
        """The `count` cells nearest to a point; unseen ones are the farthest."""
        if count >= self.tokens.shape[1]:
            return self
        distance = (self.xyz_in_cube - center[:, None]).square().sum(-1)
        distance = distance.masked_fill(~self.seen, torch.inf)
        rows = torch.arange(len(distance), device=distance.device)[:, None]
        index = distance.topk(count, largest=False, sorted=False).indices
        return Cells(
            self.tokens[rows, index], self.xyz_in_cube[rows, index], self.seen[rows, index]
        )


@dataclass(frozen=True)
class Level:
    """Ghosts in some region, and how well each one fits."""

    ghosts_in_cube: Float[Tensor, "b g 3"]
    scores: Float[Tensor, "b g"]

    @property
    def guess(self) -> Float[Tensor, "b 3"]:
        """The best ghost."""
        best = self.scores.argmax(dim=-1)
        return self.ghosts_in_cube[torch.arange(len(best), device=best.device), best]


@dataclass(frozen=True)
class Detection:
    """What the network says about the next keyframe."""

    levels: list[Level]

    action: Regressed
    """At the last guess (D-act3d-collision)."""


Place = Callable[[int, Float[Tensor, "b 3"]], Float[Tensor, "b g 3"]]
"""Level and guess (the centre of the cube at first) -> ghosts."""


class Act3d(Network):
    """Detects the next keyframe among ghost points."""

    def __init__(self, config: Act3dConfig, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__()
        self.config = config
        self.sight = CameraSight(remembers=False)
        width = config.embedding
        self.trunk: SmallTrunk | ResNet50
        if config.trunk == "small":
            self.trunk = SmallTrunk(config.trunk_channels)
        else:
            self.trunk = ResNet50(frozen=bool(config.clip_weights))
        self.pyramid = Pyramid(self.trunk.channels, width, config.levels, config.output_kernel)
        self.text = nn.Linear(text.dim, width)
        self.ghost = nn.Parameter(torch.randn(width))
        self.gripper = nn.Parameter(torch.randn(width))
        self.query = nn.Parameter(torch.randn(width))
        readers = [Reader(width, config.heads, blocks) for blocks in config.blocks]
        self.read_words, self.read_as_ghost, self.read_as_query = readers
        self.action = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, POSE))

    def load_pretrained(self) -> None:
        """CLIP's weights, if the config asks for them.

        Raises:
            UsageError: they are missing or foreign, or the trunk is not CLIP's.
        """
        if isinstance(self.trunk, ResNet50) and self.trunk.frozen:
            self.trunk.load_clip(Path(self.config.clip_weights))

    def forward(self, inputs: Inputs[Pictures], place: Place) -> Detection:
        """Guess level by level; `place` says where the ghosts of each level are."""
        coarse, fine = self._cells(inputs.scene)
        text, mask = trimmed_text(inputs)
        words = Context(self.text(text), None, padding_bias(mask))
        query = self.query.expand(len(text), 1, -1)
        guess = torch.zeros_like(inputs.gripper_in_cube[:, :3])
        levels: list[Level] = []
        for index in range(len(self.config.radii_m) + 1):
            if index == 0:
                cells = coarse.nearest(guess, self.config.coarse_cells)
                context = self._context(cells, inputs, words)
                query = self._first_read(query, context, inputs.gripper_in_cube[:, None, :3])
            else:
                cells = fine.nearest(guess, self.config.fine_cells)
                context = self._context(cells, inputs, words)
                query = self.read_as_query(query, self._code(guess[:, None]), context)
            levels.append(self._score(place(index, guess), query, context))
            guess = levels[-1].guess
        return Detection(levels, Regressed(guess, self.action(query[:, 0]).float()))

    def _first_read(
        self, query: Float[Tensor, "b 1 d"], context: Context, hand: Float[Tensor, "b 1 3"]
    ) -> Float[Tensor, "b 1 d"]:
        """The query after it has read the coarse cells, from the hand or from nowhere."""
        if self.config.first_query == "nowhere":
            return self.read_as_query(query, None, replace(context, code=None))
        return self.read_as_query(query, self._code(hand), context)

    def _cells(self, scene: Pictures) -> tuple[Cells, Cells]:
        """The present images as coarse and fine cells of all cameras.

        A cell lies where the pixel in its middle does (D-act3d-cells).
        """
        rgb, xyz, seen = scene.rgb[:, -1], scene.xyz_in_cube[:, -1], scene.seen[:, -1]
        maps = self.pyramid(self.trunk(normalised(rgb.flatten(0, 1))))
        cells = []
        for level, features in zip(self.config.levels, maps, strict=True):
            stride = self.trunk.first_stride * 2**level
            middle = (..., slice(stride // 2, None, stride), slice(stride // 2, None, stride))
            cells.append(
                Cells(
                    rearrange(features, "(b k) d y x -> b (k y x) d", b=len(rgb)),
                    rearrange(xyz[middle], "b k c y x -> b (k y x) c"),
                    rearrange(seen[middle], "b k y x -> b (k y x)"),
                )
            )
        return cells[0], cells[1]

    def _context(self, cells: Cells, inputs: Inputs, words: Context) -> Context:
        """Cells and gripper, both after reading the words; then the words, at the cube's centre."""
        gripper = self.gripper.expand(len(cells.tokens), 1, -1)
        tokens = self.read_words(torch.cat([cells.tokens, gripper], dim=1), None, words)
        hand, nowhere = inputs.gripper_in_cube[:, None, :3], torch.zeros_like(words.tokens[..., :3])
        here = padding_bias(functional.pad(cells.seen, (0, 1), value=True))
        return Context(
            tokens=torch.cat([tokens, words.tokens], dim=1),
            code=self._code(torch.cat([cells.xyz_in_cube, hand, nowhere], dim=1)),
            bias=torch.cat([here, words.bias], dim=-1),
        )

    def _score(
        self, places: Float[Tensor, "b g 3"], query: Float[Tensor, "b 1 d"], context: Context
    ) -> Level:
        ghost = self.ghost.expand(*places.shape[:2], -1)
        features = self.read_as_ghost(ghost, self._code(places), context)
        # Not a matrix product: autocast would round the scores.
        return Level(places, (features.float() * query.float()).sum(-1))

    def _code(self, points_in_cube: Float[Tensor, "b n 3"]) -> Turns:
        config = self.config
        rate, span = config.rotary_rad_per_m, config.rotary_span
        return turns(METRES * points_in_cube, config.embedding, rate, span)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross-entropy over the ghosts, errors of rotation, gripper and collision."""
        labels, config = batch.labels, self.config

        def around_label(level: int, _: Tensor) -> Tensor:
            draw, count = ghosts.scattered, config.ghosts_learning
            return self._place(draw, level, labels.position_in_cube, count)

        found = self(batch.inputs, around_label)
        spread = config.label_spread_m / METRES
        terms = {
            "bc/position": detection_loss(found.levels, labels.position_in_cube, spread),
            **found.action.terms(labels),
        }
        return weighed(terms, {"bc/rotation": config.recipe.rotation_weight})

    def act(self, inputs: Inputs) -> Prediction:
        """The best ghost of the last level; ghosts are evenly spread, the same every time."""

        def around_guess(level: int, guess: Tensor) -> Tensor:
            return self._place(ghosts.spread, level, guess, self.config.ghosts_acting[level])

        return self(inputs, around_guess).action.prediction

    def _place(
        self, draw: ghosts.Draw, level: int, center: Float[Tensor, "b 3"], count: int
    ) -> Float[Tensor, "b g 3"]:
        """Ghosts all over the cube, then in balls."""
        if level == 0:
            return ghosts.in_cube(draw, len(center), count).to(center.device)
        return ghosts.in_ball(draw, center, self.config.radii_m[level - 1] / METRES, count)


def detection_loss(
    levels: Sequence[Level], position_in_cube: Float[Tensor, "b 3"], spread: float
) -> Tensor:
    """Cross-entropy with labels that fall off exponentially with a ghost's distance from the truth.

    Mean over samples and levels.
    """
    losses = []
    for level in levels:
        distance = (level.ghosts_in_cube - position_in_cube[:, None]).norm(dim=-1)
        losses.append(functional.cross_entropy(level.scores, (-distance / spread).softmax(-1)))
    return torch.stack(losses).mean()


AGENT = AgentSpec(name="act3d", presets={"cpu": CPU, "paper": PAPER}, create=Act3d)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> KeyframePolicy:
    """The policy of a trained network; without `checkpoint`, of the released one.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    return load_policy(AGENT.name, checkpoint=checkpoint, tasks=tasks, variant=variant)
