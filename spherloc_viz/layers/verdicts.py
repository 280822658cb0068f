"""What a run and the truth say about each correspondence: kept or not, right or wrong, and how far off."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from spherloc.bounds import Bounds, bounds_of
from spherloc.geometry import transform
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.trace import Trace
from spherloc.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Residuals:
    """How far every correspondence is off at one pose. N correspondences; NaN where the pixel has no bearing."""

    px: FloatArray
    """(N,) reprojection error to first order; inf more than 90 degrees from the bearing."""
    rad: FloatArray
    """(N,) angle between the bearing and the ray to the point."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Every correspondence of a run, by the run and by the truth. N of them."""

    kept: BoolArray
    """(N,) the run calls it an inlier."""
    right: BoolArray | None
    """(N,) it is truly an inlier: by its label, else within its bound at the true pose; None if neither is known."""
    limit_px: FloatArray
    """(N,) the bound on its residual at the run's pose, px: with an estimated tilt the noise bound, else that and what
    gravity's error adds; NaN where the pixel has no bearing."""
    estimate: Residuals | None
    """At the run's pose."""
    truth: Residuals | None
    """At the true pose."""


def residuals_at(problem: Problem, cam_from_map: FloatArray) -> Residuals:
    """How far every correspondence is off at a pose (3, 4) of the problem's own frames."""
    aligned = problem.aligned
    posed = aligned.align_pose(cam_from_map)
    px, rad = np.full(len(problem), np.nan), np.full(len(problem), np.nan)
    px[aligned.index] = residuals_px(aligned, posed)
    rays = transform(posed, aligned.points)
    sine: FloatArray = np.linalg.norm(np.cross(aligned.bearings, rays), axis=1)
    rad[aligned.index] = np.arctan2(sine, np.einsum("ni,ni->n", aligned.bearings, rays))
    return Residuals(px, rad)


def run_bounds(trace: Trace) -> Bounds:
    """The bounds that the run's bearings had, (M,) usable correspondences."""
    return bounds_of(trace.problem.aligned, float(trace.options.bound_px))


@lru_cache(maxsize=8)
def verdicts(trace: Trace) -> Verdicts:
    """What is known of every correspondence of a run (cached)."""
    problem, bounds = trace.problem, run_bounds(trace)
    estimate = None if trace.cam_from_map is None else residuals_at(problem, trace.cam_from_map)
    known = problem.truth_cam_from_map
    truth = None if known is None else residuals_at(problem, known)
    wide, tight = np.full(len(problem), np.nan), np.full(len(problem), np.nan)
    wide[problem.aligned.index], tight[problem.aligned.index] = bounds.pixels, bounds.noise_px
    right = problem.truth_inliers
    if right is None and truth is not None:
        right = truth.px <= wide
    return Verdicts(trace.inlier_mask, right, _limits(trace, estimate, wide, tight), estimate, truth)


def _limits(trace: Trace, estimate: Residuals | None, wide: FloatArray, tight: FloatArray) -> FloatArray:
    """The bound by which the run's inliers were chosen, which depends on whether it estimated the tilt."""
    if estimate is None:
        return wide
    misses = [np.count_nonzero((estimate.px <= limit) != trace.inlier_mask) for limit in (tight, wide)]
    return tight if misses[0] <= misses[1] else wide
