"""MC, the paper's Algorithm 2: yaw arcs of all pairs, the yaw most of them share, translation balls at that yaw, their
maximum clique, refinement. Deterministic: no random draw.
"""

from dataclasses import dataclass

import numpy as np

from spherloc.bounds import Bounds
from spherloc.consensus.inliers import BLOCK, ROWS, count_inliers, pack_blocks, reaches
from spherloc.consensus.max_clique import EFFORT_LIMIT, max_clique
from spherloc.consensus.translation_balls import edges_of, overlapping, share_of_each, spread_balls
from spherloc.consensus.yaw_arcs import FULL, YawConsensus, deepest_yaw, yaw_arcs
from spherloc.errors import InputError
from spherloc.estimators.base import Clock, Estimate, check_positive, check_switches
from spherloc.gauss_newton import AlignedMatches
from spherloc.geometry import pose, yaw_rotation
from spherloc.kernel_cache import kernel
from spherloc.last_step import conclude, conclude_as_printed
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, residuals_px
from spherloc.solvers.two_point import two_point
from spherloc.trace import Stage, TranslationStage, YawStage
from spherloc.types import FloatArray, IndexArray
from spherloc.watch import SELDOM, Watch, stopped

WIDEST_RAD = np.radians(60.0)
"""A pair that leaves more than a sixth of the circle open says too little about yaw; wide arcs are mostly outliers'
and only raise the count everywhere. At 90 % outliers this turns 95 % success into 99 % (MEI) and costs nothing."""


MAX_PRINTED_BALLS = 5_000
"""Balls of Algorithm 2 as printed, whose 12 million edges take 100 MB: enough for all pairs of 100 matches. Of more
pairs in the rotation clique those with the smallest balls are taken, where the paper says nothing."""
PRINTED_EFFORT = 10 * EFFORT_LIMIT
"""Of their maximum clique: about 2 s."""
MAX_CORRESPONDENCES = 10_000
"""Their 50 million pairs take about a minute and 5 GB."""


@dataclass(frozen=True)
class McOptions(RefinementOptions):
    """Options of MC."""

    bound_px: float = 3.0
    """Bound on the noise of an inlier, px. Arcs and balls grow with it, so it is tighter than RANSAC's."""
    max_balls: int = 500
    """Pairs of the rotation clique that become balls, if there are more: the smallest, and of each correspondence no
    more than its share."""
    as_printed: bool = False
    """Do what the paper prints, with none of what this estimator adds: arcs of any width, a ball for each pair in
    the rotation clique, the exact maximum clique, and one least-squares fit in 6 DoF to what its pose explains
    (Algorithm 2). The paper's bound is 8 px."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self)
        if self.max_balls != int(self.max_balls) or self.max_balls > 2000:
            raise InputError(f"option max_balls is {self.max_balls}; give a whole number up to 2000.")
        check_switches(self)


class MaximumConsensus:
    """Registered as "mc"."""

    Options = McOptions

    @staticmethod
    def run(aligned: AlignedProblem, options: McOptions, bounds: Bounds, seed: int, clock: Clock) -> Estimate:
        """Algorithm 2; ``seed`` is not used."""
        count = len(aligned.bearings)
        if count > MAX_CORRESPONDENCES:
            raise InputError(
                f"mc compares all pairs and takes up to {MAX_CORRESPONDENCES:,} correspondences, not {count:,}; "
                "thin them or use ransac-2p."
            )
        nobody = np.zeros(count, dtype=bool)
        with clock.stage("yaw", until=0.75):
            widest_rad = FULL if options.as_printed else WIDEST_RAD
            pairs, lo, hi = yaw_arcs(aligned, bounds.radians, widest_rad, clock.watch)
            clock.watch.begin("sweep", until=0.9)
            consensus = deepest_yaw(lo, hi, clock.watch)
        if consensus is None:
            enough = "" if options.as_printed else " to within 60 degrees"
            reason = f"No pose: none of {count * (count - 1) // 2} pairs fixes the yaw{enough}."
            return Estimate((), None, nobody, reason)
        yaw = _yaw_stage(aligned, options, pairs, lo, hi, consensus, clock.watch)
        with clock.stage("translation", until=0.99):
            translation, start = _locate(aligned, options, bounds, pairs, lo, hi, consensus, clock.watch)
        if translation is None or start is None:
            reason = "No pose: no pair in the rotation clique bounds the camera's position."
            return Estimate((yaw,), None, nobody, reason)
        with clock.stage("refinement", until=1.0):
            if options.as_printed:
                members = residuals_px(aligned, start) <= bounds.pixels
                refined, inliers, refinement = conclude_as_printed(aligned, start, members, bounds, options)
            else:
                refined, inliers, refinement = conclude(aligned, [start], bounds, options)
        stages: tuple[Stage, ...] = (yaw, translation, refinement)
        return Estimate(stages, refined, inliers)


def _yaw_stage(
    aligned: AlignedProblem,
    options: McOptions,
    pairs: IndexArray,
    lo: FloatArray,
    hi: FloatArray,
    consensus: YawConsensus,
    watch: Watch,
) -> YawStage:
    count = len(aligned.bearings)
    named = np.empty_like(pairs)
    _rename(pairs, aligned.index, named, watch.board)
    watch.check()
    return YawStage(
        pairs_total=count * (count - 1) // 2,
        rule="" if options.as_printed else "Arcs wider than 60° say too little and are left out.",
        pairs=named,
        lo_rad=lo,
        hi_rad=hi,
        overlap=consensus.overlap,
        best_rad=consensus.interval_rad,
        yaw_rad=consensus.yaw_rad,
        clique=consensus.clique,
    )


@kernel()
def _rename(pairs, index, named, board):
    """Write ``pairs`` (A, 2) of usable matches to ``named`` (A, 2) by their numbers in the problem, ``index`` (M,).

    A watch's ``board`` can end it.
    """
    for k in range(len(pairs)):
        if k & SELDOM == 0 and stopped(board):
            break
        named[k, 0], named[k, 1] = index[pairs[k, 0]], index[pairs[k, 1]]


def _locate(
    aligned: AlignedProblem,
    options: McOptions,
    bounds: Bounds,
    pairs: IndexArray,
    lo: FloatArray,
    hi: FloatArray,
    consensus: YawConsensus,
    watch: Watch,
) -> tuple[TranslationStage | None, FloatArray | None]:
    """Balls of the rotation clique, their maximum clique, and the aligned pose (3, 4) that it proposes."""
    yaw, arcs = consensus.yaw_rad, consensus.clique
    most, share = int(options.max_balls), share_of_each(len(aligned.bearings), int(options.max_balls))
    if options.as_printed:
        most = share = min(len(arcs), MAX_PRINTED_BALLS)
    covering = (pairs, lo, hi), arcs, yaw
    pairs, centres, radii, bounded = spread_balls(aligned, bounds.radians, *covering, most, share, watch)
    if len(pairs) == 0:
        return None, None
    overlap = overlapping(centres, radii)
    clique = max_clique(overlap, PRINTED_EFFORT if options.as_printed else EFFORT_LIMIT, watch)
    members = pairs[clique.nodes], yaw, centres[clique.nodes], radii[clique.nodes]
    start = _mean_start(*members[1:]) if options.as_printed else _best_start(aligned, bounds, *members)
    stage = TranslationStage(
        candidates=len(arcs),
        rule=_rule(len(pairs), bounded, len(arcs), share),
        pairs=aligned.index.astype(np.int32)[pairs],
        centres_m=centres,
        radii_m=radii,
        edges=edges_of(overlap),
        clique=clique.nodes,
        proven=clique.proven,
        cam_from_map=aligned.unalign_pose(start),
    )
    return stage, start


def _mean_start(yaw: float, centres: FloatArray, radii: FloatArray) -> FloatArray:
    """The aligned pose (3, 4) of a yaw and the mean of the clique's balls, weighted by radius^-2."""
    weights, rotation = radii**-2.0, yaw_rotation(yaw)
    return pose(rotation, -rotation @ (weights @ centres / weights.sum()))


