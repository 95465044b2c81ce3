"""Jobs -> results in child processes that may raise, crash or be killed without ending the run.

Vulkan and PhysX must not be forked, so workers are spawned. A worker that dies turns its job into
a `JobFailure` and is replaced. Nothing about a result may depend on the worker that made it.
"""

import importlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, TypeVar

from sacil_tasks.errors import UsageError

J = TypeVar("J")
R = TypeVar("R")

HandlerFactory = str | Callable[[], Callable[[Any], Any]]
"""`"module:factory"`, or a picklable callable; called once in each worker before its first job."""

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")
_CONTEXT = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class JobFailure:
    """Why a job has no result."""

    reason: str
    """One line: the exception, or how the worker died."""

    died: bool = False
    """The worker was lost (segmentation fault, kill), not merely an exception raised."""

    details: str = ""
    """Traceback, if there is one."""


def run_jobs(
    jobs: Sequence[J], handler: HandlerFactory, workers: int, *, recycle_after: int | None = None
) -> Generator[tuple[J, Any | JobFailure], None, None]:
    """Yield `(job, result or JobFailure)` as jobs finish, in any order.

    `handler()` is called in each worker and gives the function that turns a job into a result.
    `recycle_after`: replace a worker after so many jobs. Closing the iterator (Ctrl-C too) kills
    all workers at once.

    Raises:
        UsageError: a handler raised it: no job can succeed on this machine.
    """
    waiting = list(reversed(jobs))
    crew: list[_Worker[J]] = []
    try:
        for _ in range(min(workers, len(jobs))):
            crew.append(_Worker(handler))
            crew[-1].give(waiting.pop())
        while crew:
            worker = _first_ready(crew)
            job, result = worker.collect()
            spent = not worker.alive or worker.done == recycle_after
            if spent or not waiting:
                crew.remove(worker)
                worker.stop()
            if spent and waiting:
                worker = _Worker(handler)
                crew.append(worker)
            if waiting:
                worker.give(waiting.pop())
            yield job, result
    finally:
        for worker in crew:
            worker.stop()


class _Worker(Generic[J]):
    """The parent's end of one child process and the job it holds."""

    def __init__(self, handler: HandlerFactory) -> None:
        self._pipe, child = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_serve, args=(child,), daemon=True)
        _start_deaf_to_ctrl_c(self._process)
        child.close()
        self._job: J
        self.alive = True
        self.done = 0
        self._send(handler)

    @property
    def ready(self) -> tuple[Connection, int]:
        """What becomes readable when there is an answer or the process has died."""
        return self._pipe, self._process.sentinel

    def give(self, job: J) -> None:
        """Hand over the next job; it runs at once."""
        self._job = job
        self._send(job)

    def collect(self) -> tuple[J, Any | JobFailure]:
        """Return the job held and its answer."""
        try:
            answer = self._pipe.recv()
        except (EOFError, OSError):
            self.alive = False
            self._process.join()
            return self._job, JobFailure(_cause_of_death(self._process.exitcode), died=True)
        if isinstance(answer, UsageError):
            raise answer
        self.done += 1
        return self._job, answer

    def stop(self) -> None:
        """Kill the process; there is nothing in it worth saving."""
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def _send(self, message: Any) -> None:
        # A worker that died while idle is noticed in `collect`, which blames its job.
        with suppress(BrokenPipeError):
            self._pipe.send(message)


def _start_deaf_to_ctrl_c(process: BaseProcess) -> None:
    # Ctrl-C is the parent's to handle. The child inherits the mask, so it is deaf from the start.
    # The tracker unblocks Ctrl-C when it starts, which the first child would do otherwise.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _first_ready(crew: Sequence[_Worker[J]]) -> _Worker[J]:
    ready = set(wait([end for worker in crew for end in worker.ready]))
    return next(worker for worker in crew if ready.intersection(worker.ready))


def _cause_of_death(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"the worker died of {signal.Signals(-exit_code).name}"
    return f"the worker ended with exit code {exit_code}"


def _serve(pipe: Connection) -> None:
    """Life of a worker: receive the handler factory, then jobs, until the parent is gone."""
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # before the handler imports anything
    threading.Thread(target=_die_with_parent, daemon=True).start()
    with suppress(EOFError, ConnectionError):  # a parent that is killed may close the pipe first
        factory: HandlerFactory = pipe.recv()
        handle: Callable[[Any], Any] | None = None
        while True:
            job = pipe.recv()
            try:
                handle = handle or _load(factory)()
                answer = handle(job)
            except UsageError as error:
                answer = error
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
                answer = JobFailure(reason, details=traceback.format_exc())
            pipe.send(answer)


def _load(factory: HandlerFactory) -> Callable[[], Callable[[Any], Any]]:
    if not isinstance(factory, str):
        return factory
    module, _, name = factory.partition(":")
    return getattr(importlib.import_module(module), name)


def _die_with_parent() -> None:
    # A parent killed with -9 cannot stop its workers, and a late worker must not write.
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
    os._exit(1)
