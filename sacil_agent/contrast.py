"""The two contrasts of SACIL (paper section 3.5, Eq. 3 and 4) and what they have learnt.

Both pull matched rows of two feature sets together and push the other rows of the batch apart:
symmetric InfoNCE, minimised (D-equations: the printed ones lack a minus sign). Rows that mean the
same are no negatives (D-mask): with a handful of sizes a batch is full of samples that ask for the
same thing in other words, and the paper takes negatives from other trajectories only.

Where several processes share a batch, each computes the contrasts of all its rows (`n`, of which
its own are `b`).
"""

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from baselines.batch import Batch
from baselines.distributed import gathered
from baselines.layers.attention import linear

FIRST_TEMPERATURE = 0.07
"""Initial temperature, as in CLIP; the paper gives none (D-temperature)."""

MAX_SCALE = 100.0
"""The learnt inverse temperature stays below this, as in CLIP."""


class Contrast(nn.Module):
    """Two projections to a common space, and symmetric InfoNCE with a learnt temperature."""

    def __init__(self, our_width: int, their_width: int, width: int) -> None:
        """Compare features of `our_width` with features of `their_width`."""
        super().__init__()
        self.ours = linear(our_width, width)
        self.theirs = linear(their_width, width)
        self.log_scale = nn.Parameter(torch.tensor(-math.log(FIRST_TEMPERATURE)))

    def forward(
        self,
        ours: Float[Tensor, "b d"],
        theirs: Float[Tensor, "b e"],
        same: Bool[Tensor, "n n"],
    ) -> tuple[Tensor, Float[Tensor, "n n"]]:
        """Loss, and the cosine of each pair, ours along the rows."""
        mine, yours = self.ours(ours).float(), self.theirs(theirs).float()
        cosines = cosine_matrix(gathered(mine), gathered(yours))
        scale = self.log_scale.clamp(max=math.log(MAX_SCALE)).exp()
        return info_nce(scale * cosines, same), cosines.detach()


def info_nce(logits: Float[Tensor, "b b"], same: Bool[Tensor, "b b"]) -> Tensor:
    """Cross-entropy of the diagonal by rows and by columns, without `same` pairs off it."""
    matched = torch.eye(len(logits), dtype=torch.bool, device=logits.device)
    logits = logits.masked_fill(same & ~matched, -torch.inf)
    rows = torch.arange(len(logits), device=logits.device)
    return (functional.cross_entropy(logits, rows) + functional.cross_entropy(logits.T, rows)) / 2


def cosine_matrix(ours: Float[Tensor, "b d"], theirs: Float[Tensor, "b d"]) -> Float[Tensor, "b b"]:
    """Cosine between each row of one and each row of the other, in full precision."""
    ours, theirs = functional.normalize(ours.float()), functional.normalize(theirs.float())
    # Autocast would round the cosines to three digits.
    with torch.autocast(ours.device.type, enabled=False):
        return ours @ theirs.T


def same_meaning(batch: Batch) -> Bool[Tensor, "n n"]:
    """Pairs that are no negatives of each other: equal task and slots, or one trajectory."""
    meaning, trajectory = gathered(batch.meaning), gathered(batch.trajectory)
    return (meaning[:, None] == meaning) | (trajectory[:, None] == trajectory)


def size_candidates(task: Int64[Tensor, "b"], meaning: Int64[Tensor, "b"]) -> Bool[Tensor, "b b"]:
    """Per row: itself, and one row of each other meaning of its task.

    Naming the task is easy; choosing among these is what size grounding means.
    """
    index = torch.arange(len(task), device=task.device)
    first_of_meaning = (meaning[:, None] == meaning).int().argmax(dim=1)
    stands_for_other = (first_of_meaning == index) & (meaning[:, None] != meaning)
    return (task[:, None] == task) & stands_for_other | (index[:, None] == index)


def diagnostics(name: str, cosines: Float[Tensor, "n n"], batch: Batch) -> dict[str, Tensor]:
    """How often the match wins among same-task candidates, beside its chance level.

    First and later keyframes apart: before the first one the scene shows every size and nothing
    tells which is meant, so accuracy there should stay near chance unless something leaks.
    Groups without a choice are NaN, which the training log leaves out.
    """
    candidates = size_candidates(gathered(batch.task), gathered(batch.meaning))
    first = gathered(batch.first)
    chosen = cosines.masked_fill(~candidates, -torch.inf).argmax(dim=1)
    hit = (chosen == torch.arange(len(chosen), device=chosen.device)).float()
    chance = 1 / candidates.sum(dim=1)
    open_choice = chance < 1
    found = {}
    for group, rows in (("first", first), ("later", ~first)):
        counted = rows & open_choice
        found[f"{name}/accuracy_{group}"] = hit[counted].mean()
        found[f"{name}/chance_{group}"] = chance[counted].mean()
    return found
