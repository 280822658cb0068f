"""The order of millions of numbers, in a kernel that a watch can end: numba's own sort cannot be stopped."""

import numpy as np

from spherloc.kernel_cache import kernel
from spherloc.watch import SLOTS, stopped

MAX_INSERTED = 15
"""Fewer numbers are sorted by insertion."""
MAX_WAITING = 100
"""Parts that wait to be sorted. The longer one waits, so that they are at most the logarithm of the count."""


@kernel()
def order_of(values, board):
    """The order (N,) that ``np.argsort`` gives ``values`` (N,) in a kernel, ties included: the same quicksort.

    Stopped by a watch's ``board``, some order.
    """
    order = np.arange(len(values))
    waiting = np.empty((MAX_WAITING, 2), np.int64)
    waiting[0, 0], waiting[0, 1] = 0, len(values) - 1
    count = 1
    while count > 0:
        count -= 1
        low, high = waiting[count, 0], waiting[count, 1]
        while high - low >= MAX_INSERTED and not stopped(board):
            middle = _partition(values, order, low, high)
            if high - middle > middle - low:
                waiting[count, 0], waiting[count, 1] = middle + 1, high
                count += high > middle
                high = middle - 1
            else:
                waiting[count, 0], waiting[count, 1] = low, middle - 1
                count += middle > low
                low = middle + 1
        if stopped(board):
            break
        _insert(values, order, low, high)
    return order


@kernel()
def order_of_few(values):
    """The order (N,) of ``values`` (N,), float64, that nobody needs to stop: ``order_of``."""
    return order_of(values, np.zeros(SLOTS, np.int64))


@kernel()
def _insert(values, order, low, high):
    """Sort ``order[low : high + 1]`` of ``order`` (N,) by the ``values`` (N,), by insertion."""
    for i in range(low + 1, high + 1):
        moved, j = order[i], i
        while j > low and values[moved] < values[order[j - 1]]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = moved


@kernel()
def _partition(values, order, low, high):
    """Partition ``order[low : high + 1]`` by ``values`` (N,) at the median of its first, middle and last.

    Returns the index of this one.
    """
    middle = (low + high) >> 1
    if values[order[middle]] < values[order[low]]:
        order[low], order[middle] = order[middle], order[low]
    if values[order[high]] < values[order[middle]]:
        order[high], order[middle] = order[middle], order[high]
    if values[order[middle]] < values[order[low]]:
        order[low], order[middle] = order[middle], order[low]
    pivot = values[order[middle]]
    order[high], order[middle] = order[middle], order[high]
    i, j = low, high - 1
    while True:
        while i < high and values[order[i]] < pivot:
            i += 1
        while j >= low and pivot < values[order[j]]:
            j -= 1
        if i >= j:
            break
        order[i], order[j] = order[j], order[i]
        i, j = i + 1, j - 1
    order[i], order[high] = order[high], order[i]
    return i
