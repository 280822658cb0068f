"""Translation balls: at a known yaw, the camera positions that agree with each pair of correspondences.

Paper, Eq. 24-27 and 38, stated for the camera position C = -R^T t in the aligned map frame instead of t: the two rays
of a pair start at their map points, and C is where they come closest. (Eq. 25's H loses rank for horizontal bearings;
the distance to both rays, H = [I - v_i v_i^T; I - v_j v_j^T], does not, and its least-squares solution is the middle of
their shortest connection.) With depth bounds S (see ``pair_sinusoids``) and a true yaw at most delta away, a pair of
inliers has

    |C - C_true| <= ||H^+|| hypot(S_i sin eps_i, S_j sin eps_j) + |C'| delta + |C''| delta^2 / 2,

where ||H^+|| = (1 - |cos alpha|)^(-1/2), the derivatives are by yaw, and S and |C''| are taken at their largest within
delta: the ball contains the true position.

The second half is for the exact search: balls of pairs chosen so that every consensus of a given size has its camera in
one of them. A set that leaves out at most m of the candidates holds at least one of any m + 1 disjoint pairs entirely.
"""

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.long_sort import order_of_few
from spherloc.consensus.pair_arcs import Arcs, BoundedRays, YawInterval
from spherloc.consensus.pair_sinusoids import chord, pair_sinusoids
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.small_arrays import copy_vector, fill_matrix, fill_vector
from spherloc.types import BoolArray, FloatArray, IndexArray
from spherloc.watch import DONE, Watch, stopped

ROUNDING = 1e-9
"""Part by which a lower bound is lowered, so that rounding never turns away a ball."""
FIRST_SORTED, MORE_SORTED = 32_000, 8
"""Smallest balls that are sorted to spread them, and how many times as many where these are too few."""
MAX_SORTED = 500_000
"""Numbers whose order is found at once: some hundredths of a second."""
WATCH_MASK = 1023
"""Where these bits of the number of arcs are 0, the watch is looked at."""
MAX_FIRST = 16
"""Candidates from which disjoint pairs are started."""


def translation_balls(
    aligned: AlignedProblem, bound_rad: FloatArray, pairs: IndexArray, yaw_rad: float, yaw_slack_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Camera positions (P, 3) and radii (P,), metres, of ``pairs`` (P, 2) of matches of ``aligned`` at a yaw.

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
    bearings, points = aligned.bearings, aligned.points
    found = _smallest(bearings, points, bound_rad, Arcs(*arcs), covering, yaw_rad, most, watch.board)
    pairs, centres, radii = found
    kept = _order(radii, watch)[:most]
    return pairs[kept], centres[kept], radii[kept]


def _order(values: FloatArray, watch: Watch) -> NDArray[np.int64]:
    """The stable order of values, by halves where one sort would take long: numpy's cannot be stopped."""
    watch.check()
    if len(values) > MAX_SORTED:
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
    share: int,
    watch: Watch | None = None,
) -> tuple[IndexArray, FloatArray, FloatArray, int]:
    """Pairs (S, 2), centres and radii as of ``smallest_balls``, and how many pairs bound a position.

    If these are more than ``most``, the smallest are taken, no correspondence having more than ``share`` of them; then
    the number is that of the pairs that were sorted for it, which may not be all.
    """
    count, sorted_ones = len(aligned.bearings), max(FIRST_SORTED, most + 1)
    while True:
        pairs, centres, radii = smallest_balls(aligned, bound_rad, arcs, covering, yaw_rad, sorted_ones, watch)
        if len(pairs) <= most:
            return pairs, centres, radii, len(pairs)
        kept = _spread(pairs, share, most, count)
        if len(kept) == most or len(pairs) < sorted_ones:
            return pairs[kept], centres[kept], radii[kept], len(pairs)
        sorted_ones *= MORE_SORTED


