"""A diagnosis in words: one sentence, the numbers behind it, and what to do."""

from collections.abc import Iterator

import numpy as np

from spherloc.consensus.chance import expected_text
from spherloc.diagnosis.causes import Cause, Diagnosis
from spherloc.diagnosis.evidence import MISSED, STRONG, Evidence, Fit, Narrow, Truth, apart, different, undetermined
from spherloc.metrics import BEYOND, evaluate, extent_of, said_length
from spherloc.problem import Problem
from spherloc.trace import Certificate, ConsensusStage, RansacStage, Trace

ADVICE = {
    Cause.OK: "Nothing to do.",
    Cause.TOO_FEW_INLIERS: "Get more right matches: more features, a stricter matcher, or more reference images.",
    Cause.FALSE_CONSENSUS: "Look at both poses; take out matches to structure that repeats, or decide by a prior.",
    Cause.WRONG_REFERENCE: "Retrieve other reference images; no estimator can help with these matches.",
    Cause.MAP_TOO_SPARSE: "Give the references depth, or more points to the map where the query looks.",
    Cause.GRAVITY_OFF: "Correct the known roll and pitch, or state a larger gravity bound and standard deviation.",
    Cause.BOUND_TOO_SMALL: "Raise bound_px to about three standard deviations of the noise, or calibrate better.",
    Cause.BOUND_TOO_LARGE: "Lower bound_px to about three standard deviations of the noise.",
    Cause.DEGENERATE: "Add matches elsewhere in the image and at other depths; until then do not trust the pose.",
    Cause.ITERATIONS_RAN_OUT: "Raise the iterations, set a confidence, or use mc-exact.",
    Cause.SEARCH_MISSED: "Use mc-exact, which looks at all poses.",
    Cause.UNKNOWN: "Look at the matches from the true pose: calibration, map and truth may disagree beyond noise.",
    Cause.AMBIGUOUS: "Look at both poses and decide by something else: a prior, a second image, other matches.",
}


def describe(
    trace: Trace,
    e: Evidence,
    truth: Truth | None,
    cause: Cause,
    certificate: Certificate | None,
    narrow: Narrow | None,
) -> Diagnosis:
    """The diagnosis of a run whose cause is known; ``narrow`` is the pose within a lower bound, if one was searched."""
    if cause is Cause.BOUND_TOO_LARGE and narrow is not None:
        other, summary = narrow.fit, _narrow_summary(e, narrow)
    else:
        other = _fit_beside(e, truth, cause)
        summary = _summary(e, truth, cause, other, trace.problem)
    return Diagnosis(
        cause=cause,
        doubtful=cause is not Cause.OK,
        summary=summary,
        evidence=tuple(_sentences(trace, e, truth, certificate)),
        advice=_advice(trace, e, truth, cause),
        used_truth=truth is not None,
        alternative_cam_from_map=None if other is None else e.aligned.unalign_pose(other.cam_from_map),
    )


SURE_NFA = 1e-6
"""Largest NFA of a consensus that speaks against a stated truth."""
FAR = 3.0
"""Number of noise bounds beyond which the errors of most right matches are not noise."""


def _advice(trace: Trace, e: Evidence, truth: Truth | None, cause: Cause) -> str:
    """What to do; never what the run has done already."""
    if cause is Cause.BOUND_TOO_SMALL and truth is not None:
        off_px = float(np.median(truth.exact.errors_px[truth.right]))
        if off_px > FAR * e.bound_px:
            return (
                f"Calibrate better: half of the right matches are {off_px:.0f} px off or more at the true pose, and a "
                "bound as wide lets wrong ones in."
            )
    if cause is Cause.WRONG_REFERENCE and _contradicts(e, truth):
        return (
            "Check the true pose first: its direction (camera from map), the order of its quaternion, its units and "
            "frame. If it is right, look for places in the map that look alike."
        )
    if cause is Cause.GRAVITY_OFF and e.believed_rad < e.aligned.gravity_bound_rad:
        return "Set gravity_sd_deg to what the problem states, or leave it out; then the refinement corrects the tilt."
    if cause is Cause.FALSE_CONSENSUS and truth is None and not _strong(e):
        return "Look whether the rest of the view fits, through the query's lens; add images of the place to the map."
    if cause is Cause.SEARCH_MISSED and trace.stage(ConsensusStage) is not None:
        return "Raise the effort and the time budget."
    return ADVICE[cause]


