"""Cells for a proof: a partition of all poses, each with a bound that can be checked from the cell alone.

The search (``box_search``, ``pose_search``) tells children what their parents have excluded. Here every final cell is
bounded once more by all matches, and split where that does not suffice.
"""

import numpy as np

from spherloc.consensus.pair_arcs import CIRCLE, direction_of_turn
from spherloc.consensus.pose_cells import CELL_SIZE, HALF_ANGLES, HALF_C, HALF_S, YAW, has_tilt, place_cell
from spherloc.consensus.pose_search import FORM, sort_matches
from spherloc.consensus.stabbing import deepest, find_windows, keep_possible
from spherloc.kernel_cache import kernel
from spherloc.watch import DONE, stopped

NO_TILT, STABBED, LINEAR = 0, 1, 2
"""Why a cell explains no more: all of its tilts are beyond gravity's bound; intervals of yaw; residuals."""
MAX_WAITING = 4096
"""Cells that wait to be split."""
WINDOW_MARGIN = 1e-12
"""Rad by which windows of yaw are widened; less than the intervals were."""


@kernel()
def prove_cells(matches, chart, ends, claim, switch_rad, memory, cells, board):
    """Write final cells of a ``chart``, ``ends`` = (lower (6,), upper (6,)), that together hold it, to ``cells``.

    ``matches`` are ``PackedMatches``; ``switch_rad`` is as in ``Limits``. ``memory`` is (StabbingMemory, yaw bound (B,)
    that excludes nothing); ``cells`` is (lower (K, 6), upper (K, 6), about (K, 2): rule and bound, at most ``claim``).
    Returns how many; -1 if there is no room for all or a watch's ``board`` ends it, -2 if some cell cannot be bounded
    by ``claim``.
    """
    scratch, unknown = memory
    _, _, about = cells
    lo, up = np.empty((MAX_WAITING, 6)), np.empty((MAX_WAITING, 6))
    spans = np.empty((MAX_WAITING, 4), np.int64)
    count = len(matches.rows)
    everybody = np.arange(count).astype(np.int32)
    lists = np.empty(48 * count + 4096, np.int32)
    lists[:count] = everybody
    lo[0], up[0] = ends
    spans[0] = 0
    spans[0, 1] = count
    waiting, used = 1, 0
    axis = (chart - 1) // 2 if chart > 0 else -1
    no_forms = np.empty((0, FORM))
    cell, spread, reach, spare = np.empty(CELL_SIZE), np.empty(2), np.empty(6), np.empty(count, np.int32)
    while waiting > 0:
        if stopped(board) or used + 2 * len(scratch.windows) + 8 > len(about):
            return -1
        board[DONE] += 1
        waiting -= 1
        first, last, narrow, known = spans[waiting]
        if not has_tilt(matches, lo[waiting], up[waiting]):
            used = _put(cells, used, lo[waiting], up[waiting], NO_TILT, 0)
            continue
        place_cell(chart, lo[waiting], up[waiting], cell)
        fits = len(lists) - last >= last - first
        target = lists[last:] if fits else np.empty(last - first, np.int32)
        if narrow == 1:
            sure, undecided, _ = sort_matches(matches, cell, axis, lists[first:last], target, no_forms, -1, reach)
            if known + sure + undecided <= claim:
                bound, more, _ = sort_matches(matches, cell, axis, everybody, spare, no_forms, -1, reach)
                bound += more
                if bound <= claim:
                    used = _put(cells, used, lo[waiting], up[waiting], LINEAR, bound)
                    continue
            elif fits:
                first, last, known = last, last + undecided, known + sure
        else:
            kept, free = keep_possible(matches, cell, lists[first:last], target, scratch, -1, spread)
            bound = deepest(scratch, kept, free, claim, unknown)
            if bound <= claim:
                again, free = keep_possible(matches, cell, everybody, spare, scratch, -1, spread)
                bound = deepest(scratch, again, free, claim, unknown)
                if bound <= claim:
                    used = _put(cells, used, lo[waiting], up[waiting], STABBED, bound)
                    continue
            elif fits:
                first, last = last, last + kept
            for a in range(6):
                if a < 3:
                    reach[a] = cell[HALF_S] * spread[1] if a == axis else cell[HALF_C + a] * spread[0]
                else:
                    reach[a] = cell[HALF_ANGLES + a - YAW] if a > 3 else 0.0
            if np.sum(reach) <= switch_rad and waiting + len(scratch.windows) * 2 + 4 < MAX_WAITING:
                again, free = keep_possible(matches, cell, everybody, spare, scratch, -1, spread)
                windows = find_windows(scratch, again, free, claim, unknown)
                used, waiting = _by_yaw(cells, used, lo, up, spans, waiting, (first, last, windows, claim), scratch)
                continue
        split = np.argmax(reach)
        middle = 0.5 * (lo[waiting, split] + up[waiting, split])
        if not lo[waiting, split] < middle < up[waiting, split] or waiting + 4 > MAX_WAITING:
            return -2
        for side in range(2):
            spans[waiting, 0], spans[waiting, 1], spans[waiting, 2], spans[waiting, 3] = first, last, narrow, known
            if side == 1:
                lo[waiting], up[waiting] = lo[waiting - 1], up[waiting - 1]
                up[waiting - 1, split] = middle
                lo[waiting, split] = middle
            waiting += 1
    return used


