"""2P-RANSAC, the paper's Algorithm 1: sample two correspondences, solve, count inliers, keep the best, refine."""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from spherloc.bounds import Bounds
from spherloc.consensus.inliers import mark_each
from spherloc.consensus.two_point_search import Scoring, TwoPointSearch, search_two_point
from spherloc.errors import InputError, show
from spherloc.estimators.base import Clock, Estimate, check_positive, check_sampling, check_switches
from spherloc.geometry import level_poses
from spherloc.last_step import conclude, conclude_as_printed
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions
from spherloc.trace import RansacStage

MAX_ITERATIONS = 100_000_000


@dataclass(frozen=True)
class RansacOptions(RefinementOptions):
    """Options of 2P-RANSAC. The defaults search as the paper does, and end with this project's own last step."""

    bound_px: float = 8.0
    """Reprojection error up to which a correspondence is an inlier, px (8, as OpenCV's default and the paper's)."""
    iterations: int = 1000
    """Samples drawn; with a confidence, the most that are drawn: 99.9 % take 690 of them at 90 % outliers, 2,760 at
    95 %, 69,000 at 99 %."""
    confidence: float | None = None
    """Stop as soon as Eq. 28 gives this probability of having drawn two inliers; without it all samples are drawn."""
    scoring: Scoring = "count"
    """What makes a hypothesis the best: "count", the most inliers; "msac", the least squared error, where an outlier
    costs the squared bound."""
    local_optimization: bool = False
    """Fit yaw and position to the inliers of each improvement, which frees it from the noise of its two samples."""

    as_printed: bool = False
    """Do what the paper prints, with none of what this estimator adds: the last step is one least-squares fit in 6 DoF
    to the inliers of the best sample, which does not use gravity (Algorithm 1, line 16)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self)
        check_sampling(self, MAX_ITERATIONS)
        if self.scoring not in get_args(Scoring):
            raise InputError(f"option scoring is {show(self.scoring)}; give one of {', '.join(get_args(Scoring))}.")
        check_switches(self)


class TwoPointRansac:
    """Registered as "ransac-2p"."""

    Options = RansacOptions

    @staticmethod
    def run(aligned: AlignedProblem, options: RansacOptions, bounds: Bounds, seed: int, clock: Clock) -> Estimate:
        """Algorithm 1."""
        with clock.stage("ransac", until=0.99):
            search = search_two_point(
                aligned,
                bounds.pixels,
                seed,
                int(options.iterations),
                options.confidence,
                options.scoring,
                options.local_optimization,
                clock.watch,
            )
            stage = _stage(aligned, bounds, search)
        if not search.found:
            reason = f"No pose: none of {search.drawn} sampled pairs has a solution in front of the camera."
            return Estimate((stage,), None, np.zeros(len(aligned.bearings), dtype=bool), reason)
        with clock.stage("refinement", until=1.0):
            (start,) = level_poses(search.yaws_rad[-1:], search.translations[-1:])
            if options.as_printed:
                members = stage.inlier_masks[-1][aligned.index]
                refined, inliers, refinement = conclude_as_printed(aligned, start, members, bounds, options)
            else:
                refined, inliers, refinement = conclude(aligned, [start], bounds, options)
        return Estimate((stage, refinement), refined, inliers)


def _stage(aligned: AlignedProblem, bounds: Bounds, search: TwoPointSearch) -> RansacStage:
    """The record of a search, in the problem's own frames and numbers."""
    masks = np.zeros((len(search.yaws_rad), aligned.count), dtype=bool)
    masks[:, aligned.index] = mark_each(
        search.yaws_rad,
        search.translations,
        aligned.bearings,
        aligned.points,
        aligned.pixel_from_bearing,
        bounds.pixels,
    )
    return RansacStage(
        iterations=search.drawn,
        confidence_reached=search.confidence_reached,
        improved_at=search.improved_at,
        samples=aligned.index.astype(np.int32)[search.samples],
        cam_from_map=aligned.unalign_poses(level_poses(search.yaws_rad, search.translations)),
        inlier_masks=masks,
        locally_optimized=search.locally_optimized,
    )
