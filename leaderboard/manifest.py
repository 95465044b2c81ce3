"""What a run folder is: which agent, weights and protocol, by which commands, on what software.

Written before the first episode and kept true by every later command on the same folder.
"""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

from leaderboard.records import EPISODES_FILE
from leaderboard.training import Training
from sacil_tasks.errors import UsageError
from sacil_tasks.files import package_version, write_json
from sacil_tasks.typed import parsed

KIND = "sacil-evaluation"
SCHEMA_VERSION = 1
MANIFEST_FILE = "manifest.json"

PACKAGES = ("sacil", "mani-skill", "sapien", "numpy", "torch", "pin", "coal", "ompl", "toppra")
"""Packages whose versions are stored: they draw, plan, move, render or decide."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """Identity and history of one run folder."""

    agent: str
    privileged: bool
    checkpoint: str | None
    """SHA-256 of the weights; None for agents without."""
    partition: str
    scene_set: int
    protocols: Mapping[str, Mapping[str, Any]]
    """`EvalProtocol` of each task evaluated here, with its hash."""

    commands: Sequence[str]
    """Every command line that wrote here, oldest first."""
    versions: Mapping[str, str]
    """Software of the latest command."""
    test_runs: int = 0
    """Run folders beside this one, itself included, that hold test episodes of these weights on
    any of the same splits. More than 1 means that the test was not touched once only."""
    splits: Sequence[str] = ()
    training: Training | None = None
    """What is behind the weights; None if they do not say, and in older manifests."""

    kind: str = KIND
    schema_version: int = SCHEMA_VERSION

    def joined(self, later: Self) -> Self:
        """This history continued by a command whose manifest is `later`."""
        return replace(
            later,
            protocols={**self.protocols, **later.protocols},
            commands=[*self.commands, *later.commands],
            splits=sorted({*self.splits, *later.splits}),
            training=later.training or self.training,
        )


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest in `folder`, or None where there is none.

    Raises:
        UsageError: it is damaged, or the folder has episodes without a manifest.
    """
    path = folder / MANIFEST_FILE
    if not path.is_file():
        log = folder / EPISODES_FILE
        if log.exists() and log.stat().st_size:
            raise UsageError(
                f"{log} has no {MANIFEST_FILE} beside it, so it is not a run of ours. "
                "Move it away, or choose another folder."
            )
        return None
    try:
        return _parse(path)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"{path} is not the manifest of an evaluation ({error}). "
            "Move the folder away, or choose another."
        ) from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `manifest.json` atomically.

    Raises:
        UsageError: the folder cannot be written.
    """
    write_json(folder / MANIFEST_FILE, asdict(manifest))


def check_same_run(folder: Path, ours: Manifest, theirs: Manifest) -> None:
    """Refuse to mix agents, weights, partitions or protocols in one folder.

    Raises:
        UsageError: says what differs.
    """
    for name in ("agent", "checkpoint", "partition", "scene_set"):
        found, wanted = getattr(theirs, name), getattr(ours, name)
        if found != wanted:
            raise UsageError(
                f"{folder} holds a run with {name} {found}, but this one has {wanted}. "
                "Choose another folder with --out."
            )
    for task in ours.protocols.keys() & theirs.protocols.keys():
        if ours.protocols[task]["hash"] != theirs.protocols[task]["hash"]:
            raise UsageError(
                f"{folder} holds {task} under another protocol "
                f"({_differences(ours.protocols[task], theirs.protocols[task])} differ). "
                "Results would not be comparable: choose another folder with --out."
            )


def counted(folder: Path, ours: Manifest) -> Manifest:
    """`ours` with the number of test runs that these weights have had beside `folder`."""
    if ours.partition != "test" or ours.checkpoint is None:
        return ours
    others = [
        other
        for path in folder.parent.glob(f"*/{MANIFEST_FILE}")
        if path.parent.resolve() != folder.resolve() and (other := _read_or_none(path))
    ]
    same = [
        other
        for other in others
        if (other.partition, other.checkpoint) == (ours.partition, ours.checkpoint)
        and not set(other.splits).isdisjoint(ours.splits)
    ]
    return replace(ours, test_runs=1 + len(same))


def installed_versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result may depend on; imports none."""
    return {"python": platform.python_version()} | {
        package: found for package in PACKAGES if (found := package_version(package))
    }


def _parse(path: Path) -> Manifest:
    manifest = parsed(Manifest, path.read_text(encoding="utf-8"), extra="ignore")
    if (manifest.kind, manifest.schema_version) != (KIND, SCHEMA_VERSION):
        raise ValueError(f"kind and schema_version are not {KIND} and {SCHEMA_VERSION}")
    if nameless := [task for task, rules in manifest.protocols.items() if "hash" not in rules]:
        raise ValueError(f"the protocol of {', '.join(nameless)} has no hash")
    return manifest


def _read_or_none(path: Path) -> Manifest | None:
    """A neighbour's manifest; a damaged one is the neighbour's business."""
    try:
        return _parse(path)
    except (OSError, ValueError):
        return None


def _differences(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
    names = sorted(ours.keys() | theirs.keys())
    changed = [it for it in names if it != "hash" and ours.get(it) != theirs.get(it)]
    return ", ".join(changed) or "hashes"
