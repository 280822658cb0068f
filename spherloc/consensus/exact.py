"""Exact consensus: the largest set of correspondences that any level pose could explain, bounded over all yaws.

At a yaw, let the graph have an edge where an arc of the pair covers it (``pair_arcs``). What any pose with that yaw
explains is a clique, so the largest clique over all yaws bounds every consensus from above. Bins of yaw whose cheap
bound does not exceed the best verified support cannot hold a better pose and are never searched; the others are, most
promising first.

A bin is searched by walking its arcs and keeping the graph at the yaw reached. A largest clique is completed by the
last of its edges, so only when an edge is inserted whose ends have enough common neighbours need these be searched.
One pair may own two arcs: an edge is cleared when the last one ends.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds
from spherloc.consensus.chance import least_size, nfa
from spherloc.consensus.level_pose import (
    BestPoses,
    BoundedMatches,
    bounded_matches,
    empty_list,
    improve,
    verify,
    write_level_pose,
    write_translation,
)
from spherloc.consensus.long_sort import order_of
from spherloc.consensus.max_clique import ONE, clear_edge, colour_bound, larger_clique, popcount, set_edge, subgraph
from spherloc.consensus.pair_arcs import CIRCLE, pair_arcs, turn_of, yaws_between
from spherloc.consensus.region_proof import FOUND, IMPOSSIBLE, UNKNOWN, Region, prove_none, search_region
from spherloc.consensus.translation_balls import apart_balls, may_be_seen, pair_ball, star_balls
from spherloc.consensus.yaw_bins import BIN_TURN, BINS, core_graph, degree_bounds, largest_bin_cliques, sort_into_bins
from spherloc.geometry import level_poses
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.small_arrays import elements, fill_matrix, fill_vector
from spherloc.types import BoolArray, FloatArray, IndexArray, IntArray
from spherloc.watch import DONE, SELDOM, TOTAL, Watch, stopped, working_s

DOUBTFUL_NFA = 1e-6
"""Expected number of false alarms (NFA) of the size of the guess above which better guesses are looked for."""
LARGEST_NFA = 1000.0
"""NFA of a size at which it says nothing."""
MAX_LEFT_OUT = 8
"""Nodes of a bin more than the best support up to which the whole bin is tried to be certified at once."""
MAX_POSES = 8
"""Clearly different poses that are remembered."""
PAIRS_UNTIL, BINS_UNTIL, CLIQUES_UNTIL, SEARCH_UNTIL = 0.5, 0.7, 0.75, 0.98
"""How far the run of an estimator is by ``Watch.fraction`` at the ends of the parts of this search."""
MAX_TRIALS = 16
"""Cliques of a bin that may stay without pose or proof before only larger ones are searched for."""
MAX_CELLS = 4000
"""Cells of yaw and position in one proof."""
MAX_IN_CELLS = 16
"""Correspondences up to which cells are tried where duality proves nothing."""
SORT_EFFORT = 70
"""Words that take as long as sorting an arc in."""
ROUND_EFFORT, VERIFY_EFFORT = 40, 200
"""Words that take as long as one correspondence in a round of a proof, and as one when a pose is verified."""


@dataclass(frozen=True, eq=False)
class ExactConsensus:
    """What the search found and what it proved. M correspondences, C poses."""

    poses: FloatArray
    """(C, 3, 4) level poses that were verified, best first."""
    supports: IndexArray
    """(C,) correspondences that each explains."""
    mask: BoolArray
    """(M,) what the best one explains."""
    bound: IndexArray
    """(BINS,) of turn: no pose with a yaw in that bin explains more."""
    clique: IndexArray
    """The largest clique found beyond the best support, or the best consensus itself."""
    arcs: int
    """Arcs of all pairs."""
    effort: int
    """Words touched by the searches."""
    finished: bool
    """Whether every bin was searched to its end."""

    def bound_over_yaw(self, bins: int) -> IndexArray:
        """``bound`` by yaw, from -pi upwards in an even number of equal steps."""
        return self.bound[_bins_of_yaws(bins)].max(axis=0)


def exact_consensus(
    aligned: AlignedProblem,
    bounds: Bounds,
    wrong_rate: float,
    guesses: list[tuple[float, FloatArray]],
    effort_limit: int,
    time_budget_s: float,
    watch: Watch | None = None,
) -> ExactConsensus:
    """Search all yaws.

    ``wrong_rate`` is the probability that a wrong pose explains a correspondence. ``guesses`` are level poses
    (yaw, rad, and translation (3,)) to start from: the more the best of them explains, the less is left to be
    searched. After ``effort_limit`` words or ``time_budget_s`` seconds the search stops, and the bounds say how far
    it came. ``watch`` counts pairs, steps and then the share of the bins or of the effort, whichever is the larger;
    raises ``Cancelled``.
    """
    deadline = working_s() + time_budget_s
    watch = watch or Watch()
    count = len(aligned.bearings)
    matches, best = bounded_matches(aligned, bounds), empty_list(MAX_POSES, count)
    supports = best.supports
    for yaw, translation in guesses:
        pose = np.empty(5)
        write_level_pose(yaw, translation, pose)
        improve(matches, np.empty(0, np.int64), pose, best)
    watch.begin("pairs", PAIRS_UNTIL)
    arcs = pair_arcs(aligned, bounds.radians, watch)
    watch.begin("bins", BINS_UNTIL)
    watch.expect(4)
    starts, edges = sort_into_bins(*arcs, watch.board)
    watch.reach(3)
    bound = degree_bounds(count, starts, edges, watch.board)
    watch.begin("largest_bin_cliques", CLIQUES_UNTIL)
    # What chance explains too often to be told apart is looked for last.
    for expected in (LARGEST_NFA, np.inf) if len(edges) < effort_limit else ():
        if nfa(count, int(supports[0]), wrong_rate) > DOUBTFUL_NFA:
            floor = least_size(count, wrong_rate, expected) - 1
            order = np.argsort(-bound, kind="stable")
            largest_bin_cliques(matches, starts, edges, bound, order, floor, best, watch.board)
    watch.begin("search", SEARCH_UNTIL)
    watch.expect(effort_limit)
    effort, finished = len(edges), True
    clique = np.empty(0, np.int64)
    promising = np.count_nonzero(bound > supports[0])
    for passed, b in enumerate(np.argsort(-bound, kind="stable")):
        if bound[b] <= supports[0]:
            break
        watch.reach(int(max(effort, effort_limit * passed // promising)))
        if effort >= effort_limit or working_s() >= deadline:
            finished = False
            break
        nodes, rows = core_graph(count, edges[starts[b] : starts[b + 1]], int(supports[0]), watch.board)
        watch.check()
        span = (b * BIN_TURN, (b + 1) * BIN_TURN)
        most, work = _certify_bin(matches, nodes, rows, span, best, watch.board)
        effort += work
        bound[b] = min(bound[b], most)
        if bound[b] <= supports[0]:
            continue
        left = effort_limit - effort
        most, found, work, exact = sweep_bin(matches, arcs, nodes, rows, span, best, left, watch.board)
        effort += work
        finished = finished and exact
        bound[b] = min(bound[b], most)
        clique = found if len(found) > len(clique) else clique
    watch.check()
    # A bin that was left out explains no more than the best pose.
    if len(clique) <= supports[0]:
        clique = np.flatnonzero(best.masks[0])
    known = int(best.known[0])
    return ExactConsensus(
        poses=_as_matrices(best.poses[:known]),
        supports=supports[:known],
        mask=best.masks[0],
        bound=np.maximum(bound, 1),  # a camera can always be where it sees one point
        clique=clique.astype(np.int32),
        arcs=len(arcs.pairs),
        effort=effort,
        finished=finished,
    )


def _certify_bin(
    matches: BoundedMatches,
    nodes: NDArray[np.int64],
    rows: NDArray[np.uint64],
    span: tuple[float, float],
    best: BestPoses,
    board: NDArray[np.int64],
) -> tuple[int, int]:
    """Bound a bin without walking its arcs: by colours, and by proof where few nodes more than the best support are
    left.

    The arguments are those of ``sweep_bin``. Returns the bound, and the effort.
    """
    support, effort = int(best.supports[0]), rows.size
    most = min(len(nodes), colour_bound(rows)) if len(nodes) > support else support
    if most > support and len(nodes) - support <= MAX_LEFT_OUT:
        yaws = yaws_between(*span)
        balls = apart_balls(matches, yaws, nodes, len(nodes) - support)
        proven, work = certify(matches, yaws, nodes, balls, best, board)
        effort += work
        most = 0 if proven else most
    return int(max(most, best.supports[0])), int(effort)


@lru_cache(maxsize=4)
def _bins_of_yaws(count: int) -> IntArray:
    """(B, ``count``) the bins of turn that each of that many equal steps of yaw from -pi upwards touches, some of them
    more than once."""
    ends = turn_of(np.linspace(-np.pi, np.pi, count + 1)) / BIN_TURN
    first = np.floor(ends[:-1] + 1e-9).astype(int) % BINS
    last = np.maximum(first, np.ceil(ends[1:] - 1e-9).astype(int) - 1)
    last = np.where(ends[1:] < ends[:-1], BINS - 1, last)  # the bin that ends at turn 0
    return np.minimum(first + np.arange(int((last - first).max()) + 1)[:, None], last)


def _as_matrices(poses: FloatArray) -> FloatArray:
    """Level poses (C, 5) as (C, 3, 4)."""
    matrices = level_poses(np.arctan2(poses[:, 1], poses[:, 0]), np.empty((len(poses), 3)))
    for pose, matrix in zip(poses, matrices, strict=True):
        write_translation(pose, matrix[:, 3])
    return matrices


@kernel()
def _pieces(arcs, nodes, count, start, end, board):
    """Those of ``arcs``, ``Arcs``, between ``nodes`` (K,) that touch a bin, clipped to it.

    The bin goes from turn ``start`` to turn ``end``. Nodes are numbers of ``count`` matches. Returns edges (E, 2),
    indices into ``nodes``, and their first and last ends (E,), (E,), turns. A watch's ``board`` can end it, after which
    there are none.
    """
    pairs, lo, hi = arcs
    index_of = np.empty(count, np.int64)
    fill_vector(index_of, -1)
    for index in range(len(nodes)):
        index_of[nodes[index]] = index
    used, room = 0, 0
    edges, first, last = np.empty((0, 2), np.int64), np.empty(0), np.empty(0)
    for counting in (True, False):
        for arc in range(len(lo)):
            if arc & SELDOM == 0 and stopped(board):
                return np.empty((0, 2), np.int64), np.empty(0), np.empty(0)
            for turns in (0.0, CIRCLE):
                if lo[arc] - turns > end or hi[arc] - turns < start:
                    continue
                a, b = index_of[pairs[arc, 0]], index_of[pairs[arc, 1]]
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


@kernel()
def _common(rows, a, b, out):
    """Write the common neighbours of nodes ``a`` and ``b`` of a graph ``rows`` (K, words) to ``out`` (words,).

    Returns how many.
    """
    found = 0
    for w in range(rows.shape[1]):
        word = rows[a, w] & rows[b, w]
        found += popcount(word)
        out[w] = word
    return found


@kernel()
def _members(bits, count):
    """The ``count`` nodes (N,) of the bitset ``bits`` (words,), ascending."""
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


@kernel()
def _candidates(matches, yaws, ball, nodes, common, shared):
    """Those of the ``shared`` neighbours in the bitset ``common`` that may be seen from somewhere in a ``ball`` (4,).

    Indices (C,) into ``nodes`` (K,), which are numbers of ``matches``, ``BoundedMatches``; ``yaws`` is a
    ``YawInterval``.
    """
    kept, used = np.empty(shared, np.int64), 0
    for index in _members(common, shared):
        if may_be_seen(matches, yaws, nodes[index], ball):
            kept[used] = index
            used += 1
    return kept[:used]


@kernel()
def _completed(rows, a, b, candidates, floor, effort_limit, board):
    """A clique of nodes a, b and ``candidates`` (C,) with more than ``floor`` nodes in all, or nothing.

    Nodes are those of the graph ``rows`` (K, words). Returns it, the effort, and whether it is exact; that ends at
    ``effort_limit`` or by a watch's ``board``.
    """
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


@kernel()
def certify(matches, yaws, everybody, balls, best, board):
    """Prove that no pose explains more of ``everybody`` (K,), numbers of ``matches``, than the best known one does.

    ``matches`` are ``BoundedMatches``. All poses that might are at ``yaws``, a ``YawInterval``, with positions in
    ``balls`` (B, 4). Better poses that are met are added to ``best``, ``BestPoses``, and the proof goes on against
    them. Returns whether it is proven, and the effort. A watch's ``board`` can end it unproven.
    """
    found = np.empty(5)
    effort, b = 0, 0
    while b < len(balls):
        if not balls[b, 3] < np.inf or stopped(board):
            return False, effort
        support, region = np.int64(best.supports[0]), Region(yaws, balls[b])
        answer, work = prove_none(matches, region, everybody, support, found, board)
        effort += work * ROUND_EFFORT
        if answer == UNKNOWN and len(everybody) <= MAX_IN_CELLS:
            answer, work = search_region(matches, region, everybody, support, np.int64(MAX_CELLS), found)
            effort += work
        if answer == FOUND:
            improve(matches, everybody, found, best)
            if best.supports[0] <= support:  # it climbed down by rounding
                return False, effort
        elif answer == IMPOSSIBLE:
            b += 1
        else:
            return False, effort
    return True, effort


@kernel()
def sweep_bin(matches, arcs, nodes, rows, span, best, effort_limit, board):
    """Search the bin between the turns ``span``.

    ``matches`` are ``BoundedMatches``, ``arcs`` the ``Arcs`` of all pairs; ``nodes`` (K,) and ``rows`` (K, words) are
    the bin's core and its graph, which is used up. ``best`` holds the verified poses, ``BestPoses``; better ones are
    added in place. Returns the bound for the bin, its largest clique that may have a pose (nodes; empty if none is
    larger than the support), the effort, and whether the bin was searched to its end, within ``effort_limit``. A
    watch's ``board`` can end it, and learns how much of the effort is left.
    """
    count, supports = len(matches.points), best.supports
    nothing = np.empty(0, np.int64)
    whole = colour_bound(rows)
    edges, first, last = _pieces(arcs, nodes, count, span[0], span[1], board)
    effort = len(arcs.lo) + SORT_EFFORT * len(edges)
    if effort > effort_limit:
        return whole, nothing, len(arcs.lo), False
    fill_matrix(rows, 0)
    owned = np.zeros((len(nodes), len(nodes)), np.uint8)
    common = np.empty(rows.shape[1], np.uint64)
    opening, closing = order_of(first, board), order_of(last, board)
    largest, trials, closed, floor = nothing, 0, 0, np.int64(supports[0])
    exact = True
    for edge in opening:
        if stopped(board):
            return whole, largest, effort, False
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
            return whole, largest, effort, False
        board[DONE] = max(board[DONE], board[TOTAL] - effort_limit + effort)
        # Who completes a clique with this edge is seen from its ball, at a yaw of its arc.
        yaws = yaws_between(first[edge], last[edge])
        ball = pair_ball(matches, yaws, nodes[a], nodes[b])
        candidates = _candidates(matches, yaws, ball, nodes, common, shared)
        clique, work, done = _completed(rows, a, b, candidates, floor, effort_limit - effort, board)
        effort += work
        exact = exact and done
        if len(clique) == 0:
            continue
        verify(matches, elements(nodes, clique), best)
        effort += VERIFY_EFFORT * count
        floor = max(floor, supports[0])
        if len(clique) <= floor:
            continue
        everybody = np.empty(len(candidates) + 2, np.int64)
        for k in range(len(candidates)):
            everybody[k] = nodes[candidates[k]]
        everybody[-2], everybody[-1] = nodes[a], nodes[b]
        balls = star_balls(matches, yaws, everybody, len(everybody) - supports[0], ball)
        proven, work = certify(matches, yaws, everybody, balls, best, board)
        effort += work
        if not proven and len(clique) > len(largest):
            largest = elements(nodes, clique)
        trials += not proven
        floor = np.int64(supports[0] if trials < MAX_TRIALS else max(supports[0], len(largest)))
    return max(floor, len(largest)) if exact else whole, largest, effort, exact
