"""Exact search of one bin of yaw: walk its arcs, keep the graph, and search wherever a larger clique may be completed.

A largest clique is completed by the last of its edges, so only when an edge is inserted whose ends have enough common
neighbours need these be searched. One pair may own two arcs: an edge is cleared when the last one ends.
"""

import numba
import numpy as np

from spherloc.consensus.balls_of_pairs import may_be_seen, pair_ball, star_balls, view_between
from spherloc.consensus.clique_search import ONE, clear_edge, colour_bound, larger_clique, popcount, set_edge, subgraph
from spherloc.consensus.dual_proof import FOUND, IMPOSSIBLE, UNKNOWN, prove_none
from spherloc.consensus.long_sort import order_of
from spherloc.consensus.pair_arcs import CIRCLE
from spherloc.consensus.region import search_region
from spherloc.consensus.support import improve, verify
from spherloc.watch import DONE, SELDOM, TOTAL, stopped

MOST_TRIALS = 16
"""Cliques of a bin that may stay without pose or proof before only larger ones are searched for."""
MOST_CELLS = 4000
"""Cells of yaw and position in one proof."""
MOST_IN_CELLS = 16
"""Correspondences up to which cells are tried where duality proves nothing."""
SORT_EFFORT = 70
"""Words that take as long as sorting an arc in."""
ROUND_EFFORT, VERIFY_EFFORT = 40, 200
"""Words that take as long as one correspondence in a round of a proof, and as one when a pose is verified."""


@numba.njit(cache=True, nogil=True)
def _pieces(pairs, lo, hi, nodes, count, start, end, board):
    """Arcs among ``nodes`` that touch the bin, clipped to it: their places (E, 2) in ``nodes`` and their ends (E,),
    (E,).
    """
    places = np.full(count, -1, np.int64)
    for k in range(len(nodes)):
        places[nodes[k]] = k
    used, room = 0, 0
    edges, first, last = np.empty((0, 2), np.int64), np.empty(0), np.empty(0)
    for counting in (True, False):
        for arc in range(len(lo)):
            if arc & SELDOM == 0 and stopped(board):
                return np.empty((0, 2), np.int64), np.empty(0), np.empty(0)
            for turns in (0.0, CIRCLE):
                if lo[arc] - turns > end or hi[arc] - turns < start:
                    continue
                a, b = places[pairs[arc, 0]], places[pairs[arc, 1]]
                if a < 0 or b < 0:
                    continue
                if counting:
                    room += 1
                    continue
                edges[used, 0], edges[used, 1] = a, b
                first[used], last[used] = max(lo[arc] - turns, start), min(hi[arc] - turns, end)
                used += 1
        if counting:
            edges, first, last = np.empty((room, 2), np.int64), np.empty(room), np.empty(room)
    return edges, first, last


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
def _completed(rows, a, b, candidates, floor, effort_limit, board):
    """A clique with both nodes and more than ``floor`` nodes in all, or nothing; the effort; whether it is exact."""
    small, old = subgraph(rows, candidates)
    inside, effort, exact = larger_clique(small, floor - 2, effort_limit, board)
    effort += len(candidates) * len(candidates)
    if len(inside) == 0 and floor >= 2:
        return inside, effort, exact
    clique = np.empty(len(inside) + 2, np.int64)
    for k in range(len(inside)):
        clique[k] = old[inside[k]]
    clique[-2], clique[-1] = a, b
    return clique, effort, exact


@numba.njit(cache=True, nogil=True)
def certify(data, limits, view, everybody, balls, poses, supports, masks, known, board):
    """Prove that no pose explains more of ``everybody`` than the best known one does; ``balls`` (B, 4) hold all that
    might.

    Better poses that are met become known, and the proof goes on against them. Returns how many are known, whether
    it is proven, and the effort. A watch's ``board`` can end it unproven.
    """
    found = np.empty(5)
    effort, b = 0, 0
    while b < len(balls):
        if not balls[b, 3] < np.inf or stopped(board):
            return known, False, effort
        best = np.int64(supports[0])
        answer, work = prove_none(view, limits, everybody, balls[b], best, found, board)
        effort += work * ROUND_EFFORT
        if answer == UNKNOWN and len(everybody) <= MOST_IN_CELLS:
            answer, work = search_region(view, limits, everybody, balls[b], best, np.int64(MOST_CELLS), found)
            effort += work
        if answer == FOUND:
            known = improve(data, everybody, found, poses, supports, masks, known)
            if supports[0] <= best:  # it climbed down by rounding
                return known, False, effort
        elif answer == IMPOSSIBLE:
            b += 1
        else:
            return known, False, effort
    return known, True, effort


@numba.njit(cache=True, nogil=True)
def sweep_bin(data, limits, trig, pairs, lo, hi, nodes, rows, span, poses, supports, masks, known, effort_limit, board):
    """Search the bin between the turns ``span``.

    ``data`` is what ``verify`` takes, ``limits`` what ``search_region`` takes, ``trig`` the chords and sines of the
    angular bounds; ``nodes`` and ``rows`` are the bin's core and its graph, which is used up. ``poses`` (K, 5),
    ``supports`` (K,) and ``masks`` (K, M) hold ``known`` verified poses, the first one with the largest support; better
    ones are added in place. Returns how many are known, the bound for the bin, its largest clique that may have a pose
    (nodes; empty if none is larger than the support), the effort, and whether the bin was searched to its end.
    A watch's ``board`` can end it, and learns how much of the effort is left.
    """
    nothing = np.empty(0, np.int64)
    whole = colour_bound(rows)
    edges, first, last = _pieces(pairs, lo, hi, nodes, masks.shape[1], span[0], span[1], board)
    effort = len(lo) + SORT_EFFORT * len(edges)
    if effort > effort_limit:
        return known, whole, nothing, len(lo), False
    rows[:] = 0
    owned = np.zeros((len(nodes), len(nodes)), np.uint8)
    common = np.empty(rows.shape[1], np.uint64)
    opening, closing = order_of(first, board), order_of(last, board)
    largest, trials, closed, floor = nothing, 0, 0, np.int64(supports[0])
    exact = True
    for edge in opening:
        if stopped(board):
            return known, whole, largest, effort, False
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
        board[DONE] = max(board[DONE], board[TOTAL] - effort_limit + effort)
        # Who completes a clique with this edge is seen from its ball, at a yaw of its arc.
        view = view_between(data, first[edge], last[edge])
        ball = pair_ball(view, trig, nodes[a], nodes[b])
        candidates = _candidates(view, limits, ball, nodes, common, shared)
        clique, work, done = _completed(rows, a, b, candidates, floor, effort_limit - effort, board)
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
        known, proven, work = certify(data, limits, view, everybody, balls, poses, supports, masks, known, board)
        effort += work
        if not proven and len(clique) > len(largest):
            largest = nodes[clique]
        trials += not proven
        floor = np.int64(supports[0] if trials < MOST_TRIALS else max(supports[0], len(largest)))
    return known, max(floor, len(largest)) if exact else whole, largest, effort, exact
