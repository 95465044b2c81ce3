"""What is behind a set of weights: read from the files of its checkpoint, without its network.

A checkpoint folder says in `provenance.json` what it was trained on and for how long. Any agent may
leave such a file beside its weights; without one its budget is unknown.
"""

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Self

from leaderboard.agents import AGENT_PACKAGES
from sacil_tasks.files import content_hash, file_sha256
from sacil_tasks.typed import parsed

PROVENANCE_FILE = "provenance.json"
HASHED_FILES = ("model.safetensors", "config.json")
"""Files of a checkpoint of ours whose hash names it in results."""

_HASH_LENGTH = 12


@dataclass(frozen=True)
class Terms:
    """What rows of a table must have in common."""

    samples: int
    """Behaviour-cloning samples."""

    preset: str
    text: str
    """Text encoder."""

    keyframes: tuple[tuple[str, str], ...]
    """Tasks trained on, in alphabetical order, and the hashes of their keyframes."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks trained on."""
        return tuple(task for task, _ in self.keyframes)

    def __str__(self) -> str:
        """As messages and tables show it."""
        return (
            f"{self.samples:,} samples, preset {self.preset}, text {self.text}, keyframes "
            f"{content_hash(self.keyframes)[:_HASH_LENGTH]} of {', '.join(self.tasks)}"
        )

    def unlike(self, other: Self) -> str:
        """What differs from `other`, in words; empty if nothing does."""
        ours, theirs = content_hash(self.keyframes), content_hash(other.keyframes)
        differences = {
            f"{self.samples:,} samples, not {other.samples:,}": self.samples != other.samples,
            f"preset {self.preset}, not {other.preset}": self.preset != other.preset,
            f"text {self.text}, not {other.text}": self.text != other.text,
            f"trained on {', '.join(self.tasks)}": self.tasks != other.tasks,
            "other keyframes": self.tasks == other.tasks and ours != theirs,
        }
        return "; ".join(words for words, differ in differences.items() if differ)


@dataclass(frozen=True, kw_only=True)
class Training:
    """The training facts that a run's manifest carries."""

    agent: str
    """As named to the trainer."""

    preset: str
    text: str
    seed: int
    samples: int
    core_minutes: float
    keyframes_sha256: Mapping[str, str]
    """Task -> hash of the keyframes it was trained on."""

    @property
    def terms(self) -> Terms:
        """What other rows must agree with."""
        keyframes = tuple(sorted(self.keyframes_sha256.items()))
        return Terms(self.samples, self.preset, self.text, keyframes)


def read_training(checkpoint: Path) -> Training | None:
    """The training facts in a checkpoint folder, or None if it has none that we can read."""
    try:
        facts = (checkpoint / PROVENANCE_FILE).read_text(encoding="utf-8")
        return parsed(Training, facts, extra="ignore")
    except (OSError, ValueError):
        return None


def training_behind(checkpoint: Path | None, sha256: str | None) -> Training | None:
    """The facts behind the weights `sha256`, given as a folder or released with a package."""
    if checkpoint is None and sha256 is not None:
        checkpoint = _released().get(sha256)
    return read_training(checkpoint) if checkpoint else None


@cache
def _released() -> Mapping[str, Path]:
    """Hash -> folder of every checkpoint that our packages bring along."""
    names = {package.partition(".")[0] for package in AGENT_PACKAGES}
    specs = [importlib.util.find_spec(name) for name in sorted(names)]
    roots = [Path(root) for spec in specs if spec for root in spec.submodule_search_locations or []]
    files = [file for root in roots for file in root.glob(f"released/*/*/{HASHED_FILES[0]}")]
    return {checkpoint_sha256(file.parent): file.parent for file in files}


def checkpoint_sha256(folder: Path) -> str:
    """What names a checkpoint of ours in results: a hash of weights and config."""
    return content_hash([file_sha256(folder / name) for name in HASHED_FILES])
