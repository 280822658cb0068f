"""Branch and bound over boxes of camera positions and tilts, with ``stabbing`` for a bound; ``pose_search`` ends it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.pair_arcs import CIRCLE, direction_of_turn
from spherloc.consensus.pose_cells import CELL_SIZE, HALF_ANGLES, HALF_C, HALF_S, YAW, has_tilt, place_cell
from spherloc.consensus.pose_search import (
    BEST,
    CELL_EFFORT,
    CELLS,
    EFFORT,
    HALT,
    SPLITS,
    SearchMemory,
    put_off,
    room_for,
    search_poses,
)
from spherloc.consensus.stabbing import EVERYWHERE, StabbingMemory, deepest, find_windows, keep_possible, scratch_for
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_vector
from spherloc.types import FloatArray
from spherloc.watch import stopped

MAX_BOXES = 1024
"""Boxes that wait; the deepest is split first."""


class Boxes(NamedTuple):
    """Memory of one search."""

    lower: FloatArray
    """(MAX_BOXES, 6)."""
    upper: FloatArray
    """(MAX_BOXES, 6)."""
    spans: NDArray[np.int64]
    """(MAX_BOXES, 4): where its matches begin and end in ``lists``, its chart, its bound."""
    lists: NDArray[np.int32]
    """Matches that waiting boxes may explain."""


class Splits(NamedTuple):
    """Boxes that had to be split, ``state[SPLITS]`` of them, for the picture; later ones are not kept."""

    lower: FloatArray
    """(K, 3)."""
    upper: FloatArray
    """(K, 3)."""
    about: NDArray[np.int32]
    """(K, 2): chart and bound."""


class Memory(NamedTuple):
    """All memory of one search."""

    boxes: Boxes
    """That wait."""
    scratch: StabbingMemory
    """Of one box."""
    room: SearchMemory
    """Of the search of one small cell."""
    splits: Splits
    """For the picture."""


def memory_for(count: int, most_splits: int) -> Memory:
    """Memory for ``count`` matches and so many boxes for the picture."""
    return Memory(boxes_for(count), scratch_for(count), room_for(count), splits_for(most_splits))


def splits_for(count: int) -> Splits:
    """Room for so many boxes."""
    return Splits(np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2), np.int32))


def boxes_for(count: int) -> Boxes:
    """Memory for ``count`` matches."""
    return Boxes(
        np.empty((MAX_BOXES, 6)),
        np.empty((MAX_BOXES, 6)),
        np.empty((MAX_BOXES, 4), np.int64),
        np.empty(24 * count + 4096, np.int32),
    )


@kernel()
def _yaw_of_turn(turn):
    """Yaw, rad in [-pi, pi], of a turn."""
    c, s = direction_of_turn(turn)
    return np.arctan2(s, c)


@kernel()
def _in_window(scratch, kept, count, start, end, out):
    """Write those of ``count`` matches in ``kept`` (K,) whose interval meets a window of turns to ``out`` (K,).

    The intervals are those of ``scratch``, a ``StabbingMemory``; the window goes from ``start`` to ``end``, turns.
    Returns how many.
    """
    used = 0
    for k in range(count):
        first, last = scratch.starts[k], scratch.ends[k]
        if last < EVERYWHERE:
            if last < first:
                last += CIRCLE
            if not (
                (first <= end and last >= start)
                or (first - CIRCLE <= end and last - CIRCLE >= start)
                or (first + CIRCLE <= end and last + CIRCLE >= start)
            ):
                continue
        out[used] = kept[k]
        used += 1
    return used


@kernel()
def search_boxes(matches, tasks, yaw_bound, memory, limits, found, board):
    """Search the boxes ``tasks`` = (charts (K,), lower (K, 6), upper (K, 6), bounds (K,)) at all yaws.

    ``yaw_bound`` (B,) is what is known of the bins of turn, ``memory`` is ``Memory``; ``matches``, ``limits``,
    ``found`` and ``board`` are as in ``search_poses``.
    """
    boxes, scratch, room, splits = memory
    charts, lowers, uppers, bounds = tasks
    _, state, left = found
    count = len(matches.rows)
    lists, spans, lo, up = boxes.lists, boxes.spans, boxes.lower, boxes.upper
    for k in range(count):
        lists[k] = k
    waiting = len(charts)
    for k in range(waiting):
        copy_vector(lowers[k], lo[k])
        copy_vector(uppers[k], up[k])
        spans[k, 0], spans[k, 1], spans[k, 2], spans[k, 3] = 0, count, charts[k], bounds[k]
    cell, spread, move = np.empty(CELL_SIZE), np.empty(2), np.empty(6)
    overflow, inside = np.empty(0, np.int32), np.empty(count, np.int32)
    at_lower, at_upper = np.empty(6), np.empty(6)
    while waiting > 0:
        if state[EFFORT] >= limits.effort or state[HALT] != 0 or stopped(board):
            for k in range(waiting):
                put_off(left, state, (spans[k, 2], lo[k], up[k]), spans[k, 3], np.int64(0))
            return
        waiting -= 1
        first, last, chart = spans[waiting, 0], spans[waiting, 1], spans[waiting, 2]
        cutoff = state[BEST] + limits.gap
        if spans[waiting, 3] <= cutoff or not has_tilt(matches, lo[waiting], up[waiting]):
            continue
        state[EFFORT] += CELL_EFFORT + last - first
        state[CELLS] += 1
        place_cell(chart, lo[waiting], up[waiting], cell)
        fits = len(lists) - last >= last - first
        if not fits and len(overflow) == 0:
            overflow = np.empty(count, np.int32)
        target = lists[last:] if fits else overflow
        kept, free = keep_possible(matches, cell, lists[first:last], target, scratch, cutoff, spread)
        if kept < 0:
            continue
        bound = deepest(scratch, kept, free, cutoff, yaw_bound)
        if bound <= cutoff:
            continue
        index = state[SPLITS]
        if index < len(splits.about):
            for a in range(3):
                splits.lower[index, a], splits.upper[index, a] = lo[waiting, a], up[waiting, a]
            splits.about[index, 0], splits.about[index, 1] = chart, bound
            state[SPLITS] = index + 1
        axis = (chart - 1) // 2 if chart > 0 else -1
        split, total = 0, 0.0
        for a in range(6):
            if a < 3:
                move[a] = cell[HALF_S] * spread[1] if a == axis else cell[HALF_C + a] * spread[0]
            else:
                move[a] = cell[HALF_ANGLES + a - YAW] if a > 3 else 0.0
            total += move[a]
            if move[a] > move[split]:
                split = a
        middle = 0.5 * (lo[waiting, split] + up[waiting, split])
        if total > limits.switch_rad and waiting + 2 <= len(spans) and lo[waiting, split] < middle < up[waiting, split]:
            if fits:
                first, last = last, last + kept
            for side in range(2):
                spans[waiting, 0], spans[waiting, 1], spans[waiting, 2], spans[waiting, 3] = first, last, chart, bound
                if side == 1:
                    copy_vector(lo[waiting - 1], lo[waiting])
                    copy_vector(up[waiting - 1], up[waiting])
                    up[waiting - 1, split] = middle
                    lo[waiting, split] = middle
                waiting += 1
            continue
        copy_vector(lo[waiting], at_lower)
        copy_vector(up[waiting], at_upper)
        for w in range(find_windows(scratch, kept, free, cutoff, yaw_bound)):
            start, end = scratch.windows[w, 0], scratch.windows[w, 1]
            at_lower[3] = _yaw_of_turn(start) - 1e-12
            at_upper[3] = _yaw_of_turn(end) + 1e-12
            if end - start >= CIRCLE - 1e-9:
                at_lower[3], at_upper[3] = -np.pi, np.pi
            elif at_upper[3] < at_lower[3]:
                at_upper[3] += 2.0 * np.pi
            cell_of = (chart, at_lower, at_upper)
            if state[EFFORT] >= limits.effort:
                put_off(left, state, cell_of, bound, np.int64(1))
                continue
            size = _in_window(scratch, target, kept, start, end, inside)
            if size > state[BEST] + limits.gap:
                search_poses(matches, cell_of, inside[:size], room, limits, found, board)
