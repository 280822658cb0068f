"""Translation balls: at a known yaw, the camera positions that agree with each pair of correspondences.

Paper, Eq. 24-27 and 38, stated for the camera position C = -R^T t in the aligned map frame instead of t: the two rays
of a pair start at their map points, and C is where they come closest. (Eq. 25's H loses rank for horizontal bearings;
the distance to both rays, H = [I - v_i v_i^T; I - v_j v_j^T], does not, and its least-squares solution is the middle of
their shortest connection.) With depth bounds S (see ``depth_bounds``) and a true yaw at most delta away, a pair of
inliers has

    |C - C_true| <= ||H^+|| hypot(S_i sin eps_i, S_j sin eps_j) + |C'| delta + |C''| delta^2 / 2,

where ||H^+|| = (1 - |cos alpha|)^(-1/2), the derivatives are by yaw, and S and |C''| are taken at their largest within
delta: the ball contains the true position.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.depth_bounds import chord, pair_sinusoids
from spherloc.problem import AlignedProblem
from spherloc.types import BoolArray, FloatArray, IndexArray
from spherloc.watch import DONE, Watch, stopped

ROUNDING = 1e-9
"""Part by which a lower bound is lowered, so that rounding never turns away a ball."""
FIRST_SORTED, MORE_SORTED = 32_000, 8
"""Smallest balls that are sorted to spread them, and how many times as many where these are too few."""
MOST_SORTED = 500_000
"""Numbers whose order is found at once: some hundredths of a second."""
FEW = 1023
"""Where these bits of the number of arcs are 0, the watch is looked at."""


def translation_balls(
    aligned: AlignedProblem, bound_rad: FloatArray, pairs: IndexArray, yaw_rad: float, yaw_slack_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Camera positions (P, 3) and radii (P,), metres, of ``pairs`` (P, 2) of places in ``aligned`` at a yaw.

    ``yaw_slack_rad`` (P,) bounds how far the true yaw may lie from ``yaw_rad``. A pair that bounds nothing has the
    radius inf.
    """
    centres, radii = np.empty((len(pairs), 3)), np.empty(len(pairs))
    _fill(aligned.bearings, aligned.points, bound_rad, pairs, yaw_rad, yaw_slack_rad, centres, radii)
    return centres, radii


