"""Where the camera may be: balls of pairs, chosen so that every consensus of a given size has its camera in one.

A ``view`` is (bearings, points, cos, sin, half width of an interval of yaw). ``trig`` are chords and sines of the
angular bounds. A set that leaves out at most m of the candidates holds at least one of any m + 1 disjoint pairs
entirely.
"""

import numba
import numpy as np

from spherloc.consensus.pair_arcs import middle_of_turns
from spherloc.consensus.translation_balls import ball_of_pair

MOST_FIRST = 16
"""Candidates from which disjoint pairs are started."""


@numba.njit(cache=True, nogil=True)
def view_between(data, lo, hi):
    """The view of the yaws between two turns."""
    c, s, slack = middle_of_turns(lo, hi)
    return data[0], data[1], c, s, slack


@numba.njit(cache=True, nogil=True)
def pair_ball(view, trig, i, j):
    """The ball of a pair, (4,): centre and radius."""
    bearings, points, c, s, slack = view
    ball = np.empty(4)
    ball[3] = ball_of_pair(i, j, bearings, points, trig[0], trig[1], c, s, slack, ball[:3])
    return ball


@numba.njit(cache=True, nogil=True)
def may_be_seen(view, limits, k, ball):
    """Whether a correspondence is explained from some place in a ball at a yaw of the view."""
    bearings, points, c, s, slack = view
    x, y, z = points[k, 0] - ball[0], points[k, 1] - ball[1], points[k, 2] - ball[2]
    distance = np.sqrt(x * x + y * y + z * z)
    if distance <= ball[3]:
        return True
    v = bearings[k]
    cosine = (v[0] * (c * x + s * z) + v[1] * y + v[2] * (c * z - s * x)) / distance
    angle = np.arccos(min(1.0, max(-1.0, cosine)))
    return angle <= (limits[2][k] + slack + np.arcsin(ball[3] / distance)) * (1.0 + 1e-9) + 1e-7


@numba.njit(cache=True, nogil=True)
def star_balls(view, trig, everybody, most, alone):
    """Balls (B, 4) for all sets that hold the last two of ``everybody`` and leave out less than ``most`` of all.

    The ball ``alone`` of the last two holds them all; so do together the smallest of the balls of one of these with
    each of ``most`` others.
    """
    size = len(everybody) - 2
    if most > size:
        return alone.reshape(1, 4)
    balls = np.empty((size, 4))
    for k in range(size):
        balls[k] = pair_ball(view, trig, everybody[k], everybody[-2])
        other = pair_ball(view, trig, everybody[k], everybody[-1])
        if other[3] < balls[k, 3]:
            balls[k] = other
    order = np.argsort(balls[:, 3])[:most]
    if np.sum(balls[order, 3] ** 3) < alone[3] ** 3:
        return balls[order]
    return alone.reshape(1, 4)


@numba.njit(cache=True, nogil=True)
def apart_balls(view, trig, nodes, most):
    """Small balls (B, 4) of disjoint pairs for all sets that leave out less than ``most`` of ``nodes``.

    One with an infinite radius says that there are not enough pairs.
    """
    balls = np.full((most, 4), np.inf)
    free = np.ones(len(nodes), np.bool_)
    for b in range(most):
        mate_a, mate_b = -1, -1
        for a in range(min(MOST_FIRST + most, len(nodes))):
            if not free[a]:
                continue
            for other in range(a + 1, len(nodes)):
                if free[other]:
                    ball = pair_ball(view, trig, nodes[a], nodes[other])
                    if ball[3] < balls[b, 3]:
                        balls[b], mate_a, mate_b = ball, a, other
        if mate_a < 0:
            break
        free[mate_a] = free[mate_b] = False
    return balls
