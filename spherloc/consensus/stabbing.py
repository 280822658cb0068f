"""The bound of a box of positions and tilts at all yaws at once: the deepest of the intervals of yaw left to matches.

The cell is that of ``pose_cells`` with the whole circle of yaw. A match is explained only if R_y(yaw) u is within
e = (its own angle) + psi of v' = T^T v, T being the tilt in the middle and u the direction of w. R_y keeps elevations,
and lowers azimuths atan2(z, x) by yaw. So:

- the elevation of some w in the cell must be within e of that of v': w's height is within delta of its middle's, and
  its horizontal length within delta' (the horizontal part of delta), so that ends of that rectangle decide;
- yaw lies within asin(delta' / rho) + asin(sin e / rho_v) of az(w) - az(v'), rho and rho_v being horizontal lengths of
  w in the middle and of v': a cap of radius e around v' spans asin(sin e / rho_v) of azimuth if it holds no pole.

Every pose of the cell explains at most those whose interval holds its yaw, so the most intervals over one yaw bound
the cell. They are counted in bins, both ends rounded outwards, and exactly in those that may be the deepest. Yaw is
measured in turns of ``pair_arcs``, from 0 to 4, which need no trigonometry.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.pair_arcs import CIRCLE, turn_of_direction
from spherloc.consensus.pose_cells import (
    ANGLES,
    BEARING,
    COSINE,
    HALF_ANGLES,
    HALF_C,
    HALF_C_FLAT,
    HALF_C_NORM,
    HALF_S,
    LEVEL,
    LEVEL_COSINE,
    Q_NORM,
    SINE,
    SLACK,
    C,
    Q,
    S,
)
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_vector, sort_between
from spherloc.types import FloatArray

FEW_BINS, MANY_BINS = 256, 1024
"""Multiples of the bins of ``yaw_bins``."""
MANY = 400
"""Matches from which the larger number of bins is used."""
MAX_WINDOWS = 64
MAX_GAP = 0.004
"""Turns between two windows of yaw up to which they are one."""
EVERYWHERE = 8.0
"""End of an interval that is the whole circle."""


class StabbingMemory(NamedTuple):
    """Room for one cell, M matches."""

    starts: FloatArray
    """(M,) first ends of the intervals, turns."""
    ends: FloatArray
    """(M,) last ends; smaller than the first where the interval holds turn 0; ``EVERYWHERE``."""
    windows: FloatArray
    """(MAX_WINDOWS, 2) where the depth exceeds the cutoff, turns; the last may end above 4."""
    opened: NDArray[np.int32]
    """(MANY_BINS,) how many intervals begin in each bin, then where those of deep bins end in ``opening``."""
    closed: NDArray[np.int32]
    """(MANY_BINS,) the same of last ends."""
    before: NDArray[np.int32]
    """(MANY_BINS,) depth where each bin begins."""
    opening: FloatArray
    """(M,) first ends in deep bins, by bin."""
    closing: FloatArray
    """(M,) last ends in deep bins, by bin."""


def scratch_for(count: int) -> StabbingMemory:
    """Room for cells of ``count`` matches."""
    turns, bins = np.empty((4, count)), np.empty((3, MANY_BINS), np.int32)
    return StabbingMemory(turns[0], turns[1], np.empty((MAX_WINDOWS, 2)), bins[0], bins[1], bins[2], turns[2], turns[3])


@kernel(error_model="numpy")
def keep_possible(matches, cell, members, kept, scratch, cutoff, spread):
    """Write those of ``members`` (K,) that some pose of a cell may explain to ``kept``, their intervals to ``scratch``.

    ``matches`` are ``PackedMatches``, ``cell`` (CELL_SIZE,) is that of ``place_cell``. Returns how many, and how many
    of them have the whole circle; -1 and 0 as soon as no more than ``cutoff`` can be left. ``spread`` (2,) gets the
    mean of 1 / |w| and of |q| / |w| over those kept.
    """
    rows = matches.rows
    s0, c0, c1, c2 = cell[S], cell[C], cell[C + 1], cell[C + 2]
    half_s, half_c, half_flat = cell[HALF_S], cell[HALF_C_NORM], cell[HALF_C_FLAT]
    a, c, half_a, half_tilt_c = cell[ANGLES + 1], cell[ANGLES + 2], cell[HALF_ANGLES + 1], cell[HALF_ANGLES + 2]
    ca, sa, cc, sc = np.cos(a), np.sin(a), np.cos(c), np.sin(c)
    psi = min(np.sqrt(half_a * half_a + half_tilt_c * half_tilt_c), matches.widest_turn + abs(a) + abs(c))
    cos_psi, sin_psi = np.cos(psi), np.sin(psi)
    half_y = cell[HALF_C + 1]
    upright = a == 0.0 and c == 0.0 and psi == 0.0
    used, free = 0, 0
    near, far = 0.0, 0.0
    starts, ends = scratch.starts, scratch.ends
    spare = len(members) - cutoff
    for index in range(len(members)):
        if index - used >= spare:
            return -1, 0
        k = members[index]
        row = rows[k]
        x, y, z = s0 * row[Q] - c0, s0 * row[Q + 1] - c1, s0 * row[Q + 2] - c2
        flat2 = x * x + z * z
        flat = np.sqrt(flat2)
        more = half_s * row[Q_NORM] + matches.rounding * (1.0 + row[Q_NORM])
        delta_flat = half_flat + more
        delta_y = half_y + more
        distance = max(np.sqrt(flat2 + y * y), half_c + more)
        vx, vy, vz, level = row[BEARING], row[BEARING + 1], row[BEARING + 2], row[LEVEL]
        sin_e, cos_e = row[SINE], row[COSINE]
        if not upright:  # v' = T^T v
            along_a = ca * vy + sa * vz
            vx, vy, vz = cc * vx + sc * along_a, cc * along_a - sc * vx, ca * vz - sa * vy
            level = np.sqrt(vx * vx + vz * vz)
            sin_e, cos_e = sin_e * cos_psi + cos_e * sin_psi, cos_e * cos_psi - sin_e * sin_psi
        pole = True
        if cos_e > 0.0:
            low, high = max(flat - delta_flat, 0.0), flat + delta_flat
            # tan of the highest and the lowest elevation in the cap, as quotients.
            top, below = vy * cos_e + level * sin_e, level * cos_e - vy * sin_e
            if below > 0.0 and (y - delta_y) * below > top * (high if top > 0.0 else low):
                continue
            bottom, above = vy * cos_e - level * sin_e, level * cos_e + vy * sin_e
            if above > 0.0 and (y + delta_y) * above < bottom * (low if bottom > 0.0 else high):
                continue
            pole = below <= 0.0 or above <= 0.0
        kept[used] = k
        inverse = 1.0 / distance
        near += inverse
        far += row[Q_NORM] * inverse
        if pole or delta_flat >= flat:
            starts[used], ends[used] = 0.0, EVERYWHERE
            free += 1
        else:
            # Times flat and level: the length of what a turn is taken of does not matter.
            sin1, sin2 = delta_flat, min(sin_e, level)
            cos1 = np.sqrt((flat - delta_flat) * (flat + delta_flat))
            cos2 = row[LEVEL_COSINE] if upright else np.sqrt((level - sin2) * (level + sin2))
            sin_half = sin1 * cos2 + cos1 * sin2
            cos_half = cos1 * cos2 - sin1 * sin2
            sin_half, cos_half = sin_half + SLACK * cos_half, cos_half - SLACK * sin_half
            ex, ez = x * vx + z * vz, z * vx - x * vz
            starts[used] = turn_of_direction(ex * cos_half + ez * sin_half, ez * cos_half - ex * sin_half)
            ends[used] = turn_of_direction(ex * cos_half - ez * sin_half, ez * cos_half + ex * sin_half)
        used += 1
    if used <= cutoff:
        return -1, 0
    spread[0], spread[1] = near / max(used, 1), far / max(used, 1)
    return used, free


@kernel()
def deepest(scratch, count, free, cutoff, yaw_bound):
    """Most of ``count`` intervals over one yaw; where that does not exceed ``cutoff``, a bound on it.

    The intervals are those of ``scratch``, a ``StabbingMemory``; ``free`` of them are the whole circle. Yaws where
    ``yaw_bound`` (B,), for bins of turn, does not exceed ``cutoff`` are left out if bins show that nothing else exceeds
    it.
    """
    opened, before = scratch.opened, scratch.before
    bins, depth = _count(scratch, count, free)
    most, sure, wider = 0, cutoff, bins // len(yaw_bound)
    for b in range(bins):
        touching = before[b] + opened[b]
        if touching > most and yaw_bound[b // wider] > cutoff:
            most = touching
        sure = max(sure, before[b])
    if most <= sure:
        return most
    _sort_ends(scratch, count, bins, sure)
    opening, closing, closed = scratch.opening, scratch.closing, scratch.closed
    here, there = 0, 0
    for b in range(bins):
        if opened[b] < 0:
            continue
        depth = before[b]
        while here < opened[b]:
            if there == closed[b] or opening[here] <= closing[there]:
                depth += 1
                here += 1
                sure = max(sure, depth)
            else:
                depth -= 1
                there += 1
        there = closed[b]
    return min(sure, most)


@kernel()
def find_windows(scratch, count, free, cutoff, yaw_bound):
    """Write windows to ``scratch`` that hold all yaws where the depth exceeds ``cutoff``; returns how many there are.

    The depth and ``count``, ``free`` and ``yaw_bound`` are as in ``deepest``.
    """
    windows, opened, closed, before = scratch.windows, scratch.opened, scratch.closed, scratch.before
    opening, closing = scratch.opening, scratch.closing
    bins, depth = _count(scratch, count, free)
    found = _open_window(windows, 0, 0.0) if before[0] > cutoff else 0
    _sort_ends(scratch, count, bins, cutoff)
    here, there = 0, 0
    for b in range(bins):
        if opened[b] < 0:
            continue
        depth = before[b]
        while here < opened[b] or there < closed[b]:
            if here < opened[b] and (there == closed[b] or opening[here] <= closing[there]):
                depth += 1
                if depth == cutoff + 1:
                    found = _open_window(windows, found, opening[here])
                here += 1
            else:
                if depth == cutoff + 1:
                    windows[found - 1, 1] = closing[there]
                depth -= 1
                there += 1
    if depth > cutoff and opened[bins - 1] >= 0:
        windows[found - 1, 1] = CIRCLE
    return _clip_windows(windows, found, cutoff, yaw_bound)


@kernel()
def _bin(turn, bins):
    """The bin, of so many ``bins``, of a ``turn`` from 0 to 4."""
    return min(int(turn * (bins / CIRCLE)), bins - 1)


@kernel()
def _count(scratch, count, free):
    """Count the ends of ``count`` intervals by bin, ``free`` of them being the whole circle.

    They are those of ``scratch``, a ``StabbingMemory``. Returns how many bins there are, and the depth at the end of
    the circle.
    """
    starts, ends, opened, closed, before = scratch.starts, scratch.ends, scratch.opened, scratch.closed, scratch.before
    bins = MANY_BINS if count >= MANY else FEW_BINS
    for b in range(bins):
        opened[b] = closed[b] = 0
    depth = free
    for k in range(count):
        if ends[k] < EVERYWHERE:
            opened[_bin(starts[k], bins)] += 1
            closed[_bin(ends[k], bins)] += 1
            depth += ends[k] < starts[k]
    for b in range(bins):
        before[b] = depth
        depth += opened[b] - closed[b]
    return bins, depth


@kernel()
def _sort_ends(scratch, count, bins, cutoff):
    """Sort the ends of ``count`` intervals in deep ``bins``, those that more than ``cutoff`` intervals touch.

    All are in ``scratch``, a ``StabbingMemory``: ``opened`` and ``closed`` become where those of each end in
    ``opening`` and ``closing``; -1 of other bins, where the depth does not exceed ``cutoff``.
    """
    starts, ends, opened, closed, before = scratch.starts, scratch.ends, scratch.opened, scratch.closed, scratch.before
    opening, closing = scratch.opening, scratch.closing
    here, there = 0, 0
    for b in range(bins):
        if before[b] + opened[b] > cutoff:
            opened[b], here = here, here + opened[b]
            closed[b], there = there, there + closed[b]
        else:
            opened[b] = closed[b] = -1
    for k in range(count):
        if ends[k] < EVERYWHERE:
            b = _bin(starts[k], bins)
            if opened[b] >= 0:
                opening[opened[b]] = starts[k]
                opened[b] += 1
            b = _bin(ends[k], bins)
            if closed[b] >= 0:
                closing[closed[b]] = ends[k]
                closed[b] += 1
    here, there = 0, 0
    for b in range(bins):
        if opened[b] >= 0:
            sort_between(opening, here, opened[b] - 1)
            sort_between(closing, there, closed[b] - 1)
            here, there = opened[b], closed[b]


@kernel()
def _clip_windows(windows, used, cutoff, yaw_bound):
    """Leave out those of the first ``used`` ``windows`` (W, 2), turns, whose bins are all bounded by ``cutoff``.

    ``yaw_bound`` (B,) is by bin of turn. Returns how many are left.
    """
    per_turn = len(yaw_bound) / CIRCLE
    kept = 0
    for w in range(used):
        first, last = int(windows[w, 0] * per_turn), int(windows[w, 1] * per_turn)
        for b in range(first, last + 1):
            if yaw_bound[min(b, len(yaw_bound) - 1)] > cutoff:
                copy_vector(windows[w], windows[kept])
                kept += 1
                break
    return kept


@kernel()
def _open_window(windows, used, start):
    """Add a window that begins at the turn ``start`` to the first ``used`` of ``windows`` (W, 2).

    Or the last one goes on, if that is near or there is no room for more. Returns how many there are.
    """
    if used > 0 and (start - windows[used - 1, 1] <= MAX_GAP or used == len(windows)):
        return used
    windows[used, 0] = windows[used, 1] = start
    return used + 1
