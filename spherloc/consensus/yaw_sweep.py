"""The yaw covered by most arcs: a maximum clique of the rotation graph (Eq. 34, 37) without building a graph.

Arcs on a line that overlap pairwise share a point, so a clique of their graph is a point and the arcs over it. On the
circle this holds for the arcs through any one yaw, which is what the estimator needs. Sorting the ends and walking
them finds the deepest yaw exactly, in O(A log A). (Eq. 37 as printed has the interval ends swapped.)
"""

from dataclasses import dataclass

import numba
import numpy as np

from spherloc.types import FloatArray, IndexArray
from spherloc.watch import SELDOM, Watch, stopped

BINS = 1440
"""Bins of the overlap curve kept for display, a quarter of a degree each."""
MOST_SORTED = 2_000_000
"""Numbers that are sorted at once: some hundredths of a second."""


@dataclass(frozen=True, eq=False)
class YawConsensus:
    """The deepest yaw of A arcs."""

    interval_rad: tuple[float, float]
    """The longest of the intervals covered by most arcs; its upper end exceeds pi where it crosses the seam."""
    yaw_rad: float
    """Its middle, in [-pi, pi)."""
    clique: IndexArray
    """Indices of the arcs that cover it."""
    overlap: IndexArray
    """(BINS,) the most arcs over any one yaw of each bin, from -pi upwards."""


def deepest_yaw(lo_rad: FloatArray, hi_rad: FloatArray, watch: Watch | None = None) -> YawConsensus | None:
    """The yaw that most of the closed arcs [lo, hi] cover (-pi <= lo < pi, hi <= lo + 2 pi); None without arcs.

    -pi and pi are one yaw. ``watch`` counts the steps below; raises ``Cancelled``.
    """
    if len(lo_rad) == 0:
        return None
    watch = watch or Watch()
    watch.expect(5)
    starts, ends, depth = _ends(lo_rad, hi_rad, watch.board)
    watch.reach(1)
    _sort(starts, watch)
    watch.reach(2)
    _sort(ends, watch)
    watch.reach(3)
    overlap = np.zeros(BINS, np.int32)
    start, end = _sweep(starts, ends, depth, overlap, watch.board)
    watch.reach(4)
    yaw = 0.5 * (start + end)
    yaw -= 2 * np.pi if yaw >= np.pi else 0.0
    clique = _covering(lo_rad, hi_rad, yaw, watch.board)
    watch.reach(5)
    return YawConsensus((start, end), yaw, clique, overlap)


def _sort(values: FloatArray, watch: Watch) -> None:
    """Sort in place, by halves where one sort would take long: numpy's cannot be stopped."""
    watch.check()
    if len(values) <= MOST_SORTED:
        values.sort()
        return
    half = len(values) // 2
    values.partition(half)
    _sort(values[:half], watch)
    _sort(values[half:], watch)


@numba.njit(cache=True, nogil=True, inline="always")
def _kind(lo, hi):
    """Whether an arc is the whole circle, whether it crosses the seam, and its upper end below pi."""
    full = hi - lo >= 2 * np.pi
    wraps = hi >= np.pi and not full
    return full, wraps, hi - 2 * np.pi if wraps else hi


@numba.njit(cache=True, nogil=True)
def _ends(lo, hi, board):
    """Lower and upper ends of the arcs but whole circles, in any order, and how many arcs cover -pi from before."""
    starts, ends = np.empty(len(lo)), np.empty(len(lo))
    count, depth = 0, 0
    for k in range(len(lo)):
        if k & SELDOM == 0 and stopped(board):
            break
        full, wraps, end = _kind(lo[k], hi[k])
        starts[count], ends[count] = lo[k], end
        count += not full
        depth += full or wraps
    return starts[:count], ends[:count], depth


@numba.njit(cache=True, nogil=True)
def _covering(lo, hi, yaw, board):
    """Indices of the arcs that cover a yaw of [-pi, pi)."""
    covering = np.empty(len(lo), np.int32)
    count = 0
    for k in range(len(lo)):
        if k & SELDOM == 0 and stopped(board):
            break
        full, wraps, end = _kind(lo[k], hi[k])
        above, below = lo[k] <= yaw, yaw <= end
        covering[count] = k
        count += full | (wraps & (above | below)) | (above & below)
    return covering[:count].copy()


@numba.njit(cache=True, nogil=True, inline="always")
def _bin(yaw):
    return max(0, min(BINS - 1, int((yaw + np.pi) * (BINS / (2 * np.pi)))))


@numba.njit(cache=True, nogil=True)
def _sweep(starts, ends, depth, overlap, board):
    """Walk the sorted ends from -pi to pi, starting with ``depth`` arcs that cover -pi; fill ``overlap``.

    Returns the longest interval of greatest depth. Where an arc ends and another starts at the same yaw, both
    cover it, since arcs are closed.
    """
    count = len(starts)
    opened, closed = 0, 0
    here, first, best, best_lo, best_hi = -np.pi, 0, -1, -np.pi, np.pi
    # The interval that starts at -pi continues the one that ends at pi.
    seam_depth, seam_end = -1, -np.pi
    while True:
        next_open = starts[opened] if opened < count else np.inf
        next_close = ends[closed] if closed < count else np.inf
        there = min(next_open, next_close, np.pi)
        last = _bin(there)
        for b in range(first, last + 1):
            overlap[b] = max(overlap[b], depth)
        if seam_depth < 0 and there > -np.pi:
            seam_depth, seam_end = depth, there
        far = there + (seam_end + np.pi if there == np.pi and depth == seam_depth and here > -np.pi else 0.0)
        if depth > best or (depth == best and far - here > best_hi - best_lo):
            best, best_lo, best_hi = depth, here, far
        if there == np.pi or ((opened + closed) & SELDOM == 0 and stopped(board)):
            return best_lo, best_hi
        # Which one comes next is as good as random: arithmetic instead of a branch.
        opens = np.int64(next_open <= next_close)
        depth += 2 * opens - 1
        opened += opens
        closed += 1 - opens
        here, first = there, last
