"""The circle in bins of yaw: a cheap bound on the consensus in each, and the largest cliques of whole bins.

The graph of a bin has an edge for every pair with an arc that touches the bin, so it contains the graphs of all yaws in
the bin. A clique of k nodes needs k nodes of degree k - 1 at least: the largest such k bounds the consensus.

Cliques of whole bins give a first good pose where sampling found none. With few inliers a sampled pair is seldom one of
two inliers, but at the true yaw every pair of inliers is an edge. A bin's graph holds all of its yaws at once, so its
cliques bound those of each yaw, but may have no pose.
"""

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.level_pose import verify
from spherloc.consensus.max_clique import (
    colour_bound,
    larger_clique,
    order_of_degrees,
    remove_weak_edges,
    set_edge,
    subgraph,
)
from spherloc.consensus.pair_arcs import CIRCLE
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_matrix, copy_vector, elements, fill_vector, indices_of_true
from spherloc.types import FloatArray, IndexArray
from spherloc.watch import SELDOM, stopped

EdgeArray = NDArray[np.uint16]

BINS = 256
"""Narrow beside the arcs of an error of some pixels, and few enough to cost nothing. A power of 2."""
LAST_BIN = BINS - 1
BIN_TURN = CIRCLE / BINS
"""Turns of a bin."""
EFFORT_LIMIT = 200_000
"""Words touched in one bin."""
MAX_THINNED = 1_000_000
"""Edges times words of a graph up to which it is thinned."""
CLIQUE_MARGIN = 3
"""How much smaller than a clique without pose the next one may be."""


@kernel()
def sort_into_bins(
    pairs: IndexArray, lo: FloatArray, hi: FloatArray, board: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], EdgeArray]:
    """Indices (BINS + 1,) where each bin's edges start in a list of edges (E, 2), and the list: nodes below 65,536.

    ``pairs`` (A, 2) are those of arcs from ``lo`` (A,) to ``hi`` (A,), turns. An arc is an edge of every bin that it
    touches. Nodes are copied, so that a bin is read from one place. A watch's ``board`` can end it, after which the
    edges are none.
    """
    # How many arcs begin less how many have ended, at each bin of two rounds: the first and what goes beyond it.
    change = np.zeros(2 * BINS, np.int64)
    for arc in range(len(lo)):
        if arc & SELDOM == 0 and stopped(board):
            return np.zeros(BINS + 1, np.int64), np.empty((0, 2), np.uint16)
        first, last = _bins(lo[arc], hi[arc])
        change[first] += 1
        change[last + 1] -= 1
    starts = np.zeros(BINS + 1, np.int64)
    touching = np.int64(0)
    for b in range(2 * BINS):
        touching += change[b]
        starts[(b & LAST_BIN) + 1] += touching
    for b in range(BINS):
        starts[b + 1] += starts[b]
    edges = np.empty((starts[BINS], 2), np.uint16)
    next_of_bin = np.empty(BINS, np.int64)
    copy_vector(starts, next_of_bin)
    for arc in range(len(lo)):
        if arc & SELDOM == 0 and stopped(board):
            return np.zeros(BINS + 1, np.int64), np.empty((0, 2), np.uint16)
        first, last = _bins(lo[arc], hi[arc])
        for b in range(first, last + 1):
            index = next_of_bin[b & LAST_BIN]
            edges[index, 0], edges[index, 1] = pairs[arc, 0], pairs[arc, 1]
            next_of_bin[b & LAST_BIN] += 1
    return starts, edges


@kernel()
def _bins(lo, hi):
    """First and last bin that an arc from ``lo`` to ``hi``, turns, touches; not more than all."""
    first, last = int(lo / BIN_TURN), int(hi / BIN_TURN)
    return first, min(last, first + BINS - 1)


