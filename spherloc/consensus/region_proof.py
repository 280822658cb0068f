"""Does any level pose of a small region explain more correspondences than a given number? Two proofs that none does.

A region is an interval of yaw and a ball of camera positions.

**By duality** (``prove_none``). If a pose explains all of a set, its residuals are within their bounds, |r_i| <= b_i,
so for any weights w >= 0 the weighted cost sum w_i |r_i|^2 is at most sum w_i b_i^2. Around a pose of the region r_i is
linear up to e_i, so that no pose of the region has a root of this cost below sqrt(c) - sqrt(sum w_i e_i^2), where c is
the least cost of the linear residuals. Where that exceeds sqrt(sum w_i b_i^2), the set cannot be explained: the weights
are the proof. Otherwise all poses that explain it lie in an ellipsoid around the least cost, which may be smaller than
the region, and then e_i is smaller too. Lawson's iteration, which multiplies each weight by its residual, finds both
the weights and the pose of least largest residual. A set that cannot be explained must lose one of its members of large
weight, which gives a tree over what is left out (as Chin et al., "Efficient globally optimal consensus maximisation
with tree search", 2015).

**By branch and bound** (``search_region``). A cell is an interval of yaw and a cube of camera positions. A unit ray
moves by at most the cell's half yaw plus the chord that its half diagonal spans at the point, and the residual is
linear in the ray, so a correspondence whose residual in the middle exceeds its bound by more than that movement is
explained nowhere in the cell. A cell that cannot explain more than ``floor`` is dropped; others are split until none is
left, or the limit is reached.
"""

from typing import NamedTuple

import numpy as np

from spherloc.consensus.level_pose import accumulate, linearized, move, ray, solve_step
from spherloc.consensus.long_sort import order_of_few
from spherloc.consensus.pair_arcs import YawInterval
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_vector, count_true, fill_matrix, fill_vector
from spherloc.types import FloatArray
from spherloc.watch import stopped

UNKNOWN, FOUND, IMPOSSIBLE = 0, 1, 2
"""Answers of both proofs: not settled; some pose explains more; none does."""

LAWSON_ROUNDS = 24
"""Of Lawson's iteration on a set."""
MAX_SETS = 200
"""Sets that are looked at in one proof."""
BASIS_SIZES = (5, 7, 10, 16)
"""Members of largest weight that are tried as a set that cannot be explained: few make a small tree."""
BASIS_ROUNDS = 8
"""Of Lawson's iteration on such a set."""
MARGIN = 1.0 + 1e-6
"""Of a proof over rounding."""
CURVATURE = 1.155
"""|u''| <= CURVATURE (|C'| / |p - C|)^2 for the unit vector u from the camera C to a point p: sqrt(4 / 3)."""
MAX_WAITING = 4096
"""Cells that wait to be split; more are not needed since the deepest is split first."""
MIN_CELL_RAD = 1e-5
"""A cell that moves rays by less is not split: it holds a pose that explains one more to within rounding, or nearly."""
HALF_DIAGONAL = np.sqrt(3.0)
"""Of a cube, in half sides."""


class Region(NamedTuple):
    """Level poses: any yaw of an interval with any camera position of a ball."""

    yaws: YawInterval
    """Of the camera."""
    ball: FloatArray
    """(4,) centre and radius of the positions, m, aligned map frame."""


class LawsonState(NamedTuple):
    """Where Lawson's iteration on a set of K matches is; all is changed in place."""

    pose: FloatArray
    """(5,) level pose."""
    weights: FloatArray
    """(K,) of the matches, 0 for those left out."""
    shares: FloatArray
    """(K,) residuals in units of their bounds."""