def _contradicts(e: Evidence, truth: Truth | None) -> bool:
    """Whether the matches speak for another pose than the true one, by which none of them is right."""
    best = 0 if e.best is None else e.best.support(e.bound_px)
    return truth is not None and best > 0 and e.nfa(best) < SURE_NFA


def _fit_beside(e: Evidence, truth: Truth | None, cause: Cause) -> Fit | None:
    """The pose to look at beside the run's own, if there is one."""
    if cause is Cause.OK:
        return None
    if cause is Cause.FALSE_CONSENSUS and truth is None and not _strong(e):
        return None
    if cause in (Cause.AMBIGUOUS, Cause.FALSE_CONSENSUS):
        candidates = [e.alternative, e.best] if truth is None else [truth.fit, e.alternative, e.best]
    elif truth is not None:
        candidates = [truth.fit]
    elif cause in (Cause.ITERATIONS_RAN_OUT, Cause.SEARCH_MISSED):
        candidates = [e.best]
    elif cause in (Cause.GRAVITY_OFF, Cause.BOUND_TOO_SMALL):
        return e.tilted if cause is Cause.GRAVITY_OFF else e.free
    else:
        return None
    for fit in candidates:
        if fit is not None and (e.run is None or different(fit.cam_from_map, e.run.cam_from_map)):
            return fit
    return None


def _summary(e: Evidence, truth: Truth | None, cause: Cause, other: Fit | None, problem: Problem) -> str:
    total, bound = len(e.aligned.points), e.bound_px
    run, best, second = (0 if fit is None else fit.support(bound) for fit in (e.run, e.best, other))
    match cause:
        case Cause.OK:
            return f"{run} of {total} matches agree within {px_text(bound)}, {_compared(e, truth, run)}."
        case Cause.TOO_FEW_INLIERS if truth is not None:
            right = int(np.count_nonzero(truth.right))
            lucky = " The pose is right all the same, which only the truth can tell." if truth.success else ""
            if right == 0:
                return f"None of {total} matches is right.{lucky}"
            are = "is" if right == 1 else "are"
            return f"Only {right} of {total} matches {are} right, {_by_chance(e, right, truth.within)}.{lucky}"
        case Cause.TOO_FEW_INLIERS:
            return f"No pose was found that more than {best} of {total} matches agree with, {_by_chance(e, best)}."
        case Cause.WRONG_REFERENCE if _contradicts(e, truth):
            return (
                f"No match is right by the true pose, but {best} of {total} agree with another pose, which chance does "
                "not explain: the reference shows another place that looks alike, or the true pose is not right."
            )
        case Cause.WRONG_REFERENCE:
            return f"None of {total} matches seems right: {best} agree with the best pose, no more than chance gives."
        case Cause.MAP_TOO_SPARSE:
            lacking = e.verified_without_point
            return f"{lacking} matches agree between the images but have no point in the map; {total} have one."
        case Cause.FALSE_CONSENSUS if truth is not None:
            return f"A wrong pose explains more than the true one: {best} of {total} matches against {second}."
        case Cause.FALSE_CONSENSUS if e.spread is not None and not _strong(e):
            return e.spread.sentence
        case Cause.FALSE_CONSENSUS:
            return f"Two different poses stand out, with {best} and {second} of {total} matches: either may be false."
        case Cause.AMBIGUOUS:
            return f"Two clearly different poses are supported alike: by {run} and by {second} of {total} matches."
        case Cause.ITERATIONS_RAN_OUT | Cause.SEARCH_MISSED:
            better = max(best, second, 0 if truth is None else truth.fit.support(bound))
            return f"The search missed the best pose: one with {better} of {total} matches exists, the run's has {run}."
        case Cause.UNKNOWN:
            return f"The pose is off the true one, though {run} of {total} matches agree with it and fix it well."
    return _measured_summary(e, truth, cause, problem)


def _strong(e: Evidence) -> bool:
    """Whether a second pose explains many of the matches that the best one does not explain."""
    return e.best is not None and e.alternatives_own() >= STRONG * e.best.support(e.bound_px)


