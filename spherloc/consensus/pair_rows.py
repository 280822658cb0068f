"""Goes through all pairs (i, j), i < j, of matches with several threads, each through some of the rows i."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from spherloc.processors import processor_count

MIN_PAIRS = 50_000
"""Fewer pairs are done before a thread has begun."""
MAX_THREADS = 8
PARTS_A_THREAD = 4
"""Rows are dealt out in more parts than there are threads, since some take longer."""

Fill = Callable[[tuple[int, int], tuple[NDArray, ...]], int]
"""Writes what it finds in the pairs of the rows from one up to another to the arrays; returns how much."""


def fill_rows(count: int, each: int, arrays: tuple[NDArray, ...], fill: Fill) -> tuple[NDArray, ...]:
    """What ``fill`` finds in all pairs of ``count`` matches, in the order of the rows, however many threads there are.

    ``arrays`` have room for ``each`` entries a pair. ``fill`` gets the part of them that the pairs of its rows have,
    and must not hold the interpreter's lock.
    """
    before = np.arange(count) * (2 * count - 1 - np.arange(count)) // 2  # pairs of the rows before each row
    pairs, threads = count * (count - 1) // 2, min(MAX_THREADS, processor_count())
    parts = PARTS_A_THREAD * threads if pairs >= MIN_PAIRS and threads > 1 else 1
    rows = [0, *np.searchsorted(before, np.arange(1, parts) * pairs / parts).tolist(), count]
    starts = [each * int(before[row]) for row in rows[:-1]]

    def work(part: int) -> int:
        return fill((rows[part], rows[part + 1]), tuple(array[starts[part] :] for array in arrays))

    if parts == 1:
        found = [work(0)]
    else:
        with ThreadPoolExecutor(threads) as pool:
            found = list(pool.map(work, range(parts)))
    used = 0
    for start, new in zip(starts, found, strict=True):
        for array in arrays:
            array[used : used + new] = array[start : start + new]
        used += new
    return tuple(array[:used] for array in arrays)
