"""`python -m sacil_agent.train` stands for `python -m baselines.train --agent sacil`."""

import pytest

from baselines.options import parse
from sacil_agent.train import arguments


@pytest.mark.parametrize(
    ("given", "agent"),
    [([], "sacil"), (["--agent", "sacil:no_queries"], "sacil:no_queries")],
)
def test_sacil_is_trained_unless_a_variant_is_named(given: list[str], agent: str) -> None:
    job = parse([*arguments(given), "--tasks", "pick_and_lift"])
    assert job.options.agent == agent
