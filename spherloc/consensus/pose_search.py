"""Branch and bound over cells of poses small enough for derivatives: yaw, position and, if gravity is uncertain, tilt.

Each match of a cell is surely explained, surely not, or undecided (``pose_cells``: linear part and remainder). Children
are told how many are sure and look at the undecided only: near the optimum some ten, not all.

What is left is cut before it is split. With parameters x from -1 to 1 over the cell, the residual of an undecided match
is r + f . x along its direction in the middle and q + g . x across it (q = 0), to within the remainder; whatever the
other parameters are, one of them must keep |r + f x| <= tau + F - |f| and |q + g x| <= tau + G - |g|, F and G being the
sums of all |f|, |g| and the remainder. These intervals are counted in bins, their ends rounded outwards: where no more
overlap than the best pose explains, nothing better is, and the ends of the cell are cut off. Over what is left, the
forms are those of its own middle, and the next parameter is cut by them.
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
MAX_WAITING = 2048
"""Cells that wait to be split; the deepest is split first."""
CELL_EFFORT = 8
"""Matches whose test takes as long as what a cell needs besides."""
FORM, F_SUM, G_SUM, ALONG, ACROSS = 16, 12, 13, 14, 15
"""Columns of a linear form: f and g by parameter, 6 each, then tau + F, tau + G, and the residual in the middle along
and across its direction, px."""
MAX_FORMS = 4096
"""Undecided matches up to which a cell is cut."""
CUT_BINS = 32
"""Bins over each parameter of a cell in which intervals are counted."""
CUT_MARGIN = 1e-9
"""By which they are widened against rounding, beside ``SLACK``."""
CUT_ROUNDS, CUT_AGAIN = 4, 0.7
"""Most rounds over all parameters, and the share of the volume, left after one, from which there is no other."""
CUT_ENOUGH = 0.5
"""Share of a cell's volume, left after cutting, up to which it is looked at once more before it is split."""
BEST, OPEN, EFFORT, CELLS, LEFT, SPLITS, HALT = 0, 1, 2, 3, 4, 5, 6
"""Indices into ``state`` (STATE,), int64: most matches that a pose was seen to explain; the largest bound of cells too
small to be split; work done; cells looked at; cells left for later; boxes logged; not 0 if the search shall leave
off."""
STATE = 8


class SearchMemory(NamedTuple):
    """Memory of one search."""

    lower: FloatArray
    """(MAX_WAITING, 6) lower ends of waiting cells."""
    upper: FloatArray
    """(MAX_WAITING, 6) upper ends."""
    spans: NDArray[np.int64]
    """(MAX_WAITING, 3): where its undecided begin and end in ``lists``, and how many are sure."""
    lists: NDArray[np.int32]
    """Undecided matches of waiting cells."""
    forms: FloatArray
    """(MAX_FORMS or fewer, FORM) linear forms of the undecided of one cell."""
    steps: NDArray[np.int32]
    """(CUT_BINS + 1,) changes of depth from bin to bin."""


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


def room_for(count: int) -> SearchMemory:
    """Memory for ``count`` matches."""
    return SearchMemory(
        np.empty((MAX_WAITING, 6)),
        np.empty((MAX_WAITING, 6)),
        np.empty((MAX_WAITING, 3), np.int64),
        np.empty(16 * count + 4096, np.int32),
        np.empty((min(count, MAX_FORMS), FORM)),
        np.empty(CUT_BINS + 1, np.int32),
    )


