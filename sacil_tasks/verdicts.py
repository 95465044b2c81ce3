"""Rows of the audit's trials -> findings: what was measured, what is needed, does it hold. Pure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from scipy.stats import fisher_exact

from sacil_tasks.catalog import task_spec
from sacil_tasks.contents import Contents, draw_contents
from sacil_tasks.instructions import variations
from sacil_tasks.scenes import scene_seed
from sacil_tasks.shortcuts import Scenes, guesses, limit
from sacil_tasks.sizes import LABELS, absolute_choice
from sacil_tasks.spec import TaskSpec

Row = dict[str, Any]

NEEDS_HANDS_ONLY = ("pick_and_lift", "pick_up_cup", "push_buttons", "take_off_pepper")
"""Tasks whose expert must be nearly perfect; the others aim at a peg or a drawer."""

_SHIFTS = ("shift_down", "shift_up")
_VIEWS_NEEDED = 2
_SIZE_GAP, _SIZE_P = 0.03, 0.01


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One line of the audit."""

    check: str
    task: str
    split: str
    what: str
    measured: str
    needed: str
    holds: bool


def oracle_findings(task: str, scenes: int) -> list[Finding]:
    """Who goes by trained sizes, and who goes by rank, over paired scenes."""
    spec = task_spec(task)
    found = [_rank_finding(spec, scenes)]
    for split in ("canon", *(it for it in _SHIFTS if it in spec.splits)):
        asked, drawn = _asked(spec, split), _drawn(spec, split, scenes)
        choices = np.concatenate([absolute_choices(spec.family, it, asked) for it in drawn])
        right = choices == np.concatenate([_named(it, asked) for it in drawn])
        counts, third = right.sum(axis=0), 1 if split in _SHIFTS else 3
        found.append(
            Finding(
                check="oracles",
                task=task,
                split=split,
                what="right by trained size",
                measured=", ".join(f"{count}/{len(right)}" for count in counts),
                needed="1/3 per slot" if split in _SHIFTS else "all",
                holds=bool(np.all(counts * 3 == len(right) * third)),
            )
        )
        if len(spec.slots) > 1 and split in _SHIFTS:
            found.append(_collisions(task, split, choices, right))
    return found


def _rank_finding(spec: TaskSpec, scenes: int) -> Finding:
    """Right choices by rank over the scenes of every split."""
    right = [
        rank_choices(contents, asked) == _named(contents, asked)
        for split in spec.splits
        for asked in [_asked(spec, split)]
        for contents in _drawn(spec, split, scenes)
    ]
    flat = np.concatenate([np.ravel(it) for it in right])
    return Finding(
        check="oracles",
        task=spec.name,
        split=f"all {len(spec.splits)}",
        what="right by rank",
        measured=f"{flat.sum()}/{len(flat)}",
        needed="all",
        holds=bool(flat.all()),
    )


def _drawn(spec: TaskSpec, split: str, scenes: int) -> list[Contents]:
    seeds = [scene_seed("val", 0, spec.name, index, 0) for index in range(scenes)]
    return [draw_contents(spec, split, seed) for seed in seeds]


def _collisions(
    task: str, split: str, choices: Int64[np.ndarray, "n s"], right: Bool[np.ndarray, "n s"]
) -> Finding:
    """Where both words lead to the same object, or to a wrong one, the episode is lost."""
    collide = np.equal(choices[:, 0], choices[:, 1])
    solved = right.all(axis=1)
    return Finding(
        check="oracles",
        task=task,
        split=split,
        what="both right by trained size",
        measured=f"{solved.sum()}/{len(right)}, slots collide in {collide.sum()}",
        needed="0",
        holds=not solved.any() and bool(collide.any()),
    )


def _asked(spec: TaskSpec, split: str) -> Int64[np.ndarray, "v s"]:
    words = [spec.size_words(slots) for slots in variations(spec, split)]
    return np.array([[LABELS.index(word) for word in row] for row in words])


def _named(contents: Contents, asked: Int64[np.ndarray, "v s"]) -> Int64[np.ndarray, "v s"]:
    """Candidates that the words mean."""
    return np.argsort(contents.labels)[asked]


def rank_choices(contents: Contents, asked: Int64[np.ndarray, "v s"]) -> Int64[np.ndarray, "v s"]:
    """What a policy takes that knows the order of the sizes it sees and no millimetres."""
    seen = np.flatnonzero(contents.present)
    seen = seen[np.argsort(contents.sizes_m[seen])]
    return seen[np.round(asked / (len(LABELS) - 1) * (len(seen) - 1)).astype(int)]