@kernel()
def prove_none(matches, region, everybody, floor, found, board=None):
    """Whether no level pose of a ``region``, ``Region``, explains more than ``floor`` of ``everybody`` (K,).

    These are numbers of ``matches``, ``BoundedMatches``. Returns FOUND, with such a pose in ``found`` (5,), see
    ``level_pose``, IMPOSSIBLE if there is none, or UNKNOWN; and the effort, tests of a match. A watch's ``board`` can
    end it as UNKNOWN.
    """
    count = len(everybody)
    spare = count - floor
    starts = np.empty((MAX_SETS + BASIS_SIZES[-1], 5))
    removed = np.zeros((MAX_SETS + BASIS_SIZES[-1], count), np.bool_)
    kept = np.zeros((MAX_SETS + BASIS_SIZES[-1], count), np.bool_)
    starts[0, 0], starts[0, 1] = region.yaws.cos, region.yaws.sin
    copy_vector(region.ball, starts[0, 2:])
    waiting, sets, effort = 1, 0, 0
    state = LawsonState(np.empty(5), np.empty(count), np.empty(count))
    gone, stay = np.empty(count, np.bool_), np.empty(count, np.bool_)
    while waiting > 0:
        if stopped(board):
            return UNKNOWN, effort
        waiting -= 1
        sets += 1
        copy_vector(removed[waiting], gone)
        copy_vector(kept[waiting], stay)
        copy_vector(starts[waiting], state.pose)
        for k in range(count):
            state.weights[k] = 0.0 if gone[k] else 1.0
        answer, rounds = _lawson(matches, region, everybody, gone, floor, state, np.int64(LAWSON_ROUNDS))
        effort += rounds * count
        if answer == FOUND:
            copy_vector(state.pose, found)
        if answer != IMPOSSIBLE or sets >= MAX_SETS or waiting + BASIS_SIZES[-1] > len(starts):
            return (answer if answer == FOUND else UNKNOWN), effort
        if count_true(gone) + 1 >= spare:
            continue  # without one more, too few would be left
        basis = _basis(matches, region, everybody, gone, state)
        if len(basis) == 0:
            return UNKNOWN, effort
        for k in basis:
            if stay[k]:
                continue
            copy_vector(gone, removed[waiting])
            copy_vector(stay, kept[waiting])
            copy_vector(state.pose, starts[waiting])
            removed[waiting, k] = True
            waiting += 1
            stay[k] = True
    return IMPOSSIBLE, effort


@kernel()
def _basis(matches, region, everybody, gone, state):
    """Few members, those of largest weight first, that alone cannot be explained; none if no such are found.

    Indices (B,) into ``everybody`` (K,), numbers of ``matches``, of which those ``gone`` (K,) are left out. ``state``
    is where the iteration on all others in the ``region`` ended, a ``LawsonState``; its shares are overwritten.
    """
    count, total = len(everybody), len(everybody) - count_true(gone)
    alone = LawsonState(np.empty(5), np.empty(count), state.shares)
    for k in range(count):
        alone.weights[k] = -0.0 if gone[k] else -state.weights[k]
    order, others = order_of_few(alone.weights), np.empty(count, np.bool_)
    for index in range(len(BASIS_SIZES)):
        size = min(BASIS_SIZES[index], total)
        fill_vector(others, True)
        fill_vector(alone.weights, 0.0)
        for k in order[:size]:
            others[k], alone.weights[k] = False, state.weights[k]
        copy_vector(state.pose, alone.pose)
        answer, _ = _lawson(matches, region, everybody, others, len(everybody), alone, np.int64(BASIS_ROUNDS))
        if answer == IMPOSSIBLE:
            return order[:size]
        if size == total:
            break
    # All together, which was proven.
    return order[:total] if total <= 2 * BASIS_SIZES[-1] else order[:0]


@kernel()
def _lawson(matches, region, everybody, gone, floor, state, rounds):
    """Lawson's iteration on those of ``everybody`` (K,) not ``gone`` (K,), so many ``rounds`` at most.

    ``matches`` are ``BoundedMatches``, ``region`` is a ``Region``, ``state`` a ``LawsonState``, which moves. Whether a
    pose explains more than ``floor`` of everybody, or none all of those not gone. Returns the answer and the rounds.
    """
    normal, gradient, step = np.empty((4, 4)), np.empty(4), np.empty(4)
    # Where poses that explain all may be: cos, sin and half width of yaw, and a ball. It shrinks.
    c, s, half_yaw = region.yaws
    ball = region.ball
    possible = np.empty(7)
    possible[0], possible[1], possible[2] = c, s, half_yaw
    copy_vector(ball, possible[3:])
    for k in range(rounds):
        explained, cost, allowed, neglected = _normal_equations(matches, everybody, possible, state, normal, gradient)
        if explained > floor:
            return FOUND, k + 1
        fall = solve_step(normal, gradient, step)
        if fall < 0.0:
            return UNKNOWN, k + 1
        least, most = max(0.0, cost - fall), (MARGIN * (np.sqrt(allowed) + np.sqrt(neglected))) ** 2
        if least > most:
            return IMPOSSIBLE, k + 1
        move(state.pose, step)
        _shrink(normal, most - least, state.pose, possible)
        _reweight(gone, state)
    return UNKNOWN, rounds


