"""Put a finished run among the released checkpoints: `python -m baselines.release --run FOLDER`.

The checkpoint goes, in half precision, into the package of its agent, from where the agent is
loaded when no --checkpoint is given.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from baselines.checkpoint import Identity, export_release, released_folder
from sacil_tasks.catalog import suite_tasks
from sacil_tasks.errors import UsageError, run_command


@dataclass(frozen=True, kw_only=True)
class ReleaseConfig:
    """Which run becomes which release."""

    run: Path
    """Checkpoint folder of a finished training run."""

    suite: str = "slice"
    """Name of the release: the suite whose tasks the run was trained on."""


def main(config: ReleaseConfig) -> None:
    """Export the checkpoint.

    Raises:
        UsageError: the suite is unknown or not what the run was trained on, or the run is not
            finished or not readable.
    """
    tasks = suite_tasks(config.suite)
    identity = Identity.load(config.run)
    if set(identity.tasks) != set(tasks):
        raise UsageError(
            f"{config.run} was trained on {', '.join(identity.tasks)}, but the suite "
            f"{config.suite} is {', '.join(tasks)}. Choose the run's suite with --suite."
        )
    variant = f".{identity.variant}" if identity.variant else ""
    target = released_folder(identity.agent) / f"{config.suite}{variant}"
    export_release(config.run, target)
    print(f"released {config.run} as {target}")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ReleaseConfig, description=__doc__)))
