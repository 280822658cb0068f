"""Residuals of the matches at a run's pose, scores of its inliers, and the history of RANSAC."""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np

from spherloc.bounds import Bounds, bounds_of
from spherloc.geometry import transform
from spherloc.metrics import precision_recall_f1
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.trace import RansacStage, Trace
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc_viz.layers.primitives import Table

Unit = Literal["px", "deg"]

BINS_A_DECADE = 6
DECADES: dict[Unit, tuple[int, int]] = {"px": (-1, 3), "deg": (-2, 2)}
"""Powers of ten between which residuals have bins of their own."""


@dataclass(frozen=True, eq=False)
class Histogram:
    """Residuals of N matches in B bins: the first holds all below its upper edge, the last all from its lower edge on,
    and the matches without a residual.
    """

    unit: Unit
    edges: FloatArray
    """(B - 1,) edges between the bins."""
    bin: IntArray
    """(N,) bin of every match."""
    inliers: IntArray
    """(B,) number of the run's inliers."""
    outliers: IntArray
    """(B,) number of its outliers."""
    wrongly_kept: IntArray
    """(B,) how many of the inliers are wrong by the truth; none if that is unknown."""
    wrongly_rejected: IntArray
    """(B,) how many of the outliers are right by the truth; none if that is unknown."""
    bound: tuple[float, float, float]
    """The smallest, the median and the largest bound by which the run's inliers were chosen: one number where the image
    stretches alike and gravity is exact."""
    widened: bool = False
    """Whether these bounds allow for gravity's error, besides the noise."""

    @property
    def right(self) -> IntArray:
        """(B,) number of right matches; the run's inliers where the truth is unknown."""
        return self.inliers - self.wrongly_kept + self.wrongly_rejected

    @property
    def wrong(self) -> IntArray:
        """(B,) number of the others."""
        return self.inliers + self.outliers - self.right


@lru_cache(maxsize=4)
def bin_words(unit: Unit) -> tuple[str, ...]:
    """The range of each bin in words."""
    edges = [f"{float(f'{edge:.2g}'):g}" for edge in edges_of(unit)]
    sign, lost = ("°", "without a bearing") if unit == "deg" else (" px", "more than 90° off")
    inner = (f"{low} to {high}{sign}" for low, high in pairwise(edges))
    return f"less than {edges[0]}{sign}", *inner, f"{edges[-1]}{sign} or more, or {lost}"


def edges_of(unit: Unit) -> FloatArray:
    """The edges (B - 1,) between the bins."""
    low, high = DECADES[unit]
    return 10.0 ** (low + np.arange((high - low) * BINS_A_DECADE + 1) / BINS_A_DECADE)


@dataclass(frozen=True, eq=False)
class Residuals:
    """The matches of a run at its pose."""

    px: FloatArray
    """(N,) reprojection errors, px to first order; inf more than 90 degrees off and where the pixel has no bearing."""
    deg: FloatArray
    """(N,) angles between the bearing and the direction to the point, degrees; inf where there is no bearing."""
    histograms: tuple[Histogram, Histogram]
    """The histograms in px and in degrees."""
    truth_known: bool
    """Whether the truth tells which matches are right."""
    blind: int
    """Number of matches whose pixel has no bearing."""


@dataclass(frozen=True, eq=False)
class BestHistory:
    """The history of RANSAC's best hypothesis, and Eq. 28's prediction."""

    drawn: FloatArray
    """(J,) number of samples drawn until each improvement."""
    inliers: FloatArray
    """(J,) number of inliers of each improvement."""
    iterations: int
    """Number of samples drawn in all."""
    share: float
    """w, the share of inliers of the last hypothesis."""
    size: int
    """n, correspondences in a sample."""
    clean_at: int | None
    """Samples drawn until the first improvement by right matches only; None without one, and without the truth."""

    def probability(self, drawn: FloatArray) -> FloatArray:
        """Probability (K,) by Eq. 28 for numbers of samples (K,): P = 1 - (1 - w^n)^k."""
        if self.share >= 1.0:
            return np.ones_like(drawn)
        return -np.expm1(drawn * np.log1p(-(self.share**self.size)))

    @property
    def half_at(self) -> float:
        """Number of samples within which half of all runs draw a clean one."""
        if self.share >= 1.0:
            return 1.0
        return float(np.log(0.5) / np.log1p(-(self.share**self.size))) if self.share > 0.0 else np.inf


