"""Workers: whatever happens to one job, the others and their results are untouched."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sacil_tasks.errors import UsageError
from sacil_tasks.workers import JobFailure, run_jobs

HANDLER = "tests.tasks.test_workers:make_handler"


SLEEP = """
from sacil_tasks.errors import run_command
from sacil_tasks.workers import run_jobs

run_command(lambda: list(run_jobs([60, 60], "tests.tasks.test_workers:make_sleeper", 2)))
"""


def make_sleeper() -> Callable[[float], None]:
    Path(os.environ["SLEEPERS"], f"{os.getpid()}.pid").touch()
    return time.sleep


def make_handler() -> Callable[[int | str], tuple[int | str, int]]:
    served = 0

    def handle(job: int | str) -> tuple[int | str, int]:
        nonlocal served
        served += 1
        match job:
            case "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "raise":
                raise ValueError("three blind mice")
            case "unusable":
                raise UsageError("no Vulkan device")
        return job, served

    return handle


@pytest.mark.parametrize("workers", [1, 3])
def test_every_job_comes_back_once_whatever_the_number_of_workers(workers):
    results = dict(run_jobs(range(10), HANDLER, workers))
    assert {job: result[0] for job, result in results.items()} == {n: n for n in range(10)}


def test_a_dead_worker_fails_its_own_job_and_is_replaced():
    results = dict(run_jobs([0, "crash", 1, 2], HANDLER, 1))
    assert results["crash"] == JobFailure("the worker died of SIGSEGV", died=True)
    assert results[2] == (2, 2), "the replacement served jobs 1 and 2"


def test_an_exception_is_a_failure_with_its_traceback_and_the_worker_lives():
    results = dict(run_jobs(["raise", 1], HANDLER, 1))
    failure = results["raise"]
    assert failure.reason == "ValueError: three blind mice"
    assert not failure.died
    assert "Traceback" in failure.details
    assert results[1] == (1, 2)


def test_a_usage_error_ends_the_run_with_its_sentence():
    with pytest.raises(UsageError, match="no Vulkan device"):
        list(run_jobs(["unusable", 1], HANDLER, 1))


def test_workers_are_recycled():
    results = dict(run_jobs(range(4), HANDLER, 1, recycle_after=2))
    assert [results[n][1] for n in range(4)] == [1, 2, 1, 2]


def test_no_jobs_start_no_workers():
    assert list(run_jobs([], "no_such_module:handler", 2)) == []


@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGKILL])
def test_stopping_the_parent_stops_its_workers_at_once(tmp_path, monkeypatch, blow):
    monkeypatch.setenv("SLEEPERS", str(tmp_path))
    group = subprocess.Popen(
        [sys.executable, "-c", SLEEP], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    pids = _wait_for(lambda: [int(p.stem) for p in tmp_path.glob("*.pid")], count=2)
    if blow == signal.SIGINT:
        os.killpg(group.pid, blow)  # what a terminal does: everybody gets it
    else:
        group.send_signal(blow)
    _, stderr = group.communicate(timeout=30)
    assert _wait_for(lambda: [pid for pid in pids if not _running(pid)], count=2)
    assert "Traceback" not in stderr
    assert group.returncode == (130 if blow == signal.SIGINT else -signal.SIGKILL)


def _wait_for(look: Callable[[], list[int]], count: int) -> list[int]:
    deadline = time.monotonic() + 60
    while len(found := look()) < count:
        assert time.monotonic() < deadline, f"found only {found}"
        time.sleep(0.05)
    return found


def _running(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
