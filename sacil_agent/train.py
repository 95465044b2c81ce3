"""Train SACIL: `python -m sacil_agent.train` is `python -m baselines.train --agent sacil`."""

import logging
import sys
from collections.abc import Sequence

from baselines import train
from sacil_tasks.errors import run_command

DEFAULT = ("--agent", "sacil")


def arguments(given: Sequence[str]) -> list[str]:
    """The command line with `--agent sacil` in front, unless it names an agent (a variant)."""
    named = any(word == "--agent" or word.startswith("--agent=") for word in given)
    return list(given) if named else [*DEFAULT, *given]


if __name__ == "__main__":
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    run_command(lambda: train.start(arguments(sys.argv[1:])), after_stop=train.AFTER_STOP)
