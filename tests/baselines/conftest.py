"""Shared by the trainer's tests: data on disk and an agent that trains in milliseconds."""

from pathlib import Path

import pytest
import synthetic
import torch

from baselines import agent, text
from baselines.material import sentences_of
from baselines.samples import KeyframeSet

TASKS = ("pick_and_lift", "pick_up_cup")


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tasks of six demos for training, one task of three for validation; read only.

    Their sentences are embedded already (by letter counts), so no test needs the encoder.
    """
    folder = tmp_path_factory.mktemp("data")
    synthetic.write_file(folder, "pick_and_lift")
    synthetic.write_file(folder, "pick_up_cup", seed=1)
    synthetic.write_file(folder, "pick_and_lift", demos=3, partition="val", seed=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "load_encoder", lambda name: synthetic.Letters())
        for partition, tasks in (("train", TASKS), ("val", TASKS[:1])):
            keyframes = KeyframeSet.load(folder / "canon" / partition / "keyframes", tasks)
            text.cached_table("minilm", sentences_of(keyframes))
    return folder


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the agent `tiny` known beside the real ones, and torch single-threaded."""
    known = {**agent.agent_modules(), "tiny": "synthetic"}
    monkeypatch.setattr(agent, "agent_modules", lambda: known)
    torch.set_num_threads(1)
