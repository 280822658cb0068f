"""A diagnosis in words: one sentence, the numbers behind it, and what to do."""

from collections.abc import Iterator

import numpy as np

from spherloc.cameras.base import FloatArray
from spherloc.diagnosis.causes import Cause, Diagnosis
from spherloc.diagnosis.evidence import Evidence, Truth, different
from spherloc.diagnosis.experiments import Fit
from spherloc.diagnosis.measures import apart
from spherloc.metrics import evaluate
from spherloc.trace import Certificate, RansacStage, Trace

ADVICE = {
    Cause.OK: "Nothing to do.",
    Cause.TOO_FEW_INLIERS: "Get more right matches: more features, a stricter matcher, or more reference images.",
    Cause.FALSE_CONSENSUS: "Look at both poses; take out matches to structure that repeats itself, or decide by a prior.",
    Cause.WRONG_REFERENCE: "Retrieve other reference images; no estimator can help with these matches.",
    Cause.GRAVITY_OFF: "Correct the known roll and pitch, or state a larger gravity bound and standard deviation.",
    Cause.BOUND_TOO_SMALL: "Raise bound_px to about three standard deviations of the noise, or improve the calibration.",
    Cause.DEGENERATE: "Add matches elsewhere in the image and at other depths; do not trust the undetermined direction.",
    Cause.ITERATIONS_RAN_OUT: "Raise the iterations or the effort, set a confidence, or use mc-exact.",
    Cause.AMBIGUOUS: "Look at both poses and decide by something else: a prior, a second image, other matches.",
}


def describe(
    trace: Trace, e: Evidence, truth: Truth | None, cause: Cause, certificate: Certificate | None
) -> Diagnosis:
    """The diagnosis of a run whose cause is known."""
    other = _other(e, truth, cause)
    return Diagnosis(
        cause=cause,
        doubtful=cause is not Cause.OK,
        summary=_summary(e, truth, cause, other),
        evidence=tuple(_sentences(trace, e, truth, certificate)),
        advice=ADVICE[cause],
        used_truth=truth is not None,
        rival_cam_from_map=None if other is None else e.aligned.unalign_pose(other.cam_from_map),
    )


def _other(e: Evidence, truth: Truth | None, cause: Cause) -> Fit | None:
    """The pose to look at beside the run's own, if there is one."""
    if cause is Cause.OK:
        return None
    if cause in (Cause.AMBIGUOUS, Cause.FALSE_CONSENSUS):
        candidates = [e.rival, e.best] if truth is None else [truth.fit, e.rival, e.best]
    elif truth is not None:
        candidates = [truth.fit]
    elif cause is Cause.ITERATIONS_RAN_OUT:
        candidates = [e.best]
    elif cause in (Cause.GRAVITY_OFF, Cause.BOUND_TOO_SMALL):
        return e.free
    else:
        return None
    for fit in candidates:
        if fit is not None and (e.run is None or different(fit.cam_from_map, e.run.cam_from_map)):
            return fit
    return None


def _summary(e: Evidence, truth: Truth | None, cause: Cause, other: Fit | None) -> str:
    total, bound = len(e.aligned.points), f"{e.bound_px:.3g} px"
    run = 0 if e.run is None else e.run.support(e.bound_px)
    best = 0 if e.best is None else e.best.support(e.bound_px)
    if cause is Cause.TOO_FEW_INLIERS:
        right = best if truth is None else int(np.count_nonzero(truth.right))
        return f"Only {right} of {total} matches agree or are right, which chance alone can do."
    if cause is Cause.FALSE_CONSENSUS:
        less = 0 if other is None else other.support(e.bound_px)
        if truth is None:
            return f"Two clearly different poses stand out, with {best} and {less} of {total} matches: either may be false."
        return f"A wrong pose explains more than the true one: {best} of {total} matches against {less}."
    if cause is Cause.WRONG_REFERENCE:
        return f"None of {total} matches seems right: at most {best} agree with any pose, which chance alone can do."
    if cause is Cause.GRAVITY_OFF:
        tilt = truth.tilt_rad if truth is not None else e.free.tilt_rad if e.free is not None else np.nan
        return f"The known gravity is off by {np.degrees(tilt):.1f}°, its bound is {_deg(e.aligned.gravity_bound_rad)}."
    if cause is Cause.BOUND_TOO_SMALL:
        errors = e.free.errors_px if truth is None and e.free is not None else truth.fit.errors_px[truth.right]  # type: ignore[union-attr]
        one, two = (int(np.count_nonzero(errors <= factor * e.bound_px)) for factor in (1, 2))
        return f"The noise is larger than the bound of {bound}: {one} matches are within it, {two} within twice of it."
    if cause is Cause.DEGENERATE:
        rotation, position = (
            (e.rotation_sd_rad, e.position_sd_m) if truth is None else (truth.rotation_sd_rad, truth.position_sd_m)
        )
        return f"Many matches agree, but they fix the pose to no better than {_metres(position)} and {_deg(rotation)}."
    if cause is Cause.ITERATIONS_RAN_OUT:
        better = best if truth is None else max(best, truth.fit.support(e.bound_px))
        return f"The search missed the best pose: one with {better} matches exists, the run's own has {run}."
    if cause is Cause.AMBIGUOUS:
        second = 0 if other is None else other.support(e.bound_px)
        return f"Two clearly different poses are supported alike: by {run} and by {second} of {total} matches."
    return f"{run} of {total} matches agree within {bound}, far more than chance, and no other pose comes near."