UNLIKELY = 0.05
"""Expected number of sets by chance below which it is not chance that speaks against so few matches."""


def _by_chance(e: Evidence, size: int, wider: float = 1.0) -> str:
    """Why a consensus of that size, within ``wider`` times the bound, is not believed."""
    if size <= 2:
        return "and any two agree with some pose"
    if (expected := e.nfa(size, wider)) < UNLIKELY:
        return "too few to be believed"
    return f"and {expected_text(expected)} sets of {size} are expected to agree with some pose by chance"


def _narrow_summary(e: Evidence, narrow: Narrow) -> str:
    best = 0 if e.best is None else e.best.support(e.bound_px)
    return (
        f"Within {px_text(e.bound_px)} no pose explains more matches than chance gives (the best {best} of "
        f"{len(e.aligned.points)}); within {px_text(narrow.bound_px)} one that {narrow.fit.support(narrow.bound_px)} "
        "agree with stands out."
    )


def _compared(e: Evidence, truth: Truth | None, run: int) -> str:
    """What other poses have where a run is right with so many matches; the truth can say so although one has more."""
    if truth is None:
        return "and no other pose comes near"
    best, other = (0 if fit is None else fit.support(e.bound_px) for fit in (e.best, e.alternative))
    if run < MISSED * best:
        return f"and the pose is right, though a longer search finds one that {best} agree with"
    if other >= STRONG * run:
        return f"and the pose is right, though another one has {other}"
    return "and no other pose comes near"


def _measured_summary(e: Evidence, truth: Truth | None, cause: Cause, problem: Problem) -> str:
    """Summary of causes that are a measured size: from the true pose or, without it, from the pose that ignores the
    given gravity and has a wider bound."""
    if cause is Cause.DEGENERATE:
        source = e if truth is None else truth
        fixed = f"{_distance(source.position_sd_m, problem)} and {_deg(source.rotation_sd_rad)}"
        if truth is None and e.reported_sd and not undetermined(e.rotation_sd_rad, e.position_sd_m):
            fixed = f"{_distance(e.reported_sd[1], problem)} and {_deg(e.reported_sd[0])}"
        if BEYOND in fixed:
            return "The matches that agree do not fix the position."
        return f"The matches that agree fix the pose to no better than {fixed} (1 sd)."
    fit = truth.fit if truth is not None else e.tilted if cause is Cause.GRAVITY_OFF else e.free
    if fit is None:
        raise ValueError(f"{cause} was found without a pose to show it")
    if cause is Cause.GRAVITY_OFF:
        tilt_rad = fit.tilt_rad if truth is None else truth.exact.tilt_rad
        bound_rad = e.aligned.gravity_bound_rad
        if e.believed_rad < bound_rad:
            believed = f"allows for {_deg(e.believed_rad)} at most" if e.believed_rad else "keeps it as it is"
            return f"The known gravity is off by {_deg(tilt_rad)}, but the refinement {believed}."
        return f"The known gravity is off by {_deg(tilt_rad)}, but its bound is {_deg(bound_rad)}."
    errors = fit.errors_px if truth is None else fit.errors_px[truth.right]
    one, two = (int(np.count_nonzero(errors <= factor * e.bound_px)) for factor in (1, 2))
    where = "" if truth is None else "at the true pose, " if fit is truth.exact else "near the true pose, "
    return (
        f"The noise exceeds the bound: {where}{one} matches are within its {px_text(e.bound_px)}, {two} within twice "
        "as much."
    )


