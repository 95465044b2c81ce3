"""Two processes that share batches do what one does with whole ones, and end together."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import one_of_two
import pytest
import torch
from networks import TEXT, gradients, registered
from safetensors.torch import load_file
from torch import distributed

from baselines.agent import find_agent
from baselines.checkpoint import METRICS, MODEL, PROVENANCE
from baselines.distributed import averaged, batch_norms, gathered, own_device, share
from baselines.run import read_rows
from sacil_tasks.errors import UsageError

HERE = Path(__file__).parent
TIMING = ("samples_per_s", "cpu_s", "share_loading", "share_network", "share_optimiser")


@pytest.fixture(scope="module")
def two_ranks(data, tmp_path_factory):
    """The folder that two ranks leave, and what each said before it ended."""
    out = tmp_path_factory.mktemp("two")
    # As under torchrun, what the ranks meet at outlives them.
    store = distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    shared = {
        "PYTHONPATH": os.pathsep.join(map(str, (HERE, HERE.parent, HERE.parents[1]))),
        "TORCHELASTIC_USE_AGENT_STORE": "True",
        "MASTER_ADDR": store.host,
        "MASTER_PORT": str(store.port),
        "WORLD_SIZE": "2",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, HERE / "one_of_two.py", data, out],
            env=os.environ | shared | {"RANK": rank, "LOCAL_RANK": rank},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in "01"
    ]
    try:
        said = [process.communicate() for process in processes]
    finally:
        for process in processes:
            process.kill()
    return out, said, [process.returncode for process in processes]


@pytest.mark.parametrize("name", registered())
def test_shares_of_a_batch_teach_what_the_whole_does(two_ranks, monkeypatch, name):
    network = one_of_two.network_of(name)
    if batch_norms(network):
        pytest.skip("batch norm sees one rank's samples only")
    one_of_two.draw_alike(monkeypatch.setattr)
    loss, terms = network.loss(one_of_two.batch_of(network))
    loss.backward()
    found, expected = load_file(two_ranks[0] / f"{name}.safetensors"), gradients(network)
    for term, value in ({"loss": loss.detach()} | terms).items():
        assert found.pop(f"term {term}").item() == pytest.approx(value.item(), 1e-5, nan_ok=True)
    assert found.keys() == expected.keys()
    scale = max(1.0, *(float(value.abs().max()) for value in expected.values()))
    for part, value in expected.items():
        torch.testing.assert_close(
            found[part], value, rtol=0, atol=1e-5 * scale, msg=lambda text, part=part: part + text
        )


def test_a_run_of_two_ranks_is_that_of_one(data, two_ranks, monkeypatch, tmp_path):
    one_of_two.know_tiny(monkeypatch.setattr)
    one_of_two.train(data, tmp_path)
    both = two_ranks[0] / "unbroken"
    weights = load_file(both / MODEL)
    for name, expected in load_file(tmp_path / MODEL).items():
        torch.testing.assert_close(weights[name], expected, rtol=0, atol=1e-5)
    for found, expected in zip(*(read_rows(p / METRICS) for p in (both, tmp_path)), strict=True):
        numbers = {k: v for k, v in expected.items() if isinstance(v, float) and k not in TIMING}
        assert {k: found[k] for k in numbers} == pytest.approx(numbers, abs=1e-5)
    alone, shared = (json.loads((p / PROVENANCE).read_text()) for p in (tmp_path, both))
    assert (alone["ranks"], shared["ranks"], shared["samples"]) == (1, 2, alone["samples"])
    assert shared["device"] == "cpu"


def test_a_stop_that_one_rank_hears_of_stops_all_and_loses_nothing(two_ranks):
    out = two_ranks[0]
    assert all((out / f"rank{rank}").read_text().startswith("stopped at 6;") for rank in (0, 1))
    assert (out / "stopped" / MODEL).read_bytes() == (out / "unbroken" / MODEL).read_bytes()


def test_a_loss_that_is_not_finite_on_one_rank_ends_all_at_the_same_step(two_ranks):
    for rank in (0, 1):
        assert "no longer finite at step 3" in (two_ranks[0] / f"rank{rank}").read_text()


def test_an_error_on_one_rank_ends_all_with_one_sentence(two_ranks):
    _, said, codes = two_ranks
    assert "error: cannot write /dev/full: No space left" in said[0][1]
    assert codes == [2, 1]
    assert said[1] == ("", "")


def test_batch_norm_is_named(monkeypatch):
    spec, _ = find_agent("rvt2")
    network = spec.create(replace(one_of_two.tiny(spec.config("cpu")), head_norm="batch"), TEXT)
    assert batch_norms(network) == ["head.norm"]
    assert batch_norms(network.eval()) == []


def test_alone_everything_is_ones_own():
    rows = torch.randn(4, 3)
    assert gathered(rows) is rows
    assert share(5) == slice(0, 5)
    assert averaged({"loss": 1.5}) == {"loss": 1.5}


def test_a_batch_that_cannot_be_shared_equally_is_refused(monkeypatch):
    monkeypatch.setattr("baselines.distributed.ranks", lambda: 3)
    with pytest.raises(UsageError, match=r"16 cannot be shared equally by 3 .*multiple of 3"):
        share(16)


def test_a_gpu_is_asked_for_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert own_device("auto") == own_device("cpu") == torch.device("cpu")
    with pytest.raises(UsageError, match="1 processes need a GPU each, but this machine has 0"):
        own_device("cuda")
