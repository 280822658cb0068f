"""Exact maximum clique of a graph of up to a few thousand nodes, with a limit that never lies.

Libraries that we tried cannot be interrupted and may take minutes on a dense graph; this one stops after a stated
effort and says so, which keeps a live page alive and the result the same on every machine.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.clique_search import larger_clique

EFFORT_LIMIT = 200_000_000
"""Words touched, see ``clique_search``, before the search returns the best clique so far as not proven: about 0.2 s."""


@dataclass(frozen=True, eq=False)
class Clique:
    """A clique and whether it is known to be a largest one."""

    nodes: NDArray[np.int32]
    """(S,) ascending."""
    proven: bool
    """False if the search reached its limit first."""


def max_clique(adjacency: NDArray[np.bool_], effort_limit: int = EFFORT_LIMIT) -> Clique:
    """A maximum clique of the graph with the symmetric adjacency matrix (M, M); its diagonal is ignored."""
    count = len(adjacency)
    if count == 0:
        return Clique(np.empty(0, np.int32), True)
    graph = adjacency.copy()
    np.fill_diagonal(graph, False)
    order = _degeneracy_order(graph)
    rows = _pack(graph[np.ix_(order, order)])
    members = _greedy(rows)
    larger, _, proven = larger_clique(rows, len(members), effort_limit)
    members = larger if len(larger) else members
    nodes = np.sort(order[members]).astype(np.int32)
    inside = graph[np.ix_(nodes, nodes)]
    if int(np.count_nonzero(inside)) != len(nodes) * (len(nodes) - 1):
        raise AssertionError("the maximum clique search returned nodes that are not all adjacent")
    return Clique(nodes, bool(proven))


def _pack(graph: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Rows of the adjacency as (M, ceil(M / 64)) words, node k in bit k % 64 of word k // 64."""
    words = (len(graph) + 63) // 64
    padded = np.zeros((len(graph), words * 64), dtype=bool)
    padded[:, : len(graph)] = graph
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)


@numba.njit(cache=True, nogil=True)
def _degeneracy_order(graph: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Nodes by repeated removal of one of least degree, the first removed last: dense nodes are coloured first."""
    count = len(graph)
    degree = np.zeros(count, np.int64)
    for i in range(count):
        for j in range(count):
            degree[i] += graph[i, j]
    order = np.empty(count, np.int64)
    left = np.ones(count, np.bool_)
    for place in range(count - 1, -1, -1):
        least = -1
        for i in range(count):
            if left[i] and (least < 0 or degree[i] < degree[least]):
                least = i
        order[place] = least
        left[least] = False
        for j in range(count):
            if graph[least, j]:
                degree[j] -= 1
    return order


@numba.njit(cache=True, nogil=True)
def _greedy(rows):
    """Members of some clique: each node in turn that is adjacent to all before it. A first bound for the search."""
    members = np.empty(len(rows), np.int64)
    taken = 0
    for node in range(len(rows)):
        fits = True
        for k in range(taken):
            member = members[k]
            fits = fits and (rows[node, member // 64] >> np.uint64(member % 64)) & np.uint64(1) != 0
        if fits:
            members[taken] = node
            taken += 1
    return members[:taken].copy()
