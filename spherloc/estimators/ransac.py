"""2P-RANSAC, the paper's Algorithm 1: sample two correspondences, solve, count inliers, keep the best, refine."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds
from spherloc.consensus.inliers import count_inliers
from spherloc.errors import InputError
from spherloc.estimators.base import Clock, Outcome, check_positive
from spherloc.geometry import pose, yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, refine, residuals_px
from spherloc.solvers.two_point import solve_pair
from spherloc.trace import RansacStage

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RansacOptions(RefinementOptions):
    """Options of 2P-RANSAC."""

    bound_px: float = 8.0
    """Reprojection error up to which a correspondence is an inlier, px (8, as OpenCV's default and the paper's)."""
    iterations: int = 1000
    """Samples drawn; with a confidence, the most that are drawn."""
    confidence: float | None = None
    """Stop as soon as Eq. 28 gives this probability of having drawn two inliers; None draws all samples."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self)
        if self.iterations != int(self.iterations) or self.iterations > 10_000_000:
            raise InputError(f"option iterations is {self.iterations}; give a whole number up to 10,000,000.")
        if self.confidence is not None and self.confidence >= 1.0:
            raise InputError(f"option confidence is {self.confidence}; give a probability below 1.")


class TwoPointRansac:
    """Registered as "ransac-2p"."""

    Options = RansacOptions

    @staticmethod
    def run(aligned: AlignedProblem, options: RansacOptions, bounds: Bounds, seed: int, clock: Clock) -> Outcome:
        """Algorithm 1."""
        count = len(aligned.bearings)
        with clock.stage("ransac"):
            samples = draw_pairs(np.random.default_rng(seed), count, int(options.iterations))
            drawn, improved_at, yaws, translations = _search(
                aligned.bearings,
                aligned.points,
                aligned.pixel_from_bearing,
                bounds.pixels,
                samples,
                np.nan if options.confidence is None else options.confidence,
            )
            states = np.array([pose(yaw_rotation(yaw), t) for yaw, t in zip(yaws, translations, strict=True)])
            states = states.reshape(-1, 3, 4)
            masks = np.array([residuals_px(aligned, state) <= bounds.pixels for state in states], dtype=bool)
            stage = RansacStage(
                iterations=drawn,
                improved_at=improved_at,
                samples=aligned.index[samples[improved_at]].astype(np.int32),
                cam_from_map=np.array([aligned.unalign_pose(state) for state in states]).reshape(-1, 3, 4),
                inlier_masks=np.array([aligned.full_mask(mask) for mask in masks]).reshape(-1, aligned.count),
            )
        if len(states) == 0:
            reason = f"No pose: none of {drawn} sampled pairs has a solution in front of the camera."
            return Outcome((stage,), None, np.zeros(count, dtype=bool), reason)
        with clock.stage("refinement"):
            refined, inliers, refinement = refine(aligned, states[-1], bounds, options)
        return Outcome((stage, refinement), refined, inliers)


def draw_pairs(rng: np.random.Generator, count: int, draws: int) -> NDArray[np.int64]:
    """Uniform ordered pairs (draws, 2) of two different numbers below ``count``."""
    pairs = rng.integers(0, [count, count - 1], size=(draws, 2))
    pairs[:, 1] += pairs[:, 1] >= pairs[:, 0]
    return pairs


@numba.njit(cache=True, nogil=True)
def _search(bearings, points, weights, bound_px, samples, confidence):
    """Samples drawn, and iteration, yaw and translation of each hypothesis that beat all before it."""
    count, most = len(points), len(samples)
    improved, best = 0, 0
    at, yaws, translations = np.empty(count + 1, np.int32), np.empty(count + 1), np.empty((count + 1, 3))
    root, position = np.empty(2), np.empty((2, 3))
    drawn, needed = 0, float(most)
    while drawn < most and drawn < needed:
        i, j = samples[drawn]
        for k in range(solve_pair(bearings[i], bearings[j], points[i], points[j], root, position)):
            inliers = count_inliers(root[k], position[k], bearings, points, weights, bound_px)
            if inliers <= best:
                continue
            best = inliers
            at[improved], yaws[improved], translations[improved] = drawn, root[k], position[k]
            improved += 1
            if not np.isnan(confidence):
                rate2 = (inliers / count) ** 2
                needed = np.log(1.0 - confidence) / np.log1p(-rate2) if rate2 < 1.0 else 0.0
        drawn += 1
    return drawn, at[:improved].copy(), yaws[:improved].copy(), translations[:improved].copy()
