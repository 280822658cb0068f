"""Success, errors and time of estimators against the outlier rate, noise, number or gravity error (Figs. 5 to 7).

>>> plan = planned(Path("scenes/mei_outliers_80.toml"), "outlier_rate", [0.5, 0.9], [Entrant("mc")], runs=100)
>>> rows = list(run_sweep(plan))

The runs are done by processes on this machine, or by a Dask cluster whose machines have spherloc installed and can read
the scene file.
"""

import asyncio
import contextlib
import logging
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from typing import Any, Protocol

from spherloc.errors import InputError, reason
from spherloc.experiments.sweep_plan import AXES, Entrant, Job, SweepPlan, planned
from spherloc.experiments.sweep_rows import SweepRow
from spherloc.registry import require
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


CONNECT_S = 10.0
COUNT_EVERY_S = 2.0
"""Time between two counts of the workers, whose number can change."""
PATIENCE_S = 60.0
"""Longest time for which a cluster may be without any worker."""
GATHER_S = 2.0


class Cluster:
    """Workers behind a Dask scheduler. Dask does the tasks of a lost worker again, also those with a result."""

    def __init__(self, plan: SweepPlan, address: str, keep: Keep | None) -> None:
        """Raises ``InputError`` if ``dask.distributed`` is missing, or no scheduler with workers is at ``address``."""
        self._dask = require("distributed", "cluster", "a sweep on a Dask cluster")
        self._plan, self._address, self._keep = plan, address, keep
        # Errors are reported here in one sentence; Dask would log them with tracebacks.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            # A client that never reached its scheduler takes 20 s to be deleted, so the address is tried before.
            with ThreadPoolExecutor(1) as knocking:
                knocking.submit(asyncio.run, _knock(self._dask, address)).result()
            self._client: Any = self._dask.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, TypeError, ImportError) as error:
            raise InputError(
                f"no Dask scheduler answers at '{address}' ({_one_line(error)}); give its address, such as "
                "tcp://host:8786."
            ) from None
        self._tasks: dict[Any, tuple[Job, ...]] = {}
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._threads, self._counted, self._seen = 0, 0.0, time.monotonic()
        try:
            with contextlib.suppress(TimeoutError):
                self._client.wait_for_workers(1, timeout=CONNECT_S)
            self._count()
            if not self._threads:
                raise InputError(f"the Dask cluster at {address} has no workers; start some: dask worker {address}")
        except BaseException:
            self.close()
            raise

    def room(self) -> int:
        """Number of further tasks that can be submitted now."""
        if time.monotonic() - self._counted > COUNT_EVERY_S:
            self._count()
        return self._threads + AHEAD - len(self._tasks)

    def submit(self, jobs: tuple[Job, ...]) -> None:
        """Have a worker do these jobs as one task; does not wait."""
        future = self._client.submit(solve, self._plan, jobs, self._keep, pure=False)
        self._tasks[future] = jobs
        future.add_done_callback(self._ended.put)

    def collect(self, timeout_s: float) -> list[Done]:
        """Tasks that ended since the last call; waits at most ``timeout_s`` seconds for the first one."""
        found: list[Done] = []
        with contextlib.suppress(queue.Empty):
            future = self._ended.get(timeout=timeout_s)
            while True:
                if (done := self._gather(future)) is not None:
                    found.append(done)
                future = self._ended.get_nowait()
        if not found:
            self._check()
        return found

    def close(self) -> None:
        """Drop tasks that are not done, and disconnect from the workers."""
        with contextlib.suppress(Exception):  # the scheduler may be gone
            self._client.cancel(list(self._tasks), asynchronous=False)
        self._tasks.clear()
        with contextlib.suppress(Exception):
            self._client.close(timeout=2)

    def _gather(self, future: Any) -> Done | None:
        """The task of a future; None if its result was lost with its worker and is being computed again."""
        try:
            solved = future.result(timeout=GATHER_S)
        except self._dask.KilledWorker:
            solved = None
        except TimeoutError:
            future.add_done_callback(self._ended.put)
            return None
        except self._dask.CancelledError:
            raise self._lost() from None
        return Done(self._tasks.pop(future), solved)

    def _check(self) -> None:
        if self._client.status != "running":
            raise self._lost()
        if time.monotonic() - self._seen > PATIENCE_S:
            raise InputError(
                f"the Dask cluster at {self._address} has had no workers for {PATIENCE_S:.0f} s; start some and give "
                "the same command to go on."
            )

    def _count(self) -> None:
        try:
            self._threads = sum(self._client.nthreads().values())
        except (OSError, TimeoutError):
            raise self._lost() from None
        self._counted = time.monotonic()
        if self._threads:
            self._seen = self._counted

    def _lost(self) -> InputError:
        return InputError(
            f"the Dask scheduler at {self._address} is gone; start it and give the same command to go on."
        )


async def _knock(dask: Any, address: str) -> None:
    identity = dask.rpc(address, timeout=CONNECT_S)
    try:
        if (await asyncio.wait_for(identity.identity(), CONNECT_S))["type"] != "Scheduler":
            raise ValueError("it is not a scheduler")
    finally:
        await identity.close_rpc()


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."


__all__ = ["AXES", "Entrant", "Job", "Keep", "SweepPlan", "SweepRow", "planned", "run_sweep"]

TASK_S = 0.3
"""Target duration of a task, which is a few runs: a shorter one costs too many messages, a longer one looks stuck."""
OVERHEAD_MS = 2.0
"""Time of a run besides its estimator: drawing the problem, judging the pose."""
KEEPING_MS = 50.0
"""Additional time of a run that is stored."""
MAX_DEATHS = 3
LISTEN_S = 0.1


