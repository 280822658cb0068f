"""Exact maximum clique of a graph of up to a few thousand nodes, with a limit that never lies.

Branch and bound over bitsets with a greedy colouring as the bound (San Segundo et al., "An exact
bit-parallel algorithm for the maximum clique problem", 2011). Libraries that we tried cannot be interrupted
and may take minutes on a dense graph; this one stops after a stated number of branches and says so, which
keeps a live page alive and the result the same on every machine.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

BRANCH_LIMIT = 200_000
"""Branches after which the search returns the best clique found so far as not proven."""


@dataclass(frozen=True, eq=False)
class Clique:
    """A clique and whether it is known to be a largest one."""

    nodes: NDArray[np.int32]
    """(S,) ascending."""
    proven: bool
    """False if the search reached its limit first."""


def max_clique(adjacency: NDArray[np.bool_], branch_limit: int = BRANCH_LIMIT) -> Clique:
    """A maximum clique of the graph with the symmetric adjacency matrix (M, M); its diagonal is ignored."""
    count = len(adjacency)
    if count == 0:
        return Clique(np.empty(0, np.int32), True)
    graph = adjacency.copy()
    np.fill_diagonal(graph, False)
    order = _degeneracy_order(graph)
    members, proven = _search(_pack(graph[np.ix_(order, order)]), branch_limit)
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
def _lowest_bit(word: np.uint64) -> int:
    """Index of the lowest set bit of a word that is not zero."""
    index = 0
    low = word & np.uint64(0xFFFFFFFF)
    if low == 0:
        index += 32
        word >>= np.uint64(32)
    if word & np.uint64(0xFFFF) == 0:
        index += 16
        word >>= np.uint64(16)
    if word & np.uint64(0xFF) == 0:
        index += 8
        word >>= np.uint64(8)
    if word & np.uint64(0xF) == 0:
        index += 4
        word >>= np.uint64(4)
    if word & np.uint64(0x3) == 0:
        index += 2
        word >>= np.uint64(2)
    if word & np.uint64(0x1) == 0:
        index += 1
    return index


@numba.njit(cache=True, nogil=True)
def _colour(candidates, rows, needed, order, bound):
    """Colour the candidate bitset greedily; list the nodes whose colour exceeds ``needed``, with the colour.

    A clique uses each colour once, so only such nodes can be the last of a clique that beats the best one.
    Returns how many were listed, in ascending order of colour.
    """
    words = len(candidates)
    uncoloured = candidates.copy()
    free = np.empty(words, np.uint64)
    listed, colour, left = 0, 0, True
    while left:
        colour += 1
        left = False
        free[:] = uncoloured
        for w in range(words):
            while free[w] != 0:
                bit = _lowest_bit(free[w])
                node = w * 64 + bit
                mask = ~(np.uint64(1) << np.uint64(bit))
                uncoloured[w] &= mask
                free[w] &= mask
                for x in range(w, words):
                    free[x] &= ~rows[node, x]
                if colour > needed:
                    order[listed] = node
                    bound[listed] = colour
                    listed += 1
            if uncoloured[w] != 0:
                left = True
    return listed


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


@numba.njit(cache=True, nogil=True)
def _search(rows, branch_limit):
    """Members of a largest clique, and whether the search was finished. Explicit stack, no recursion."""
    count, words = rows.shape
    candidates = np.zeros((count + 1, words), np.uint64)
    for node in range(count):
        candidates[0, node // 64] |= np.uint64(1) << np.uint64(node % 64)
    order = np.empty((count + 1, count), np.int32)
    bound = np.empty((count + 1, count), np.int32)
    place = np.zeros(count + 1, np.int64)
    current = np.empty(count, np.int64)
    best = _greedy(rows)
    place[0] = _colour(candidates[0], rows, len(best), order[0], bound[0]) - 1
    depth, branches = 0, 0
    while depth >= 0:
        if place[depth] < 0 or depth + bound[depth, place[depth]] <= len(best):
            depth -= 1
            continue
        if branches >= branch_limit:
            return best, False
        branches += 1
        node = order[depth, place[depth]]
        place[depth] -= 1
        current[depth] = node
        some = False
        for w in range(words):
            candidates[depth + 1, w] = candidates[depth, w] & rows[node, w]
            some = some or candidates[depth + 1, w] != 0
        candidates[depth, node // 64] &= ~(np.uint64(1) << np.uint64(node % 64))
        if not some:
            if depth + 1 > len(best):
                best = current[: depth + 1].copy()
            continue
        depth += 1
        place[depth] = _colour(candidates[depth], rows, len(best) - depth, order[depth], bound[depth]) - 1
    return best, True