@kernel()
def _shrink(root, room, pose, possible):
    """Shrink ``possible`` (7,) to the ellipsoid of steps x from ``pose`` (5,) with |root^T x|^2 <= ``room``.

    Only where that is smaller. ``root`` (4, 4) is lower triangular; ``possible`` holds cos, sin and half width of the
    yaw, and centre and radius of the positions.
    """
    inverse = np.empty((4, 4))
    fill_matrix(inverse, 0.0)
    for a in range(4):
        inverse[a, a] = 1.0 / root[a, a]
        for b in range(a + 1, 4):
            for d in range(a, b):
                inverse[b, a] -= root[b, d] * inverse[d, a]
            inverse[b, a] /= root[b, b]
    # A step is root^-T times a vector of length sqrt(room) at most: column a of ``inverse`` spans its axis a.
    turn2 = reach2 = 0.0
    for a in range(4):
        turn2 += inverse[a, 0] * inverse[a, 0]
        for b in range(1, 4):
            reach2 += inverse[a, b] * inverse[a, b]
    turn, reach = np.sqrt(room * turn2), np.sqrt(room * reach2)
    if turn < possible[2]:
        possible[0], possible[1], possible[2] = pose[0], pose[1], turn
    if reach < possible[6]:
        copy_vector(pose[2:], possible[3:6])
        possible[6] = reach


@kernel()
def _reweight(gone, state):
    """Multiply each weight of those not ``gone`` (K,) by the share of the bound that its residual takes.

    Both are those of ``state``, a ``LawsonState``. The mean weight becomes 1.
    """
    weights, total, left = state.weights, 0.0, 0
    for k in range(len(weights)):
        if not gone[k]:
            weights[k] *= min(max(state.shares[k], 1e-3), 10.0)
            total += weights[k]
            left += 1
    for k in range(len(weights)):
        weights[k] *= left / total


@kernel()
def _normal_equations(matches, everybody, possible, state, normal, gradient):
    """Fill the equations of the linear residuals by yaw and by position in camera axes, and the shares of ``state``.

    The equations are ``normal`` (4, 4) and ``gradient`` (4,), the state is a ``LawsonState``. Returns how many of
    ``everybody`` (K,), numbers of ``matches``, the pose explains, the weighted cost, px^2, and the weighted squares of
    bounds and of what the linear residuals neglect among the ``possible`` (7,) poses, see ``_shrink``.
    """
    bearings, bound_px = matches.bearings, matches.bound_px
    c, s, x0, y0, z0 = state.pose[0], state.pose[1], state.pose[2], state.pose[3], state.pose[4]
    reach = np.sqrt((x0 - possible[3]) ** 2 + (y0 - possible[4]) ** 2 + (z0 - possible[5]) ** 2) + possible[6]
    swing = abs(np.arctan2(s * possible[0] - c * possible[1], c * possible[0] + s * possible[1])) + possible[2]
    fill_matrix(normal, 0.0)
    fill_vector(gradient, 0.0)
    explained, cost, allowed, neglected = 0, 0.0, 0.0, 0.0
    for index in range(len(everybody)):
        k = everybody[index]
        gx, gy, gz, distance = ray(matches.points[k], state.pose)
        along = bearings[k, 0] * gx + bearings[k, 1] * gy + bearings[k, 2] * gz
        size2 = 0.0
        weight = state.weights[index] if distance > 1.01 * reach else 0.0
        for axis in range(2):
            r, by_yaw, by_x, by_y, by_z = linearized(matches.pixel_jacobian[k, axis], gx, gy, gz, distance)
            size2 += r * r
            accumulate(normal, gradient, weight, r, (by_yaw, by_x, by_y, by_z))
        cost += weight * size2
        state.shares[index] = np.sqrt(size2) / bound_px[k]
        if state.shares[index] <= 1.0 and along > 0.0 and along >= np.cos(matches.bound_rad[k]):
            explained += 1
        if weight > 0.0:
            allowed += weight * bound_px[k] ** 2
            movement = swing + reach / (distance - reach)
            neglected += weight * (0.5 * CURVATURE * matches.pixels_per_radian[k] * movement * movement) ** 2
    return explained, cost, allowed, neglected