def _sentences(trace: Trace, e: Evidence, truth: Truth | None, certificate: Certificate | None) -> Iterator[str]:
    total, bound = len(e.aligned.points), e.bound_px
    if e.run is None:
        yield "The run has no pose."
    else:
        support, counted = e.run.support(bound), int(np.count_nonzero(trace.inlier_mask))
        yield f"{support} of {total} matches agree with the run's pose within {px_text(bound)}."
        if counted != support:
            yield f"The run counts {counted}, within a bound that allows for the error of gravity too."
    if e.best is not None:
        best = e.best.support(bound)
        if e.run is None or best > e.run.support(bound):
            fewer = ", fewer than with the true one" if truth is not None and truth.exact.support(bound) > best else ""
            finder = "Before refinement the run had" if _had_best(trace, best) else "A longer search finds"
            yield f"{finder} a pose that {best} agree with{fewer}."
        if np.isfinite(e.position_sd_m):
            fixed = f"{_distance(e.position_sd_m, trace.problem)} and {_deg(e.rotation_sd_rad)}"
            yield f"The {best} fix their pose to {fixed} (1 sd)."
        yield f"Sets of {best} that agree by chance: {expected_text(e.nfa(best))} expected."
    if e.best is not None and e.alternative is not None and e.alternative.support(bound) > 1:
        turn, distance = apart(e.best.cam_from_map, e.alternative.cam_from_map)
        away = f"{_distance(distance, trace.problem)} and {_deg(turn)}"
        yield f"The next pose, {away} away from the best, has {e.alternative.support(bound)}."
    if e.free is not None and np.isfinite(e.free_tilt_sd_rad):
        one, two, four = (e.free.support(factor * bound) for factor in (1, 2, 4))
        bound_rad = e.aligned.gravity_bound_rad
        known = f"whose bound is {_deg(bound_rad)}" if bound_rad else "which is taken as exact"
        yield (
            f"A least-squares fit of the pose without gravity has {one} within the bound, {two} within twice and "
            f"{four} within four times of it. Its vertical is {_deg(e.free.tilt_rad)} ± {_deg(e.free_tilt_sd_rad)} "
            f"from the given gravity, {known}."
        )
    yield from _proofs(trace, certificate)
    if truth is not None:
        yield from _truths(trace, e, truth)


def _had_best(trace: Trace, best: int) -> bool:
    """Whether the run's own search found a pose that so many, more than with the run's, agree with: refinement went on
    from it."""
    return trace.certificate is not None and best <= trace.certificate.lower_bound


def _proofs(trace: Trace, certificate: Certificate | None) -> Iterator[str]:
    if (ransac := trace.stage(RansacStage)) is not None:
        reached = 100.0 * ransac.confidence_reached
        drew = f"RANSAC drew {ransac.iterations:,} samples"
        yield f"{drew}, a confidence of {reached:.3g} % (Eq. 28) if no more matches are right than it found."
    if certificate is not None and certificate.proven:
        most = certificate.upper_bound
        yield f"Proven: no pose within the gravity bound explains more than {most}, and one explains as many."
    elif certificate is not None:
        yield (
            f"Before refinement, no pose within the gravity bound explains more than {certificate.upper_bound}; one "
            f"with {certificate.lower_bound} is known."
        )


def _truths(trace: Trace, e: Evidence, truth: Truth) -> Iterator[str]:
    right, metrics = int(np.count_nonzero(truth.right)), evaluate(trace)
    at, near = truth.exact.support(e.bound_px), truth.fit.support(e.bound_px)
    more = f", {near} with a pose fitted near it" if near > at else ""
    what = "match is" if right == 1 else "matches are"
    yield f"Truth: {right} {what} right, and {at} agree{'s' * (at == 1)} with the true pose{more}."
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        error = f"{_distance(metrics.translation_error_m, trace.problem)} and {metrics.rotation_error_deg:.3g}°"
        yield f"Truth: the run's pose is off by {error}; the known gravity by {_deg(truth.exact.tilt_rad)}."
    best = 0 if e.best is None else e.best.support(e.bound_px)
    if e.best is not None and (e.run is None or best > e.run.support(e.bound_px)):
        turn, distance = apart(e.best.cam_from_map, truth.exact.cam_from_map)
        which = "before refinement" if _had_best(trace, best) else "of the longer search"
        yield f"Truth: the pose {which} is off by {_distance(distance, trace.problem)} and {_deg(turn)}."


def _deg(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.2g}°" if angle_rad < 1.7 else f"{np.degrees(angle_rad):.0f}°"


def px_text(size_px: float) -> str:
    """A length in pixels as text with three digits, or all of a large one."""
    return f"{size_px:.3g} px" if size_px < 1000 else f"{size_px:,.0f} px"


def _distance(distance: float, problem: Problem) -> str:
    if problem.metric and distance < 1.0:
        return f"{100.0 * distance:.2g} cm"
    text = f"{distance:.2g} {problem.unit}" if distance < 100 else f"{distance:.0f} {problem.unit}"
    return said_length(distance, extent_of(problem.points), text)
