"""Refinement and the outcome."""

import numpy as np

from spherloc.metrics import evaluate
from spherloc.trace import Certificate, RefinementStage
from spherloc_viz import style
from spherloc_viz.layers import uncertainty
from spherloc_viz.layers.certificate import chance, proof, warning
from spherloc_viz.layers.frame import Frame, RunView
from spherloc_viz.layers.primitives import Chart, Curve, Step


def frames(view: RunView, stage: RefinementStage) -> list[Frame]:
    """One frame: from the first pose to the last."""
    rms = np.sqrt(stage.cost_px2)
    counts = stage.inlier_counts
    mask = view.trace.inlier_mask
    return [
        Frame(
            Step(
                "refinement",
                "Refinement",
                f"{len(rms) - 1} Gauss-Newton steps in {stage.dof} degrees of freedom take the inliers from "
                f"{rms[0]:.2f} to {rms[-1]:.2f} px RMS, and their number from {counts[0]} to {counts[-1]}. "
                f"The camera ends at {view.position(view.aligned_pose(stage.cam_from_map[-1]))}, and its error is "
                f"{uncertainty.spread(stage)}.",
                _objective(stage),
                uncertainty.tilt(stage),
            ),
            view.aligned_pose(stage.cam_from_map[-1]),
            view.colors(style.UNDECIDED, (mask, style.INLIER)),
            mask,
            located=True,
            charts=(chart(stage),),
            tables=(uncertainty.table(stage),),
        )
    ]


def _objective(stage: RefinementStage) -> str:
    gravity = "" if stage.gravity_sd_rad in (0.0, np.inf) else " + (tilt / σ_g)²"
    return f"min over R, t of Σ (‖π(R p + t) − u‖ / σ)²{gravity}   (Algorithm 1, line 16; Algorithm 2, line 24)"


def chart(stage: RefinementStage) -> Chart:
    """RMS residual of the final inliers over the steps."""
    rms = np.sqrt(stage.cost_px2)
    curve = Curve("RMS of the inliers", np.arange(len(rms), dtype=np.float64), rms, style.ESTIMATE)
    return Chart("refinement", "Residual during refinement", "Gauss-Newton step", "RMS (px)", (curve,))


def outcome_frame(view: RunView) -> Frame:
    """The last frame: the pose with its inliers and outliers, or why there is none."""
    trace, metrics = view.trace, evaluate(view.trace)
    message, _, remark = trace.message.partition(". ")
    if trace.cam_from_map is None:
        caption = f"{message.rstrip('.')}. Give more matches, a wider bound or better gravity."
        step = Step("outcome", "No pose", caption, "", remark)
        return Frame(step, view.standing(np.eye(3)), view.colors(style.OUTLIER), view.nobody())
    inliers = int(np.count_nonzero(trace.inlier_mask))
    total = trace.timings_ms["total"]
    proven, chances = ("", "") if trace.certificate is None else _certified(trace.certificate)
    caption = f"{inliers} of {len(trace.problem)} matches agree with the pose, found in {total:.1f} ms{proven}. "
    if metrics.rotation_error_deg is None or metrics.translation_error_m is None:
        caption += "The truth is unknown, so the share of agreeing matches is all there is to judge it by."
    else:
        verdict = "a success" if metrics.success else "a failure"
        caption += (
            f"It is {metrics.rotation_error_deg:.3f}° and {100 * metrics.translation_error_m:.1f} cm off the truth: "
            f"{verdict} by the limits of 1° and 10 cm."
        )
    return Frame(
        Step(
            "outcome",
            "Outcome",
            caption,
            "success: error < 1° and < 0.1 m   (Sec. VI-A)",
            f"{chances} {remark}".strip(),
        ),
        view.aligned_pose(trace.cam_from_map),
        view.colors(style.OUTLIER, (trace.inlier_mask, style.INLIER)),
        trace.inlier_mask,
        located=True,
    )


def _certified(certificate: Certificate) -> tuple[str, str]:
    """What is proven, as the end of a sentence, and what chance alone would do, as a note."""
    note = f"Expected false sets of this size: {chance(certificate)}. {warning(certificate)}"
    return f"; {proof(certificate)}", note.strip()