def absolute_choices(
    family: str, contents: Contents, asked: Int64[np.ndarray, "v s"]
) -> Int64[np.ndarray, "v s"]:
    """What a policy takes that knows the sizes of training and no ranks."""
    picks = [absolute_choice(family, label, contents.sizes_m) for label in LABELS]
    return np.array(picks)[asked]


def shortcut_findings(task: str, rows: Sequence[Row]) -> list[Finding]:
    """Guesses of the target from all but images, and scenes solved without a move."""
    scenes = Scenes(
        sentences=[row["sentence"] for row in rows],
        **{
            name: np.array([row[name] for row in rows])
            for name in ("asked", "targets", "xy_m", "yaw_rad", "rgb", "ids", "shared")
        },
    )
    allowed = limit(len(rows))
    found = [
        Finding(
            check="shortcuts",
            task=task,
            split="canon",
            what=kind,
            measured=", ".join(f"{share:.3f}" for share in shares),
            needed=f"0.333 +- {allowed:.3f}",
            holds=all(abs(share - 1 / 3) <= allowed for share in shares),
        )
        for kind, shares in guesses(scenes).items()
    ]
    solved = sum(row["solved"] for row in rows)
    return [*found, _count("shortcuts", task, "canon", "solved at reset", solved, len(rows))]


def look_findings(task: str, split: str, rows: Sequence[Row]) -> list[Finding]:
    """Pixels under other words, and sizes told apart in images."""
    changed = sum(len(set(row["images"])) > 1 for row in rows)
    unclear = sum(not _told_apart(np.array(row["pixels"])) for row in rows)
    return [
        _count("looks", task, split, "scenes whose pixels follow the words", changed, len(rows)),
        _count("looks", task, split, "scenes with sizes alike in 3 views", unclear, len(rows)),
    ]


def _told_apart(pixels: Int64[np.ndarray, "4 3"]) -> bool:
    pairs = [pixels[:, b] > pixels[:, a] for a, b in ((0, 1), (1, 2), (0, 2))]
    return min(int(pair.sum()) for pair in pairs) >= _VIEWS_NEEDED


def script_findings(task: str, split: str, rows: Sequence[Row]) -> list[Finding]:
    """Outcome codes of scripted mistakes."""
    episodes = [episode for row in rows for episode in row["episodes"]]
    wrong = [it for it in episodes if it["code"] not in it["expected"]]
    finding = _count("scripts", task, split, "unintended outcome codes", len(wrong), len(episodes))
    return [finding]


def expert_findings(task: str, split: str, rows: Sequence[Row]) -> list[Finding]:
    """The expert's success, whether it depends on the size, and how many scenes it turned down."""
    episodes = [episode for row in rows for episode in row["episodes"]]
    won = {label: [it["clean"] for it in episodes if it["asked"][0] == label] for label in LABELS}
    share = float(np.mean([it["clean"] for it in episodes]))
    needed = 0.93 if split in _SHIFTS else 0.98 if task in NEEDS_HANDS_ONLY else 0.95
    rejected = sum(row["rejected"] for row in rows)
    sizes = ", ".join(f"{label} {sum(it)}/{len(it)}" for label, it in won.items() if it)
    return [
        Finding(
            check="expert",
            task=task,
            split=split,
            what=f"clean success ({len(rows) / (len(rows) + rejected):.1%} of scenes accepted)",
            measured=f"{share:.1%} ({sizes})",
            needed=f">= {needed:.0%}, no size behind",
            holds=share >= needed and not _lags(won),
        )
    ]


def _lags(won: Mapping[str, Sequence[bool]]) -> bool:
    """Whether one size succeeds clearly less often than another."""
    groups = [(sum(it), len(it)) for it in won.values() if it]
    best = max(groups, key=lambda group: group[0] / group[1])
    worst = min(groups, key=lambda group: group[0] / group[1])
    gap = best[0] / best[1] - worst[0] / worst[1]
    table = [[best[0], best[1] - best[0]], [worst[0], worst[1] - worst[0]]]
    return gap > _SIZE_GAP and float(fisher_exact(table)[1]) < _SIZE_P


def _count(check: str, task: str, split: str, what: str, found: int, of: int) -> Finding:
    """A finding of which there must be none."""
    return Finding(
        check=check,
        task=task,
        split=split,
        what=what,
        measured=f"{found}/{of}",
        needed="0",
        holds=found == 0,
    )
