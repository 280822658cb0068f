"""A first good pose where sampling found none: the largest cliques of whole bins of yaw.

With few inliers a sampled pair is seldom one of two inliers, but at the true yaw every pair of inliers is an edge. A
bin's graph holds all of its yaws at once, so its cliques bound those of each yaw, but may have no pose.
"""

import numba
import numpy as np

from spherloc.consensus.clique_search import colour_bound, larger_clique, set_edge
from spherloc.consensus.support import verify

EFFORT_LIMIT = 200_000
"""Words touched in one bin."""


@numba.njit(cache=True, nogil=True)
def scout(data, pairs, starts, arcs, bound, poses, supports, masks, known):
    """Verify the largest clique of each bin; better poses become known, and the bound of each bin is lowered in place.

    A clique must be larger than the best support, and no smaller than the largest clique that had no pose. Returns
    how many poses are known.
    """
    floor = supports[0]
    for b in np.argsort(-bound, kind="mergesort"):
        if bound[b] <= floor:
            break
        nodes, rows = core_graph(masks.shape[1], pairs, arcs[starts[b] : starts[b + 1]], floor)
        if len(nodes) <= floor or colour_bound(rows) <= floor:
            bound[b] = floor
            continue
        clique, _, exact = larger_clique(rows, floor, EFFORT_LIMIT)
        if exact:
            bound[b] = max(floor, len(clique))
        if len(clique):
            known = verify(data, nodes[clique], poses, supports, masks, known)
            floor = max(supports[0], len(clique) - 1)
    return known


@numba.njit(cache=True, nogil=True)
def core_graph(count, pairs, arcs, least):
    """Nodes with at least ``least`` edges among themselves, by falling degree, and the graph of ``arcs`` on them."""
    degree, alive = np.empty(count, np.int64), np.ones(count, np.bool_)
    left = arcs.copy()
    changed = True
    while changed:
        changed = False
        degree[:] = 0
        used = 0
        for arc in left:
            i, j = pairs[arc, 0], pairs[arc, 1]
            if alive[i] and alive[j]:
                degree[i] += 1
                degree[j] += 1
                left[used] = arc
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
    for arc in left:
        a, b = places[pairs[arc, 0]], places[pairs[arc, 1]]
        if a >= 0 and b >= 0:
            set_edge(rows, a, b)
    return nodes, rows
