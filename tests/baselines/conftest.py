"""Shared by the trainer's tests: data on disk and an agent that trains in milliseconds."""

from pathlib import Path

import pytest
import synthetic
import torch

from baselines import agent


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tasks of six demos for training, one task of three for validation; read only."""
    folder = tmp_path_factory.mktemp("data")
    synthetic.write_file(folder, "pick_and_lift")
    synthetic.write_file(folder, "pick_up_cup", seed=1)
    synthetic.write_file(folder, "pick_and_lift", demos=3, partition="val", seed=2)
    return folder


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the agent `tiny` known beside the real ones, and torch single-threaded."""
    known = {**agent.agent_modules(), "tiny": "synthetic"}
    monkeypatch.setattr(agent, "agent_modules", lambda: known)
    torch.set_num_threads(1)
