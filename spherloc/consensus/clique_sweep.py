"""Exact search of one bin of yaw: walk its arcs, keep the graph, and search wherever a larger clique may be completed.

A largest clique is completed by the last of its edges, so only when an edge is inserted whose ends have enough common
neighbours need these be searched. One pair may own two arcs: an edge is cleared when the last one ends.
"""

import numba
import numpy as np

from spherloc.consensus.clique_search import ONE, clear_edge, colour_bound, larger_clique, popcount, set_edge, subgraph
from spherloc.consensus.depth_bounds import chord
from spherloc.consensus.pair_arcs import CIRCLE, middle_of_turns
from spherloc.consensus.support import verify
from spherloc.consensus.translation_balls import ball_of_pair

MOST_PARTED = 32
"""Common neighbours of a pair up to which theirs balls are compared too."""
MOST_TRIALS = 16
"""Cliques of a bin that are looked at before only larger ones are searched for."""


@numba.njit(cache=True, nogil=True)
def peel(count, pairs, arcs, least):
    """Nodes that are left after removing, again and again, those with fewer than ``least`` edges among ``arcs``."""
    alive = np.ones(count, np.bool_)
    degree = np.empty(count, np.int64)
    changed = True
    while changed:
        changed = False
        degree[:] = 0
        for arc in arcs:
            i, j = pairs[arc, 0], pairs[arc, 1]
            if alive[i] and alive[j]:
                degree[i] += 1
                degree[j] += 1
        for node in range(count):
            if alive[node] and degree[node] < least:
                alive[node] = False
                changed = True
    nodes = np.flatnonzero(alive)
    return nodes[np.argsort(-degree[nodes])]


@numba.njit(cache=True, nogil=True)
def _pieces(pairs, lo, hi, arcs, places, start, end):
    """Ends of node pairs (a, b) clipped to the bin: rows (E, 2) of nodes, and their ends (E,), (E,)."""
    nodes = np.empty((2 * len(arcs), 2), np.int64)
    first, last = np.empty(2 * len(arcs)), np.empty(2 * len(arcs))
    used = 0
    for arc in arcs:
        a, b = places[pairs[arc, 0]], places[pairs[arc, 1]]
        if a < 0 or b < 0:
            continue
        for turns in (0.0, CIRCLE):
            if lo[arc] - turns <= end and hi[arc] - turns >= start:
                nodes[used, 0], nodes[used, 1] = a, b
                first[used], last[used] = max(lo[arc] - turns, start), min(hi[arc] - turns, end)
                used += 1
    return nodes[:used], first[:used], last[:used]


@numba.njit(cache=True, nogil=True)
def _common(rows, a, b, out):
    """Common neighbours of two nodes, into ``out``; returns how many."""
    found = 0
    for w in range(rows.shape[1]):
        word = rows[a, w] & rows[b, w]
        found += popcount(word)
        out[w] = word
    return found


@numba.njit(cache=True, nogil=True)
def _members(bits, count):
    """Nodes of a bitset."""
    nodes = np.empty(count, np.int64)
    used = 0
    for w in range(len(bits)):
        word = bits[w]
        while word != 0:
            low = word & (~word + ONE)
            nodes[used] = w * 64 + popcount(low - ONE)
            used += 1
            word ^= low
    return nodes[:used]


@numba.njit(cache=True, nogil=True)
def _sees(view, eps, ball, k):
    """Whether point ``k`` may be seen from some place in the ball (centre, radius) at a yaw of the view."""
    bearings, points, c, s, slack = view
    x, y, z = points[k, 0] - ball[0], points[k, 1] - ball[1], points[k, 2] - ball[2]
    distance = np.sqrt(x * x + y * y + z * z)
    if distance <= ball[3]:
        return True
    v = bearings[k]
    cosine = (v[0] * (c * x + s * z) + v[1] * y + v[2] * (c * z - s * x)) / distance
    angle = np.arccos(min(1.0, max(-1.0, cosine)))
    return angle <= (eps[k] + slack + np.arcsin(ball[3] / distance)) * (1.0 + 1e-9) + 1e-7


@numba.njit(cache=True, nogil=True)
def _ball(view, trig, i, j):
    """The ball of a pair in a view: its centre and radius."""
    bearings, points, c, s, slack = view
    ball = np.empty(4)
    ball[3] = ball_of_pair(i, j, bearings, points, trig[0], trig[1], c, s, slack, ball[:3])
    return ball


@numba.njit(cache=True, nogil=True)
def _drop_unseen(view, eps, trig, nodes, a, b, common):
    """Drop from ``common`` what is seen from nowhere in the ball of the pair (a, b); returns how many stay.

    A pose that explains all three lies in the ball.
    """
    ball = _ball(view, trig, nodes[a], nodes[b])
    kept = 0
    for w in range(len(common)):
        word = common[w]
        while word != 0:
            low = word & (~word + ONE)
            word ^= low
            if _sees(view, eps, ball, nodes[w * 64 + popcount(low - ONE)]):
                kept += 1
            else:
                common[w] &= ~low
    return kept