def _sentences(trace: Trace, e: Evidence, truth: Truth | None, certificate: Certificate | None) -> Iterator[str]:
    total, bound = len(e.aligned.points), e.bound_px
    if e.run is None:
        yield "The run has no pose."
    else:
        yield f"{e.run.support(bound)} of {total} matches agree with the run's pose within {bound:.3g} px."
    if e.best is not None:
        best = e.best.support(bound)
        if e.run is None or best > e.run.support(bound):
            yield f"A longer search finds a pose that {best} agree with."
        yield f"Sets of {best} that agree by chance: {_expected(e.chance_sets(best))} expected."
        if np.isfinite(e.position_sd_m):
            yield f"They fix its position to {_metres(e.position_sd_m)} and its rotation to {_deg(e.rotation_sd_rad)} (1 sd)."
    if e.best is not None and e.rival is not None and e.rival.support(bound) > 1:
        turn, distance = apart(e.best.cam_from_map, e.rival.cam_from_map)
        yield f"The next pose, {_metres(distance)} and {_deg(turn)} away from the best, has {e.rival.support(bound)}."
    if e.free is not None and np.isfinite(e.free_tilt_sd_rad):
        one, two, four = (e.free.support(factor * bound) for factor in (1, 2, 4))
        yield (
            f"Where gravity is not believed, {one} agree within the bound, {two} within twice and {four} within four times of it; "
            f"gravity then tilts by {_deg(e.free.tilt_rad)}, give or take {_deg(e.free_tilt_sd_rad)}, "
            f"and its bound is {_deg(e.aligned.gravity_bound_rad)}."
        )
    yield from _proofs(trace, certificate)
    if truth is not None:
        yield from _truths(trace, e, truth)


def _proofs(trace: Trace, certificate: Certificate | None) -> Iterator[str]:
    if (ransac := trace.stage(RansacStage)) is not None:
        reached = 100.0 * ransac.confidence_reached
        yield f"RANSAC drew {ransac.iterations:,} samples and reached a confidence of {reached:.3g} % (Eq. 28)."
    if certificate is not None and certificate.proven:
        yield f"Proven: no pose explains more than {certificate.upper_bound}."
    elif certificate is not None:
        yield f"No pose explains more than {certificate.upper_bound}; one with {certificate.lower_bound} is known."


def _truths(trace: Trace, e: Evidence, truth: Truth) -> Iterator[str]:
    right, metrics = int(np.count_nonzero(truth.right)), evaluate(trace)
    yield f"Truth: {right} matches are right, and {truth.fit.support(e.bound_px)} agree with the true pose."
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        error = f"{metrics.translation_error_m:.3g} m and {metrics.rotation_error_deg:.3g}°"
        yield f"Truth: the run's pose is off by {error}; the known gravity by {_deg(truth.tilt_rad)}."


def _deg(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.2g}°" if angle_rad < 1.7 else f"{np.degrees(angle_rad):.0f}°"


def _metres(distance: float) -> str:
    return f"{distance:.2g} m" if distance < 100 else f"{distance:.0f} m"


def _expected(sets: float) -> str:
    return "practically none" if sets < 1e-6 else f"{sets:.1g}" if sets < 1e6 else "millions"
