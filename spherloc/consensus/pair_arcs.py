"""What a pair of bounded bearings says about yaw and depth, exactly, and the arcs of yaw that it leaves.

**Sinusoids of yaw.** For a pair (i, j) let w(yaw) = R d be the vector between its points, a = v_i . v_j and alpha the
angle between the measured bearings. Every quantity here has the form A cos yaw + B sin yaw + C, kept as the triple
(A, B, C):

- f = (v_i x v_j) . w, Eq. 22;
- the measured depths s, the least-squares solution of w = s_i v_i - s_j v_j;
- upper bounds S on the true depths. With true bearings at most eps away, chords c = 2 sin(eps / 2) and
  g = c / sin alpha, the dual vectors of v_i and v_j (length 1 / sin alpha) give
      s_i >= (1 - g_i) s_i* - g_j s_j*,    s_j >= (1 - g_j) s_j* - g_i s_i*,
  and, since that matrix is inverse-positive for g_i + g_j < 1,
      s_i* <= S_i = ((1 - g_j) s_i + g_j s_j) / (1 - g_i - g_j),    and S_j alike;
- the bound on |f| at the true yaw, tau = sin alpha (S_i sin eps_i + S_j sin eps_j): f is linear in each bearing, and
  |(v_i x v_j) . v_i*| = |v_j . (v_i* x v_i)| <= sin alpha sin eps_i.

Nothing here is a first-order approximation. A pair with g_i + g_j >= 1 (bearings too close) bounds nothing.

**Arcs**, for the exact search, without trigonometry: |f| <= tau where depths may be positive. That search only compares
yaws, so an end (cos, sin) becomes its turn, the length along the square |cos| + |sin| = 1, from 0 to 4, which grows
with yaw and costs one division. The arcs bound as those of ``yaw_arcs`` do and are a little wider: a depth that
changes its sign within an arc does not shorten it. A pair that bounds nothing has the whole circle: its edge is in
every graph.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.pair_rows import fill_rows
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.types import FloatArray, IndexArray
from spherloc.watch import DONE, Watch, stopped

CIRCLE = 4.0
"""Turns of the whole circle."""
MAX_ARCS = 2
"""Arcs of a pair."""
ROUNDING = 1e-12
"""Slack of every condition, relative to its amplitude, so that rounding never excludes the true yaw."""


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


@kernel(inline="always")
def _along(v, dx, dy, dz):
    """v . (R d) of a bearing v (3,) and d = (dx, dy, dz), m, as (cos, sin, constant)."""
    return v[0] * dx + v[2] * dz, v[0] * dz - v[2] * dx, v[1] * dy


@kernel()
def chord(angle):
    """Distance between unit vectors at this angle, rad (any shape)."""
    return 2.0 * np.sin(0.5 * angle)


@kernel(inline="always")
def pair_sinusoids(vi, vj, pi, pj, chord_i, chord_j, sin_i, sin_j):
    """sin alpha, and the (cos, sin, constant) of f, s_i, s_j, S_i, S_j, tau, m, of two bearings and two points.

    ``vi`` and ``vj`` (3,) are the bearings, ``pi`` and ``pj`` (3,), m, the points; ``chord_i``, ``chord_j``, ``sin_i``
    and ``sin_j`` are chord and sine of the bound on each bearing's angular error. sin alpha is 0 for a pair that bounds
    nothing: its bearings are too close, or its points coincide.
    """
    zero = (0.0, 0.0, 0.0)
    dx, dy, dz = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    nx = vi[1] * vj[2] - vi[2] * vj[1]
    ny = vi[2] * vj[0] - vi[0] * vj[2]
    nz = vi[0] * vj[1] - vi[1] * vj[0]
    sin2 = nx * nx + ny * ny + nz * nz
    sin_alpha = np.sqrt(sin2)
    if sin_alpha <= chord_i + chord_j or (dx == 0.0 and dy == 0.0 and dz == 0.0):
        return 0.0, zero, zero, zero, zero, zero, zero
    dot = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    gi, gj = chord_i / sin_alpha, chord_j / sin_alpha
    scale = 1.0 / (1.0 - gi - gj)
    f = (nx * dx + nz * dz, nx * dz - nz * dx, ny * dy)
    along_i, along_j = _along(vi, dx, dy, dz), _along(vj, dx, dy, dz)
    per_sin2 = 1.0 / sin2
    si = _mix(per_sin2, along_i, -dot * per_sin2, along_j)
    sj = _mix(dot * per_sin2, along_i, -per_sin2, along_j)
    most_i = _mix(scale * (1.0 - gj), si, scale * gj, sj)
    most_j = _mix(scale * (1.0 - gi), sj, scale * gi, si)
    return sin_alpha, f, si, sj, most_i, most_j, _mix(sin_alpha * sin_i, most_i, sin_alpha * sin_j, most_j)


@kernel(inline="always")
def _mix(a, u, b, v):
    """a u + b v of two sinusoids, as (cos, sin, constant)."""
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]


def turn_of(yaw_rad: FloatArray) -> FloatArray:
    """Turns in [0, 4) of yaws (any shape), rad."""
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
def _behind(wave, u0, v0, u1, v1):
    """Whether a cos + b sin + c < 0 on all of the arc, shorter than half a circle, between two unit vectors.

    (a, b, c) is the ``wave`` (3,), (u0, v0) and (u1, v1) are the vectors. A wave exceeds the larger of its ends by at
    most its amplitude times sin^2 of half the arc's width.
    """
    a, b, c = wave
    most = max(a * u0 + b * v0, a * u1 + b * v1) + c
    if most >= 0.0:
        return False
    bulge = np.sqrt(a * a + b * b) * 0.5 * (1.0 - (u0 * u1 + v0 * v1))
    return most + bulge + ROUNDING * abs(c) < 0.0


@kernel()
def _fill(bearings, points, eps, rows, arcs, board):
    """Write the arcs of the pairs (i, j) with i from ``rows[0]`` up to ``rows[1]`` to the ``Arcs`` ``arcs``, which have
    room for all; returns how many.

    ``bearings`` (M, 3), ``points`` (M, 3), m, ``eps`` (M,), rad. A watch's ``board`` counts the pairs and can end it.
    """
    used, (pairs, lo, hi) = 0, arcs
    chords, sines = np.empty(len(eps)), np.empty(len(eps))
    for i in range(len(eps)):
        chords[i], sines[i] = chord(eps[i]), np.sin(eps[i])
    # All waves of a bearing before their arcs: branches that cannot be predicted then do not wait for the waves.
    waves, is_bounded = np.empty((len(eps), 4, 3)), np.empty(len(eps), np.bool_)
    for i in range(rows[0], rows[1]):
        if stopped(board):
            break
        for j in range(i + 1, len(bearings)):
            sin_alpha, f, _, _, most_i, most_j, tau = pair_sinusoids(
                bearings[i], bearings[j], points[i], points[j], chords[i], chords[j], sines[i], sines[j]
            )
            is_bounded[j] = sin_alpha > 0.0
            for k in range(3):
                waves[j, 0, k], waves[j, 1, k] = f[k] - tau[k], f[k] + tau[k]
                waves[j, 2, k], waves[j, 3, k] = most_i[k], most_j[k]
        for j in range(i + 1, len(bearings)):
            # Outside the arc (out0, out1): f <= tau. Inside the arc [in0, in1]: -f <= tau.
            a1, b1, c1 = waves[j, 0, 0], waves[j, 0, 1], waves[j, 0, 2]
            a2, b2, c2 = waves[j, 1, 0], waves[j, 1, 1], waves[j, 1, 2]
            amp1, amp2 = a1 * a1 + b1 * b1, a2 * a2 + b2 * b2
            c1 -= ROUNDING * (np.sqrt(amp1) + abs(c1))
            c2 += ROUNDING * (np.sqrt(amp2) + abs(c2))
            root1, root2 = amp1 - c1 * c1, amp2 - c2 * c2
            if (root1 < 0.0 and c1 > 0.0) or (root2 < 0.0 and c2 < 0.0):
                continue
            free1, free2 = root1 <= 0.0, root2 <= 0.0
            if not is_bounded[j] or (free1 and free2):
                pairs[used, 0], pairs[used, 1] = i, j
                lo[used], hi[used] = 0.0, CIRCLE
                used += 1
                continue
            q1, q2 = np.sqrt(max(root1, 0.0)), np.sqrt(max(root2, 0.0))
            # Ends by decreasing (0) and increasing (1) yaw seen from the middle of the arc (a, b).
            if free1:
                out0u = out0v = out1u = out1v = 0.0
            else:
                per = 1.0 / amp1
                out0u, out0v = (-c1 * a1 + b1 * q1) * per, (-c1 * b1 - a1 * q1) * per
                out1u, out1v = (-c1 * a1 - b1 * q1) * per, (-c1 * b1 + a1 * q1) * per
            if free2:
                in0u = in0v = in1u = in1v = 0.0
            else:
                per = 1.0 / amp2
                in0u, in0v = (-c2 * a2 + b2 * q2) * per, (-c2 * b2 - a2 * q2) * per
                in1u, in1v = (-c2 * a2 - b2 * q2) * per, (-c2 * b2 + a2 * q2) * per
            # Each arc as its first and second end, by growing yaw; the second is missing if its first vector is 0.
            first = (out1u, out1v, in1u, in1v)
            second = (in0u, in0v, out0u, out0v)
            if free1:
                first, second = (in0u, in0v, in1u, in1v), (0.0, 0.0, 0.0, 0.0)
            elif free2:
                first, second = (out1u, out1v, out0u, out0v), (0.0, 0.0, 0.0, 0.0)
            else:
                begins = a2 * out1u + b2 * out1v + c2 >= 0.0  # the excluded arc ends within the included one
                stops = a2 * out0u + b2 * out0v + c2 >= 0.0
                covers = a1 * in0u + b1 * in0v + c1 > 0.0  # the included arc begins within the excluded one
                if begins and stops and covers:
                    first, second = (out1u, out1v, out0u, out0v), (0.0, 0.0, 0.0, 0.0)
                elif begins and not stops:
                    second = (0.0, 0.0, 0.0, 0.0)
                elif stops and not begins:
                    first, second = second, (0.0, 0.0, 0.0, 0.0)
                elif not begins and not stops:
                    if covers:
                        continue
                    first, second = (in0u, in0v, in1u, in1v), (0.0, 0.0, 0.0, 0.0)
            for k in range(2):
                u0, v0, u1, v1 = first if k == 0 else second
                if u0 == 0.0 and v0 == 0.0:
                    break
                # sin of the width: a positive one below half a circle.
                if u0 * v1 - v0 * u1 > 0.0 and (
                    _behind(waves[j, 2], u0, v0, u1, v1) or _behind(waves[j, 3], u0, v0, u1, v1)
                ):
                    continue
                start, end = turn_of_direction(u0, v0), turn_of_direction(u1, v1)
                start = start if start < CIRCLE else 0.0
                if end < start:
                    end = start if start - end < ROUNDING else end + CIRCLE
                pairs[used, 0], pairs[used, 1] = i, j
                lo[used], hi[used] = start, end
                used += 1
        board[DONE] += len(bearings) - 1 - i
    return used
