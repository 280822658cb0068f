"""Workers that do the tasks of a sweep, and those that are processes on this machine."""

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from typing import Any, Protocol

from spherloc.errors import InputError, reason
from spherloc.experiments.sweep_plan import Job, SweepPlan
from spherloc.experiments.sweep_rows import SweepRow
from spherloc.trace import Trace
from spherloc.warm_up import warm_up

MAX_WORKERS = 64
AHEAD = 1
"""Number of tasks that are queued besides those that are being done, so that no worker has to wait."""
MAX_FAILED_STARTS = 2
START_S = 120.0
"""Longest time that the first process may take to start."""
NICENESS = 10
"""Niceness of the worker processes: a sweep in the background must not slow down other work on this machine."""


class Keep(Protocol):
    """Stores whole runs where they are done. It is sent to the workers, so it must be plain data."""

    def __call__(self, plan: SweepPlan, job: Job, trace: Trace) -> str:
        """Store a run; returns a sentence that says why it could not be stored, or an empty text."""
        ...


@dataclass(frozen=True)
class Solved:
    """The results of a task."""

    rows: list[SweepRow]
    """A row for each run."""
    complaints: tuple[str, ...] = ()
    """Sentences that say why runs could not be stored."""
    failures: tuple[tuple[str, str], ...] = ()
    """Estimators of other packages that failed, by their labels, and how."""


@dataclass(frozen=True)
class Done:
    """A task that has ended."""

    jobs: tuple[Job, ...]
    """The jobs of the task."""
    solved: Solved | None
    """Its results; None if its worker died."""


class Workers(Protocol):
    """Workers that do tasks, each of which is a few jobs."""

    def room(self) -> int:
        """Number of further tasks that can be submitted now."""
        ...

    def submit(self, jobs: tuple[Job, ...]) -> None:
        """Have a worker do a task; does not wait."""
        ...

    def collect(self, timeout_s: float) -> list[Done]:
        """Tasks that have ended, as soon as there is one; an empty list if none ends in time.

        Raises ``InputError`` if a task is impossible or the workers are lost for good.
        """
        ...

    def close(self) -> None:
        """End the workers, whatever they are doing. May be called twice."""
        ...


def solve(plan: SweepPlan, jobs: Sequence[Job], keep: Keep | None) -> Solved:
    """Do the jobs of a task; called in a worker."""
    _warm(frozenset(entrant.estimator for entrant in plan.entrants))
    complaints: list[str] = []
    failures: dict[str, str] = {}
    rows = plan.solve(
        jobs,
        None if keep is None else lambda job, trace: complaints.append(keep(plan, job, trace)),
        lambda job, sentence: failures.update({plan.labels[job.entrant]: sentence}),
    )
    return Solved(rows, tuple(filter(None, complaints)), tuple(failures.items()))


@cache
def _warm(estimators: frozenset[str]) -> None:
    """Load the kernels, so that no run's time includes it."""
    warm_up(estimators=estimators)


class LocalWorkers:
    """Processes on this machine.

    They hold one end of a pipe, the lifeline, and end when its other end is closed: by ``close``, or because this
    process has ended, whatever ended it. A pool with a dead process is replaced, and its tasks are reported as lost.
    """

    def __init__(self, plan: SweepPlan, workers: int, keep: Keep | None) -> None:
        """Raises ``InputError`` for a wrong number of workers."""
        if not 1 <= workers <= MAX_WORKERS:
            raise InputError(f"the sweep has {workers} workers; give a number from 1 to {MAX_WORKERS}.")
        self._plan, self._workers, self._keep = plan, workers, keep
        self._tasks: dict[Future[Solved], tuple[Job, ...]] = {}
        self._failed_starts = 0
        self._start()

    def room(self) -> int:
        """Number of further tasks that can be submitted now."""
        return self._workers + AHEAD - len(self._tasks)

    def submit(self, jobs: tuple[Job, ...]) -> None:
        """Have a worker do these jobs as one task; does not wait.

        Raises ``InputError`` if no process can be started.
        """
        try:
            with _deaf_to_ctrl_c():
                future = self._pool.submit(solve, self._plan, jobs, self._keep)
        except BrokenExecutor as error:  # noticed before ``collect``
            future = Future()
            future.set_exception(error)
        except OSError as error:  # a further process is started when there is work for it
            raise _not_started(error) from None
        self._tasks[future] = jobs

    def collect(self, timeout_s: float) -> list[Done]:
        """Tasks that ended since the last call; waits at most ``timeout_s`` seconds for the first one.

        Raises ``InputError`` if the first process does not start in time.
        """
        ended, _ = wait(self._tasks, timeout_s, FIRST_COMPLETED)
        if not self._begun.done() and time.monotonic() - self._started > START_S:
            for process in dict(self._pool._processes or {}).values():
                process.kill()  # it does not listen to the lifeline yet
            raise InputError(
                f"no worker process has started within {START_S:.0f} s; see whether other programs keep the machine "
                "busy, then start the sweep again."
            )
        if any(_is_broken(future) for future in ended):
            ended = set(self._tasks)  # those that have a result keep it
            self._replace()
        return [Done(self._tasks.pop(future), _result(future)) for future in ended]

    def close(self) -> None:
        """Drop tasks that were not begun, and end the processes."""
        self._lifeline.close()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _start(self) -> None:
        spawn = multiprocessing.get_context("spawn")  # the page has threads, which a fork would break
        reader, self._lifeline = spawn.Pipe(duplex=False)
        try:
            self._started = time.monotonic()
            self._pool = ProcessPoolExecutor(self._workers, spawn, _begin, (reader,))
            with _deaf_to_ctrl_c():
                self._begun = self._pool.submit(os.getpid)
        except OSError as error:
            self._lifeline.close()
            raise _not_started(error) from None

    def _replace(self) -> None:
        begun = _result(self._begun) is not None
        self._failed_starts = 0 if begun else self._failed_starts + 1
        if self._failed_starts == MAX_FAILED_STARTS:
            raise InputError(
                "the worker processes end while they start: in a script, call this under "
                "'if __name__ == \"__main__\":', else see whether the memory is full and what the terminal says."
            )
        self.close()
        self._start()


def _not_started(error: OSError) -> InputError:
    return InputError(
        f"the worker processes cannot be started ({reason(error)}); see whether /dev/shm can be written and how many "
        "processes are allowed."
    )


def _begin(lifeline: Connection) -> None:
    """Start of a worker process."""
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    threading.Thread(target=_end_with, args=(lifeline,), name="spherloc-lifeline", daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(0)


def _is_broken(future: Future[Solved]) -> bool:
    return not future.cancelled() and isinstance(future.exception(), BrokenExecutor)


def _result(future: Future[Any]) -> Any:
    """The result of a task that has ended or never will; None if its worker died. Raises what the task raised."""
    try:
        return future.result(timeout=0)
    except (BrokenExecutor, CancelledError, TimeoutError):
        return None


@contextlib.contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Processes that are started within it ignore Ctrl-C, which a terminal sends to them too."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