@kernel()
def _put(cells, used, lower, upper, rule, bound):
    """Write a final cell, ends ``lower`` and ``upper`` (6,), as number ``used`` of ``cells``; returns the next one.

    ``rule`` and ``bound`` say by what it is bounded, and by how much.
    """
    lowers, uppers, about = cells
    lowers[used], uppers[used] = lower, upper
    about[used, 0], about[used, 1] = rule, bound
    return used + 1


@kernel()
def _by_yaw(cells, used, lo, up, spans, waiting, about, scratch):
    """Cut the cell ``waiting`` at the ends of its windows of yaw: these wait, what lies between them is final.

    ``lo`` and ``up`` (W, 6) are the ends of waiting cells, ``spans`` (W, 4) what ``prove_cells`` keeps of each;
    ``about`` is (first, last, windows, claim) of this one, ``scratch`` holds its windows. Final cells are written to
    ``cells`` from number ``used`` on. Returns how many are final and how many wait.
    """
    first, last, windows, claim = about
    lower, upper = lo[waiting].copy(), up[waiting].copy()
    here = -np.pi
    for half in (2.0, 0.0):  # turns from 2 to 4 are yaws from -pi to 0
        for w in range(windows):
            start, end = max(scratch.windows[w, 0], half), min(scratch.windows[w, 1], half + 2.0)
            if start > end:
                continue
            c, s = direction_of_turn(start)
            begin = -np.pi if half == 2.0 and start <= 2.0 else np.arctan2(s, c)
            c, s = direction_of_turn(end)
            stop = 0.0 if end >= CIRCLE else np.pi if half == 0.0 and end >= 2.0 else np.arctan2(s, c)
            begin, stop = max(begin - WINDOW_MARGIN, here), min(stop + WINDOW_MARGIN, np.pi)
            if stop <= here:
                continue
            if begin > here:
                lower[3], upper[3] = here, begin
                used = _put(cells, used, lower, upper, STABBED, claim)
            lower[3], upper[3] = begin, stop
            lo[waiting], up[waiting] = lower, upper
            spans[waiting, 0], spans[waiting, 1], spans[waiting, 2], spans[waiting, 3] = first, last, 1, 0
            waiting += 1
            here = stop
    if here < np.pi:
        lower[3], upper[3] = here, np.pi
        used = _put(cells, used, lower, upper, STABBED, claim)
    return used, waiting