@numba.njit(cache=True, nogil=True)
def _part_unseen(view, eps, trig, nodes, ends, members, small):
    """Part those of ``members`` in their graph ``small`` that are not both seen from the balls with one of ``ends``."""
    for end in ends:
        for k in range(len(members)):
            ball = _ball(view, trig, nodes[end], nodes[members[k]])
            for m in range(len(members)):
                joined = (small[k, m >> 6] >> np.uint64(m & 63)) & ONE != 0
                if joined and not _sees(view, eps, ball, nodes[members[m]]):
                    clear_edge(small, k, m)


@numba.njit(cache=True, nogil=True)
def _completed(view, eps, trig, nodes, rows, a, b, common, floor, effort_limit):
    """A clique with both nodes and more than ``floor`` nodes in all, or nothing; the effort; whether it is exact."""
    shared = _drop_unseen(view, eps, trig, nodes, a, b, common)
    nothing = np.empty(0, np.int64)
    if shared + 2 <= floor:
        return nothing, 0, True
    small, old = subgraph(rows, _members(common, shared))
    if shared <= MOST_PARTED:
        _part_unseen(view, eps, trig, nodes, (a, b), old, small)
    inside, effort, exact = larger_clique(small, floor - 2, effort_limit)
    effort += shared * shared
    if len(inside) == 0 and floor >= 2:
        return nothing, effort, exact
    clique = np.empty(len(inside) + 2, np.int64)
    for k in range(len(inside)):
        clique[k] = old[inside[k]]
    clique[-2], clique[-1] = a, b
    return clique, effort, exact


@numba.njit(cache=True, nogil=True)
def sweep_bin(data, eps, pairs, lo, hi, arcs, start, end, poses, supports, masks, known, effort_limit):
    """Search one bin.

    ``data`` is what ``verify`` takes. ``poses`` (K, 3, 4), ``supports`` (K,) and ``masks`` (K, M) hold ``known`` verified
    poses, the first one with the largest support; better ones are added in place. Returns how many are known, the
    bound for the bin, its largest clique (nodes; empty if none is larger than the support was), the effort, and
    whether the bin was searched to its end.
    """
    count = masks.shape[1]
    best = supports[0]
    nothing = np.empty(0, np.int64)
    nodes = peel(count, pairs, arcs, best)
    if len(nodes) <= best:
        return known, best, nothing, len(arcs), True
    places = np.full(count, -1, np.int64)
    for k in range(len(nodes)):
        places[nodes[k]] = k
    edges, first, last = _pieces(pairs, lo, hi, arcs, places, start, end)
    rows = np.zeros((len(nodes), (len(nodes) + 63) // 64), np.uint64)
    for k in range(len(edges)):
        set_edge(rows, edges[k, 0], edges[k, 1])
    whole = colour_bound(rows)
    effort = len(arcs) + rows.size
    if whole <= best:
        return known, best, nothing, effort, True
    rows[:] = 0
    owned = np.zeros((len(nodes), len(nodes)), np.uint8)
    common = np.empty(rows.shape[1], np.uint64)
    trig = (chord(eps), np.sin(eps))
    opening, closing = np.argsort(first), np.argsort(last)
    largest, floor, trials, closed = nothing, best, 0, 0
    exact = True
    for k in range(len(edges)):
        edge = opening[k]
        while last[closing[closed]] < first[edge]:
            a, b = edges[closing[closed], 0], edges[closing[closed], 1]
            owned[a, b] -= 1
            if owned[a, b] == 0:
                clear_edge(rows, a, b)
            closed += 1
        a, b = edges[edge, 0], edges[edge, 1]
        owned[a, b] += 1
        set_edge(rows, a, b)
        effort += len(common)
        shared = _common(rows, a, b, common)
        if shared + 2 <= floor:
            continue
        if effort >= effort_limit:
            return known, whole, largest, effort, False
        view = (data[0], data[1], *middle_of_turns(first[edge], last[edge]))
        clique, work, done = _completed(view, eps, trig, nodes, rows, a, b, common, floor, effort_limit - effort)
        effort += work
        exact = exact and done
        if len(clique) == 0:
            continue
        clique = nodes[clique]
        if len(clique) > len(largest):
            largest = clique
        trials += 1
        known = verify(data, clique, poses, supports, masks, known)
        best = supports[0]
        floor = best if trials < MOST_TRIALS else max(best, len(largest))
    return known, max(floor, len(largest)) if exact else whole, largest, effort, exact
