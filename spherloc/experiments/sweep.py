"""Success, errors and time of estimators against the outlier rate, noise, number or gravity error (Figs. 5 to 7).

>>> plan = planned(Path("scenes/mei_outliers_80.toml"), "outlier_rate", [0.5, 0.9], [Entrant("mc")], runs=100)
>>> rows = list(run_sweep(plan))

The runs are done by processes on this machine, or by a Dask cluster.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence

from spherloc.errors import InputError
from spherloc.experiments.sweep_cluster import Cluster
from spherloc.experiments.sweep_plan import AXES, Entrant, Job, SweepPlan, planned
from spherloc.experiments.sweep_rows import SweepRow
from spherloc.experiments.sweep_workers import Keep, LocalWorkers, Workers

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
    return LocalWorkers(plan, workers, keep) if scheduler is None else Cluster(plan, scheduler, keep)


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
