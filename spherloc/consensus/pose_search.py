"""Branch and bound over cells of poses small enough for derivatives: yaw, position and, if gravity is uncertain, tilt.

Each match of a cell is surely explained, surely not, or undecided (``pose_cells``: linear part and remainder). Children
are told how many are sure and look at the undecided only: near the optimum some ten, not all.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.pose_cells import SLACK, has_tilt, place_cell
from spherloc.types import FloatArray
from spherloc.watch import stopped

BEND = 1.1547005383792517
"""2 / sqrt 3."""
MOST_WAITING = 2048
CELL_EFFORT = 8
"""Matches whose test takes as long as what a cell needs besides."""
BEST, OPEN, EFFORT, CELLS, LEFT, SPLITS, HALT = 0, 1, 2, 3, 4, 5, 6
"""Places of ``state``: most matches that a pose was seen to explain; the largest bound of cells too small to be split;
work done; cells looked at; cells left for later; boxes logged; not 0 if the search shall leave off."""
STATE = 8


class Room(NamedTuple):
    """Memory of one search."""

    lower: FloatArray
    """(MOST_WAITING, 6) lower ends of waiting cells."""
    upper: FloatArray
    """(MOST_WAITING, 6) upper ends."""
    spans: NDArray[np.int64]
    """(MOST_WAITING, 3): where its undecided begin and end in ``lists``, and how many are sure."""
    lists: NDArray[np.int32]
    """Undecided matches of waiting cells."""


class Left(NamedTuple):
    """Cells that a search left for later, ``state[LEFT]`` of them."""

    lower: FloatArray
    """(K, 6) lower ends."""
    upper: FloatArray
    """(K, 6) upper ends."""
    about: NDArray[np.int64]
    """(K, 3): chart, the most that any of its poses explains, and 1 if its yaw is narrow, 0 if it is the circle."""


class Limits(NamedTuple):
    """When a search leaves off."""

    gap: int
    """A cell is dropped that could explain at most as many more than the best pose."""
    effort: int
    """Most work, matches tested."""
    least_px: float
    """Cells in which residuals vary less are not split."""
    switch_rad: float
    """Mean movement of the directions in a box below which derivatives are used."""


def room_for(count: int) -> Room:
    """Memory for ``count`` matches."""
    return Room(
        np.empty((MOST_WAITING, 6)),
        np.empty((MOST_WAITING, 6)),
        np.empty((MOST_WAITING, 3), np.int64),
        np.empty(16 * count + 4096, np.int32),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sort_matches(matches, cell, axis, members, kept, cutoff, reach):
    """Sort the matches ``members`` of a cell; write the undecided to ``kept``.

    Returns how many are surely explained, how many undecided, and how many of these the middle explains; -1 if all
    together are no more than ``cutoff``. ``reach`` (6,) gets the sums over the undecided of the px by which each
    parameter moves their residuals.
    """
    rows = matches.rows
    s0, c0, c1, c2 = cell[0], cell[1], cell[2], cell[3]
    half_s, half_c = cell[4], cell[8]
    hy, ha, hc = cell[13], cell[14], cell[15]
    tilted = ha > 0.0 or hc > 0.0
    cy, sy, ca, sa = np.cos(cell[10]), np.sin(cell[10]), np.cos(cell[11]), np.sin(cell[11])
    cc, sc = np.cos(cell[12]), np.sin(cell[12])
    r00, r01, r02 = cc * cy, -sc, cc * sy
    r10, r11, r12 = ca * sc * cy + sa * sy, ca * cc, ca * sc * sy - sa * cy
    r20, r21, r22 = sa * sc * cy - ca * sy, sa * cc, sa * sc * sy + ca * cy
    # Axes of the tilts seen from the map: R^T e_x and R^T (0, -sin a, cos a).
    ax, ay, az = r00, r01, r02
    bx, by, bz = ca * r20 - sa * r10, ca * r21 - sa * r11, ca * r22 - sa * r12
    turn = hy + ha + hc + SLACK
    reach[:] = 0.0
    sure, undecided, inside = 0, 0, 0
    spare = len(members) - cutoff
    gone = 0
    for place in range(len(members)):
        if gone >= spare:
            return -1, 0, 0
        k = members[place]
        row = rows[k]
        x, y, z = s0 * row[0] - c0, s0 * row[1] - c1, s0 * row[2] - c2
        d2 = x * x + y * y + z * z
        delta = half_c + half_s * row[3] + matches.rounding * (1.0 + row[3])
        px = row[14]
        if delta * delta >= 0.998 * d2:
            kept[undecided] = k
            undecided += 1
            for j in range(3):
                reach[j] += px * (half_s * row[3] if j == axis else cell[5 + j]) / delta
            continue
        d = np.sqrt(d2)
        x, y, z = x / d, y / d, z / d
        ratio = delta / d
        m00 = row[7] * r00 + row[8] * r10 + row[9] * r20
        m01 = row[7] * r01 + row[8] * r11 + row[9] * r21
        m02 = row[7] * r02 + row[8] * r12 + row[9] * r22
        m10 = row[10] * r00 + row[11] * r10 + row[12] * r20
        m11 = row[10] * r01 + row[11] * r11 + row[12] * r21
        m12 = row[10] * r02 + row[11] * r12 + row[12] * r22
        u, v = m00 * x + m01 * y + m02 * z, m10 * x + m11 * y + m12 * z
        r2 = u * u + v * v
        tau = row[13]
        # asin(x) <= x / sqrt(1 - x^2)
        alpha = turn + ratio / np.sqrt(1.0 - ratio * ratio)
        move = px * alpha
        if r2 > (tau + move) * (tau + move):
            gone += 1
            continue
        along = (
            row[4] * (r00 * x + r01 * y + r02 * z)
            + row[5] * (r10 * x + r11 * y + r12 * z)
            + row[6] * (r20 * x + r21 * y + r22 * z)
        )
        if along <= -alpha or (along <= 0.0 and alpha + row[15] < 1.57):
            gone += 1
            continue
        r = np.sqrt(r2)
        e = ratio / (1.0 - ratio)
        rest = px * (0.5 * (turn * turn + 2.0 * turn * e + BEND * e * e) + SLACK)
        nu, nv = (u / r, v / r) if r > 0.0 else (1.0, 0.0)
        # Derivative by yaw: W R (e_y x w).
        p, q = m00 * z - m02 * x, m10 * z - m12 * x
        f0, g0 = hy * abs(nu * p + nv * q), hy * abs(nu * q - nv * p)
        p, q = (m00 - u * x) / d, (m10 - v * x) / d
        h = cell[5]
        f1, g1 = h * abs(nu * p + nv * q), h * abs(nu * q - nv * p)
        p, q = (m01 - u * y) / d, (m11 - v * y) / d
        h = cell[6]
        f2, g2 = h * abs(nu * p + nv * q), h * abs(nu * q - nv * p)
        p, q = (m02 - u * z) / d, (m12 - v * z) / d
        h = cell[7]
        f3, g3 = h * abs(nu * p + nv * q), h * abs(nu * q - nv * p)
        if axis >= 0:
            along_q = x * row[0] + y * row[1] + z * row[2]
            p = (m00 * row[0] + m01 * row[1] + m02 * row[2] - u * along_q) / d
            q = (m10 * row[0] + m11 * row[1] + m12 * row[2] - v * along_q) / d
            fs, gs = half_s * abs(nu * p + nv * q), half_s * abs(nu * q - nv * p)
            if axis == 0:
                f1, g1 = fs, gs
            elif axis == 1:
                f2, g2 = fs, gs
            else:
                f3, g3 = fs, gs
        f, g = f0 + f1 + f2 + f3 + rest, g0 + g1 + g2 + g3 + rest
        f4 = g4 = f5 = g5 = 0.0
        if tilted:
            tx, ty, tz = ay * z - az * y, az * x - ax * z, ax * y - ay * x
            p, q = m00 * tx + m01 * ty + m02 * tz, m10 * tx + m11 * ty + m12 * tz
            f4, g4 = ha * abs(nu * p + nv * q), ha * abs(nu * q - nv * p)
            tx, ty, tz = by * z - bz * y, bz * x - bx * z, bx * y - by * x
            p, q = m00 * tx + m01 * ty + m02 * tz, m10 * tx + m11 * ty + m12 * tz
            f5, g5 = hc * abs(nu * p + nv * q), hc * abs(nu * q - nv * p)
            f, g = f + f4 + f5, g + g4 + g5
        f, g = min(f, move), min(g, move)
        if r - f > tau:
            gone += 1
            continue
        if along > alpha and (r + f) * (r + f) + g * g <= tau * tau:
            sure += 1
            continue
        kept[undecided] = k
        undecided += 1
        inside += r <= tau and along > 0.0
        reach[3] += f0 + g0
        reach[0] += f1 + g1
        reach[1] += f2 + g2
        reach[2] += f3 + g3
        reach[4] += f4 + g4
        reach[5] += f5 + g5
    if sure + undecided <= cutoff:
        return -1, 0, 0
    return sure, undecided, inside


@numba.njit(cache=True, nogil=True)
def put_off(left, state, cell_of, bound, narrow):
    """Leave a cell for later, or count its bound as open if there is no room."""
    place = state[LEFT]
    if place == len(left.about):
        state[OPEN] = max(state[OPEN], bound)
        return
    left.lower[place], left.upper[place] = cell_of[1], cell_of[2]
    left.about[place, 0], left.about[place, 1], left.about[place, 2] = cell_of[0], bound, narrow
    state[LEFT] = place + 1


@numba.njit(cache=True, nogil=True)
def search_poses(matches, cell_of, members, room, limits, found, board):
    """Split a cell, ``cell_of`` = (chart, lower (6,), upper (6,)), until no part may explain more than the best pose
    and ``limits.gap``.

    ``members`` are all that may be explained in it. ``found`` is (best_at, state, left): better poses go to ``best_at``
    (7,), chart and parameters, and to ``state``; where the effort ends, cells go to ``left``.
    """
    chart, lower, upper = cell_of
    best_at, state, left = found
    lists, spans, lo, up = room.lists, room.spans, room.lower, room.upper
    axis = (chart - 1) // 2 if chart > 0 else -1
    count = len(members)
    lists[:count] = members
    lo[0], up[0] = lower, upper
    spans[0, 0], spans[0, 1], spans[0, 2] = 0, count, 0
    waiting = 1
    cell, reach = np.empty(16), np.empty(6)
    while waiting > 0:
        if state[EFFORT] >= limits.effort or state[HALT] != 0 or stopped(board):
            for k in range(waiting):
                put_off(left, state, (chart, lo[k], up[k]), spans[k, 2] + spans[k, 1] - spans[k, 0], 1)
            return
        waiting -= 1
        first, last, known = spans[waiting, 0], spans[waiting, 1], spans[waiting, 2]
        state[EFFORT] += CELL_EFFORT + last - first
        state[CELLS] += 1
        if known + last - first <= state[BEST] + limits.gap or not has_tilt(matches, lo[waiting], up[waiting]):
            continue
        place_cell(chart, lo[waiting], up[waiting], cell)
        room_left = len(lists) - last >= last - first
        target = lists[last:] if room_left else np.empty(last - first, np.int32)
        cutoff = state[BEST] + limits.gap - known
        sure, undecided, inside = sort_matches(matches, cell, axis, lists[first:last], target, cutoff, reach)
        if sure < 0:
            continue
        if known + sure + inside > state[BEST] and np.cos(cell[11]) * np.cos(cell[12]) >= matches.least_cosine:
            state[BEST] = known + sure + inside
            best_at[0] = chart
            for a in range(6):
                best_at[1 + a] = 0.5 * (lo[waiting, a] + up[waiting, a])
            if known + sure + undecided <= state[BEST] + limits.gap:
                continue
        split = 0
        for a in range(1, 6):
            if reach[a] > reach[split]:
                split = a
        middle = 0.5 * (lo[waiting, split] + up[waiting, split])
        small = reach[split] < limits.least_px * undecided
        if small or waiting + 2 > len(spans) or not lo[waiting, split] < middle < up[waiting, split]:
            state[OPEN] = max(state[OPEN], known + sure + undecided)
            continue
        if room_left:
            first, last, known = last, last + undecided, known + sure
        for side in range(2):
            spans[waiting, 0], spans[waiting, 1], spans[waiting, 2] = first, last, known
            if side == 1:
                lo[waiting], up[waiting] = lo[waiting - 1], up[waiting - 1]
                up[waiting - 1, split] = middle
                lo[waiting, split] = middle
            waiting += 1