def smallest_balls(
    aligned: AlignedProblem,
    bound_rad: FloatArray,
    arcs: tuple[IndexArray, FloatArray, FloatArray],
    covering: IndexArray,
    yaw_rad: float,
    most: int,
    watch: Watch | None = None,
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """The ``most`` smallest balls of the pairs whose arcs cover a yaw, smallest first: pairs (S, 2), centres, radii.

    ``arcs`` are those of ``yaw_arcs``, ``covering`` (K,) the indices of those that cover ``yaw_rad``; the slack of each
    reaches to its arc's farther end. Pairs that bound nothing are left out. Of equal balls the first counts as smaller.
    ``watch`` counts the arcs; raises ``Cancelled``.
    """
    watch = watch or Watch()
    watch.expect(len(covering))
    data = (aligned.bearings, aligned.points, bound_rad)
    pairs, centres, radii = _smallest(*data, *arcs, covering, yaw_rad, most, watch.board)
    kept = _order(radii, watch)[:most]
    return pairs[kept], centres[kept], radii[kept]


def _order(values: FloatArray, watch: Watch) -> NDArray[np.int64]:
    """The stable order of values, by halves where one sort would take long: numpy's cannot be stopped."""
    watch.check()
    if len(values) > MOST_SORTED:
        middle = np.partition(values, len(values) // 2)[len(values) // 2]
        low, high = np.flatnonzero(values < middle), np.flatnonzero(values >= middle)
        if len(low):
            return np.concatenate((low[_order(values[low], watch)], high[_order(values[high], watch)]))
    return np.argsort(values, kind="stable")


def share_of_each(count: int, most: int) -> int:
    """How many of ``most`` balls each of ``count`` correspondences may be part of: 2 (most / count)^2, rounded up.

    The smallest balls of all are those of the few points nearest to the camera. Among the thousand matches of real
    images these may all be wrong alike, where structure repeats; among a hundred the few right ones need several each.
    """
    return max(1, int(np.ceil(2.0 * (most / count) ** 2)))


def spread_balls(
    aligned: AlignedProblem,
    bound_rad: FloatArray,
    arcs: tuple[IndexArray, FloatArray, FloatArray],
    covering: IndexArray,
    yaw_rad: float,
    most: int,
    watch: Watch | None = None,
) -> tuple[IndexArray, FloatArray, FloatArray, int]:
    """Pairs (S, 2), centres and radii as of ``smallest_balls``, and how many pairs bound a position.

    If these are more than ``most``, the smallest are taken, no correspondence having more than ``share_of_each``; then
    the number is that of the pairs that were sorted for it, which may not be all.
    """
    count, sorted_ones = len(aligned.bearings), max(FIRST_SORTED, most + 1)
    while True:
        pairs, centres, radii = smallest_balls(aligned, bound_rad, arcs, covering, yaw_rad, sorted_ones, watch)
        if len(pairs) <= most:
            return pairs, centres, radii, len(pairs)
        kept = _spread(pairs, share_of_each(count, most), most, count)
        if len(kept) == most or len(pairs) < sorted_ones:
            return pairs[kept], centres[kept], radii[kept], len(pairs)
        sorted_ones *= MORE_SORTED


def overlapping(centres: FloatArray, radii: FloatArray) -> BoolArray:
    """Eq. 38: symmetric matrix (M, M) of balls that overlap; false on the diagonal."""
    overlap = np.zeros((len(radii), len(radii)), dtype=bool)
    _overlap(np.ascontiguousarray(centres.T), radii, overlap)
    return overlap


def edges_of(overlap: BoolArray) -> IndexArray:
    """(E, 2) places of the balls that overlap, the smaller one first, in ascending order."""
    return _edges(overlap, np.count_nonzero(overlap) // 2)


@numba.njit(cache=True, nogil=True)
def _edges(overlap, count):
    edges = np.empty((count + 1, 2), np.int32)
    found = 0
    for a in range(len(overlap)):
        for b in range(a + 1, len(overlap)):
            edges[found, 0], edges[found, 1] = a, b
            found += overlap[a, b]
    return edges[:count]


@numba.njit(cache=True, nogil=True)
def _overlap(centres, radii, overlap):
    x, y, z = centres
    for a in range(len(radii)):
        for b in range(a):
            dx, dy, dz, reach = x[a] - x[b], y[a] - y[b], z[a] - z[b], radii[a] + radii[b]
            overlap[a, b] = overlap[b, a] = dx * dx + dy * dy + dz * dz <= reach * reach


@numba.njit(cache=True, nogil=True)
def _spread(pairs, share, most, count):
    """Places of the first ``most`` pairs in which nobody has more than ``share``."""
    kept, used = np.empty(most, np.int64), np.zeros(count, np.int64)
    found = 0
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        if found < most and used[i] < share and used[j] < share:
            used[i] += 1
            used[j] += 1
            kept[found] = k
            found += 1
    return kept[:found]


@numba.njit(cache=True, nogil=True)
def _smallest(bearings, points, eps, pairs, lo, hi, covering, yaw, most, board):
    """Pairs (S, 2) in their order, centres and radii: the ``most`` smallest balls and some more."""
    chords, sines = chord(eps), np.sin(eps)
    c, s = np.cos(yaw), np.sin(yaw)
    room = min(2 * most, len(covering) + 1)
    near, centres, radii = np.empty((room, 2), np.int32), np.empty((room, 3)), np.empty(room)
    count, limit = 0, np.inf
    for place in range(len(covering)):
        if place & FEW == 0:
            board[DONE] = place
            if stopped(board):
                break
        arc = covering[place]
        i, j = np.int64(pairs[arc, 0]), np.int64(pairs[arc, 1])
        if not _least_squared_radius(i, j, bearings, points, chords, sines, c, s) < limit * limit:
            continue
        at = yaw if lo[arc] <= yaw else yaw + 2.0 * np.pi
        slack = max(at - lo[arc], hi[arc] - at)
        radii[count] = ball_of_pair(i, j, bearings, points, chords, sines, c, s, slack, centres[count])
        near[count, 0], near[count, 1] = i, j
        count += radii[count] < limit
        if count < room:
            continue
        # Keep the smallest, of equal ones the first, and look for smaller ones only.
        limit = np.partition(radii, most - 1)[most - 1]
        ties, count = most - np.count_nonzero(radii < limit), 0
        for old in range(room):
            if radii[old] < limit or (radii[old] == limit and ties > 0):
                ties -= radii[old] == limit
                near[count], centres[count], radii[count] = near[old], centres[old], radii[old]
                count += 1
    return near[:count].copy(), centres[:count].copy(), radii[:count].copy()


@numba.njit(cache=True, nogil=True, inline="always")
def _least_squared_radius(i, j, bearings, points, chords, sines, c, s):
    """A lower bound on the squared radius of ``ball_of_pair``, whatever its slack, for a fraction of the time."""
    vi, vj, pi, pj = bearings[i], bearings[j], points[i], points[j]
    dx, dy, dz = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    x, z = dx * c + dz * s, dz * c - dx * s
    along_i, along_j = vi[0] * x + vi[1] * dy + vi[2] * z, vj[0] * x + vj[1] * dy + vj[2] * z
    dot, sin2 = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2], _sin2_between(vi, vj)
    spare = np.sqrt(sin2) - chords[i] - chords[j]
    if spare <= 0.0:
        return np.inf
    # The depths and their bounds as in ``pair_sinusoids``, with the divisions left for the end.
    depth_i, depth_j = along_i - dot * along_j, dot * along_i - along_j
    most_i = max(0.0, (spare + chords[i]) * depth_i + chords[j] * depth_j) * sines[i]
    most_j = max(0.0, (spare + chords[j]) * depth_j + chords[i] * depth_i) * sines[j]
    squared = (most_i * most_i + most_j * most_j) * (1.0 + abs(dot)) / (spare * spare * sin2 * sin2 * sin2)
    return squared * (1.0 - ROUNDING)


@numba.njit(cache=True, nogil=True)
def _fill(bearings, points, eps, pairs, yaw, slack, centres, radii):
    chords, sines = chord(eps), np.sin(eps)
    c, s = np.cos(yaw), np.sin(yaw)
    for k in range(len(pairs)):
        i, j = np.int64(pairs[k, 0]), np.int64(pairs[k, 1])
        radii[k] = ball_of_pair(i, j, bearings, points, chords, sines, c, s, slack[k], centres[k])


@numba.njit(cache=True, nogil=True)
def ball_of_pair(i, j, bearings, points, chords, sines, c, s, slack, centre):
    """Radius of the ball of a pair at the yaw (c, s), inf if it bounds nothing; its centre is written."""
    vi, vj, pi, pj = bearings[i], bearings[j], points[i], points[j]
    sin_alpha, _, depth_i, depth_j, largest_i, largest_j, _ = pair_sinusoids(
        vi, vj, pi, pj, chords[i], chords[j], sines[i], sines[j]
    )
    if sin_alpha == 0.0:
        centre[:] = 0.5 * (pi + pj)
        return np.inf
    si, sj = _value(depth_i, c, s), _value(depth_j, c, s)
    di, dj = _slope(depth_i, c, s), _slope(depth_j, c, s)
    slope2 = 0.0
    for axis in range(3):
        ray_i, turn_i = _turned_back(vi, c, s, axis)
        ray_j, turn_j = _turned_back(vj, c, s, axis)
        centre[axis] = 0.5 * (pi[axis] - si * ray_i + pj[axis] - sj * ray_j)
        slope2 += (0.5 * (di * ray_i + si * turn_i + dj * ray_j + sj * turn_j)) ** 2
    # |(s v)''| <= |s''| + 2 |s'| + |s|, and a sinusoid's derivatives are at most its amplitude.
    bend = 0.5 * (_amplitude(depth_i) * 4.0 + abs(depth_i[2]) + _amplitude(depth_j) * 4.0 + abs(depth_j[2]))
    most_i = max(0.0, _value(largest_i, c, s) + _amplitude(largest_i) * slack)
    most_j = max(0.0, _value(largest_j, c, s) + _amplitude(largest_j) * slack)
    spread2 = (most_i * sines[i]) ** 2 + (most_j * sines[j]) ** 2
    dot = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    # 1 - |cos| = sin^2 / (1 + |cos|)
    noise = np.sqrt(spread2 * (1.0 + abs(dot)) / _sin2_between(vi, vj))
    return noise + np.sqrt(slope2) * slack + 0.5 * bend * slack * slack


@numba.njit(cache=True, nogil=True, inline="always")
def _value(wave, c, s):
    return wave[0] * c + wave[1] * s + wave[2]


@numba.njit(cache=True, nogil=True, inline="always")
def _slope(wave, c, s):
    return wave[1] * c - wave[0] * s


@numba.njit(cache=True, nogil=True, inline="always")
def _amplitude(wave):
    return np.sqrt(wave[0] * wave[0] + wave[1] * wave[1])


@numba.njit(cache=True, nogil=True, inline="always")
def _sin2_between(vi, vj):
    """sin^2 of the angle between two unit vectors, without cancellation for small angles."""
    cx = vi[1] * vj[2] - vi[2] * vj[1]
    cy = vi[2] * vj[0] - vi[0] * vj[2]
    cz = vi[0] * vj[1] - vi[1] * vj[0]
    return cx * cx + cy * cy + cz * cz


@numba.njit(cache=True, nogil=True)
def _turned_back(v, c, s, axis):
    """Component ``axis`` of R^T v and of its derivative by yaw."""
    if axis == 0:
        return v[0] * c - v[2] * s, -v[0] * s - v[2] * c
    if axis == 1:
        return v[1], 0.0
    return v[0] * s + v[2] * c, v[0] * c - v[2] * s