@kernel()
def degree_bounds(
    count: int, starts: NDArray[np.int64], edges: EdgeArray, board: NDArray[np.int64] | None = None
) -> IndexArray:
    """(BINS,) bound on the clique number of each bin's graph of ``count`` nodes.

    The edges of bin b are rows ``starts[b]`` to ``starts[b + 1] - 1`` of ``edges`` (E, 2), ``starts`` (BINS + 1,).
    A watch's ``board`` can end it, after which the other bounds are ``count``.
    """
    bound = np.empty(BINS, np.int32)
    fill_vector(bound, count)
    degree, tally = np.empty(count, np.int32), np.empty(count + 1, np.int32)
    for b in range(BINS):
        if stopped(board):
            break
        fill_vector(degree, 0)
        for index in range(starts[b], starts[b + 1]):
            degree[edges[index, 0]] += 1
            degree[edges[index, 1]] += 1
        # k nodes of degree k - 1 have k (k - 1) / 2 edges.
        most = min(count, int(0.5 + np.sqrt(0.25 + 2.0 * (starts[b + 1] - starts[b]))) + 1)
        for k in range(most + 1):
            tally[k] = 0
        for node in range(count):
            tally[min(degree[node], most)] += 1
        # Nodes of degree k - 1 at least, for falling k, until there are k of them.
        nodes = tally[most]
        k = most
        while k > 1:
            nodes += tally[k - 1]
            if nodes >= k:
                break
            k -= 1
        bound[b] = k
    return bound


@kernel()
def largest_bin_cliques(matches, starts, edges, bound, order, least, best, board=None):
    """Verify the largest clique of each bin; better poses go to ``best``, and each bin's ``bound`` (BINS,) is lowered.

    ``matches`` are ``BoundedMatches``, ``starts`` and ``edges`` those of ``sort_into_bins``, ``best`` is ``BestPoses``.
    ``order`` (BINS,) is that of falling bounds.
    A clique must be larger than the best support. While that is not above ``least`` it must be larger than this, and
    not much smaller than the largest clique that had no pose. A watch's ``board`` can end it.
    """
    count, supports = len(matches.points), best.supports
    floor = max(least, supports[0])
    for b in order:
        if bound[b] <= floor or stopped(board):
            break
        nodes, rows = core_graph(count, edges[starts[b] : starts[b + 1]], floor, board)
        if len(nodes) <= floor or colour_bound(rows) <= floor:
            bound[b] = floor
            continue
        clique, _, exact = larger_clique(rows, floor, np.int64(EFFORT_LIMIT), board)
        if exact:
            bound[b] = max(floor, len(clique))
        if len(clique):
            verify(matches, elements(nodes, clique), best)
            floor = supports[0] if supports[0] > least else max(floor, len(clique) - CLIQUE_MARGIN)


@kernel()
def core_graph(count, edges, least, board=None):
    """Nodes (K,) that may belong to a clique of more than ``least``, by falling degree, and their graph (K, words).

    ``edges`` (E, 2) are among ``count`` nodes. Nodes have ``least`` edges among themselves or more (two between the
    same nodes count as two, but are one in the graph), and in a graph that is not too large the ends of every edge have
    ``least`` - 1 neighbours in common. Stopped by a watch's ``board``, it has no edges.
    """
    degree, alive, left = np.empty(count, np.int64), np.empty(count, np.bool_), np.empty(edges.shape, edges.dtype)
    fill_vector(alive, True)
    copy_matrix(edges, left)
    changed = True
    while changed and not stopped(board):
        changed = False
        fill_vector(degree, 0)
        used = 0
        for k in range(len(left)):
            i, j = left[k, 0], left[k, 1]
            if alive[i] and alive[j]:
                degree[i] += 1
                degree[j] += 1
                left[used, 0], left[used, 1] = i, j
                used += 1
        left = left[:used]
        for node in range(count):
            if alive[node] and degree[node] < least:
                alive[node] = False
                changed = True
    nodes = indices_of_true(alive)
    nodes = elements(nodes, order_of_degrees(elements(degree, nodes)))
    index_of = np.empty(count, np.int64)
    for index in range(len(nodes)):
        index_of[nodes[index]] = index
    rows = np.zeros((len(nodes), (len(nodes) + 63) // 64), np.uint64)
    if stopped(board):
        return nodes, rows
    for k in range(len(left)):
        set_edge(rows, index_of[left[k, 0]], index_of[left[k, 1]])
    if len(left) * rows.shape[1] > MAX_THINNED or len(nodes) <= least:
        return nodes, rows
    kept = remove_weak_edges(rows, least)
    small, old = subgraph(rows, kept)
    return elements(nodes, old), small