def overlapping(centres: FloatArray, radii: FloatArray) -> BoolArray:
    """Eq. 38: symmetric matrix (M, M) of balls that overlap; false on the diagonal."""
    overlap = np.zeros((len(radii), len(radii)), dtype=bool)
    _overlap(np.ascontiguousarray(centres.T), radii, overlap)
    return overlap


def edges_of(overlap: BoolArray) -> IndexArray:
    """(E, 2) indices of the balls that overlap, the smaller one first, in ascending order."""
    return _edges(overlap, np.count_nonzero(overlap) // 2)


@kernel()
def _edges(overlap, count):
    """The ``count`` edges (E, 2) of the symmetric matrix ``overlap`` (M, M)."""
    edges = np.empty((count + 1, 2), np.int32)
    found = 0
    for a in range(len(overlap)):
        for b in range(a + 1, len(overlap)):
            edges[found, 0], edges[found, 1] = a, b
            found += overlap[a, b]
    return edges[:count]


@kernel()
def _overlap(centres, radii, overlap):
    """Write which balls overlap to ``overlap`` (M, M), false before; ``centres`` (3, M), m, ``radii`` (M,), m."""
    x, y, z = centres
    for a in range(len(radii)):
        for b in range(a):
            dx, dy, dz, reach = x[a] - x[b], y[a] - y[b], z[a] - z[b], radii[a] + radii[b]
            overlap[a, b] = overlap[b, a] = dx * dx + dy * dy + dz * dz <= reach * reach


@kernel()
def _spread(pairs, share, most, count):
    """Indices of the first ``most`` of ``pairs`` (P, 2) in which none of ``count`` matches has more than ``share``."""
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


@kernel()
def bounded_rays(bearings, points, eps):
    """``BoundedRays`` of ``bearings`` (M, 3) and ``points`` (M, 3), m, with angular errors up to ``eps`` (M,), rad."""
    return BoundedRays(bearings, points, chord(eps), np.sin(eps))


@kernel()
def _smallest(bearings, points, eps, arcs, covering, yaw, most, board):
    """Pairs (S, 2) in their order, centres (S, 3) and radii (S,), m: the ``most`` smallest balls and some more.

    ``bearings`` (M, 3), ``points`` (M, 3), m, ``eps`` (M,), rad, ``arcs``, ``covering`` (K,) and ``yaw``, rad, are
    those of ``smallest_balls``; a watch's ``board`` counts the arcs and can end it.
    """
    rays = bounded_rays(bearings, points, eps)
    pairs, lo, hi = arcs
    c, s = np.cos(yaw), np.sin(yaw)
    room = min(2 * most, len(covering) + 1)
    near, centres, radii = np.empty((room, 2), np.int32), np.empty((room, 3)), np.empty(room)
    count, limit = 0, np.inf
    for index in range(len(covering)):
        if index & WATCH_MASK == 0:
            board[DONE] = index
            if stopped(board):
                break
        arc = covering[index]
        i, j = np.int64(pairs[arc, 0]), np.int64(pairs[arc, 1])
        if not _least_squared_radius(i, j, rays, c, s) < limit * limit:
            continue
        unwrapped = yaw if lo[arc] <= yaw else yaw + 2.0 * np.pi
        slack = max(unwrapped - lo[arc], hi[arc] - unwrapped)
        radii[count] = ball_of_pair(i, j, rays, YawInterval(c, s, slack), centres[count])
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


@kernel(inline="always")
def _least_squared_radius(i, j, rays, c, s):
    """A lower bound on the squared radius, m^2, of ``ball_of_pair``, whatever its slack, for a fraction of the time.

    The pair is ``i`` and ``j`` of ``rays``, ``BoundedRays``; c and s are cos and sin of the yaw.
    """
    vi, vj, pi, pj = rays.bearings[i], rays.bearings[j], rays.points[i], rays.points[j]
    chord_i, chord_j, sine_i, sine_j = rays.chord[i], rays.chord[j], rays.sine[i], rays.sine[j]
    dx, dy, dz = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    x, z = dx * c + dz * s, dz * c - dx * s
    along_i, along_j = vi[0] * x + vi[1] * dy + vi[2] * z, vj[0] * x + vj[1] * dy + vj[2] * z
    dot, sin2 = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2], _sin2_between(vi, vj)
    spare = np.sqrt(sin2) - chord_i - chord_j
    if spare <= 0.0:
        return np.inf
    # The depths and their bounds as in ``pair_sinusoids``, with the divisions left for the end.
    depth_i, depth_j = along_i - dot * along_j, dot * along_i - along_j
    most_i = max(0.0, (spare + chord_i) * depth_i + chord_j * depth_j) * sine_i
    most_j = max(0.0, (spare + chord_j) * depth_j + chord_i * depth_i) * sine_j
    squared = (most_i * most_i + most_j * most_j) * (1.0 + abs(dot)) / (spare * spare * sin2 * sin2 * sin2)
    return squared * (1.0 - ROUNDING)


