"""Judges a run without the truth: localized, doubtful or failed, by one rule.

A pose is believed if its inliers are more than chance explains, if no clearly different pose is supported about as well
and no pose with another gravity much better, if they fix it to within the errors of a success, if no clearly different
pose, found without those on which it depends most, fits all matches about as well, and if they do not lie on one thing
in a panorama while nothing else in it agrees. Each condition has a margin, which is 0 at its
limit; the smallest margin is the run's score.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from spherloc.bounds import bounds_of
from spherloc.consensus.chance import chance_rate, expected_text
from spherloc.consensus.inliers import mark_each
from spherloc.consensus.spread import spread_in
from spherloc.consensus.two_point_search import search_two_point
from spherloc.diagnosis.evidence import MIN_SDS, STRONG, agreeing, different, sd_of
from spherloc.diagnosis.rival import rival_of
from spherloc.free_gravity import MAX_NFA, MIN_LEAD, count_distinct, expected_by_chance, lead, nearby_support
from spherloc.gauss_newton import MIN_GRAVITY_SD_RAD
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M, extent_of, is_beyond
from spherloc.problem import AlignedProblem
from spherloc.refine import gravity_sd_rad, residuals_px
from spherloc.trace import ConsensusStage, RefinementStage, Trace
from spherloc.types import BoolArray, FloatArray

SAMPLES, CONFIDENCE = 2000, 0.99
"""Samples and confidence of the search for an alternative pose among the matches that the pose does not explain."""
FAR = 3.0
"""A correspondence whose residual exceeds this many bounds is used in that search."""


class Outcome(StrEnum):
    """The outcome of a run."""

    LOCALIZED = "localized"
    """The pose is believed."""
    DOUBTFUL = "doubtful"
    """There is a pose, but chance, an alternative pose, another gravity, its covariance or where its inliers lie speaks
    against it."""
    FAILED = "failed"
    """There is no pose."""


def count_within_noise(trace: Trace) -> int:
    """How many inliers are within the bound on the noise at the reported pose.

    Fewer than the inliers where these were counted at a bound that allows for the error of gravity too.
    """
    if trace.cam_from_map is None:
        return 0
    aligned = trace.problem.aligned
    errors = residuals_px(aligned, aligned.align_pose(trace.cam_from_map))
    return int(np.count_nonzero(trace.inlier_mask & aligned.full_mask(errors <= float(trace.options.bound_px))))


@dataclass(frozen=True)
class Judgement:
    """An outcome with its score and its reasons."""

    outcome: Outcome
    """The outcome of the run."""
    score: float
    """The least margin; a pose is believed from 0 on; -inf without a pose."""
    reasons: tuple[str, ...]
    """Sentences: what speaks against the pose, or why there is none; empty if it is believed."""


def judge(trace: Trace) -> Judgement:
    """Judge a run by its pose, its inliers and their covariance: some milliseconds, once for a trace."""
    known = _JUDGED.get(trace)
    if known is None:
        known = _JUDGED[trace] = _judge(trace)
    return known


def known_judgement(trace: Trace) -> Judgement | None:
    """The judgement of a run if it was judged before; else None."""
    return _JUDGED.get(trace)


_JUDGED: WeakKeyDictionary[Trace, Judgement] = WeakKeyDictionary()


def _judge(trace: Trace) -> Judgement:
    if trace.cam_from_map is None:
        return Judgement(Outcome.FAILED, -np.inf, (trace.message,))
    aligned, bound_px = trace.problem.aligned, float(trace.options.bound_px)
    state, bounds = aligned.align_pose(trace.cam_from_map), bounds_of(aligned, bound_px)
    stage = trace.stage(RefinementStage)
    errors = residuals_px(aligned, state)
    inliers, fixed_by = agreeing(trace, errors), 3 if stage is not None and stage.dof == 6 else 2
    size, rate = count_distinct(aligned, inliers), chance_rate(aligned.bearings, np.minimum(bounds.radians, np.pi / 2))
    if fixed_by == 3:
        rate = chance_rate(aligned.bearings, bounds_of(replace(aligned, gravity_bound_rad=0.0), bound_px).radians)
    found = [
        _chance_margin(len(aligned.points), size, rate, fixed_by),
        _alternative_margin(trace, aligned, state, errors, size, rate, fixed_by),
        _gravity_margin(aligned, state, errors, inliers, trace.options),
        _error_margin(trace, aligned, state, inliers),
        _spread_margin(trace, inliers),
        _rival_margin(trace, aligned, state, inliers),
    ]
    score = min(margin for margin, _ in found)
    reasons = tuple(reason for margin, reason in found if margin < 0.0)
    return Judgement(Outcome.DOUBTFUL if reasons else Outcome.LOCALIZED, float(score), reasons)


def _chance_margin(count: int, size: int, rate: float, fixed_by: int) -> tuple[float, str]:
    expected = max(expected_by_chance(count, size, rate, fixed_by), 1e-300)
    margin = np.log10(MAX_NFA) - np.log10(min(expected, 1e300))
    if size <= fixed_by:
        return margin, f"Only {size} different matches agree with it; any {fixed_by} fix a pose, wrong ones too."
    many = f"{expected_text(expected)}{' of' if expected >= 1e6 else ''} such sets"
    return margin, f"Only {size} different matches agree with it; {many} are expected by chance."


def _alternative_margin(
    trace: Trace, aligned: AlignedProblem, state: FloatArray, errors: FloatArray, size: int, rate: float, fixed_by: int
) -> tuple[float, str]:
    """Margin over the best clearly different pose that chance does not explain: it must be clearly smaller, and less
    than the share ``STRONG``, with which a diagnosis says that either pose may be false."""
    bound_px, most = float(trace.options.bound_px), 0
    poses = (
        [] if (stage := trace.stage(ConsensusStage)) is None else [aligned.align_pose(p) for p in stage.cam_from_map]
    )
    for other in poses:
        if different(state, other):
            most = max(most, count_distinct(aligned, (residuals_px(aligned, other) <= bound_px) & (errors > bound_px)))
    rest = np.flatnonzero(errors > FAR * bound_px)
    if len(rest) > 2:
        names = ("index", "bearings", "points", "pixel_from_bearing", "radians_per_pixel")
        part = replace(aligned, **{name: np.ascontiguousarray(getattr(aligned, name)[rest]) for name in names})
        limits = bounds_of(part, bound_px).pixels
        found = search_two_point(part, limits, 0, SAMPLES, CONFIDENCE, local_optimization=True)
        if found.found:
            best = int(np.argmax(found.support))
            yaws, places = found.yaws_rad[best : best + 1], found.translations[best : best + 1]
            mask = mark_each(yaws, places, part.bearings, part.points, part.pixel_from_bearing, limits)[0]
            most = max(most, count_distinct(part, mask))
    if expected_by_chance(len(aligned.points), most, rate, fixed_by) > MAX_NFA:
        return np.inf, ""
    needed = max(MIN_LEAD, lead(size, int(np.ceil(STRONG * size)) - 1))  # of many, it must lead by more
    return lead(size, most) - needed, f"Another pose explains {most} different matches, this one {size}."


def _gravity_margin(
    aligned: AlignedProblem, state: FloatArray, errors: FloatArray, inliers: BoolArray, options: Any
) -> tuple[float, str]:
    """Margin against poses nearby that ignore the given gravity and explain more.

    Where the options keep the given gravity, inliers are counted at a bound that allows for its error; those of them
    count that agree within the bound on the noise, as the others do.
    """
    bound_px = float(options.bound_px)
    if gravity_sd_rad(aligned, options) < MIN_GRAVITY_SD_RAD:
        inliers = inliers & (errors <= bound_px)
    size = count_distinct(aligned, inliers)
    free = nearby_support(aligned, state, bound_px, float(options.noise_px))
    return (
        MIN_LEAD - lead(free, size),
        f"Without the known gravity, {free} different matches agree instead of {size}.",
    )


def _error_margin(trace: Trace, aligned: AlignedProblem, state: FloatArray, inliers: BoolArray) -> tuple[float, str]:
    """Margin of the covariance: natural logarithm of the ratio of a success's errors to the stated errors."""
    rotation, position = sd_of(aligned, state, inliers, trace.options)
    if np.isinf(position):
        return -np.inf, "Its inliers do not fix it."
    worst = MIN_SDS * max(np.degrees(rotation) / SUCCESS_DEG, position / SUCCESS_M, 1e-300)
    fixed = f"{np.degrees(rotation):.2g}° and {position:.2g} {trace.problem.unit}"
    if is_beyond(position, extent_of(trace.problem.points)):
        return -np.log(worst), "Its inliers do not fix its position."
    return -np.log(worst), f"Its inliers fix it to no better than {fixed} (1 sd)."


def _spread_margin(trace: Trace, inliers: BoolArray) -> tuple[float, str]:
    """Margin against an object or a facade that looks alike elsewhere."""
    spread = spread_in(trace.problem, inliers)
    return (np.inf, "") if spread is None else (spread.margin, spread.sentence)


def _rival_margin(trace: Trace, aligned: AlignedProblem, state: FloatArray, inliers: BoolArray) -> tuple[float, str]:
    """Margin over a clearly different pose that is found without the inliers on which this one depends most."""
    rival = rival_of(aligned, state, inliers, trace.options, float(trace.options.bound_px))
    return (np.inf, "") if rival is None else (rival.margin, rival.sentence)
