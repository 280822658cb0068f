"""Exact consensus: the largest set of correspondences that any level pose could explain, bounded over all yaws.

At a yaw, let the graph have an edge where an arc of the pair covers it (``pair_arcs``). What any pose with that yaw
explains is a clique, so the largest clique over all yaws bounds every consensus from above. Bins of yaw whose cheap
bound does not exceed the best verified support cannot hold a better pose and are never searched; the others are, most
promising first.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds
from spherloc.consensus.chance import chance_sets
from spherloc.consensus.clique_sweep import sweep_bin
from spherloc.consensus.depth_bounds import chord
from spherloc.consensus.pair_arcs import pair_arcs, turn_of
from spherloc.consensus.scout import scout
from spherloc.consensus.support import climb, keep
from spherloc.consensus.yaw_bins import BIN_TURN, BINS, degree_bounds, sort_into_bins
from spherloc.problem import AlignedProblem

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.int32]

DOUBTFUL = 1e-6
"""Expected number of chance sets of the size of the guess above which better guesses are looked for."""
MOST_POSES = 8
"""Clearly different poses that are remembered."""


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
        """``bound`` (bins,) by yaw, from -pi upwards in equal steps."""
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
    noise_px: float,
    wrong_rate: float,
    guesses: list[tuple[FloatArray, FloatArray]],
    effort_limit: int,
    time_budget_s: float,
) -> ExactConsensus:
    """Search all yaws.

    ``wrong_rate`` is the probability that a wrong pose explains a correspondence. ``guesses`` are level poses (rotation (3, 3), translation (3,)) to start from: the more the best of them explains,
    the less is left to be searched. After ``effort_limit`` words or ``time_budget_s`` seconds the search stops, and the
    bounds say how far it came.
    """
    deadline = time.perf_counter() + time_budget_s
    count = len(aligned.bearings)
    # Rounding must not exclude what the pixel bound allows.
    least_cos = np.cos(np.minimum(bounds.radians + 1e-9, np.pi / 2))
    data = (aligned.bearings, aligned.points, aligned.pixel_from_bearing, bounds.pixels, least_cos, noise_px)
    limits = (aligned.pixel_from_bearing, bounds.pixels, bounds.radians, aligned.pixels_per_radian)
    trig = (chord(bounds.radians), np.sin(bounds.radians))
    poses, supports = np.empty((MOST_POSES, 3, 4)), np.zeros(MOST_POSES, np.int32)
    masks = np.zeros((MOST_POSES, count), np.bool_)
    known = 0
    for rotation, translation in guesses:
        mask = np.empty(count, np.bool_)
        support = climb(data, rotation, translation, mask)
        known = keep(rotation, translation, support, mask, poses, supports, masks, known)
    pairs, lo, hi = pair_arcs(aligned, bounds.radians)
    starts, arcs = sort_into_bins(lo, hi)
    bound = degree_bounds(count, pairs, starts, arcs)
    if chance_sets(count, int(supports[0]), wrong_rate) > DOUBTFUL:
        known = scout(data, pairs, starts, arcs, bound, poses, supports, masks, known)
    effort, finished = len(arcs), True
    clique = np.empty(0, np.int64)
    for b in np.argsort(-bound, kind="stable"):
        if bound[b] <= supports[0]:
            break
        if effort >= effort_limit or time.perf_counter() >= deadline:
            finished = False
            break
        inside = arcs[starts[b] : starts[b + 1]]
        edges = (b * BIN_TURN, (b + 1) * BIN_TURN)
        known, most, found, work, exact = sweep_bin(
            data, limits, trig, pairs, lo, hi, inside, *edges, poses, supports, masks, known, effort_limit - effort
        )
        effort += work
        finished = finished and exact
        bound[b] = min(bound[b], most)
        clique = found if len(found) > len(clique) else clique
    # A bin that was left out explains no more than the best pose.
    if len(clique) <= supports[0]:
        clique = np.flatnonzero(masks[0])
    return ExactConsensus(
        poses=poses[:known],
        supports=supports[:known],
        mask=masks[0],
        bound=bound,
        clique=clique.astype(np.int32),
        arcs=len(pairs),
        effort=effort,
        finished=finished,
    )
