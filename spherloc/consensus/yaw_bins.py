"""First pass of the exact search: the circle in bins of yaw, and in each a cheap bound on the clique number.

The graph of a bin has an edge for every pair with an arc that touches the bin, so it contains the graphs of all yaws in
the bin. A clique of k nodes needs k nodes of degree k - 1 at least: the largest such k bounds the consensus.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.pair_arcs import CIRCLE
from spherloc.types import FloatArray, IndexArray
from spherloc.watch import SELDOM, stopped

EdgeArray = NDArray[np.uint16]

BINS = 256
"""Narrow beside the arcs of an error of some pixels, and few enough to cost nothing."""
BIN_TURN = CIRCLE / BINS


@numba.njit(cache=True, nogil=True)
def sort_into_bins(
    pairs: IndexArray, lo: FloatArray, hi: FloatArray, board: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], EdgeArray]:
    """Places (BINS + 1,) where each bin's edges start in a list of edges (E, 2), and the list: nodes below 65,536.

    An arc is an edge of every bin that it touches. Nodes are copied, so that a bin is read from one place. A
    watch's ``board`` can end it, after which the edges are none.
    """
    starts = np.zeros(BINS + 1, np.int64)
    for arc in range(len(lo)):
        if arc & SELDOM == 0 and stopped(board):
            return np.zeros(BINS + 1, np.int64), np.empty((0, 2), np.uint16)
        first, last = _bins(lo[arc], hi[arc])
        for b in range(first, last + 1):
            starts[b % BINS + 1] += 1
    for b in range(BINS):
        starts[b + 1] += starts[b]
    edges = np.empty((starts[BINS], 2), np.uint16)
    place = starts[:BINS].copy()
    for arc in range(len(lo)):
        if arc & SELDOM == 0 and stopped(board):
            return np.zeros(BINS + 1, np.int64), np.empty((0, 2), np.uint16)
        first, last = _bins(lo[arc], hi[arc])
        for b in range(first, last + 1):
            edges[place[b % BINS], 0], edges[place[b % BINS], 1] = pairs[arc, 0], pairs[arc, 1]
            place[b % BINS] += 1
    return starts, edges


@numba.njit(cache=True, nogil=True)
def _bins(lo, hi):
    """First and last bin that an arc touches; not more than all."""
    first, last = int(lo / BIN_TURN), int(hi / BIN_TURN)
    return first, min(last, first + BINS - 1)


@numba.njit(cache=True, nogil=True)
def degree_bounds(
    count: int, starts: NDArray[np.int64], edges: EdgeArray, board: NDArray[np.int64] | None = None
) -> IndexArray:
    """(BINS,) bound on the clique number of each bin's graph of ``count`` nodes.

    A watch's ``board`` can end it, after which the other bounds are ``count``.
    """
    bound = np.full(BINS, count, np.int32)
    degree, tally = np.empty(count, np.int64), np.empty(count + 1, np.int64)
    for b in range(BINS):
        if stopped(board):
            break
        degree[:] = 0
        for place in range(starts[b], starts[b + 1]):
            degree[edges[place, 0]] += 1
            degree[edges[place, 1]] += 1
        tally[:] = 0
        for node in range(count):
            tally[min(degree[node], count)] += 1
        # Nodes of degree k - 1 at least, for falling k, until there are k of them.
        nodes = tally[count]
        k = count
        while k > 1:
            nodes += tally[k - 1]
            if nodes >= k:
                break
            k -= 1
        bound[b] = k
    return bound
