"""Yaw arcs of all pairs for the exact search, without trigonometry: ends as turns on a square instead of a circle.

The conditions are those of ``depth_bounds``: |f| <= tau where depths may be positive. The exact search only compares
yaws, so an end (cos, sin) becomes its turn, the length along the square |cos| + |sin| = 1, from 0 to 4, which grows
with yaw and costs one division. The arcs bound as those of ``yaw_arcs`` do and are a little wider: a depth that
changes its sign within an arc does not shorten it. A pair that bounds nothing has the whole circle: its edge is in
every graph.
"""

import numba
import numpy as np

from spherloc.consensus.depth_bounds import chord, pair_sinusoids
from spherloc.problem import AlignedProblem
from spherloc.types import FloatArray, IndexArray
from spherloc.watch import DONE, Watch, stopped

CIRCLE = 4.0
"""Turns of the whole circle."""
ROUNDING = 1e-12
"""Slack of every condition, relative to its amplitude, so that rounding never excludes the true yaw."""


def turn_of(yaw_rad: FloatArray) -> FloatArray:
    """Turns in [0, 4) of yaws (any shape), rad."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    quarter = s / (np.abs(c) + np.abs(s))
    turn = np.where(c >= 0.0, quarter, 2.0 - quarter) % CIRCLE
    return np.where(turn < CIRCLE, turn, 0.0)


def pair_arcs(
    aligned: AlignedProblem, bound_rad: FloatArray, watch: Watch | None = None
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """Arcs of all pairs: pairs (A, 2) of places in ``aligned``, first ends (A,) in [0, 4) and second ends (A,), turns.

    The second end is up to a circle larger than the first. ``bound_rad`` (M,) bounds each bearing's angular error.
    ``watch`` counts the pairs; raises ``Cancelled``.
    """
    watch = watch or Watch()
    count = len(aligned.bearings)
    watch.expect(count * (count - 1) // 2)
    room = 2 * (count * (count - 1) // 2)
    # Memory that is never touched is never used, so room for the worst case costs nothing.
    pairs, ends = np.empty((room, 2), np.int32), np.empty((room, 2))
    used = _fill(aligned.bearings, aligned.points, bound_rad, pairs, ends, watch.board)
    watch.check()
    # Of one layout, however many there are: kernels are compiled for it.
    return pairs[:used], np.ascontiguousarray(ends[:used, 0]), np.ascontiguousarray(ends[:used, 1])


@numba.njit(cache=True, nogil=True, inline="always")
def _turn(c, s):
    """Turn in [0, 4] of a direction of any length."""
    quarter = s / (abs(c) + abs(s))
    if c < 0.0:
        return 2.0 - quarter
    return quarter if quarter >= 0.0 else 4.0 + quarter


@numba.njit(cache=True, nogil=True)
def direction_of_turn(turn):
    """(cos, sin) of the yaw of a turn."""
    turn %= CIRCLE
    c, s = abs(turn - 2.0) - 1.0, 1.0 - abs(turn - 1.0) if turn <= 3.0 else turn - 4.0
    norm = np.sqrt(c * c + s * s)
    return c / norm, s / norm


@numba.njit(cache=True, nogil=True)
def middle_of_turns(lo, hi):
    """(cos, sin) in the middle of an arc of less than half a circle, and half its width, rad."""
    c0, s0 = direction_of_turn(lo)
    c1, s1 = direction_of_turn(hi)
    c, s = c0 + c1, s0 + s1
    norm = np.sqrt(c * c + s * s)
    return c / norm, s / norm, 0.5 * np.arctan2(c0 * s1 - s0 * c1, c0 * c1 + s0 * s1) + ROUNDING


@numba.njit(cache=True, nogil=True, inline="always")
def _behind(a, b, c, u0, v0, u1, v1):
    """Whether a cos + b sin + c < 0 on all of the arc, shorter than half a circle, between two unit vectors.

    A wave exceeds the larger of its ends by at most its amplitude times sin^2 of half the arc's width.
    """
    most = max(a * u0 + b * v0, a * u1 + b * v1) + c
    if most >= 0.0:
        return False
    bulge = np.sqrt(a * a + b * b) * 0.5 * (1.0 - (u0 * u1 + v0 * v1))
    return most + bulge + ROUNDING * abs(c) < 0.0


@numba.njit(cache=True, nogil=True)
def _fill(bearings, points, eps, pairs, ends, board):
    used = 0
    chords, sines = chord(eps), np.sin(eps)
    for i in range(len(bearings)):
        if stopped(board):
            break
        for j in range(i + 1, len(bearings)):
            sin_alpha, f, _, _, most_i, most_j, tau = pair_sinusoids(
                bearings[i], bearings[j], points[i], points[j], chords[i], chords[j], sines[i], sines[j]
            )
            if sin_alpha == 0.0:
                pairs[used, 0], pairs[used, 1] = i, j
                ends[used, 0], ends[used, 1] = 0.0, CIRCLE
                used += 1
                continue
            # Outside the arc (out0, out1): f <= tau. Inside the arc [in0, in1]: -f <= tau.
            a1, b1, c1 = f[0] - tau[0], f[1] - tau[1], f[2] - tau[2]
            a2, b2, c2 = f[0] + tau[0], f[1] + tau[1], f[2] + tau[2]
            amp1, amp2 = a1 * a1 + b1 * b1, a2 * a2 + b2 * b2
            c1 -= ROUNDING * (np.sqrt(amp1) + abs(c1))
            c2 += ROUNDING * (np.sqrt(amp2) + abs(c2))
            root1, root2 = amp1 - c1 * c1, amp2 - c2 * c2
            if (root1 < 0.0 and c1 > 0.0) or (root2 < 0.0 and c2 < 0.0):
                continue
            free1, free2 = root1 <= 0.0, root2 <= 0.0
            if free1 and free2:
                pairs[used, 0], pairs[used, 1] = i, j
                ends[used, 0], ends[used, 1] = 0.0, CIRCLE
                used += 1
                continue
            q1, q2 = np.sqrt(max(root1, 0.0)), np.sqrt(max(root2, 0.0))
            # Ends by decreasing (0) and increasing (1) yaw seen from the middle of the arc (a, b).
            if free1:
                out0u = out0v = out1u = out1v = 0.0
            else:
                out0u, out0v = (-c1 * a1 + b1 * q1) / amp1, (-c1 * b1 - a1 * q1) / amp1
                out1u, out1v = (-c1 * a1 - b1 * q1) / amp1, (-c1 * b1 + a1 * q1) / amp1
            if free2:
                in0u = in0v = in1u = in1v = 0.0
            else:
                in0u, in0v = (-c2 * a2 + b2 * q2) / amp2, (-c2 * b2 - a2 * q2) / amp2
                in1u, in1v = (-c2 * a2 - b2 * q2) / amp2, (-c2 * b2 + a2 * q2) / amp2
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
                    _behind(most_i[0], most_i[1], most_i[2], u0, v0, u1, v1)
                    or _behind(most_j[0], most_j[1], most_j[2], u0, v0, u1, v1)
                ):
                    continue
                lo, hi = _turn(u0, v0) % CIRCLE, _turn(u1, v1)
                if hi < lo:
                    hi = lo if lo - hi < ROUNDING else hi + CIRCLE
                pairs[used, 0], pairs[used, 1] = i, j
                ends[used, 0], ends[used, 1] = lo, hi
                used += 1
        board[DONE] += len(bearings) - 1 - i
    return used
