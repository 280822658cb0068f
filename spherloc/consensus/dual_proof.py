"""Proof that no level pose of a small region explains more than a given number of correspondences, by duality.

If a pose explains all of a set, its residuals are within their bounds, |r_i| <= b_i, so for any weights w >= 0 the
weighted cost sum w_i |r_i|^2 is at most sum w_i b_i^2. Around a pose of the region r_i is linear up to e_i, so that
no pose of the region has a root of this cost below sqrt(c) - sqrt(sum w_i e_i^2), where c is the least cost of the
linear residuals. Where that exceeds sqrt(sum w_i b_i^2), the set cannot be explained: the weights are the proof.
Otherwise all poses that explain it lie in an ellipsoid around the least cost, which may be smaller than the region,
and then e_i is smaller too. Lawson's iteration, which multiplies each weight by its residual, finds both the weights
and the pose of least largest residual.

A set that cannot be explained must lose one of its members of large weight, which gives a tree over what is left out
(as Chin et al., "Efficient globally optimal consensus maximisation with tree search", 2015).
"""

import numba
import numpy as np

from spherloc.consensus.level_fit import accumulate, move, ray, slope_of, solve_step
from spherloc.watch import stopped

ROUNDS = 24
"""Of Lawson's iteration."""
MOST_NODES = 200
"""Sets that are looked at in one proof."""
BASIS = (5, 7, 10, 16)
"""Members of largest weight that are tried as a set that cannot be explained: few make a small tree."""
BASIS_ROUNDS = 8
MARGIN = 1.0 + 1e-6
"""Of a proof over rounding."""
BEND = 1.155
"""|u''| <= BEND (|C'| / |p - C|)^2 for the unit vector u from the camera to a point: sqrt(4 / 3)."""

UNKNOWN, FOUND, IMPOSSIBLE = 0, 1, 2


@numba.njit(cache=True, nogil=True)
def prove_none(view, limits, everybody, ball, floor, found, board=None):
    """Whether no level pose of the region explains more than ``floor`` of ``everybody``.

    ``view`` is (bearings, points, cos, sin and half width of the yaw interval); ``limits`` are the weights (M, 2, 3),
    the bounds (M,) px, the angular bounds (M,) rad and the px/rad (M,); ``ball`` (4,) centre and radius of camera
    positions. Returns FOUND, with such a pose in ``found`` (5,), see ``level_fit``, IMPOSSIBLE if there is none, or
    UNKNOWN; and the effort. A watch's ``board`` can end it as UNKNOWN.
    """
    count = len(everybody)
    spare = count - floor
    places = np.empty((MOST_NODES + BASIS[-1], 5))
    removed = np.zeros((MOST_NODES + BASIS[-1], count), np.bool_)
    kept = np.zeros((MOST_NODES + BASIS[-1], count), np.bool_)
    places[0, 0], places[0, 1], places[0, 2:] = view[2], view[3], ball[:3]
    waiting, nodes, effort = 1, 0, 0
    weight, residual = np.empty(count), np.empty(count)
    here = np.empty(5)
    while waiting > 0:
        if stopped(board):
            return UNKNOWN, effort
        waiting -= 1
        nodes += 1
        gone, stay, here[:] = removed[waiting].copy(), kept[waiting].copy(), places[waiting]
        weight[:] = np.where(gone, 0.0, 1.0)
        answer, rounds = _lawson(view, limits, everybody, gone, ball, floor, here, weight, residual, np.int64(ROUNDS))
        effort += rounds * count
        if answer == FOUND:
            found[:] = here
        if answer != IMPOSSIBLE or nodes >= MOST_NODES or waiting + BASIS[-1] > len(places):
            return (answer if answer == FOUND else UNKNOWN), effort
        if np.count_nonzero(gone) + 1 >= spare:
            continue  # without one more, too few would be left
        basis = _basis(view, limits, everybody, gone, ball, here, weight, residual)
        if len(basis) == 0:
            return UNKNOWN, effort
        for k in basis:
            if stay[k]:
                continue
            removed[waiting], kept[waiting], places[waiting] = gone, stay, here
            removed[waiting, k] = True
            waiting += 1
            stay[k] = True
    return IMPOSSIBLE, effort


@numba.njit(cache=True, nogil=True)
def _basis(view, limits, everybody, gone, ball, here, weight, residual):
    """Few members, those of largest weight first, that alone cannot be explained; none if no such are found."""
    order = np.argsort(-np.where(gone, 0.0, weight))
    total = len(everybody) - np.count_nonzero(gone)
    start, alone = here.copy(), np.empty_like(weight)
    for size in BASIS:
        size = min(size, total)
        others = np.ones(len(everybody), np.bool_)
        others[order[:size]] = False
        here[:] = start
        alone[:] = np.where(others, 0.0, weight)
        answer, _ = _lawson(
            view, limits, everybody, others, ball, len(everybody), here, alone, residual, np.int64(BASIS_ROUNDS)
        )
        here[:] = start
        if answer == IMPOSSIBLE:
            return order[:size]
        if size == total:
            break
    # All together, which was proven.
    return order[:total] if total <= 2 * BASIS[-1] else order[:0]