@kernel()
def _fill(bearings, points, eps, pairs, yaw, slack, centres, radii):
    """Write the balls of ``translation_balls`` to ``centres`` (P, 3) and ``radii`` (P,), m.

    ``bearings``, ``points``, ``eps``, ``pairs`` (P, 2), ``yaw`` and ``slack`` (P,) are as there.
    """
    rays = bounded_rays(bearings, points, eps)
    c, s = np.cos(yaw), np.sin(yaw)
    for k in range(len(pairs)):
        i, j = np.int64(pairs[k, 0]), np.int64(pairs[k, 1])
        radii[k] = ball_of_pair(i, j, rays, YawInterval(c, s, slack[k]), centres[k])


@kernel()
def ball_of_pair(i, j, rays, yaws, centre):
    """Radius, m, of the ball of a pair for ``yaws``, a ``YawInterval``; inf if it bounds nothing.

    The pair is ``i`` and ``j`` of ``rays``, ``BoundedRays``. Its ``centre`` (3,), m, is written.
    """
    c, s, slack = yaws
    vi, vj, pi, pj = rays.bearings[i], rays.bearings[j], rays.points[i], rays.points[j]
    sine_i, sine_j = rays.sine[i], rays.sine[j]
    sin_alpha, _, depth_i, depth_j, largest_i, largest_j, _ = pair_sinusoids(
        vi, vj, pi, pj, rays.chord[i], rays.chord[j], sine_i, sine_j
    )
    if sin_alpha == 0.0:
        for axis in range(3):
            centre[axis] = 0.5 * (pi[axis] + pj[axis])
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
    spread2 = (most_i * sine_i) ** 2 + (most_j * sine_j) ** 2
    dot = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    # 1 - |cos| = sin^2 / (1 + |cos|)
    noise = np.sqrt(spread2 * (1.0 + abs(dot)) / _sin2_between(vi, vj))
    return noise + np.sqrt(slope2) * slack + 0.5 * bend * slack * slack


@kernel(inline="always")
def _value(wave, c, s):
    """Of a wave (cos, sin, constant) at the yaw with cos c and sin s."""
    return wave[0] * c + wave[1] * s + wave[2]


@kernel(inline="always")
def _slope(wave, c, s):
    """The derivative by yaw of a ``wave`` (cos, sin, constant) where cos and sin of the yaw are ``c`` and ``s``."""
    return wave[1] * c - wave[0] * s


@kernel(inline="always")
def _amplitude(wave):
    """The most that a wave (cos, sin, constant) differs from its constant."""
    return np.sqrt(wave[0] * wave[0] + wave[1] * wave[1])


@kernel(inline="always")
def _sin2_between(vi, vj):
    """sin^2 of the angle between unit vectors ``vi`` and ``vj`` (3,), without cancellation for small angles."""
    cx = vi[1] * vj[2] - vi[2] * vj[1]
    cy = vi[2] * vj[0] - vi[0] * vj[2]
    cz = vi[0] * vj[1] - vi[1] * vj[0]
    return cx * cx + cy * cy + cz * cz


