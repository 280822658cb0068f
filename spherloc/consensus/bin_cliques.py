"""A first good pose where sampling found none: the largest cliques of whole bins of yaw.

With few inliers a sampled pair is seldom one of two inliers, but at the true yaw every pair of inliers is an edge. A
bin's graph holds all of its yaws at once, so its cliques bound those of each yaw, but may have no pose.
"""

import numba
import numpy as np

from spherloc.consensus.clique_search import colour_bound, larger_clique, set_edge, subgraph, thin
from spherloc.consensus.support import verify
from spherloc.watch import stopped

EFFORT_LIMIT = 200_000
"""Words touched in one bin."""
MOST_THINNED = 1_000_000
"""Edges times words of a graph up to which it is thinned."""
CLIQUE_MARGIN = 3
"""How much smaller than a clique without pose the next one may be."""


@numba.njit(cache=True, nogil=True)
def largest_bin_cliques(data, starts, edges, bound, least, poses, supports, masks, known, board=None):
    """Verify the largest clique of each bin; better poses become known, and the bound of each bin is lowered in place.

    A clique must be larger than the best support. While that is not above ``least`` it must be larger than this, and
    not much smaller than the largest clique that had no pose. Returns how many poses are known.
    A watch's ``board`` can end it.
    """
    floor = max(least, supports[0])
    for b in np.argsort(-bound, kind="mergesort"):
        if bound[b] <= floor or stopped(board):
            break
        nodes, rows = core_graph(masks.shape[1], edges[starts[b] : starts[b + 1]], floor, board)
        if len(nodes) <= floor or colour_bound(rows) <= floor:
            bound[b] = floor
            continue
        clique, _, exact = larger_clique(rows, floor, np.int64(EFFORT_LIMIT), board)
        if exact:
            bound[b] = max(floor, len(clique))
        if len(clique):
            known = verify(data, nodes[clique], poses, supports, masks, known)
            floor = supports[0] if supports[0] > least else max(floor, len(clique) - CLIQUE_MARGIN)
    return known


@numba.njit(cache=True, nogil=True)
def core_graph(count, edges, least, board=None):
    """Nodes that may belong to a clique of more than ``least``, by falling degree, and their graph.

    Nodes have ``least`` edges among themselves or more (two between the same nodes count as two, but are one in the
    graph), and in a graph that is not too large the ends of every edge have ``least`` - 1 neighbours in common.
    Stopped by a watch's ``board``, it has no edges.
    """
    degree, alive = np.empty(count, np.int64), np.ones(count, np.bool_)
    left = edges.copy()
    changed = True
    while changed and not stopped(board):
        changed = False
        degree[:] = 0
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
    nodes = np.flatnonzero(alive)
    nodes = nodes[np.argsort(-degree[nodes])]
    places = np.full(count, -1, np.int64)
    for k in range(len(nodes)):
        places[nodes[k]] = k
    rows = np.zeros((len(nodes), (len(nodes) + 63) // 64), np.uint64)
    if stopped(board):
        return nodes, rows
    for k in range(len(left)):
        set_edge(rows, places[left[k, 0]], places[left[k, 1]])
    if len(left) * rows.shape[1] > MOST_THINNED or len(nodes) <= least:
        return nodes, rows
    kept = thin(rows, least)
    small, old = subgraph(rows, kept)
    return nodes[old], small
