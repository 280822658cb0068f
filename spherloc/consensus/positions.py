"""The largest consensus of all poses within the gravity bound, by branch and bound over cells (``pose_cells``).

Boxes of positions (and tilts) come first, ``box_search``, small cells with yaw after them, ``pose_search``. The work is
cut into tasks: cells that wait, those that might explain most first. In a round several tasks are searched at the same
time, each for a limited effort, against what was best before the round; what they leave becomes tasks again. So the
result does not depend on how many threads there are or how fast each of them is, and whenever the search is stopped,
the largest bound among its tasks is what is proven.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.box_search import MAX_BOXES, memory_for, search_boxes
from spherloc.consensus.pose_cells import AXES, TILT_A, YAW, PackedMatches, parameters_of, pose_of, whole_domain
from spherloc.consensus.pose_search import (
    BEST,
    EFFORT,
    HALT,
    LEFT,
    MAX_WAITING,
    OPEN,
    SPLITS,
    STATE,
    Left,
    Limits,
    search_poses,
)
from spherloc.consensus.yaw_bins import BINS
from spherloc.problem import AlignedProblem
from spherloc.processors import processor_count
from spherloc.types import FloatArray
from spherloc.watch import DONE, Watch, working_s

SWITCH_RAD = 0.06
"""Mean movement of directions in a box below which it is searched with derivatives."""
MIN_PX = 1e-5
"""Smaller cells differ by rounding."""
FIRST_EFFORT = 100_000
"""Tests of a match before threads are started: some thousandths of a second."""
TASK_EFFORT, TASK_ROUNDS = 400_000, 400
"""Least effort of a task, and its effort for each match: starting one again costs a test of every match."""
TASKS_A_ROUND = 8
SLOW_EFFORT = 5_000_000
"""Tests after which another start is asked for: most problems need fewer."""
MAX_SPLITS = 2000
"""Boxes that each task keeps for the picture, ..."""
MAX_KEPT = 20_000
"""... and all of them together."""
NEAR_TURN_RAD, NEAR_SHARE, NEAR_GAP, NEAR_EFFORT = 2e-3, 4e-3, 0.01, 60
"""The cell around the first guess: half sides of its turns, rad, and of its position, of the median distance; what may
be missed there, of all matches; tests for each match."""

Start = tuple[FloatArray, int]
"""A pose (3, 4) between the aligned frames, within the gravity bound, and how many matches it explains."""


@dataclass(frozen=True, eq=False)
class PositionSearch:
    """What the search found and proved."""

    pose: FloatArray | None
    """(3, 4) between the aligned frames, within the gravity bound; None if nothing explains two matches."""
    support: int
    """Matches that it explains, by the search's arithmetic; 1 without a pose."""
    upper: int
    """No pose within the gravity bound explains more."""
    effort: int
    """Matches tested."""
    boxes_m: FloatArray
    """(B, 2, 3) lower and upper corners, aligned map frame, of the boxes of positions that had to be split, the cube of
    all near ones first; those far away are left out."""
    level: NDArray[np.int32]
    """(B,) how often the cube was halved to get each."""
    box_bound: NDArray[np.int32]
    """(B,) what poses in each box explain at most."""

    @property
    def finished(self) -> bool:
        """Whether nothing is left to be searched."""
        return self.upper <= self.support


def search_positions(
    aligned: AlignedProblem,
    matches: PackedMatches,
    start: Start | None,
    effort: int,
    deadline: float,
    yaw_bound: NDArray[np.int32] | None = None,
    watch: Watch | None = None,
    another: Callable[[], Start | None] | None = None,
) -> PositionSearch:
    """Search all poses within the gravity bound for one that explains more matches than ``start`` does.

    ``matches`` is that of ``pack_matches``. After ``effort`` tests or at ``deadline`` (``working_s``) the search stops.
    ``yaw_bound`` (BINS,) bounds what poses explain by bin of turn, if anything is known. ``watch`` counts the tests;
    raises ``Cancelled``. ``another`` is called once if the search takes long, for a better start.
    """
    watch = watch or Watch()
    watch.expect(effort)
    search = _Search(aligned, matches, start, yaw_bound, watch)
    if working_s() < deadline:
        search.around_start(effort)
        search.first(min(FIRST_EFFORT, effort))
        search.rounds(effort, deadline, another)
    watch.check()
    return PositionSearch(search.pose(), search.best, search.upper(), search.effort, *search.boxes())


def threads_to_use() -> int:
    """Threads for the tasks of a round."""
    return min(TASKS_A_ROUND, processor_count())


