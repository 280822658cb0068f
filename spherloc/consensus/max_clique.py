"""Exact maximum clique of a graph of up to a few thousand nodes, with a limit that never lies.

Libraries that we tried cannot be interrupted and may take minutes on a dense graph; this one stops after a stated
effort and says so, which keeps a live page alive and the result the same on every machine.

It is a branch and bound for a clique larger than a given size, with greedy colouring for a bound (San Segundo et al.,
"An exact bit-parallel algorithm for the maximum clique problem", 2011). Graphs are rows of 64-bit words, node k in bit
k % 64 of word k // 64. Effort is counted in words touched, so that a limit means about the same time for every graph
and the same result on every machine.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.long_sort import order_of_few
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_vector, elements, fill_vector
from spherloc.watch import Watch, stopped

EFFORT_LIMIT = 200_000_000
"""Words touched before the search returns the best clique so far as not proven: about 0.2 s."""
ONE = np.uint64(1)


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


@kernel()
def _pack(adjacency):
    """The graph ``adjacency`` (M, M) as bitsets (M, words) of renumbered nodes, and each one's old number (M,)."""
    count, order = len(adjacency), _degeneracy_order(adjacency)
    rows = np.zeros((count, (count + 63) // 64), np.uint64)
    for node in range(count):
        row = adjacency[order[node]]
        for word in range(rows.shape[1]):
            bits = np.uint64(0)
            for bit in range(min(64, count - 64 * word)):
                bits |= np.uint64(row[order[64 * word + bit]]) << np.uint64(bit)
            rows[node, word] = bits
        rows[node, node >> 6] &= ~(np.uint64(1) << np.uint64(node & 63))
    return rows, order


@kernel()
def _all_adjacent(adjacency, nodes):
    """Whether each of ``nodes`` (K,) is adjacent to all others in the graph ``adjacency`` (M, M)."""
    for a in nodes:
        for b in nodes:
            if a != b and not adjacency[a, b]:
                return False
    return True


@kernel()
def _degeneracy_order(adjacency):
    """Nodes (M,) of a graph ``adjacency`` (M, M) by repeated removal of one of least degree, the first removed last.

    So dense nodes are coloured first.
    """
    count = len(adjacency)
    degree = np.empty(count, np.int32)
    for node in range(count):
        degree[node] = np.count_nonzero(adjacency[node]) - adjacency[node, node]
    order = np.empty(count, np.int64)
    for position in range(count - 1, -1, -1):
        least = np.argmin(degree)
        order[position] = least
        row = adjacency[least]
        for node in range(count):
            degree[node] -= row[node]
        # A removed node stays above all degrees, whatever is still subtracted from it.
        degree[least] = 2 * count + position
    return order


@kernel()
def _greedy(rows):
    """Members (K,) of some clique of a graph ``rows`` (M, words): each node in turn that is adjacent to all before it.

    A first bound for the search.
    """
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


@kernel()
def popcount(word):
    """Number of set bits of a 64-bit word."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@kernel()
def lowest_bit(word):
    """Index of the lowest set bit of a word that is not zero."""
    return popcount((word & (~word + ONE)) - ONE)


@kernel()
def set_edge(rows, a, b):
    """Join nodes ``a`` and ``b`` of the graph ``rows`` (M, words), in place."""
    rows[a, b >> 6] |= ONE << np.uint64(b & 63)
    rows[b, a >> 6] |= ONE << np.uint64(a & 63)


@kernel()
def clear_edge(rows, a, b):
    """Remove the edge between nodes ``a`` and ``b`` of the graph ``rows`` (M, words), in place."""
    rows[a, b >> 6] &= ~(ONE << np.uint64(b & 63))
    rows[b, a >> 6] &= ~(ONE << np.uint64(a & 63))


@kernel()
def colour(candidates, rows, needed, order, bound):
    """Colour the ``candidates`` (words,) greedily; list the nodes whose colour exceeds ``needed``, with the colour.

    The graph is ``rows`` (M, words); nodes are written to ``order`` (M,) and colours, from 1, to ``bound`` (M,).

    A clique uses each colour once, so only such nodes can be the last of a clique that beats the best one. Returns how
    many were listed, in ascending order of colour.
    """
    words = len(candidates)
    uncoloured, free = np.empty(words, np.uint64), np.empty(words, np.uint64)
    copy_vector(candidates, uncoloured)
    listed, shade, first = 0, 0, 0
    while first < words:
        shade += 1
        for w in range(first, words):
            free[w] = uncoloured[w]
        for w in range(first, words):
            while free[w] != 0:
                bit = lowest_bit(free[w])
                node = w * 64 + bit
                mask = ~(ONE << np.uint64(bit))
                uncoloured[w] &= mask
                free[w] &= mask
                for x in range(w, words):
                    free[x] &= ~rows[node, x]
                if shade > needed:
                    order[listed] = node
                    bound[listed] = shade
                    listed += 1
        while first < words and uncoloured[first] == 0:
            first += 1
    return listed


@kernel()
def all_nodes(count):
    """The bitset (words,) of nodes 0 to ``count`` - 1."""
    bits = np.zeros((count + 63) // 64, np.uint64)
    for node in range(count):
        bits[node >> 6] |= ONE << np.uint64(node & 63)
    return bits


@kernel()
def colour_bound(rows):
    """Colours that greedy colouring of the graph ``rows`` (M, words) needs: no clique is larger."""
    count = len(rows)
    if count == 0:
        return 0
    order, bound = np.empty(count, np.int32), np.empty(count, np.int32)
    listed = colour(all_nodes(count), rows, np.int64(0), order, bound)
    return np.int64(bound[listed - 1])


@kernel()
def larger_clique(rows, floor, effort_limit, board=None):
    """A largest clique (K,) if it has more than ``floor`` nodes, else an empty array; the effort; whether it is exact.

    The graph is ``rows`` (M, words). Nodes are numbered so that those of high degree come first. With an explicit
    stack, not recursion. It ends early, not exact, at ``effort_limit`` or by a watch's ``board``.
    """
    count, words = rows.shape
    best = np.empty(0, np.int64)
    largest = floor
    if count <= floor:
        return best, 0, True
    candidates = np.empty((count + 1, words), np.uint64)
    copy_vector(all_nodes(count), candidates[0])
    order = np.empty((count + 1, count), np.int32)
    bound = np.empty((count + 1, count), np.int32)
    cursor = np.zeros(count + 1, np.int64)
    current = np.empty(count, np.int64)
    cursor[0] = colour(candidates[0], rows, largest, order[0], bound[0]) - 1
    depth, effort = 0, count * words
    while depth >= 0:
        if cursor[depth] < 0 or depth + bound[depth, cursor[depth]] <= largest:
            depth -= 1
            continue
        if effort >= effort_limit or stopped(board):
            return best, effort, False
        node = order[depth, cursor[depth]]
        cursor[depth] -= 1
        current[depth] = node
        size = 0
        for w in range(words):
            candidates[depth + 1, w] = candidates[depth, w] & rows[node, w]
            size += popcount(candidates[depth + 1, w])
        candidates[depth, node >> 6] &= ~(ONE << np.uint64(node & 63))
        if size == 0:
            if depth + 1 > largest:
                best, largest = np.empty(depth + 1, np.int64), depth + 1
                copy_vector(current, best)
            continue
        effort += words
        if depth + 1 + size <= largest:
            continue
        depth += 1
        effort += size * words
        cursor[depth] = colour(candidates[depth], rows, largest - depth, order[depth], bound[depth]) - 1
    return best, effort, True


@kernel()
def order_of_degrees(degree):
    """The order (K,) of falling ``degree`` (K,)."""
    falling = np.empty(len(degree))
    for k in range(len(degree)):
        falling[k] = -degree[k]
    return order_of_few(falling)


@kernel()
def subgraph(rows, nodes):
    """The graph (K, words) among ``nodes`` (K,) of ``rows`` (M, words), and their old numbers (K,).

    Nodes are numbered by descending degree.
    """
    count = len(nodes)
    degree = np.empty(count, np.int64)
    fill_vector(degree, 0)
    for a in range(count):
        for b in range(count):
            degree[a] += np.int64((rows[nodes[a], nodes[b] >> 6] >> np.uint64(nodes[b] & 63)) & ONE)
    old = elements(nodes, order_of_degrees(degree))
    small = np.zeros((count, (count + 63) // 64), np.uint64)
    for a in range(count):
        for b in range(a):
            if (rows[old[a], old[b] >> 6] >> np.uint64(old[b] & 63)) & ONE != 0:
                set_edge(small, a, b)
    return small, old


@kernel()
def remove_weak_edges(rows, floor):
    """Clear, again and again, edges whose ends have less than ``floor`` - 1 common neighbours, in ``rows`` (M, words).

    No clique of more than ``floor`` nodes, two at least, loses an edge. Returns the nodes (K,) left with any.
    """
    count, words = rows.shape
    changed = True
    while changed:
        changed = False
        for a in range(count):
            for w in range(a >> 6, words):
                word = rows[a, w]
                while word != 0:
                    low = word & (~word + ONE)
                    word ^= low
                    b = w * 64 + popcount(low - ONE)
                    if b <= a:
                        continue
                    common = 0
                    for x in range(words):
                        common += popcount(rows[a, x] & rows[b, x])
                    if common < floor - 1:
                        clear_edge(rows, a, b)
                        changed = True
    left, found = np.empty(count, np.int64), 0
    for a in range(count):
        for w in range(words):
            if rows[a, w] != 0:
                left[found] = a
                found += 1
                break
    return left[:found]