def residuals_of(trace: Trace) -> Residuals | None:
    """The residuals of a run; None if it found no pose."""
    if trace.cam_from_map is None:
        return None
    aligned, problem = trace.problem.aligned, trace.problem
    px, deg = np.full(len(problem), np.inf), np.full(len(problem), np.inf)
    px[aligned.index] = residuals_px(aligned, aligned.align_pose(trace.cam_from_map))
    deg[aligned.index] = _angles_deg(problem.bearings, transform(trace.cam_from_map, problem.points))[aligned.index]
    kept, right = trace.inlier_mask, problem.truth_inliers
    bounds = run_bounds(trace)
    limits_px = verdicts(trace).limit_px[aligned.index]
    # Both bounds are this wide, or neither: gravity's error is added to the noise in px and in radians.
    widened = bool(np.any(limits_px > bounds.noise_px))
    level = replace(aligned, gravity_bound_rad=0.0)
    limits_rad = bounds.radians if widened else bounds_of(level, bounds.noise_px).radians
    histograms = (
        histogram("px", px, (kept, right), _middle(limits_px), widened),
        histogram("deg", deg, (kept, right), _middle(np.degrees(limits_rad)), widened),
    )
    return Residuals(px, deg, histograms, right is not None, int(np.count_nonzero(~problem.usable)))