@kernel(error_model="numpy")
def sort_matches(matches, cell, axis, members, kept, forms, cutoff, reach):
    """Sort the ``members`` (K,) of ``matches``, ``PackedMatches``, by what a ``cell`` (CELL_SIZE,) explains.

    The undecided are written to ``kept``. ``axis`` is the one of c that s takes the place of in this chart, -1 if none.
    Returns how many are surely explained, how many undecided, and how many of these the middle explains; -1 if all
    together are no more than ``cutoff``. The linear forms of the undecided are written to ``forms`` (K, FORM) if that
    has room for all members. ``reach`` (6,) gets the sums over the undecided of the px by which each parameter moves
    their residuals.
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
    tilt = ha + hc + SLACK
    fill_vector(reach, 0.0)
    sure, undecided, inside = 0, 0, 0
    spare = len(members) - cutoff
    gone, formed = 0, len(forms) >= len(members)
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
            if formed:
                fill_vector(forms[undecided], 0.0)
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
        shift, level = ratio / np.sqrt(1.0 - ratio * ratio), np.sqrt(x * x + z * z)
        alpha = tilt + hy * level + shift
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
        by_yaw = hy * min(level + shift, 1.0)
        second = tilt * tilt + (2.0 * tilt + hy) * by_yaw + (2.0 * (tilt + hy) + CURVATURE * e) * e
        rest = px * (0.5 * second + SLACK)
        nu, nv = (u / r, v / r) if r > 0.0 else (1.0, 0.0)
        # Derivative by yaw: W R (e_y x w).
        p, q = m00 * z - m02 * x, m10 * z - m12 * x
        f0, g0 = hy * (nu * p + nv * q), hy * (nu * q - nv * p)
        p, q = (m00 - u * x) / d, (m10 - v * x) / d
        h = cell[HALF_C]
        f1, g1 = -h * (nu * p + nv * q), -h * (nu * q - nv * p)
        p, q = (m01 - u * y) / d, (m11 - v * y) / d
        h = cell[HALF_C + 1]
        f2, g2 = -h * (nu * p + nv * q), -h * (nu * q - nv * p)
        p, q = (m02 - u * z) / d, (m12 - v * z) / d
        h = cell[HALF_C + 2]
        f3, g3 = -h * (nu * p + nv * q), -h * (nu * q - nv * p)
        if axis >= 0:
            along_q = x * row[Q] + y * row[Q + 1] + z * row[Q + 2]
            p = (m00 * row[Q] + m01 * row[Q + 1] + m02 * row[Q + 2] - u * along_q) / d
            q = (m10 * row[Q] + m11 * row[Q + 1] + m12 * row[Q + 2] - v * along_q) / d
            fs, gs = half_s * (nu * p + nv * q), half_s * (nu * q - nv * p)
            if axis == 0:
                f1, g1 = fs, gs
            elif axis == 1:
                f2, g2 = fs, gs
            else:
                f3, g3 = fs, gs
        f = abs(f0) + abs(f1) + abs(f2) + abs(f3) + rest
        g = abs(g0) + abs(g1) + abs(g2) + abs(g3) + rest
        f4 = g4 = f5 = g5 = 0.0
        if tilted:
            tx, ty, tz = ay * z - az * y, az * x - ax * z, ax * y - ay * x
            p, q = m00 * tx + m01 * ty + m02 * tz, m10 * tx + m11 * ty + m12 * tz
            f4, g4 = ha * (nu * p + nv * q), ha * (nu * q - nv * p)
            tx, ty, tz = by * z - bz * y, bz * x - bx * z, bx * y - by * x
            p, q = m00 * tx + m01 * ty + m02 * tz, m10 * tx + m11 * ty + m12 * tz
            f5, g5 = hc * (nu * p + nv * q), hc * (nu * q - nv * p)
            f, g = f + abs(f4) + abs(f5), g + abs(g4) + abs(g5)
        f_sum, g_sum = tau + f, tau + g
        f, g = min(f, move), min(g, move)
        if r - f > tau:
            gone += 1
            continue
        if along > alpha and (r + f) * (r + f) + g * g <= tau * tau:
            sure += 1
            continue
        kept[undecided] = k
        if formed:
            form = forms[undecided]
            form[0], form[1], form[2], form[3], form[4], form[5] = f1, f2, f3, f0, f4, f5
            form[6], form[7], form[8], form[9], form[10], form[11] = g1, g2, g3, g0, g4, g5
            form[F_SUM], form[G_SUM], form[ALONG], form[ACROSS] = f_sum, g_sum, r, 0.0
        undecided += 1
        inside += r <= tau and along > 0.0
        reach[3] += abs(f0) + abs(g0)
        reach[0] += abs(f1) + abs(g1)
        reach[1] += abs(f2) + abs(g2)
        reach[2] += abs(f3) + abs(g3)
        reach[4] += abs(f4) + abs(g4)
        reach[5] += abs(f5) + abs(g5)
    if sure + undecided <= cutoff:
        return -1, 0, 0
    return sure, undecided, inside


@kernel(error_model="numpy")
def _meet(offset, slope, room, low, high):
    """The part of ``low`` to ``high``, rounded outwards, with x where |offset + slope x| <= room - |slope|."""
    size = abs(slope)
    room -= size
    if size + abs(offset) > room:
        per = 1.0 / size
        middle, half = -offset * per, room * per + CUT_MARGIN
        if slope < 0.0:
            middle = -middle
        low, high = max(low, middle - half), min(high, middle + half)
    return low, high


@kernel(error_model="numpy")
def _overlap(forms, a, steps, cutoff, ends):
    """Where along parameter ``a`` more than ``cutoff`` of the linear ``forms`` (K, FORM) may be explained at once.

    The first and the last such place are written to ``ends`` (2,), from -1 to 1; ``steps`` (CUT_BINS + 1,) is scratch
    memory. Returns the most at one place.
    """
    fill_vector(steps, 0)
    per_unit = 0.5 * CUT_BINS
    for k in range(len(forms)):
        form = forms[k]
        low, high = _meet(form[ALONG], form[a], form[F_SUM], -1.0, 1.0)
        low, high = _meet(form[ACROSS], form[6 + a], form[G_SUM], low, high)
        if low <= high:
            steps[int((low + 1.0) * per_unit)] += 1
            steps[min(int((high + 1.0) * per_unit), CUT_BINS - 1) + 1] -= 1
    first, last, most, depth = CUT_BINS, -1, 0, 0
    for b in range(CUT_BINS):
        depth += steps[b]
        most = max(most, depth)
        if depth > cutoff:
            first, last = min(first, b), b
    ends[0], ends[1] = first / per_unit - 1.0, (last + 1) / per_unit - 1.0
    return most


@kernel()
def cut_cell(forms, lower, upper, steps, cutoff, reach):
    """Cut off ends of a cell, ``lower`` and ``upper`` (6,), where no more than ``cutoff`` of ``forms`` are explained.

    The ``forms`` (K, FORM) become those of what is left, and ``reach`` (6,) shrinks with it; ``steps`` (CUT_BINS + 1,)
    is scratch memory. Returns the most that may be explained at once, ``cutoff`` or less if nothing is left, and the
    share of the volume that is left.
    """
    ends, most, share = np.empty(2), len(forms), 1.0
    for _ in range(CUT_ROUNDS):
        before = share
        for a in range(6):
            if not lower[a] < upper[a]:
                continue
            most = min(most, _overlap(forms, a, steps, cutoff, ends))
            if most <= cutoff:
                return most, 0.0
            width, shift = 0.5 * (ends[1] - ends[0]), 0.5 * (ends[0] + ends[1])
            if width >= 1.0:
                continue
            middle, half = 0.5 * (lower[a] + upper[a]), 0.5 * (upper[a] - lower[a])
            if ends[0] > -1.0:
                lower[a] = max(lower[a], middle + half * ends[0])
            if ends[1] < 1.0:
                upper[a] = min(upper[a], middle + half * ends[1])
            share *= width
            reach[a] *= width
            for k in range(len(forms)):
                form = forms[k]
                form[F_SUM] -= (1.0 - width) * abs(form[a])
                form[G_SUM] -= (1.0 - width) * abs(form[6 + a])
                form[ALONG] += shift * form[a]
                form[ACROSS] += shift * form[6 + a]
                form[a] *= width
                form[6 + a] *= width
        if share > CUT_AGAIN * before:
            break
    return most, share


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
    """Split a cell until no part may explain more than the best pose and ``limits.gap``.

    The cell is ``cell_of`` = (chart, lower (6,), upper (6,)); ``members`` (K,) are all of ``matches``,
    ``PackedMatches``, that may be explained in it. ``room`` is a ``SearchMemory``, ``limits`` are ``Limits``.
    ``found`` is (best_at, state, left): better poses go to ``best_at`` (7,), chart and parameters, and to ``state``;
    where the effort ends, cells go to ``left``. A watch's ``board`` can end it too.
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
        asked = lists[first:last]
        sure, undecided, inside = sort_matches(matches, cell, axis, asked, target, room.forms, cutoff, reach)
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
        share, most = 1.0, undecided
        if len(room.forms) >= last - first:
            cutoff = state[BEST] + limits.gap - known - sure
            forms = room.forms[:undecided]
            state[EFFORT] += undecided
            most, share = cut_cell(forms, lo[waiting], up[waiting], room.steps, cutoff, reach)
            if most <= cutoff:
                continue
        split = 0
        for a in range(1, 6):
            if reach[a] > reach[split]:
                split = a
        middle = 0.5 * (lo[waiting, split] + up[waiting, split])
        once_more = share <= CUT_ENOUGH
        small = not once_more and reach[split] < limits.least_px * undecided
        divisible = lo[waiting, split] < middle < up[waiting, split] and waiting + 2 <= len(spans)
        if small or not (once_more or divisible):
            state[OPEN] = max(state[OPEN], known + sure + most)
            continue
        if room_left:
            first, last, known = last, last + undecided, known + sure
        for side in range(1 if once_more else 2):
            spans[waiting, 0], spans[waiting, 1], spans[waiting, 2] = first, last, known
            if side == 1:
                copy_vector(lo[waiting - 1], lo[waiting])
                copy_vector(up[waiting - 1], up[waiting])
                up[waiting - 1, split] = middle
                lo[waiting, split] = middle
            waiting += 1
