"""The yaw covered by most arcs: a maximum clique of the rotation graph (Eq. 34, 37) without building a graph.

Arcs on a line that overlap pairwise share a point, so a clique of their graph is a point and the arcs over it. On the
circle this holds for the arcs through any one yaw, which is what the estimator needs. Sorting the ends and walking
them finds the deepest yaw exactly, in O(A log A). (Eq. 37 as printed has the interval ends swapped.)
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]

BINS = 1440
"""Bins of the overlap curve kept for display, a quarter of a degree each."""


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


def deepest_yaw(lo_rad: FloatArray, hi_rad: FloatArray) -> YawConsensus | None:
    """The yaw that most of the closed arcs [lo, hi] cover (-pi <= lo < pi, hi <= lo + 2 pi); None without arcs.

    -pi and pi are one yaw.
    """
    if len(lo_rad) == 0:
        return None
    full = hi_rad - lo_rad >= 2 * np.pi
    wraps = (hi_rad >= np.pi) & ~full
    ends = np.where(wraps, hi_rad - 2 * np.pi, hi_rad)
    overlap = np.zeros(BINS, np.int32)
    always = int(np.count_nonzero(full))
    start, end = _sweep(np.sort(lo_rad[~full]), np.sort(ends[~full]), always + int(np.count_nonzero(wraps)), overlap)
    yaw = 0.5 * (start + end)
    yaw -= 2 * np.pi if yaw >= np.pi else 0.0
    covers = full | np.where(wraps, (lo_rad <= yaw) | (yaw <= ends), (lo_rad <= yaw) & (yaw <= ends))
    return YawConsensus((start, end), yaw, np.flatnonzero(covers).astype(np.int32), overlap)


@numba.njit(cache=True, nogil=True)
def _mark(overlap, start, end, depth):
    """Raise the bins that touch [start, end] to ``depth``."""
    bins = len(overlap)
    first = max(0, min(bins - 1, int((start + np.pi) / (2 * np.pi) * bins)))
    last = max(0, min(bins - 1, int((end + np.pi) / (2 * np.pi) * bins)))
    for b in range(first, last + 1):
        overlap[b] = max(overlap[b], depth)


@numba.njit(cache=True, nogil=True)
def _sweep(starts, ends, depth, overlap):
    """Walk the sorted ends from -pi to pi, starting with ``depth`` arcs that cover -pi; fill ``overlap``.

    Returns the longest interval of greatest depth. Where an arc ends and another starts at the same yaw, both
    cover it, since arcs are closed.
    """
    count = len(starts)
    opened, closed = 0, 0
    here, best, best_lo, best_hi = -np.pi, -1, -np.pi, np.pi
    # The interval that starts at -pi continues the one that ends at pi.
    seam_depth, seam_end = -1, -np.pi
    while True:
        next_open = starts[opened] if opened < count else np.inf
        next_close = ends[closed] if closed < count else np.inf
        there = min(next_open, next_close, np.pi)
        _mark(overlap, here, there, depth)
        if seam_depth < 0 and there > -np.pi:
            seam_depth, seam_end = depth, there
        far = there + (seam_end + np.pi if there == np.pi and depth == seam_depth and here > -np.pi else 0.0)
        if depth > best or (depth == best and far - here > best_hi - best_lo):
            best, best_lo, best_hi = depth, here, far
        if there == np.pi:
            return best_lo, best_hi
        if next_open <= next_close:
            depth += 1
            opened += 1
        else:
            depth -= 1
            closed += 1
        here = there
