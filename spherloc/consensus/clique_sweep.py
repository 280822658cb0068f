"""Exact search of one bin of yaw: walk its arcs, keep the graph, and search wherever a larger clique may be completed.

A largest clique is completed by the last of its edges, so only when an edge is inserted whose ends have enough common
neighbours need these be searched. One pair may own two arcs: an edge is cleared when the last one ends.
"""

import numba
import numpy as np

from spherloc.consensus.balls_of_pairs import apart_balls, may_be_seen, pair_ball, star_balls, view_between
from spherloc.consensus.clique_search import ONE, clear_edge, colour_bound, larger_clique, popcount, set_edge, subgraph
from spherloc.consensus.dual_proof import FOUND, IMPOSSIBLE, UNKNOWN, prove_none
from spherloc.consensus.pair_arcs import CIRCLE
from spherloc.consensus.region import search_region
from spherloc.consensus.scout import core_graph
from spherloc.consensus.support import climb, keep, verify

MOST_TRIALS = 16
"""Cliques of a bin that may stay without pose or proof before only larger ones are searched for."""
MOST_SPARE = 8
"""Nodes of a bin more than the best support up to which the whole bin is tried to be settled at once."""
MOST_CELLS = 4000
"""Cells of yaw and position in one proof."""
MOST_IN_CELLS = 16
"""Correspondences up to which cells are tried where duality proves nothing."""
CELL_EFFORT, ROUND_EFFORT, VERIFY_EFFORT = 200, 40, 200
"""Words that take as long as a cell, as one correspondence in a round of a proof, and as one when a pose is verified."""


@numba.njit(cache=True, nogil=True)
def _pieces(pairs, lo, hi, arcs, nodes, count, start, end):
    """Arcs among ``nodes``, clipped to the bin: their places (E, 2) in ``nodes``, and their ends (E,), (E,)."""
    places = np.full(count, -1, np.int64)
    for k in range(len(nodes)):
        places[nodes[k]] = k
    edges = np.empty((2 * len(arcs), 2), np.int64)
    first, last = np.empty(2 * len(arcs)), np.empty(2 * len(arcs))
    used = 0
    for arc in arcs:
        a, b = places[pairs[arc, 0]], places[pairs[arc, 1]]
        if a < 0 or b < 0:
            continue
        for turns in (0.0, CIRCLE):
            if lo[arc] - turns <= end and hi[arc] - turns >= start:
                edges[used, 0], edges[used, 1] = a, b
                first[used], last[used] = max(lo[arc] - turns, start), min(hi[arc] - turns, end)
                used += 1
    return edges[:used], first[:used], last[:used]


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
def _candidates(view, limits, ball, nodes, common, shared):
    """Places of the common neighbours that may be seen from somewhere in the ball of their pair."""
    kept, used = np.empty(shared, np.int64), 0
    for k in _members(common, shared):
        if may_be_seen(view, limits, nodes[k], ball):
            kept[used] = k
            used += 1
    return kept[:used]


@numba.njit(cache=True, nogil=True)
def _completed(rows, a, b, candidates, floor, effort_limit):
    """A clique with both nodes and more than ``floor`` nodes in all, or nothing; the effort; whether it is exact."""
    small, old = subgraph(rows, candidates)
    inside, effort, exact = larger_clique(small, floor - 2, effort_limit)
    effort += len(candidates) * len(candidates)
    if len(inside) == 0 and floor >= 2:
        return inside, effort, exact
    clique = np.empty(len(inside) + 2, np.int64)
    for k in range(len(inside)):
        clique[k] = old[inside[k]]
    clique[-2], clique[-1] = a, b
    return clique, effort, exact