class _Worker:
    """Memory of one thread."""

    def __init__(self, count: int) -> None:
        self.memory = memory_for(count, MAX_SPLITS)
        most = MAX_BOXES + MAX_WAITING + 64
        self.left = Left(np.empty((most, AXES)), np.empty((most, AXES)), np.empty((most, 3), np.int64))
        self.state = np.zeros(STATE, np.int64)
        self.best_at = np.zeros(1 + AXES)


class _Search:
    """The waiting tasks and the best pose of one search."""

    def __init__(
        self,
        aligned: AlignedProblem,
        matches: PackedMatches,
        start: Start | None,
        yaw_bound: NDArray[np.int32] | None,
        watch: Watch,
    ) -> None:
        self.matches = matches
        self.watch = watch
        self.count = len(aligned.points)
        self.gravity_bound_rad = aligned.gravity_bound_rad
        self.yaw_bound = np.full(BINS, self.count, np.int32) if yaw_bound is None else yaw_bound
        self.best, self.open, self.effort = 1, 1, 0
        self.best_at: FloatArray | None = None
        self._halted = False
        self._splits: list[tuple[FloatArray, FloatArray, NDArray[np.int32]]] = []
        self._kept = 0
        self.take_start(start)
        lower, upper = whole_domain(self.gravity_bound_rad)
        about = np.array([[chart, self.count, 0] for chart in range(len(lower))], np.int64)
        self.lower, self.upper_ends, self.about = lower, upper, about
        self._workers = [_Worker(self.count)]

    def halt(self) -> None:
        """Let the search leave off; from any thread."""
        self._halted = True
        for worker in self._workers:
            worker.state[HALT] = 1

    def pose(self) -> FloatArray | None:
        """The best pose (3, 4)."""
        return None if self.best_at is None else pose_of(self.matches, int(self.best_at[0]), self.best_at[1:])

    def boxes(self) -> tuple[FloatArray, NDArray[np.int32], NDArray[np.int32]]:
        """Boxes near the map that had to be split, as in ``PositionSearch``: those that could hold a better pose than
        the best one, each once, by level."""
        if not self._splits:
            return np.empty((0, 2, 3)), np.empty(0, np.int32), np.empty(0, np.int32)
        lower, upper, about = (np.concatenate(parts) for parts in zip(*self._splits, strict=True))
        near = (about[:, 0] == 0) & (about[:, 1] > self.best)
        corners, bound = np.stack([lower, upper], axis=1)[near], about[near, 1]
        level = np.round(np.log2(2.0 / (corners[:, 1] - corners[:, 0])).sum(axis=1)).astype(np.int32)
        # One position may be in several boxes, of other tilts: the largest bound counts.
        order = np.lexsort((-bound, *corners.reshape(-1, 6).T, level))
        _, first = np.unique(corners[order], axis=0, return_index=True)
        order = order[np.sort(first)]
        return self.matches.middle + self.matches.scale * corners[order], level[order], bound[order]

    def upper(self) -> int:
        """What is proven so far."""
        return max(self.best, self.open, int(self.about[:, 1].max(initial=0)))

    def take_start(self, start: Start | None) -> None:
        """Search for more than a pose explains from now on, if that is better than the best one."""
        if start is not None and start[1] > self.best:
            chart, at = parameters_of(self.matches, start[0])
            self.best_at, self.best = np.array([chart, *at]), start[1]

    def around_start(self, effort: int) -> None:
        """Look for better poses near the start."""
        if self.best_at is None:
            return
        chart, at = int(self.best_at[0]), self.best_at[1:]
        seen = pose_distances(self.matches, chart, at)
        half = np.full(AXES, NEAR_TURN_RAD)
        half[:YAW] = NEAR_SHARE * float(np.median(seen))
        half[TILT_A:] = np.minimum(half[TILT_A:], self.gravity_bound_rad)
        worker = self._workers[0]
        limits = Limits(int(NEAR_GAP * self.count), min(effort, NEAR_EFFORT * self.count), MIN_PX, SWITCH_RAD)
        self._prepare(worker)
        everybody = np.arange(self.count, dtype=np.int32)
        search_poses(
            self.matches,
            (chart, at - half, at + half),
            everybody,
            worker.memory.room,
            limits,
            (worker.best_at, worker.state, worker.left),
            self.watch.board,
        )
        self._take_best(worker)
        self.effort += int(worker.state[EFFORT])

    def first(self, effort: int) -> None:
        """Search everything, in this thread."""
        charts, bounds = self.about[:, 0].copy(), self.about[:, 1].copy()
        worker = self._workers[0]
        self._prepare(worker)
        tasks = (charts, self.lower.copy(), self.upper_ends.copy(), bounds)
        search_boxes(
            self.matches,
            tasks,
            self.yaw_bound,
            worker.memory,
            Limits(0, effort, MIN_PX, SWITCH_RAD),
            (worker.best_at, worker.state, worker.left),
            self.watch.board,
        )
        self._take_best(worker)
        self.about = np.empty((0, 3), np.int64)
        self.lower = self.upper_ends = np.empty((0, AXES))
        self._take_left([worker])

    def rounds(self, effort: int, deadline: float, another: Callable[[], Start | None] | None) -> None:
        """Search tasks, round by round, until none is left, as many tests are done, or it is as late.

        ``another`` is called once, for a better start, if the search takes long.
        """
        if len(self.about) == 0 or self.effort >= effort:
            return
        self._workers += [_Worker(self.count) for _ in range(TASKS_A_ROUND - 1)]
        each = max(TASK_EFFORT, TASK_ROUNDS * self.count)
        timer = threading.Timer(min(max(0.0, deadline - working_s()), threading.TIMEOUT_MAX), self.halt)
        timer.daemon = True
        timer.start()
        try:
            with ThreadPoolExecutor(threads_to_use()) as pool:
                while len(self.about) and self.effort < effort and not self._halted:
                    self.watch.board[DONE] = self.effort
                    self.watch.check()
                    if another is not None and self.effort >= SLOW_EFFORT:
                        self.take_start(another())
                        another = None
                    order = np.argsort(-self.about[:, 1], kind="stable")
                    now, later = order[:TASKS_A_ROUND], order[TASKS_A_ROUND:]
                    workers = self._workers[: len(now)]
                    left = max(1, effort - self.effort)
                    limits = Limits(0, min(each, left), MIN_PX, SWITCH_RAD)
                    for worker in workers:
                        self._prepare(worker)
                    list(pool.map(self._work, workers, now, repeat(limits)))
                    self.lower, self.upper_ends, self.about = (
                        self.lower[later],
                        self.upper_ends[later],
                        self.about[later],
                    )
                    for worker in workers:
                        self._take_best(worker)
                    self._take_left(workers)
        finally:
            timer.cancel()

    def _work(self, worker: _Worker, task: Any, limits: Limits) -> None:
        """Search one task."""
        chart, bound, narrow = self.about[task]
        lower, upper = self.lower[task].copy(), self.upper_ends[task].copy()
        found = (worker.best_at, worker.state, worker.left)
        if narrow:
            everybody = np.arange(self.count, dtype=np.int32)
            cell = (chart, lower, upper)
            search_poses(self.matches, cell, everybody, worker.memory.room, limits, found, self.watch.board)
            return
        tasks = (np.array([chart]), lower[None], upper[None], np.array([bound]))
        search_boxes(self.matches, tasks, self.yaw_bound, worker.memory, limits, found, self.watch.board)

    def _prepare(self, worker: _Worker) -> None:
        worker.state[:HALT] = 0
        worker.state[HALT] = self._halted
        worker.state[BEST] = self.best

    def _take_best(self, worker: _Worker) -> None:
        if worker.state[BEST] > self.best:
            self.best, self.best_at = int(worker.state[BEST]), worker.best_at.copy()

    def _take_left(self, workers: list[_Worker]) -> None:
        """Make what workers left tasks, unless it cannot explain more than the best pose."""
        lower, upper, about = [self.lower], [self.upper_ends], [self.about]
        for worker in workers:
            many, splits = int(worker.state[SPLITS]), worker.memory.splits
            if self._kept < MAX_KEPT:
                left_ends, right_ends, bounds = splits
                self._splits.append((left_ends[:many].copy(), right_ends[:many].copy(), bounds[:many].copy()))
                self._kept += many
            many = int(worker.state[LEFT])
            lower.append(worker.left.lower[:many].copy())
            upper.append(worker.left.upper[:many].copy())
            about.append(worker.left.about[:many].copy())
            self.open = max(self.open, int(worker.state[OPEN]))
            self.effort += int(worker.state[EFFORT])
        self.lower, self.upper_ends, self.about = np.concatenate(lower), np.concatenate(upper), np.concatenate(about)
        more = self.about[:, 1] > self.best
        self.lower, self.upper_ends, self.about = self.lower[more], self.upper_ends[more], self.about[more]


def pose_distances(matches: PackedMatches, chart: int, at: FloatArray) -> FloatArray:
    """|w| (M,) of a chart's parameters."""
    scale, c = 1.0, at[:3].copy()
    if chart:
        axis = (chart - 1) // 2
        scale = float(c[axis])
        c[axis] = 1.0 if chart % 2 else -1.0
    return np.linalg.norm(scale * matches.rows[:, :3] - c, axis=1)