@kernel()
def search_region(matches, region, everybody, floor, cell_limit, found):
    """Whether some level pose of a ``region``, ``Region``, explains more than ``floor`` of ``everybody`` (K,).

    As ``prove_none``, with such a pose in ``found`` (5,). ``matches`` are ``BoundedMatches``. Returns the answer, and
    how many cells were looked at, ``cell_limit`` at most.
    """
    c0, s0, slack = region.yaws
    ball, order, cells = region.ball, np.empty(len(everybody), np.int64), np.empty((MAX_WAITING, 6))
    copy_vector(everybody, order)
    cells[0, 0], cells[0, 1] = 0.0, slack
    copy_vector(ball, cells[0, 2:])
    waiting, used, exact = 1, 0, True
    reach = _mean_distance(matches.points, everybody, ball)
    while waiting > 0:
        if used >= cell_limit or waiting > MAX_WAITING - 8:
            exact = False
            break
        waiting -= 1
        used += 1
        yaw, half_yaw, half = cells[waiting, 0], cells[waiting, 1], cells[waiting, 5]
        x, y, z = cells[waiting, 2], cells[waiting, 3], cells[waiting, 4]
        c, s = c0 * np.cos(yaw) - s0 * np.sin(yaw), s0 * np.cos(yaw) + c0 * np.sin(yaw)
        middle = (c, s, x, y, z)
        if not _may_explain(matches, order, middle, half_yaw, half * HALF_DIAGONAL, floor):
            continue
        if _explained(matches, everybody, middle) > floor:
            found[0], found[1], found[2], found[3], found[4] = c, s, x, y, z
            return FOUND, used
        if half_yaw + half * HALF_DIAGONAL / reach < MIN_CELL_RAD:
            exact = False
            continue
        if half_yaw * reach > half * HALF_DIAGONAL:
            for side in (-0.5, 0.5):
                cells[waiting, 0], cells[waiting, 1] = yaw + side * half_yaw, 0.5 * half_yaw
                cells[waiting, 2], cells[waiting, 3], cells[waiting, 4], cells[waiting, 5] = x, y, z, half
                waiting += 1
            continue
        half *= 0.5
        for corner in range(8):
            cells[waiting, 0], cells[waiting, 1], cells[waiting, 5] = yaw, half_yaw, half
            cells[waiting, 2] = x + (half if corner & 1 else -half)
            cells[waiting, 3] = y + (half if corner & 2 else -half)
            cells[waiting, 4] = z + (half if corner & 4 else -half)
            waiting += 1
    return (IMPOSSIBLE if exact else UNKNOWN), used


@kernel()
def _mean_distance(points, everybody, ball):
    """Mean distance, m, of ``everybody`` (K,) of the ``points`` (M, 3) from the centre of a ``ball`` (4,)."""
    total = 0.0
    for k in everybody:
        x, y, z = points[k, 0] - ball[0], points[k, 1] - ball[1], points[k, 2] - ball[2]
        total += np.sqrt(x * x + y * y + z * z)
    return total / len(everybody)


@kernel()
def _excess(matches, k, pose):
    """What the residual of match ``k`` at a level ``pose`` (5,) exceeds its bound by, times the distance, px m.

    And the distance along its bearing, and the distance, m. ``matches`` are ``BoundedMatches``.
    """
    bearings, points, jacobian = matches.bearings, matches.points, matches.pixel_jacobian
    c, s, x, y, z = pose
    dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
    rx, rz = c * dx + s * dz, c * dz - s * dx
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    du = jacobian[k, 0, 0] * rx + jacobian[k, 0, 1] * dy + jacobian[k, 0, 2] * rz
    dv = jacobian[k, 1, 0] * rx + jacobian[k, 1, 1] * dy + jacobian[k, 1, 2] * rz
    along = bearings[k, 0] * rx + bearings[k, 1] * dy + bearings[k, 2] * rz
    return np.sqrt(du * du + dv * dv) - matches.bound_px[k] * distance, along, distance


@kernel()
def _explained(matches, everybody, pose):
    """How many of ``everybody`` (K,), numbers of ``matches``, a level ``pose`` (5,) explains."""
    inliers = 0
    for k in everybody:
        excess, along, distance = _excess(matches, k, pose)
        inliers += excess <= 0.0 and along > 0.0 and along >= np.cos(matches.bound_rad[k]) * distance
    return inliers


@kernel()
def _may_explain(matches, order, middle, half_yaw, reach, floor):
    """Whether some pose of a cell might explain more than ``floor`` of ``order`` (K,), numbers of ``matches``.

    The cell is ``half_yaw``, rad, and ``reach``, m, around the ``middle`` (5,). Those that it surely does not explain
    are moved to the front of ``order``, to come first next time.
    """
    spare = len(order) - floor
    out = 0
    for index in range(len(order)):
        k = order[index]
        excess, along, distance = _excess(matches, k, middle)
        ratio = reach / max(distance, 1e-300)
        if ratio >= 1.0:
            continue
        # The chord of an angle whose sine is the ratio.
        movement = ratio / np.sqrt(0.5 * (1.0 + np.sqrt(1.0 - ratio * ratio))) + half_yaw
        hidden = along < 0.0 and matches.bound_rad[k] + 1.6 * movement < 1.57
        if hidden or excess > (matches.pixels_per_radian[k] * movement * (1.0 + 1e-9) + 1e-9) * distance:
            order[index], order[out] = order[out], k
            out += 1
            if out >= spare:
                return False
    return True
