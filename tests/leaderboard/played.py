"""Made-up run folders, written as `python -m leaderboard.run` writes them, and their tables."""

import csv
import hashlib
from collections.abc import Callable
from pathlib import Path

from leaderboard.entry import Entry
from leaderboard.layout import SUITES
from leaderboard.manifest import Manifest, write_manifest
from leaderboard.plan import plan_episodes
from leaderboard.protocol import protocol_name, protocol_of
from leaderboard.records import EpisodeKey, EpisodeLog, EpisodeRecord
from leaderboard.tables import TablesConfig, main
from leaderboard.training import Training

Solves = Callable[[EpisodeKey], bool]


SOLVED = {"outcome": "SUCCESS", "success": True, "success_lenient": True, "end": "success"}
FAILED = {"outcome": "MOTOR_FAIL", "success": False, "success_lenient": False, "end": "limit"}


def by_chance(agent: str, rate: float, seed: int = 0) -> Solves:
    """Success by a hash of names: the same on every machine, another for each agent and seed."""

    def solves(key: EpisodeKey) -> bool:
        digest = hashlib.sha256(repr((agent, seed, *key)).encode()).digest()
        return digest[0] / 256 < rate

    return solves


def make_training(agent="sacil", tasks=SUITES["single"], **changes) -> Training:
    standard = {
        "agent": agent,
        "preset": "cpu",
        "text": "minilm",
        "seed": 0,
        "samples": 120_000,
        "core_minutes": 60.0,
        "keyframes_sha256": {task: f"keyframes of {task}" for task in tasks},
    }
    return Training(**standard | changes)


def play(
    folder: Path,
    agent: str = "sacil",
    *,
    tasks: tuple[str, ...] = SUITES["single"],
    solves: Solves | None = None,
    training: Training | None = None,
    partition: str = "test",
    scene_set: int = 0,
    split: str = "canon",
    episodes: int = 18,
    privileged: bool = False,
    protocol: str | None = None,
    **changes,
) -> Path:
    """Write the run of an agent; `changes` are made to every record."""
    weights = hashlib.sha256(repr((agent, training)).encode()).hexdigest()
    rules = {protocol_name(it, split): protocol_of(it, partition, scene_set, split) for it in tasks}
    described = {
        name: it.described() | ({"hash": protocol} if protocol else {})
        for name, it in rules.items()
    }
    entry = Entry(
        agent=agent,
        privileged=privileged,
        checkpoint=None if privileged else weights,
        protocols={name: it["hash"] for name, it in described.items()},
    )
    manifest = Manifest(
        agent=agent,
        privileged=privileged,
        checkpoint=entry.checkpoint,
        partition=partition,
        scene_set=scene_set,
        protocols=described,
        commands=["python -m leaderboard.run"],
        versions={},
        splits=[split],
        training=training,
    )
    write_manifest(folder, manifest)
    solves = solves or by_chance(agent, 0.5, training.seed if training else 0)
    keys = plan_episodes([(task, split) for task in tasks], partition, scene_set, episodes)
    with EpisodeLog(folder) as log:
        for key in keys:
            log.append(_record(entry, key, solves(key), changes))
    return folder


def _record(entry: Entry, key: EpisodeKey, success: bool, changes: dict) -> EpisodeRecord:  # noqa: FBT001
    identity = entry.identity(key)
    result = (SOLVED if success else FAILED) | {"fingerprint": repr(key), "keyframes": 4}
    return EpisodeRecord(**identity | result | changes)


def tabulate(runs: Path, **options) -> Path:
    out = options.pop("out", runs.with_name("tables"))
    main(TablesConfig(runs=(runs,), out=out, **options))
    return out


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def rows(out: Path, name: str = "table1_single") -> dict[str, dict[str, str]]:
    return {line["agent"]: line for line in read(out / f"{name}.csv")}