def run_sweep(
    plan: SweepPlan,
    done: Collection[tuple[str, float, int]] = (),
    workers: int = 2,
    scheduler: str | None = None,
    stop: threading.Event | None = None,
    keep: Keep | None = None,
    complain: Callable[[str], None] = lambda sentence: None,
    warn: Callable[[str], None] = lambda sentence: None,
) -> Iterator[SweepRow]:
    """The rows of a sweep as they are completed, evenly over all points; all runs are done in other processes.

    ``done`` holds (estimator's label, value, seed) of runs to be left out. ``scheduler`` is the address of a Dask
    scheduler ("tcp://host:8786"), whose workers then do the runs instead of ``workers`` processes on this machine.
    The rows do not depend on which worker does them, except for their times and their order. Setting ``stop``, or
    closing the iterator, ends it within a fraction of a second and leaves no process behind. Runs of a worker that dies
    are done again.

    ``keep`` is called with every run where it is done, before its row is returned and outside the measured time;
    ``complain`` gets a sentence for each run that could not be stored. ``warn`` gets one for each estimator of an
    extension that fails: such runs count as failures without a pose.

    Raises ``InputError`` if a run is impossible or kills its worker every time, or if there are no workers.
    """
    backlog = Backlog(plan, done, OVERHEAD_MS + (0.0 if keep is None else KEEPING_MS))
    pool, warned = _start_workers(plan, workers, scheduler, keep), set[str]()
    try:
        while backlog.left and not (stop is not None and stop.is_set()):
            for _ in range(pool.room()):
                if jobs := backlog.take():
                    pool.submit(jobs)
            for task in pool.collect(LISTEN_S):
                if task.solved is None:
                    backlog.put_back(task.jobs)
                    continue
                for label, sentence in task.solved.failures:
                    if label not in warned:
                        warned.add(label)
                        warn(f"{sentence} Such runs count as failures.")
                for sentence in task.solved.complaints:
                    complain(sentence)
                yield from backlog.book(task.jobs, task.solved.rows)
    finally:
        pool.close()


def _start_workers(plan: SweepPlan, workers: int, scheduler: str | None, keep: Keep | None) -> Workers:
    if scheduler is None:
        return LocalWorkers(plan, workers, keep)
    from spherloc.experiments.sweep import Cluster

    return Cluster(plan, scheduler, keep)


class Backlog:
    """The runs that are still to be done, divided into tasks."""

    def __init__(
        self, plan: SweepPlan, done: Collection[tuple[str, float, int]], overhead_ms: float = OVERHEAD_MS
    ) -> None:
        """``overhead_ms`` is the time of a run besides its estimator."""
        self._plan, self._overhead_ms = plan, overhead_ms
        known, labels = set(done), plan.labels
        self._fresh = (
            job
            for job in plan.jobs()
            if (labels[job.entrant], plan.values[job.value], plan.first_seed + job.run) not in known
        )
        self._next = next(self._fresh, None)
        self._suspects: deque[Job] = deque()
        """Jobs of tasks whose worker died. Each is done alone, with no other task, to find the one that kills
        workers."""
        self._trial: tuple[Job, ...] = ()
        """The suspect that is being done, alone."""
        self._deaths: Counter[Job] = Counter()
        self._out: set[tuple[Job, ...]] = set()
        self._spent_ms: dict[tuple[int, int], tuple[int, float]] = {}

    @property
    def left(self) -> bool:
        """Whether some runs are not done."""
        return bool(self._next or self._suspects or self._out)

    def take(self) -> tuple[Job, ...]:
        """The next task; empty if there is none now."""
        if self._trial or (self._suspects and self._out):
            return ()
        jobs = self._trial = (self._suspects.popleft(),) if self._suspects else ()
        jobs = jobs or tuple(self._next_jobs())
        if jobs:
            self._out.add(jobs)
        return jobs

    def book(self, jobs: tuple[Job, ...], rows: Sequence[SweepRow]) -> Sequence[SweepRow]:
        """Note that a task is done; returns its rows."""
        self._leave(jobs)
        for job, row in zip(jobs, rows, strict=True):
            runs, total_ms = self._spent_ms.get((job.value, job.entrant), (0, 0.0))
            self._spent_ms[job.value, job.entrant] = runs + 1, total_ms + row.time_ms
        return rows

    def put_back(self, jobs: tuple[Job, ...]) -> None:
        """Note that a task's worker died. Raises ``InputError`` if that happens every time."""
        if jobs == self._trial:
            self._deaths[jobs[0]] += 1
            if self._deaths[jobs[0]] == MAX_DEATHS:
                raise InputError(
                    f"{self._plan.place(jobs[0])}: its worker process was killed {MAX_DEATHS} times; see whether the "
                    "memory suffices, or sweep without it."
                )
        self._leave(jobs)
        self._suspects.extend(jobs)

    def _leave(self, jobs: tuple[Job, ...]) -> None:
        self._out.remove(jobs)
        if jobs == self._trial:
            self._trial = ()

    def _next_jobs(self) -> Iterator[Job]:
        spent_ms = 0.0
        while self._next is not None:
            job = self._next
            # The time of a run at a new point is unknown, so the first one is a task of its own.
            runs, total_ms = self._spent_ms.get((job.value, job.entrant), (1, 1e3 * TASK_S))
            cost_ms = total_ms / runs + self._overhead_ms
            if spent_ms and spent_ms + cost_ms > 1e3 * TASK_S:
                return
            spent_ms += cost_ms
            self._next = next(self._fresh, None)
            yield job
