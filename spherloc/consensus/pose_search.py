"""Branch and bound over cells of poses small enough for derivatives: yaw, position and, if gravity is uncertain, tilt.

Each match of a cell is surely explained, surely not, or undecided (``pose_cells``: linear part and remainder). Children
are told how many are sure and look at the undecided only: near the optimum some ten, not all.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.pose_cells import (
    ANGLES,
    BEARING,
    BOUND_PX,
    BOUND_RAD,
    CELL_SIZE,
    HALF_ANGLES,
    HALF_C,
    HALF_C_NORM,
    HALF_S,
    JACOBIAN,
    PX_PER_RAD,
    Q_NORM,
    SLACK,
    C,
    Q,
    S,
    has_tilt,
    place_cell,
)
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_vector, fill_vector
from spherloc.types import FloatArray
from spherloc.watch import stopped

CURVATURE = 1.1547005383792517
"""2 / sqrt 3, of the remainder in ``pose_cells``."""
MOST_WAITING = 2048
"""Cells that wait to be split; the deepest is split first."""
CELL_EFFORT = 8
"""Matches whose test takes as long as what a cell needs besides."""
BEST, OPEN, EFFORT, CELLS, LEFT, SPLITS, HALT = 0, 1, 2, 3, 4, 5, 6
"""Indices into ``state`` (STATE,), int64: most matches that a pose was seen to explain; the largest bound of cells too
small to be split; work done; cells looked at; cells left for later; boxes logged; not 0 if the search shall leave
off."""
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


@kernel(error_model="numpy")
def sort_matches(matches, cell, axis, members, kept, cutoff, reach):
    """Sort the ``members`` (K,) of ``PackedMatches`` by what a ``cell`` (CELL_SIZE,) explains.

    The undecided are written to ``kept``. ``axis`` is the one of c that s takes the place of in this chart, -1 if none.
    Returns how many are surely explained, how many undecided, and how many of these the middle explains; -1 if all
    together are no more than ``cutoff``. ``reach`` (6,) gets the sums over the undecided of the px by which each
    parameter moves their residuals.
    """
    rows = matches.rows
    s0, c0, c1, c2 = cell[S], cell[C], cell[C + 1], cell[C + 2]
    half_s, half_c = cell[HALF_S], cell[HALF_C_NORM]
    hy, ha, hc = cell[HALF_ANGLES], cell[HALF_ANGLES + 1], cell[HALF_ANGLES + 2]
    tilted = ha > 0.0 or hc > 0.0
    cy, sy, ca, sa = np.cos(cell[ANGLES]), np.sin(cell[ANGLES]), np.cos(cell[ANGLES + 1]), np.sin(cell[ANGLES + 1])
    cc, sc = np.cos(cell[ANGLES + 2]), np.sin(cell[ANGLES + 2])
    r00, r01, r02 = cc * cy, -sc, cc * sy
    r10, r11, r12 = ca * sc * cy + sa * sy, ca * cc, ca * sc * sy - sa * cy
    r20, r21, r22 = sa * sc * cy - ca * sy, sa * cc, sa * sc * sy + ca * cy
    # Axes of the tilts seen from the map: R^T e_x and R^T (0, -sin a, cos a).
    ax, ay, az = r00, r01, r02
    bx, by, bz = ca * r20 - sa * r10, ca * r21 - sa * r11, ca * r22 - sa * r12
    turn = hy + ha + hc + SLACK
    fill_vector(reach, 0.0)
    sure, undecided, inside = 0, 0, 0
    spare = len(members) - cutoff
    gone = 0
    for index in range(len(members)):
        if gone >= spare:
            return -1, 0, 0
        k = members[index]
        row = rows[k]
        x, y, z = s0 * row[Q] - c0, s0 * row[Q + 1] - c1, s0 * row[Q + 2] - c2
        d2 = x * x + y * y + z * z
        delta = half_c + half_s * row[Q_NORM] + matches.rounding * (1.0 + row[Q_NORM])
        px = row[PX_PER_RAD]
        if delta * delta >= 0.998 * d2:
            kept[undecided] = k
            undecided += 1
            for j in range(3):
                reach[j] += px * (half_s * row[Q_NORM] if j == axis else cell[HALF_C + j]) / delta
            continue
        d = np.sqrt(d2)
        x, y, z = x / d, y / d, z / d
        ratio = delta / d
        m00 = row[JACOBIAN] * r00 + row[JACOBIAN + 1] * r10 + row[JACOBIAN + 2] * r20
        m01 = row[JACOBIAN] * r01 + row[JACOBIAN + 1] * r11 + row[JACOBIAN + 2] * r21
        m02 = row[JACOBIAN] * r02 + row[JACOBIAN + 1] * r12 + row[JACOBIAN + 2] * r22
        m10 = row[JACOBIAN + 3] * r00 + row[JACOBIAN + 4] * r10 + row[JACOBIAN + 5] * r20
        m11 = row[JACOBIAN + 3] * r01 + row[JACOBIAN + 4] * r11 + row[JACOBIAN + 5] * r21
        m12 = row[JACOBIAN + 3] * r02 + row[JACOBIAN + 4] * r12 + row[JACOBIAN + 5] * r22
        u, v = m00 * x + m01 * y + m02 * z, m10 * x + m11 * y + m12 * z
        r2 = u * u + v * v
        tau = row[BOUND_PX]
        # asin(x) <= x / sqrt(1 - x^2)
        alpha = turn + ratio / np.sqrt(1.0 - ratio * ratio)
        move = px * alpha
        if r2 > (tau + move) * (tau + move):
            gone += 1
            continue
        along = (
            row[BEARING] * (r00 * x + r01 * y + r02 * z)
            + row[BEARING + 1] * (r10 * x + r11 * y + r12 * z)
            + row[BEARING + 2] * (r20 * x + r21 * y + r22 * z)
        )
        if along <= -alpha or (along <= 0.0 and alpha + row[BOUND_RAD] < 1.57):
            gone += 1
            continue
        r = np.sqrt(r2)
        e = ratio / (1.0 - ratio)
        rest = px * (0.5 * (turn * turn + 2.0 * turn * e + CURVATURE * e * e) + SLACK)
        nu, nv = (u / r, v / r) if r > 0.0 else (1.0, 0.0)
        # Derivative by yaw: W R (e_y x w).
        p, q = m00 * z - m02 * x, m10 * z - m12 * x
        f0, g0 = hy * abs(nu * p + nv * q), hy * abs(nu * q - nv * p)
        p, q = (m00 - u * x) / d, (m10 - v * x) / d
        h = cell[HALF_C]
        f1, g1 = h * abs(nu * p + nv * q), h * abs(nu * q - nv * p)
        p, q = (m01 - u * y) / d, (m11 - v * y) / d
        h = cell[HALF_C + 1]
        f2, g2 = h * abs(nu * p + nv * q), h * abs(nu * q - nv * p)
        p, q = (m02 - u * z) / d, (m12 - v * z) / d
        h = cell[HALF_C + 2]
        f3, g3 = h * abs(nu * p + nv * q), h * abs(nu * q - nv * p)
        if axis >= 0:
            along_q = x * row[Q] + y * row[Q + 1] + z * row[Q + 2]
            p = (m00 * row[Q] + m01 * row[Q + 1] + m02 * row[Q + 2] - u * along_q) / d
            q = (m10 * row[Q] + m11 * row[Q + 1] + m12 * row[Q + 2] - v * along_q) / d
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


@kernel()
def put_off(left, state, cell_of, bound, narrow):
    """Write a cell, ``cell_of`` = (chart, lower (6,), upper (6,)), to ``left``, or its bound to ``state`` if that is
    full.

    ``narrow`` is 1 if the cell's yaw is not the whole circle.
    """
    chart, lower, upper = cell_of
    index = state[LEFT]
    if index == len(left.about):
        state[OPEN] = max(state[OPEN], bound)
        return
    copy_vector(lower, left.lower[index])
    copy_vector(upper, left.upper[index])
    left.about[index, 0], left.about[index, 1], left.about[index, 2] = chart, bound, narrow
    state[LEFT] = index + 1


@kernel()
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
    for k in range(count):
        lists[k] = members[k]
    copy_vector(lower, lo[0])
    copy_vector(upper, up[0])
    spans[0, 0], spans[0, 1], spans[0, 2] = 0, count, 0
    waiting = 1
    cell, reach = np.empty(CELL_SIZE), np.empty(6)
    while waiting > 0:
        if state[EFFORT] >= limits.effort or state[HALT] != 0 or stopped(board):
            for k in range(waiting):
                put_off(left, state, (chart, lo[k], up[k]), spans[k, 2] + spans[k, 1] - spans[k, 0], np.int64(1))
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
        tilt_a, tilt_c = cell[ANGLES + 1], cell[ANGLES + 2]
        if known + sure + inside > state[BEST] and np.cos(tilt_a) * np.cos(tilt_c) >= matches.least_cosine:
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
                copy_vector(lo[waiting - 1], lo[waiting])
                copy_vector(up[waiting - 1], up[waiting])
                up[waiting - 1, split] = middle
                lo[waiting, split] = middle
            waiting += 1
