"""Branch and bound over level poses in a small region: does any of them explain more than a given number?

A cell is an interval of yaw and a cube of camera positions. A unit ray moves by at most the cell's half yaw plus the
chord that its half diagonal spans at the point, and the residual is linear in the ray, so a correspondence whose
residual in the middle exceeds its bound by more than that movement is explained nowhere in the cell. A cell that
cannot explain more than ``floor`` is dropped; others are split until none is left, or the limit is reached.
"""

import numba
import numpy as np

from spherloc.consensus.dual_proof import FOUND, IMPOSSIBLE, UNKNOWN

MOST_WAITING = 4096
"""Cells that wait to be split; more are not needed since the deepest is split first."""
LEAST_CELL_RAD = 1e-5
"""A cell that moves rays by less is not split: it holds a pose that explains one more to within rounding, or nearly."""
HALF_DIAGONAL = np.sqrt(3.0)


@numba.njit(cache=True, nogil=True)
def search_region(view, limits, few, ball, floor, cell_limit, found):
    """Whether some level pose of the region explains more than ``floor`` of ``few``: as ``prove_none``; and the cells.

    ``view`` is (bearings, points, cos, sin and half width of the yaw interval); ``limits`` are the weights (M, 2, 3),
    the bounds (M,) px, the angular bounds (M,) rad and the px/rad (M,); ``ball`` (4,) centre and radius of camera
    positions.
    """
    c0, s0, slack = view[2], view[3], view[4]
    order = few.copy()
    cells = np.empty((MOST_WAITING, 6))
    cells[0, 0], cells[0, 1], cells[0, 2:5], cells[0, 5] = 0.0, slack, ball[:3], ball[3]
    waiting, used, exact = 1, 0, True
    reach = _mean_distance(view[1], few, ball)
    while waiting > 0:
        if used >= cell_limit or waiting > MOST_WAITING - 8:
            exact = False
            break
        waiting -= 1
        used += 1
        yaw, half_yaw, half = cells[waiting, 0], cells[waiting, 1], cells[waiting, 5]
        x, y, z = cells[waiting, 2], cells[waiting, 3], cells[waiting, 4]
        c, s = c0 * np.cos(yaw) - s0 * np.sin(yaw), s0 * np.cos(yaw) + c0 * np.sin(yaw)
        if not _may_explain(view, limits, order, c, s, x, y, z, half_yaw, half * HALF_DIAGONAL, floor):
            continue
        if _explained(view, limits, few, c, s, x, y, z) > floor:
            found[0], found[1], found[2], found[3], found[4] = c, s, x, y, z
            return FOUND, used
        if half_yaw + half * HALF_DIAGONAL / reach < LEAST_CELL_RAD:
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


@numba.njit(cache=True, nogil=True)
def _mean_distance(points, few, ball):
    total = 0.0
    for k in few:
        x, y, z = points[k, 0] - ball[0], points[k, 1] - ball[1], points[k, 2] - ball[2]
        total += np.sqrt(x * x + y * y + z * z)
    return total / len(few)


@numba.njit(cache=True, nogil=True, inline="always")
def _excess(view, limits, k, c, s, x, y, z):
    """Residual less its bound, px (inf behind the bearing), and the distance, of a correspondence seen from (x, y,
    z).
    """
    bearings, points = view[0], view[1]
    weights, bound_px = limits[0], limits[1]
    dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
    rx, rz = c * dx + s * dz, c * dz - s * dx
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    du = weights[k, 0, 0] * rx + weights[k, 0, 1] * dy + weights[k, 0, 2] * rz
    dv = weights[k, 1, 0] * rx + weights[k, 1, 1] * dy + weights[k, 1, 2] * rz
    along = bearings[k, 0] * rx + bearings[k, 1] * dy + bearings[k, 2] * rz
    return np.sqrt(du * du + dv * dv) - bound_px[k] * distance, along, distance


@numba.njit(cache=True, nogil=True)
def _explained(view, limits, few, c, s, x, y, z):
    """How many a pose explains."""
    inliers = 0
    for k in few:
        excess, along, distance = _excess(view, limits, k, c, s, x, y, z)
        inliers += excess <= 0.0 and along > 0.0 and along >= np.cos(limits[2][k]) * distance
    return inliers


@numba.njit(cache=True, nogil=True)
def _may_explain(view, limits, order, c, s, x, y, z, half_yaw, reach, floor):
    """Whether some pose of a cell might explain more than ``floor``. Those that it surely does not come first next
    time.
    """
    eps, pixels_per_radian = limits[2], limits[3]
    spare = len(order) - floor
    out = 0
    for place in range(len(order)):
        k = order[place]
        excess, along, distance = _excess(view, limits, k, c, s, x, y, z)
        ratio = reach / max(distance, 1e-300)
        if ratio >= 1.0:
            continue
        # The chord of an angle whose sine is the ratio.
        move = ratio / np.sqrt(0.5 * (1.0 + np.sqrt(1.0 - ratio * ratio))) + half_yaw
        hidden = along < 0.0 and eps[k] + 1.6 * move < 1.57
        if hidden or excess > (pixels_per_radian[k] * move * (1.0 + 1e-9) + 1e-9) * distance:
            order[place], order[out] = order[out], k
            out += 1
            if out >= spare:
                return False
    return True
