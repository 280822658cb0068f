"""The arcs of yaw that pairs of bounded bearings leave, for the exact search, without trigonometry.

An arc is where |f| <= tau and depths may be positive (see ``pair_sinusoids``). That search only compares yaws, so an
end (cos, sin) becomes its turn, the length along the square |cos| + |sin| = 1, from 0 to 4, which grows with yaw and
costs one division. The arcs bound as those of ``yaw_arcs`` do and are a little wider: a depth that changes its sign
within an arc does not shorten it. A pair that bounds nothing has the whole circle: its edge is in every graph.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.arc_block import BLOCK, FIRST, ROWS, SECOND, WHOLE, arcs_of_block
from spherloc.consensus.pair_rows import fill_rows
from spherloc.consensus.pair_sinusoids import ROUNDING, chord
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.types import FloatArray, IndexArray
from spherloc.watch import DONE, Watch, stopped

CIRCLE = 4.0
"""Turns of the whole circle."""
MAX_ARCS = 2
"""Arcs of a pair."""


class BoundedRays(NamedTuple):
    """M rays from map points to the camera, and the bounds on their directions."""

    bearings: FloatArray
    """(M, 3) measured unit vectors, aligned camera frame."""
    points: FloatArray
    """(M, 3) map points, m, aligned map frame."""
    chord: FloatArray
    """(M,) distance of unit vectors at the largest angular error."""
    sine: FloatArray
    """(M,) sine of that angle."""


class YawInterval(NamedTuple):
    """Yaws less than a quarter of a circle around one."""

    cos: float
    """Of the middle."""
    sin: float
    """Of the middle."""
    half_width_rad: float
    """How far the ends are from it."""


class Arcs(NamedTuple):
    """A arcs of feasible yaw of pairs of matches."""

    pairs: IndexArray
    """(A, 2) the two matches of each."""
    lo: FloatArray
    """(A,) first ends, in [0, 4), turns."""
    hi: FloatArray
    """(A,) second ends, up to a circle larger than the first, turns."""


def turn_of(yaw_rad: FloatArray) -> FloatArray:
    """Turns (...,) in [0, 4) of yaws (...,), rad."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    quarter = s / (np.abs(c) + np.abs(s))
    turn = np.where(c >= 0.0, quarter, 2.0 - quarter) % CIRCLE
    return np.where(turn < CIRCLE, turn, 0.0)


def pair_arcs(aligned: AlignedProblem, bound_rad: FloatArray, watch: Watch | None = None) -> Arcs:
    """Arcs of all pairs of the matches of ``aligned``.

    ``bound_rad`` (M,) bounds each bearing's angular error. ``watch`` counts the pairs; raises ``Cancelled``.
    """
    watch = watch or Watch()
    count = len(aligned.bearings)
    watch.expect(count * (count - 1) // 2)
    room = MAX_ARCS * (count * (count - 1) // 2)
    # Memory that is never touched is never used, so room for the worst case costs nothing.
    arcs = Arcs(np.empty((room, 2), np.int32), np.empty(room), np.empty(room))

    def fill(rows: tuple[int, int], part: tuple[NDArray, ...]) -> int:
        return _fill(aligned.bearings, aligned.points, bound_rad, rows, Arcs(*part), watch.board)

    found = fill_rows(count, MAX_ARCS, arcs, fill)
    watch.check()
    return Arcs(*found)


@kernel()
def turn_of_direction(c, s):
    """Turn in [0, 4] of the direction (c, s) of any length; 4 by rounding alone."""
    quarter = s / (abs(c) + abs(s))
    if c < 0.0:
        return 2.0 - quarter
    return quarter if quarter >= 0.0 else 4.0 + quarter


@kernel()
def direction_of_turn(turn):
    """(cos, sin) of the yaw of a turn."""
    turn %= CIRCLE
    c, s = abs(turn - 2.0) - 1.0, 1.0 - abs(turn - 1.0) if turn <= 3.0 else turn - 4.0
    norm = np.sqrt(c * c + s * s)
    return c / norm, s / norm


@kernel()
def yaws_between(lo, hi):
    """The ``YawInterval`` between the turns ``lo`` and ``hi``, less than half a circle apart."""
    c0, s0 = direction_of_turn(lo)
    c1, s1 = direction_of_turn(hi)
    c, s = c0 + c1, s0 + s1
    norm = np.sqrt(c * c + s * s)
    half_width_rad = 0.5 * np.arctan2(c0 * s1 - s0 * c1, c0 * c1 + s0 * s1) + ROUNDING
    return YawInterval(c / norm, s / norm, half_width_rad)


@kernel()
def _fill(bearings, points, eps, rows, arcs, board):
    """Write the arcs of the pairs (i, j) with i from ``rows[0]`` up to ``rows[1]`` to the ``Arcs`` ``arcs``, which have
    room for all; returns how many.

    ``bearings`` (M, 3), ``points`` (M, 3), m, ``eps`` (M,), rad. A watch's ``board`` counts the pairs and can end it.
    """
    used, count, rays = 0, len(eps), np.empty((8, len(eps)))
    for j in range(count):
        for axis in range(3):
            rays[axis, j], rays[3 + axis, j] = bearings[j, axis], points[j, axis]
        rays[6, j], rays[7, j] = chord(eps[j]), np.sin(eps[j])
    found = np.empty((ROWS, BLOCK))
    for i in range(rows[0], rows[1]):
        if stopped(board):
            break
        for begin in range(i + 1, count, BLOCK):
            end = min(begin + BLOCK, count)
            arcs_of_block(rays, i, begin, end, found.ravel())
            for k in range(end - begin):
                flags = int(found[0, k])
                if flags == WHOLE:
                    _put(arcs, used, i, begin + k, 0.0, CIRCLE)
                    used += 1
                else:
                    # Written in any case and counted if they exist: whether they do cannot be predicted.
                    _put(arcs, used, i, begin + k, found[1, k], found[2, k])
                    used += flags & FIRST
                    _put(arcs, used, i, begin + k, found[3, k], found[4, k])
                    used += flags // SECOND
        board[DONE] += count - 1 - i
    return used


@kernel(inline="always")
def _put(arcs, place, i, j, start, end):
    """Write an arc of the pair ``i``, ``j`` from the turn ``start`` to ``end``, in [0, 4], to a ``place`` of the
    ``Arcs`` ``arcs``."""
    pairs, lo, hi = arcs
    pairs[place, 0], pairs[place, 1] = i, j
    start = start if start < CIRCLE else 0.0
    past = start if start - end < ROUNDING else end + CIRCLE
    lo[place], hi[place] = start, past if end < start else end
