"""Branch and bound for a clique larger than a given size, over bitsets: the kernel of every clique search here.

Greedy colouring is the bound (San Segundo et al., "An exact bit-parallel algorithm for the maximum clique problem",
2011). Graphs are rows of 64-bit words, node k in bit k % 64 of word k // 64. Effort is counted in words touched, so
that a limit means about the same time for every graph and the same result on every machine.
"""

import numba
import numpy as np

from spherloc.watch import stopped

ONE = np.uint64(1)


@numba.njit(cache=True, nogil=True, inline="always")
def popcount(word):
    """Number of set bits of a 64-bit word."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@numba.njit(cache=True, nogil=True, inline="always")
def lowest_bit(word):
    """Index of the lowest set bit of a word that is not zero."""
    return popcount((word & (~word + ONE)) - ONE)


@numba.njit(cache=True, nogil=True, inline="always")
def set_edge(rows, a, b):
    """Join two nodes."""
    rows[a, b >> 6] |= ONE << np.uint64(b & 63)
    rows[b, a >> 6] |= ONE << np.uint64(a & 63)


@numba.njit(cache=True, nogil=True, inline="always")
def clear_edge(rows, a, b):
    """Part two nodes."""
    rows[a, b >> 6] &= ~(ONE << np.uint64(b & 63))
    rows[b, a >> 6] &= ~(ONE << np.uint64(a & 63))


@numba.njit(cache=True, nogil=True)
def colour(candidates, rows, needed, order, bound):
    """Colour the candidate bitset greedily; list the nodes whose colour exceeds ``needed``, with the colour.

    A clique uses each colour once, so only such nodes can be the last of a clique that beats the best one. Returns how
    many were listed, in ascending order of colour.
    """
    words = len(candidates)
    uncoloured = candidates.copy()
    free = np.empty(words, np.uint64)
    listed, shade, first = 0, 0, 0
    while first < words:
        shade += 1
        free[first:] = uncoloured[first:]
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


@numba.njit(cache=True, nogil=True)
def all_nodes(count):
    """The bitset of nodes 0 to ``count`` - 1."""
    bits = np.zeros((count + 63) // 64, np.uint64)
    for node in range(count):
        bits[node >> 6] |= ONE << np.uint64(node & 63)
    return bits


@numba.njit(cache=True, nogil=True)
def colour_bound(rows):
    """Colours that greedy colouring needs: no clique is larger."""
    count = len(rows)
    if count == 0:
        return 0
    order, bound = np.empty(count, np.int32), np.empty(count, np.int32)
    listed = colour(all_nodes(count), rows, np.int64(0), order, bound)
    return np.int64(bound[listed - 1])


@numba.njit(cache=True, nogil=True)
def larger_clique(rows, floor, effort_limit, board=None):
    """A largest clique if it has more than ``floor`` nodes, else an empty array; the effort; whether it is exact.

    Nodes are numbered so that those of high degree come first. With an explicit stack, not recursion. A watch's
    ``board`` can end it as its limit does.
    """
    count, words = rows.shape
    best = np.empty(0, np.int64)
    largest = floor
    if count <= floor:
        return best, 0, True
    candidates = np.empty((count + 1, words), np.uint64)
    candidates[0] = all_nodes(count)
    order = np.empty((count + 1, count), np.int32)
    bound = np.empty((count + 1, count), np.int32)
    place = np.zeros(count + 1, np.int64)
    current = np.empty(count, np.int64)
    place[0] = colour(candidates[0], rows, largest, order[0], bound[0]) - 1
    depth, effort = 0, count * words
    while depth >= 0:
        if place[depth] < 0 or depth + bound[depth, place[depth]] <= largest:
            depth -= 1
            continue
        if effort >= effort_limit or stopped(board):
            return best, effort, False
        node = order[depth, place[depth]]
        place[depth] -= 1
        current[depth] = node
        size = 0
        for w in range(words):
            candidates[depth + 1, w] = candidates[depth, w] & rows[node, w]
            size += popcount(candidates[depth + 1, w])
        candidates[depth, node >> 6] &= ~(ONE << np.uint64(node & 63))
        if size == 0:
            if depth + 1 > largest:
                best, largest = current[: depth + 1].copy(), depth + 1
            continue
        effort += words
        if depth + 1 + size <= largest:
            continue
        depth += 1
        effort += size * words
        place[depth] = colour(candidates[depth], rows, largest - depth, order[depth], bound[depth]) - 1
    return best, effort, True


@numba.njit(cache=True, nogil=True)
def subgraph(rows, nodes):
    """Rows of the graph among ``nodes`` (K,), numbered by descending degree, and their old numbers (K,)."""
    count = len(nodes)
    degree = np.zeros(count, np.int64)
    for a in range(count):
        for b in range(count):
            degree[a] += np.int64((rows[nodes[a], nodes[b] >> 6] >> np.uint64(nodes[b] & 63)) & ONE)
    old = nodes[np.argsort(-degree)]
    small = np.zeros((count, (count + 63) // 64), np.uint64)
    for a in range(count):
        for b in range(a):
            if (rows[old[a], old[b] >> 6] >> np.uint64(old[b] & 63)) & ONE != 0:
                set_edge(small, a, b)
    return small, old


@numba.njit(cache=True, nogil=True)
def thin(rows, floor):
    """Clear, again and again, edges whose ends have less than ``floor`` - 1 common neighbours; return nodes left with
    any.

    No clique of more than ``floor`` nodes, two at least, loses an edge.
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
    return np.array([a for a in range(count) if np.any(rows[a] != 0)], np.int64)
