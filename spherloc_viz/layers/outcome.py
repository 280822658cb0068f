"""The last step: the pose with its inliers and outliers, or why there is none."""

import numpy as np

from spherloc.metrics import evaluate
from spherloc.trace import Certificate
from spherloc_viz import style
from spherloc_viz.layers.certificate import chance, proof, warning
from spherloc_viz.layers.focus import map_focus
from spherloc_viz.layers.frame import Frame, Plan, RunView
from spherloc_viz.layers.scale_bar import angle_text, length_text


def plans(view: RunView) -> list[Plan]:
    """One stop."""
    cam_from_map = view.trace.cam_from_map
    if cam_from_map is None:
        return [Plan("outcome", "No pose", lambda: _no_pose(view))]
    return [Plan("outcome", "Outcome", lambda: _pose(view, view.aligned_pose(cam_from_map)))]


def _no_pose(view: RunView) -> Frame:
    message, _, remark = view.trace.message.partition(". ")
    return Frame(
        f"{message.rstrip('.')}. Give more matches, a wider bound or better gravity.",
        "",
        view.standing(np.eye(3)),
        view.colors(style.OUTLIER),
        view.nobody(),
        note=remark,
        focus=map_focus(view, view.standing(np.eye(3))),
    )


def _pose(view: RunView, cam_from_map: np.ndarray) -> Frame:
    trace, metrics = view.trace, evaluate(view.trace)
    remark = trace.message.partition(". ")[2]
    inliers = int(np.count_nonzero(trace.inlier_mask))
    total = trace.timings_ms["total"]
    proven, chances = ("", "") if trace.certificate is None else _certified(trace.certificate)
    caption = f"{inliers} of {len(trace.problem)} matches agree with the pose, found in {total:.1f} ms{proven}. "
    if metrics.rotation_error_deg is None or metrics.translation_error_m is None:
        caption += "The truth is unknown, so the share of agreeing matches is all there is to judge it by."
    else:
        verdict = "a success" if metrics.success else "a failure"
        angle, length = angle_text(metrics.rotation_error_deg), length_text(metrics.translation_error_m)
        caption += f"It is {angle} and {length} off the truth: {verdict} by the limits of 1° and 10 cm."
    return Frame(
        caption,
        "success: error < 1° and < 0.1 m   (Sec. VI-A)",
        cam_from_map,
        view.colors(style.OUTLIER, (trace.inlier_mask, style.INLIER)),
        trace.inlier_mask,
        note=f"{chances} {remark}".strip(),
        located=True,
    )


def _certified(certificate: Certificate) -> tuple[str, str]:
    """What is proven, as the end of a sentence, and what chance alone would do, as a note."""
    note = f"Expected false sets of this size: {chance(certificate)}. {warning(certificate)}"
    return f"; {proof(certificate)}", note.strip()