@numba.njit(cache=True, nogil=True)
def _lawson(view, limits, everybody, gone, ball, floor, here, weight, residual, rounds):
    """Lawson's iteration on those not ``gone``: whether a pose explains more than ``floor`` of everybody, or none all
    of them.

    ``here`` (5,), cos, sin and position, and ``weight`` (count,), 0 for those gone, are moved; ``residual`` (count,) is
    written. Returns the answer and the rounds.
    """
    normal, slope, step = np.empty((4, 4)), np.empty(4), np.empty(4)
    # Where poses that explain all may be: cos, sin and half width of yaw, and a ball.
    region = np.array([view[2], view[3], view[4], ball[0], ball[1], ball[2], ball[3]])
    for k in range(rounds):
        explained, cost, allowed, bend = _normal_equations(
            view, limits, everybody, region, here, weight, residual, normal, slope
        )
        if explained > floor:
            return FOUND, k + 1
        fall = solve_step(normal, slope, step)
        if fall < 0.0:
            return UNKNOWN, k + 1
        least, most = max(0.0, cost - fall), (MARGIN * (np.sqrt(allowed) + np.sqrt(bend))) ** 2
        if least > most:
            return IMPOSSIBLE, k + 1
        move(here, step)
        _contract(normal, most - least, here, region)
        _reweight(gone, residual, weight)
    return UNKNOWN, rounds


@numba.njit(cache=True, nogil=True)
def _contract(root, room, here, region):
    """Shrink the region to the ellipsoid of steps x from ``here`` with |root^T x|^2 <= ``room``, where that is
    smaller.
    """
    inverse = np.zeros((4, 4))
    for a in range(4):
        inverse[a, a] = 1.0 / root[a, a]
        for b in range(a + 1, 4):
            for d in range(a, b):
                inverse[b, a] -= root[b, d] * inverse[d, a]
            inverse[b, a] /= root[b, b]
    # A step is root^-T times a vector of length sqrt(room) at most: column a of ``inverse`` spans its axis a.
    turn = np.sqrt(room * np.sum(inverse[:, 0] ** 2))
    reach = np.sqrt(room * np.sum(inverse[:, 1:] ** 2))
    if turn < region[2]:
        region[0], region[1], region[2] = here[0], here[1], turn
    if reach < region[6]:
        region[3:6] = here[2:]
        region[6] = reach


@numba.njit(cache=True, nogil=True)
def _reweight(gone, residual, weight):
    """Multiply each weight by the share of the bound that its residual takes; the mean becomes 1."""
    total, left = 0.0, 0
    for k in range(len(weight)):
        if not gone[k]:
            weight[k] *= min(max(residual[k], 1e-3), 10.0)
            total += weight[k]
            left += 1
    weight *= left / total


@numba.njit(cache=True, nogil=True)
def _normal_equations(view, limits, everybody, region, here, weight, residual, normal, slope):
    """Fill the normal equations of the linear residuals by yaw and by position in camera axes, and each one's share.

    Returns how many of everybody the pose explains, the weighted cost, and the weighted squares of bounds and of
    what the linear residuals neglect within the region.
    """
    bearings, points = view[0], view[1]
    weights, bound_px, bound_rad, pixels_per_radian = limits
    c, s, x0, y0, z0 = here
    reach = np.sqrt((x0 - region[3]) ** 2 + (y0 - region[4]) ** 2 + (z0 - region[5]) ** 2) + region[6]
    swing = abs(np.arctan2(s * region[0] - c * region[1], c * region[0] + s * region[1])) + region[2]
    normal[:] = 0.0
    slope[:] = 0.0
    explained, cost, allowed, bend = 0, 0.0, 0.0, 0.0
    for m in range(len(everybody)):
        k = everybody[m]
        gx, gy, gz, distance = ray(points[k], here)
        along = bearings[k, 0] * gx + bearings[k, 1] * gy + bearings[k, 2] * gz
        size2 = 0.0
        used = weight[m] if distance > 1.01 * reach else 0.0
        for axis in range(2):
            r, by_yaw, by_x, by_y, by_z = slope_of(weights[k, axis], gx, gy, gz, distance)
            size2 += r * r
            accumulate(normal, slope, used, r, by_yaw, by_x, by_y, by_z)
        cost += used * size2
        residual[m] = np.sqrt(size2) / bound_px[k]
        if residual[m] <= 1.0 and along > 0.0 and along >= np.cos(bound_rad[k]):
            explained += 1
        if used > 0.0:
            allowed += used * bound_px[k] ** 2
            movement = swing + reach / (distance - reach)
            bend += used * (0.5 * BEND * pixels_per_radian[k] * movement * movement) ** 2
    return explained, cost, allowed, bend
