"""Exact maximum clique of a graph of up to a few thousand nodes, with a limit that never lies.

Libraries that we tried cannot be interrupted and may take minutes on a dense graph; this one stops after a stated
effort and says so, which keeps a live page alive and the result the same on every machine.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.clique_search import all_nodes, larger_clique, lowest_bit
from spherloc.watch import Watch

EFFORT_LIMIT = 200_000_000
"""Words touched, see ``clique_search``, before the search returns the best clique so far as not proven: about 0.2 s."""


@dataclass(frozen=True, eq=False)
class Clique:
    """A clique and whether it is known to be a largest one."""

    nodes: NDArray[np.int32]
    """(S,) ascending."""
    proven: bool
    """False if the search reached its limit first."""


def max_clique(adjacency: NDArray[np.bool_], effort_limit: int = EFFORT_LIMIT, watch: Watch | None = None) -> Clique:
    """A maximum clique of the graph with the symmetric adjacency matrix (M, M); its diagonal is ignored.

    ``watch`` can end the search; raises ``Cancelled``.
    """
    watch = watch or Watch()
    count = len(adjacency)
    if count == 0:
        return Clique(np.empty(0, np.int32), True)
    rows, order = _pack(adjacency)
    members = _greedy(rows)
    larger, _, proven = larger_clique(rows, len(members), effort_limit, watch.board)
    watch.check()
    members = larger if len(larger) else members
    nodes = np.sort(order[members]).astype(np.int32)
    if not _all_adjacent(adjacency, nodes):
        raise AssertionError("the maximum clique search returned nodes that are not all adjacent")
    return Clique(nodes, bool(proven))


@numba.njit(cache=True, nogil=True)
def _pack(adjacency):
    """The graph as bitsets of renumbered nodes, as ``clique_search`` takes it, and each one's old number."""
    count, order = len(adjacency), _degeneracy_order(adjacency)
    rows = np.zeros((count, (count + 63) // 64), np.uint64)
    for place in range(count):
        row = adjacency[order[place]]
        for word in range(rows.shape[1]):
            bits = np.uint64(0)
            for bit in range(min(64, count - 64 * word)):
                bits |= np.uint64(row[order[64 * word + bit]]) << np.uint64(bit)
            rows[place, word] = bits
        rows[place, place >> 6] &= ~(np.uint64(1) << np.uint64(place & 63))
    return rows, order


@numba.njit(cache=True, nogil=True)
def _all_adjacent(adjacency, nodes):
    for a in nodes:
        for b in nodes:
            if a != b and not adjacency[a, b]:
                return False
    return True


@numba.njit(cache=True, nogil=True)
def _degeneracy_order(adjacency):
    """Nodes by repeated removal of one of least degree, the first removed last: dense nodes are coloured first."""
    count = len(adjacency)
    degree = np.empty(count, np.int32)
    for node in range(count):
        degree[node] = np.count_nonzero(adjacency[node]) - adjacency[node, node]
    order = np.empty(count, np.int64)
    for place in range(count - 1, -1, -1):
        least = np.argmin(degree)
        order[place] = least
        row = adjacency[least]
        for node in range(count):
            degree[node] -= row[node]
        # A removed node stays above all degrees, whatever is still subtracted from it.
        degree[least] = 2 * count + place
    return order


@numba.njit(cache=True, nogil=True)
def _greedy(rows):
    """Members of some clique: each node in turn that is adjacent to all before it. A first bound for the search."""
    members, taken = np.empty(len(rows), np.int64), 0
    fitting = all_nodes(len(rows))
    for word in range(len(fitting)):
        while fitting[word] != 0:
            node = word * 64 + lowest_bit(fitting[word])
            fitting[word] &= fitting[word] - np.uint64(1)
            fitting &= rows[node]
            members[taken] = node
            taken += 1
    return members[:taken].copy()
