"""The outcome of a run: its last step, its tables, and its certificate in words."""

from collections.abc import Mapping

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.metrics import AWAY, SUCCESS_M, evaluate, extent_of, is_away
from spherloc.outcome import Judgement, Outcome, count_within_noise, judge
from spherloc.problem import Problem
from spherloc.trace import Certificate, RefinementStage, Trace
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers import uncertainty
from spherloc_viz.layers.frame import Frame, Plan, RunView, angle_text, length, map_focus, place_text
from spherloc_viz.layers.primitives import Table

KNOWABLE = 0.01
"""Largest NFA with which an answer can be known."""
UNKNOWABLE = "the answer cannot be known"


def proof(certificate: Certificate, explained: int) -> str:
    """Whether a pose may exist that beats the best known one, as part of a sentence on a run whose pose explains so
    many matches within the bound on the noise."""
    lower, gap = certificate.lower_bound, certificate.gap
    if not certificate.proven:
        known = "" if explained == lower else f" than the {lower} of the best known pose"
        return f"not proven optimal: no pose explains more than {certificate.upper_bound}, so at most {gap} more{known}"
    if explained == lower:
        return f"proven optimal: no pose explains more than {lower}"
    return f"before refinement {lower}, which is proven optimal: no pose explains more"


def difference(certificate: Certificate, inliers: int, explained: int) -> str:
    """A sentence that says why a run with so many inliers has a certificate of another number; empty if it has not.

    ``explained`` of them are within the bound on the noise, which the certificate counts with.
    """
    if explained < inliers:
        return (
            "The certificate counts matches within the bound on the noise, at poses within the gravity bound; this "
            f"pose keeps the given gravity and has {explained} such matches."
        )
    if inliers < certificate.lower_bound:
        return "Refinement makes the squared residuals small, not the count large: matches near the bound can drop out."
    if inliers > certificate.upper_bound:
        return (
            "The certificate counts residuals within the noise bound at poses within the gravity bound; the run's "
            "count can go beyond either."
        )
    return ""


def is_knowable(certificate: Certificate) -> bool:
    """Whether wrong matches are unlikely to agree as well as the inliers do."""
    return certificate.nfa < KNOWABLE


def chance(certificate: Certificate) -> str:
    """The NFA as text: expected number of sets of wrong matches of that size that agree by chance."""
    value = certificate.nfa
    return f"{value:.2g}" if value >= 1e-99 else "below 1e-99"


def warning(certificate: Certificate) -> str:
    """A sentence if no method can know the answer; empty otherwise."""
    if is_knowable(certificate):
        return ""
    return (
        f"{UNKNOWABLE.capitalize()}: {chance(certificate)} sets of {certificate.lower_bound} wrong matches are "
        "expected to agree with some pose by chance."
    )


def plans(view: RunView) -> list[Plan]:
    """One step."""
    cam_from_map = view.trace.cam_from_map
    if cam_from_map is None:
        return [Plan("outcome", "No pose", lambda: _no_pose(view))]
    return [Plan("outcome", "Outcome", lambda: _pose(view, view.aligned_pose(cam_from_map)))]


def _no_pose(view: RunView) -> Frame:
    message, _, remark = view.trace.message.partition(". ")
    return Frame(
        f"{message.rstrip('.')}. Give more matches, another bound or better gravity.",
        "",
        view.standing(np.eye(3)),
        view.colors(style.OUTLIER),
        view.no_matches(),
        note=remark,
        focus=map_focus(view, view.standing(np.eye(3))),
    )


TURNING = "Lines that turn red lead to inliers that are wrong by the truth."


def _pose(view: RunView, cam_from_map: np.ndarray) -> Frame:
    trace, metrics = view.trace, evaluate(view.trace)
    remark = trace.message.partition(". ")[2]
    inliers, explained = int(np.count_nonzero(trace.inlier_mask)), count_within_noise(trace)
    total = trace.timings_ms["total"]
    proven, chances = ("", "") if trace.certificate is None else _certified(trace.certificate, inliers, explained)
    caption = f"{inliers} of {len(trace.problem)} matches agree with the pose"
    if explained < inliers:
        bound = f"{view.bounds.noise_px:.3g} px"
        caption += f" within {bound} and what the error of gravity may add, {explained} of them within {bound}"
    if metrics.rotation_error_deg is None or metrics.translation_error_m is None:
        caption += f", solved in {total:.1f} ms{proven}. "
        caption += "The truth is unknown: only the matches speak for it or against it."
        limits = ""
    else:
        limits = f"success: error < 1° and < {SUCCESS_M:g} {trace.problem.unit}   (Sec. VI-A)"
        verdict = "a success" if metrics.success else "a failure"
        angle, length = angle_text(metrics.rotation_error_deg), view.length(metrics.translation_error_m)
        limit = view.length(SUCCESS_M)
        caption += (
            f"{proven}. The pose, solved in {total:.1f} ms, is {angle} and {length} off the truth: {verdict} by the "
        )
        caption += f"limits of 1° and {limit}."
    right = trace.problem.truth_inliers
    turning = "" if right is None or right[trace.inlier_mask].all() else TURNING
    return Frame(
        caption,
        limits,
        cam_from_map,
        view.colors(style.OUTLIER, (trace.inlier_mask, style.INLIER)),
        trace.inlier_mask,
        note=" ".join(filter(None, (turning, chances, remark))),
        located=True,
        focus=map_focus(view, cam_from_map, trace.inlier_mask),
    )


