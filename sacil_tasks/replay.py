"""Re-execute stored demos and report success and drift: `python -m sacil_tasks.replay`.

The stored actions are played open loop in the scene that the stored seed and options give. On the
machine that made the demos nothing drifts; elsewhere this shows how far physics differs.
"""

import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tyro
from jaxtyping import Float
from tqdm import tqdm

from sacil_tasks.catalog import env_id, task_names
from sacil_tasks.demos import read_records
from sacil_tasks.errors import UsageError, run_command


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """Re-execute stored demos; the exit code is 0 if all of them succeed again."""

    demos: Path
    """A folder with `trajectory.h5` in it or below it, e.g. data/canon/train/demos."""

    count: int | None = None
    """Replay only so many demos of each file."""


@dataclass(frozen=True)
class Replayed:
    """How one demo went this time."""

    task: str
    episode_id: int
    success: bool
    drift_mm: float
    """Largest distance of the gripper or a candidate from where it was recorded last."""


def main(config: ReplayConfig) -> None:
    """Replay and print one line a demo.

    Raises:
        UsageError: there is nothing to replay, files are damaged, or a demo does not succeed.
    """
    folders = sorted(path.parent for path in config.demos.rglob("trajectory.h5"))
    if not folders:
        raise UsageError(
            f"no trajectory.h5 in or below {config.demos}. "
            "Make demos with `python -m sacil_tasks.gen_demos`."
        )
    if config.count is not None and config.count < 1:
        raise UsageError(f"--count is at least 1, not {config.count}.")
    work = [(folder, read_records(folder)[: config.count]) for folder in folders]
    for folder, records in work:
        _check(folder, records)
    results = []
    with tqdm(
        total=sum(len(records) for _, records in work),
        unit="demo",
        disable=not sys.stderr.isatty(),
    ) as bar:
        for folder, records in work:
            for result in replay(folder, records):
                results.append(result)
                bar.write(_line(result))
                bar.update()
    failed = sum(not result.success for result in results)
    worst_mm = max(result.drift_mm for result in results)
    print(
        f"{len(results) - failed}/{len(results)} demos succeed again, largest drift "
        f"{worst_mm:.3f} mm"
    )
    if failed:
        raise UsageError(
            f"{failed} of {len(results)} demos do not succeed again here; make demos on this "
            "machine with `python -m sacil_tasks.gen_demos --out ANOTHER_FOLDER`."
        )


def replay(folder: Path, records: list[dict[str, Any]]) -> Iterator[Replayed]:
    """Play the actions of each record in a simulator that renders nothing."""
    import gymnasium as gym  # after all checks: this starts the simulator

    info = _env_info(folder)
    env: Any = gym.make(info["env_id"], render_backend="none", **info["env_kwargs"]).unwrapped
    try:
        with h5py.File(folder / "trajectory.h5", "r") as file:
            for record in records:
                stored = file[f"traj_{record['episode_id']}"]
                env.reset(**record["reset_kwargs"])
                for action in stored["actions"][:]:
                    *_, state = env.step(action)
                reached = _points_m(env)
                env.set_state_dict(_last(stored["env_states"]))
                drift_m = np.linalg.norm(reached - _points_m(env), axis=-1).max()
                yield Replayed(
                    env.task.name, record["episode_id"], bool(state["success"]), 1e3 * drift_m
                )
    finally:
        env.close()


def _env_info(folder: Path) -> dict[str, Any]:
    info = json.loads((folder / "trajectory.json").read_text()).get("env_info", {})
    ours = {f"sacil_tasks:{env_id(task)}" for task in task_names()}
    if info.get("env_id") not in ours:
        raise UsageError(
            f"{folder / 'trajectory.json'} holds demos of {info.get('env_id')}, which is no task "
            "of ours. Replay them with `python -m mani_skill.trajectory.replay_trajectory`."
        )
    return info


def _check(folder: Path, records: list[dict[str, Any]]) -> None:
    """Find what would stop a replay before it starts.

    Raises:
        UsageError: the demos are of a foreign task, or there are none, or one lacks its reset.
    """
    info = _env_info(folder)
    if not records or "env_kwargs" not in info or any("reset_kwargs" not in r for r in records):
        raise UsageError(
            f"{folder / 'trajectory.json'} lists no demos, or not how their scenes are made. "
            "Delete the folder and run `python -m sacil_tasks.gen_demos` again."
        )


def _points_m(env: Any) -> Float[np.ndarray, "4 3"]:
    return np.vstack([env.candidate_in_base(), env.tcp_in_base()[0, :3].numpy()])


def _last(tree: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: _last(branch) if isinstance(branch, Mapping) else branch[-1:]
        for name, branch in tree.items()
    }


def _line(result: Replayed) -> str:
    verdict = "success" if result.success else "FAILED"
    return f"{result.task} demo {result.episode_id}: {verdict}, drift {result.drift_mm:.3f} mm"


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ReplayConfig)))