def _middle(values: FloatArray) -> tuple[float, float, float]:
    """Smallest, median and largest of some values."""
    ordered = np.sort(values)
    return float(ordered[0]), float(ordered[len(ordered) // 2]), float(ordered[-1])


def _angles_deg(bearings: FloatArray, points: FloatArray) -> FloatArray:
    """Angles (N,) between unit bearings (N, 3) and the directions to points (N, 3), accurate near 0 and 180."""
    directions = points / np.sqrt(np.einsum("ni,ni->n", points, points))[:, None]
    apart, along = bearings - directions, bearings + directions
    squares = np.einsum("ni,ni->n", apart, apart), np.einsum("ni,ni->n", along, along)
    return np.degrees(2.0 * np.arctan2(np.sqrt(squares[0]), np.sqrt(squares[1])))


def histogram(
    unit: Unit,
    values: FloatArray,
    judged: tuple[BoolArray, BoolArray | None],
    bound: tuple[float, float, float],
    widened: bool = False,
) -> Histogram:
    """Histogram of values (N,) of 0 or more, in bins of equal ratios; values that are not finite are in the last bin.

    ``judged`` are masks (N,) of the run's inliers and of the right matches, this one None if they are unknown.
    """
    edges = edges_of(unit)
    place = np.searchsorted(edges, np.nan_to_num(values, nan=np.inf), "right").astype(np.int64)
    kept, right = judged[0], judged[0] if judged[1] is None else judged[1]

    def count(some: BoolArray) -> IntArray:
        return np.bincount(place[some], minlength=len(edges) + 1)

    return Histogram(
        unit, edges, place, count(kept), count(~kept), count(kept & ~right), count(~kept & right), bound, widened
    )


def scores_table(trace: Trace) -> Table:
    """Table of precision, recall and F1 with their counts, or of the counts that are known without the truth."""
    truth, reported = trace.problem.truth_inliers, trace.inlier_mask
    found = int(np.count_nonzero(reported))
    if truth is None:
        return Table("scores", ("", "matches", ""), (("reported inliers", f"{found:,} of {len(reported):,}", ""),))
    hits, all_right = int(np.count_nonzero(truth & reported)), int(np.count_nonzero(truth))
    precision, recall, f1 = (f"{100.0 * value:.1f} %" for value in precision_recall_f1(truth, reported))
    rows = (
        ("precision", f"{hits:,} right of {found:,} reported", precision),
        ("recall", f"{hits:,} reported of {all_right:,} right", recall),
        ("F1", f"2 × {hits:,} of {found + all_right:,}", f1),
    )
    return Table("scores", ("", "matches", ""), rows)


def history_of(trace: Trace) -> BestHistory | None:
    """The history of a RANSAC run; None for other runs and if no sample gave a pose."""
    stage = trace.stage(RansacStage)
    if stage is None or not len(stage.improved_at):
        return None
    inliers = np.count_nonzero(stage.inlier_masks, axis=1).astype(np.float64)
    drawn, truth = stage.improved_at.astype(np.float64) + 1.0, trace.problem.truth_inliers
    clean = np.zeros(0, dtype=np.int64) if truth is None else np.flatnonzero(truth[stage.samples].all(axis=1))
    share = float(inliers[-1]) / len(trace.problem)
    at = int(drawn[clean[0]]) if len(clean) else None
    return BestHistory(drawn, inliers, max(1, stage.iterations), share, stage.samples.shape[1], at)


@dataclass(frozen=True, eq=False)
class MatchResiduals:
    """Residuals of N correspondences at one pose; NaN where the pixel has no bearing."""

    px: FloatArray
    """(N,) reprojection error to first order; inf more than 90 degrees from the bearing."""
    rad: FloatArray
    """(N,) angle between the bearing and the ray to the point."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Judgement of the N correspondences of a run, by the run and by the truth."""

    kept: BoolArray
    """(N,) whether the run calls it an inlier."""
    right: BoolArray | None
    """(N,) whether it is a true inlier: by its label, else by its bound at the true pose; None if neither is known."""
    limit_px: FloatArray
    """(N,) the bound on its residual at the run's pose, px: with an estimated tilt the noise bound, else that and what
    gravity's error adds; NaN where the pixel has no bearing."""
    estimate: MatchResiduals | None
    """Residuals at the run's pose; None without a pose."""
    truth: MatchResiduals | None
    """Residuals at the true pose; None if it is unknown."""


def residuals_at(problem: Problem, cam_from_map: FloatArray) -> MatchResiduals:
    """Residuals of every correspondence at a pose (3, 4) between the problem's own frames."""
    aligned = problem.aligned
    posed = aligned.align_pose(cam_from_map)
    px, rad = np.full(len(problem), np.nan), np.full(len(problem), np.nan)
    px[aligned.index] = residuals_px(aligned, posed)
    rays = transform(posed, aligned.points)
    sine: FloatArray = np.linalg.norm(np.cross(aligned.bearings, rays), axis=1)
    rad[aligned.index] = np.arctan2(sine, np.einsum("ni,ni->n", aligned.bearings, rays))
    return MatchResiduals(px, rad)


def run_bounds(trace: Trace) -> Bounds:
    """The bounds that the run used, for its M usable correspondences."""
    return bounds_of(trace.problem.aligned, float(trace.options.bound_px))


@lru_cache(maxsize=8)
def verdicts(trace: Trace) -> Verdicts:
    """Judgement of every correspondence of a run (cached)."""
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


def _limits(trace: Trace, estimate: MatchResiduals | None, wide: FloatArray, tight: FloatArray) -> FloatArray:
    """The bound by which the run's inliers were chosen, which depends on whether it estimated the tilt."""
    if estimate is None:
        return wide
    misses = [np.count_nonzero((estimate.px <= limit) != trace.inlier_mask) for limit in (tight, wide)]
    return tight if misses[0] <= misses[1] else wide