def _certified(certificate: Certificate, inliers: int, explained: int) -> tuple[str, str]:
    """The proven bounds, as the end of a sentence, and as a note why they differ from the inliers, and the NFA."""
    chances = f"NFA: {chance(certificate)} sets of {certificate.lower_bound} matches are expected to agree by chance."
    notes = (difference(certificate, inliers, explained), chances, warning(certificate))
    return f"; {proof(certificate, explained)}", " ".join(filter(None, notes))


def outcome_table(trace: Trace) -> Table:
    """Pose, errors, scores and times of a run, and its judgement without the truth."""
    return early_table(trace, judge(trace))


def early_table(trace: Trace, judged: Judgement | None) -> Table:
    """The same with the judgement if it is known already, since judging can take longer than the run."""
    metrics, extent_m = evaluate(trace), extent_of(trace.problem.points)
    rows: list[tuple[str, str]] = [("estimator", trace.estimator), ("outcome", verdict(trace, metrics.success))]
    if trace.cam_from_map is not None:
        rows.append(("judged without the truth", "…" if judged is None else _judged(judged, metrics.success)))
        rows.append(("camera position", _place(trace.problem, camera_centre(trace.cam_from_map))))
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        rows.append(("rotation error", f"{metrics.rotation_error_deg:.3f}°"))
        rows.append(("position error", length(metrics.translation_error_m, trace.problem.metric, extent_m)))
    refinement = trace.stage(RefinementStage)
    if refinement is not None and trace.cam_from_map is not None:
        doubted = metrics.success is False or (judged is not None and judged.outcome is not Outcome.LOCALIZED)
        condition = ", if its inliers are right" if doubted and refinement.expected_errors is not None else ""
        rows.append(("expected error", uncertainty.spread(refinement, trace.problem.metric, extent_m) + condition))
    inliers, explained = int(np.count_nonzero(trace.inlier_mask)), count_within_noise(trace)
    within = f", {explained} within the bound on the noise" if explained < inliers else ""
    rows.append(("inliers", f"{inliers} of {len(trace.problem)}{within}"))
    if metrics.precision is not None and metrics.recall is not None and metrics.f1 is not None:
        rows.append(("precision / recall", f"{100 * metrics.precision:.3g} % / {100 * metrics.recall:.3g} %"))
        rows.append(("F1", f"{100 * metrics.f1:.3g} %"))
    if trace.certificate is not None:
        rows += _certificate_rows(trace.certificate, explained)
    rows.append(("solved in", _times(trace.timings_ms)))
    return Table("outcome", ("", "this run"), tuple(rows))


def _place(problem: Problem, position: FloatArray) -> str:
    return AWAY if is_away(position, problem.points) else place_text(position, 3, problem.metric)


def _times(timings_ms: Mapping[str, float]) -> str:
    """The time of a run and its stages, with what is left over if that is a tenth or more."""
    total, stages = timings_ms["total"], {name: value for name, value in timings_ms.items() if name != "total"}
    rest = total - sum(stages.values())
    parts = [f"{name} {value:.1f}" for name, value in stages.items()]
    if parts and rest >= 0.1 * total:
        parts.append(f"the rest {rest:.1f}")
    return f"{total:.1f} ms" + (f" ({', '.join(parts)})" if parts else "")


def _judged(judged: Judgement, success: bool | None) -> str:
    if judged.outcome is Outcome.LOCALIZED and success is False:
        return f"{judged.outcome}: nothing in the matches tells that the pose is wrong"
    return " ".join((f"{judged.outcome}{':' * bool(judged.reasons)}", *judged.reasons))


def _certificate_rows(certificate: Certificate, explained: int) -> list[tuple[str, str]]:
    rows = [("certificate", proof(certificate, explained).capitalize())]
    rows.append(("NFA", f"{chance(certificate)} sets of {certificate.lower_bound} matches expected to agree by chance"))
    if not is_knowable(certificate):
        rows.append(("warning", UNKNOWABLE))
    return rows


def verdict(trace: Trace, success: bool | None) -> str:
    """The outcome of a run in a few words; ``success`` is None if the truth is unknown."""
    if trace.cam_from_map is None:
        return "no pose"
    return {True: "success", False: "failure", None: "pose found, truth unknown"}[success]