@kernel()
def _turned_back(v, c, s, axis):
    """Component ``axis`` of R^T v, v (3,), and of its derivative by yaw, whose cos and sin are ``c`` and ``s``."""
    if axis == 0:
        return v[0] * c - v[2] * s, -v[0] * s - v[2] * c
    if axis == 1:
        return v[1], 0.0
    return v[0] * s + v[2] * c, v[0] * c - v[2] * s


@kernel()
def pair_ball(matches, yaws, i, j):
    """The ball (4,), centre and radius, m, of matches ``i`` and ``j`` for ``yaws``, a ``YawInterval``.

    ``matches`` are ``BoundedMatches``.
    """
    rays = BoundedRays(matches.bearings, matches.points, matches.chord, matches.sine)
    ball = np.empty(4)
    ball[3] = ball_of_pair(i, j, rays, yaws, ball[:3])
    return ball


@kernel()
def may_be_seen(matches, yaws, k, ball):
    """Whether match ``k`` is explained from somewhere in a ``ball`` (4,) at a yaw of ``yaws``, a ``YawInterval``.

    ``matches`` are ``BoundedMatches``.
    """
    c, s, slack = yaws
    points = matches.points
    x, y, z = points[k, 0] - ball[0], points[k, 1] - ball[1], points[k, 2] - ball[2]
    distance = np.sqrt(x * x + y * y + z * z)
    if distance <= ball[3]:
        return True
    v = matches.bearings[k]
    cosine = (v[0] * (c * x + s * z) + v[1] * y + v[2] * (c * z - s * x)) / distance
    angle = np.arccos(min(1.0, max(-1.0, cosine)))
    return angle <= (matches.bound_rad[k] + slack + np.arcsin(ball[3] / distance)) * (1.0 + 1e-9) + 1e-7


@kernel()
def star_balls(matches, yaws, everybody, most, alone):
    """Balls (B, 4) for all sets that hold the last two of ``everybody`` (K,) and leave out less than ``most`` of all.

    ``matches`` are ``BoundedMatches``, ``yaws`` a ``YawInterval``. The ball ``alone`` of the last two holds them all;
    so do together the smallest of the balls of one of these with each of ``most`` others.
    """
    size = len(everybody) - 2
    if most > size:
        return alone.reshape(1, 4)
    balls, radii = np.empty((size, 4)), np.empty(size)
    for k in range(size):
        ball = pair_ball(matches, yaws, everybody[k], everybody[-2])
        other = pair_ball(matches, yaws, everybody[k], everybody[-1])
        copy_vector(other if other[3] < ball[3] else ball, balls[k])
        radii[k] = balls[k, 3]
    order, volume, smallest = order_of_few(radii), 0.0, np.empty((most, 4))
    for index in range(most):
        copy_vector(balls[order[index]], smallest[index])
        volume += radii[order[index]] ** 3
    return smallest if volume < alone[3] ** 3 else alone.reshape(1, 4)


@kernel()
def apart_balls(matches, yaws, nodes, most):
    """Small balls (B, 4) of disjoint pairs for all sets that leave out less than ``most`` of ``nodes`` (K,).

    Nodes are numbers of ``matches``, ``BoundedMatches``, seen at ``yaws``, a ``YawInterval``. A ball with an infinite
    radius says that there are not enough pairs.
    """
    balls, free = np.empty((most, 4)), np.empty(len(nodes), np.bool_)
    fill_matrix(balls, np.inf)
    fill_vector(free, True)
    for b in range(most):
        mate_a, mate_b = -1, -1
        for a in range(min(MAX_FIRST + most, len(nodes))):
            if not free[a]:
                continue
            for other in range(a + 1, len(nodes)):
                if free[other]:
                    ball = pair_ball(matches, yaws, nodes[a], nodes[other])
                    if ball[3] < balls[b, 3]:
                        copy_vector(ball, balls[b])
                        mate_a, mate_b = a, other
        if mate_a < 0:
            break
        free[mate_a] = free[mate_b] = False
    return balls