@numba.njit(cache=True, nogil=True)
def _settle(data, limits, view, everybody, balls, poses, supports, masks, known):
    """Prove that no pose explains more of ``everybody`` than the best known one does; ``balls`` (B, 4) hold all that might.

    Better poses that are met become known, and the proof goes on against them. Returns how many are known, whether
    it is proven, and the effort.
    """
    found = np.empty((3, 4))
    mask = np.empty(masks.shape[1], np.bool_)
    effort, b = 0, 0
    while b < len(balls):
        if not balls[b, 3] < np.inf:
            return known, False, effort
        best = supports[0]
        answer, work = prove_none(view, limits, everybody, balls[b], best, found)
        effort += work * ROUND_EFFORT
        if answer == UNKNOWN and len(everybody) <= MOST_IN_CELLS:
            answer, work = search_region(view, limits, everybody, balls[b], best, MOST_CELLS, found)
            effort += work
        if answer == FOUND:
            support = climb(data, found[:, :3], found[:, 3], mask)
            known = keep(found[:, :3], found[:, 3], support, mask, poses, supports, masks, known)
            if supports[0] <= best:  # it climbed down by rounding
                return known, False, effort
        elif answer == IMPOSSIBLE:
            b += 1
        else:
            return known, False, effort
    return known, True, effort


@numba.njit(cache=True, nogil=True)
def sweep_bin(data, limits, trig, pairs, lo, hi, arcs, start, end, poses, supports, masks, known, effort_limit):
    """Search one bin.

    ``data`` is what ``verify`` takes, ``limits`` what ``search_region`` takes, ``trig`` the chords and sines of the
    angular bounds. ``poses`` (K, 3, 4), ``supports`` (K,) and ``masks`` (K, M) hold ``known`` verified poses, the first one
    with the largest support; better ones are added in place. Returns how many are known, the bound for the bin, its
    largest clique that may have a pose (nodes; empty if none is larger than the support), the effort, and whether the
    bin was searched to its end.
    """
    nothing = np.empty(0, np.int64)
    nodes, rows = core_graph(masks.shape[1], pairs, arcs, supports[0])
    if len(nodes) <= supports[0]:
        return known, supports[0], nothing, len(arcs), True
    whole = colour_bound(rows)
    effort = len(arcs) + rows.size
    if whole <= supports[0]:
        return known, supports[0], nothing, effort, True
    if len(nodes) - supports[0] <= MOST_SPARE:
        view = view_between(data, start, end)
        balls = apart_balls(view, trig, nodes, len(nodes) - supports[0])
        known, proven, work = _settle(data, limits, view, nodes, balls, poses, supports, masks, known)
        effort += work
        if proven:
            return known, supports[0], nothing, effort, True
    edges, first, last = _pieces(pairs, lo, hi, arcs, nodes, masks.shape[1], start, end)
    rows[:] = 0
    owned = np.zeros((len(nodes), len(nodes)), np.uint8)
    common = np.empty(rows.shape[1], np.uint64)
    opening, closing = np.argsort(first), np.argsort(last)
    largest, trials, closed, floor = nothing, 0, 0, supports[0]
    exact = True
    for edge in opening:
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
        # Who completes a clique with this edge is seen from its ball, at a yaw of its arc.
        view = view_between(data, first[edge], last[edge])
        ball = pair_ball(view, trig, nodes[a], nodes[b])
        candidates = _candidates(view, limits, ball, nodes, common, shared)
        clique, work, done = _completed(rows, a, b, candidates, floor, effort_limit - effort)
        effort += work
        exact = exact and done
        if len(clique) == 0:
            continue
        known = verify(data, nodes[clique], poses, supports, masks, known)
        effort += VERIFY_EFFORT * masks.shape[1]
        floor = max(floor, supports[0])
        if len(clique) <= floor:
            continue
        everybody = np.append(nodes[candidates], nodes[np.array([a, b])])
        balls = star_balls(view, trig, everybody, len(everybody) - supports[0], ball)
        known, proven, work = _settle(data, limits, view, everybody, balls, poses, supports, masks, known)
        effort += work
        if not proven and len(clique) > len(largest):
            largest = nodes[clique]
        trials += not proven
        floor = supports[0] if trials < MOST_TRIALS else max(supports[0], len(largest))
    return known, max(floor, len(largest)) if exact else whole, largest, effort, exact