def _best_start(
    aligned: AlignedProblem, bounds: Bounds, pairs: IndexArray, yaw: float, centres: FloatArray, radii: FloatArray
) -> FloatArray:
    """The aligned pose (3, 4) that explains most correspondences, among those which the clique proposes.

    These are its own yaw with the mean of its balls, weighted by radius^-2, and the 2P poses of its pairs: the yaw is
    only as sharp as the widest arcs allow, while some pair of the clique is sharper.
    """
    mean = _mean_start(yaw, centres, radii)
    yaws, translations, exists = two_point(aligned.bearings[pairs], aligned.points[pairs])
    yaws, translations = np.append(yaw, yaws[exists]), np.vstack([mean[:, 3], translations[exists]])
    matches = AlignedMatches(aligned.bearings, aligned.points, aligned.pixel_from_bearing)
    best = _most_inliers(yaws, translations, matches, bounds.pixels)
    return pose(yaw_rotation(float(yaws[best])), translations[best])


@kernel()
def _most_inliers(yaws, translations, matches, bound_px):
    """Index of the level pose that explains most correspondences, the first of equals.

    ``yaws`` (J,), rad, ``translations`` (J, 3), m, ``matches`` are ``gauss_newton.AlignedMatches``, ``bound_px`` (M,).
    """
    count = len(matches.points)
    blocks = pack_blocks(matches, bound_px, np.arange(count))
    left = np.maximum(count - BLOCK * np.arange(1, len(blocks) // (ROWS * BLOCK) + 1), 0)
    best, most = 0, -1
    for k in range(len(yaws)):
        if reaches(yaws[k], translations[k], blocks, most + 1 - left):
            inliers = count_inliers(yaws[k], translations[k], matches, bound_px)
            if inliers > most:
                best, most = k, inliers
    return best


def _rule(kept: int, bounded: int, candidates: int, share: int) -> str:
    if kept == candidates:
        return f"All {candidates:,} pairs of the rotation clique."
    if kept == bounded:
        return f"The {kept:,} of {candidates:,} pairs in the rotation clique that bound a position."
    if share >= kept:
        return f"The {kept:,} smallest balls of the {candidates:,} pairs in the rotation clique."
    each = "once" if share == 1 else f"at most {share} times"
    return f"The {kept:,} smallest balls of the {candidates:,} pairs in the rotation clique, each match used {each}."
