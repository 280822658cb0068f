"""Exact consensus: the largest set of correspondences that any level pose could explain, bounded over all yaws.

At a yaw, let the graph have an edge where an arc of the pair covers it (``pair_arcs``). What any pose with that yaw
explains is a clique, so the largest clique over all yaws bounds every consensus from above. Bins of yaw whose cheap
bound does not exceed the best verified support cannot hold a better pose and are never searched; the others are, most
promising first.
"""

from dataclasses import dataclass

import numpy as np

from spherloc.bounds import Bounds
from spherloc.consensus.balls_of_pairs import apart_balls, view_between
from spherloc.consensus.bin_cliques import core_graph, largest_bin_cliques
from spherloc.consensus.chance import least_size, nfa
from spherloc.consensus.clique_search import colour_bound
from spherloc.consensus.clique_sweep import certify, sweep_bin
from spherloc.consensus.depth_bounds import chord
from spherloc.consensus.level_fit import place, translation_of
from spherloc.consensus.pair_arcs import pair_arcs, turn_of
from spherloc.consensus.support import improve
from spherloc.consensus.yaw_bins import BIN_TURN, BINS, degree_bounds, sort_into_bins
from spherloc.geometry import yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.types import BoolArray, FloatArray, IndexArray
from spherloc.watch import Watch, working_s

DOUBTFUL = 1e-6
"""Expected number of false alarms (NFA) of the size of the guess above which better guesses are looked for."""
LARGEST_NFA = 1000.0
"""NFA of a size at which it says nothing."""
MOST_SPARE = 8
"""Nodes of a bin more than the best support up to which the whole bin is tried to be certified at once."""
MOST_POSES = 8
"""Clearly different poses that are remembered."""
PAIRS_UNTIL, BINS_UNTIL, SCOUT_UNTIL, SEARCH_UNTIL = 0.5, 0.7, 0.75, 0.98
"""How far the run of an estimator is by ``Watch.fraction`` at the ends of the parts of this search."""


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
        ends = turn_of(np.linspace(-np.pi, np.pi, bins + 1)) / BIN_TURN
        first = np.floor(ends[:-1] + 1e-9).astype(int) % BINS
        last = np.maximum(first, np.ceil(ends[1:] - 1e-9).astype(int) - 1)
        last = np.where(ends[1:] < ends[:-1], BINS - 1, last)  # the bin that ends at turn 0
        most = np.zeros(bins, np.int32)
        for more in range(int((last - first).max()) + 1):
            most = np.maximum(most, self.bound[np.minimum(first + more, last)])
        return most


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
    # Rounding must not exclude what the pixel bound allows.
    least_cos = np.cos(np.minimum(bounds.radians + 1e-9, np.pi / 2))
    data = (aligned.bearings, aligned.points, aligned.pixel_from_bearing, bounds.pixels, least_cos)
    limits = (aligned.pixel_from_bearing, bounds.pixels, bounds.radians, aligned.pixels_per_radian)
    trig = (chord(bounds.radians), np.sin(bounds.radians))
    poses, supports = np.empty((MOST_POSES, 5)), np.zeros(MOST_POSES, np.int32)
    masks = np.zeros((MOST_POSES, count), np.bool_)
    known = 0
    for yaw, translation in guesses:
        here = np.empty(5)
        place(yaw, translation, here)
        known = improve(data, np.empty(0, np.int64), here, poses, supports, masks, known)
    watch.begin("pairs", PAIRS_UNTIL)
    pairs, lo, hi = pair_arcs(aligned, bounds.radians, watch)
    watch.begin("bins", BINS_UNTIL)
    watch.expect(4)
    starts, edges = sort_into_bins(pairs, lo, hi, watch.board)
    watch.reach(3)
    bound = degree_bounds(count, starts, edges, watch.board)
    watch.begin("largest_bin_cliques", SCOUT_UNTIL)
    # What chance explains too often to be told apart is looked for last.
    for expected in (LARGEST_NFA, np.inf) if len(edges) < effort_limit else ():
        if nfa(count, int(supports[0]), wrong_rate) > DOUBTFUL:
            floor = least_size(count, wrong_rate, expected) - 1
            known = largest_bin_cliques(data, starts, edges, bound, floor, poses, supports, masks, known, watch.board)
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
        known, most, work = _certify_bin(
            data, limits, trig, nodes, rows, span, poses, supports, masks, known, watch.board
        )
        effort += work
        bound[b] = min(bound[b], most)
        if bound[b] <= supports[0]:
            continue
        left = effort_limit - effort
        known, most, found, work, exact = sweep_bin(
            data, limits, trig, pairs, lo, hi, nodes, rows, span, poses, supports, masks, known, left, watch.board
        )
        effort += work
        finished = finished and exact
        bound[b] = min(bound[b], most)
        clique = found if len(found) > len(clique) else clique
    watch.check()
    # A bin that was left out explains no more than the best pose.
    if len(clique) <= supports[0]:
        clique = np.flatnonzero(masks[0])
    return ExactConsensus(
        poses=_as_matrices(poses[:known]),
        supports=supports[:known],
        mask=masks[0],
        bound=np.maximum(bound, 1),  # a camera can always be where it sees one point
        clique=clique.astype(np.int32),
        arcs=len(pairs),
        effort=effort,
        finished=finished,
    )


def _certify_bin(data, limits, trig, nodes, rows, span, poses, supports, masks, known, board) -> tuple[int, int, int]:
    """Bound a bin without walking its arcs: by colours, and by proof where few nodes more than the best support are
    left.

    The arguments are those of ``sweep_bin``. Returns how many poses are known, the bound, and the effort.
    """
    best, effort = int(supports[0]), rows.size
    most = min(len(nodes), colour_bound(rows)) if len(nodes) > best else best
    if most > best and len(nodes) - best <= MOST_SPARE:
        view = view_between(data, *span)
        balls = apart_balls(view, trig, nodes, len(nodes) - best)
        known, proven, work = certify(data, limits, view, nodes, balls, poses, supports, masks, known, board)
        effort += work
        most = 0 if proven else most
    return int(known), int(max(most, supports[0])), int(effort)


def _as_matrices(poses: FloatArray) -> FloatArray:
    """Level poses (C, 5) as (C, 3, 4)."""
    matrices = np.zeros((len(poses), 3, 4))
    for here, matrix in zip(poses, matrices, strict=True):
        matrix[:, :3] = yaw_rotation(np.arctan2(here[1], here[0]))
        translation_of(here, matrix[:, 3])
    return matrices
