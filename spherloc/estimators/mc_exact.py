"""mc-exact: exact consensus over yaw with a certificate. Correspondences are the nodes, not pairs as in ``mc``."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds
from spherloc.consensus.chance import chance_rate, chance_sets
from spherloc.consensus.exact import ExactConsensus, exact_consensus
from spherloc.consensus.two_point_search import TwoPointSearch, search_two_point
from spherloc.errors import InputError
from spherloc.estimators.base import Clock, Outcome, check_positive
from spherloc.geometry import yaw_of
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, refine, residuals_px
from spherloc.trace import Certificate, ConsensusStage

FloatArray = NDArray[np.float64]

MOST_CORRESPONDENCES = 10_000
"""Their 50 million pairs take some 10 s and 3 GB."""
SEED_SAMPLES = 20_000
"""Most samples of the 2P-RANSAC that finds the first lower bound: enough at 1.5 % inliers, and some milliseconds."""
LEAST_SAMPLES = 100
SEED_CONFIDENCE = 0.99
YAW_BINS = 1440


@dataclass(frozen=True)
class McExactOptions(RefinementOptions):
    """Options of mc-exact."""

    bound_px: float = 3.0
    """Bound on the noise of an inlier, px."""
    effort: float = 1.0
    """Share of the usual effort after which the search stops and reports the gap that is left; usual is some tenths of
    a second, and more than all but very dense or repetitive problems need."""
    time_budget_s: float = 60.0
    """Seconds after which it stops too. Runs that do not reach it give the same result on every machine."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self)


EFFORT = 100_000_000
"""Words touched by an ``effort`` of 1."""


class ExactMaximumConsensus:
    """Registered as "mc-exact"."""

    Options = McExactOptions

    @staticmethod
    def run(aligned: AlignedProblem, options: McExactOptions, bounds: Bounds, seed: int, clock: Clock) -> Outcome:
        """Guess by 2P-RANSAC, search all yaws, refine, certify. ``seed`` is that of the RANSAC."""
        count = len(aligned.bearings)
        if count > MOST_CORRESPONDENCES:
            raise InputError(
                f"mc-exact compares all pairs and takes up to {MOST_CORRESPONDENCES:,} correspondences, not {count:,}; "
                "thin them or use ransac-2p."
            )
        samples = max(LEAST_SAMPLES, round(min(1.0, options.effort) * SEED_SAMPLES))
        with clock.stage("guess", until=0.1):
            guess = search_two_point(
                aligned, bounds.pixels, seed, samples, SEED_CONFIDENCE, local_optimization=True, watch=clock.watch
            )
        with clock.stage("consensus"):
            rate = chance_rate(aligned.bearings, bounds.radians)
            found = exact_consensus(
                aligned,
                bounds,
                rate,
                _poses(guess),
                int(options.effort * EFFORT),
                options.time_budget_s,
                clock.watch,
            )
        stage = _stage(aligned, guess, found)
        upper = int(found.bound.max(initial=1))
        if len(found.poses) == 0:
            certificate = Certificate(upper, 1, chance_sets(count, 1, rate))
            reason = "No pose: no pair of correspondences has a solution in front of the camera."
            return Outcome((stage,), None, np.zeros(count, dtype=bool), reason, certificate=certificate)
        with clock.stage("refinement", until=1.0):
            refined, inliers, refinement = refine(aligned, found.poses[0], bounds, options)
        lower = _lower_bound(aligned, bounds, found, refined, refinement.tilt_rad)
        certificate = Certificate(max(upper, lower), lower, chance_sets(count, lower, rate))
        return Outcome((stage, refinement), refined, inliers, certificate=certificate)


def _poses(guess: TwoPointSearch) -> list[tuple[float, FloatArray]]:
    """The best pose of a search, if it found any."""
    if not guess.found:
        return []
    best = int(np.argmax(guess.support))
    return [(float(guess.yaws_rad[best]), guess.translations[best])]


def _lower_bound(
    aligned: AlignedProblem, bounds: Bounds, found: ExactConsensus, refined: FloatArray, tilt_rad: float
) -> int:
    """What a pose within the gravity bound surely explains: the best verified one, or the refined one."""
    lower = np.count_nonzero(residuals_px(aligned, found.poses[0]) <= bounds.noise_px)
    if tilt_rad <= aligned.gravity_bound_rad + 1e-12:
        lower = max(lower, np.count_nonzero(residuals_px(aligned, refined) <= bounds.noise_px))
    return int(lower)


def _stage(aligned: AlignedProblem, guess: TwoPointSearch, found: ExactConsensus) -> ConsensusStage:
    places = aligned.index.astype(np.int32)
    return ConsensusStage(
        arcs=found.arcs,
        seed_support=int(guess.support.max(initial=0)),
        bound=found.bound_over_yaw(YAW_BINS),
        effort=found.effort,
        finished=found.finished,
        yaw_rad=yaw_of(found.poses[0][:, :3]) if len(found.poses) else 0.0,
        clique=places[found.clique],
        cam_from_map=np.array([aligned.unalign_pose(pose) for pose in found.poses]).reshape(-1, 3, 4),
        support=found.supports.astype(np.int32),
    )
