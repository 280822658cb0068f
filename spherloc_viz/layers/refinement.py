"""Refinement: each Gauss-Newton state, the matches that agree with the last one, and the uncertainty of the pose."""

from functools import partial

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.trace import RefinementStage
from spherloc.types import BoolArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers import uncertainty
from spherloc_viz.layers.frame import Frame, Plan, RunView, angle_text, even, one_color, sphere_box
from spherloc_viz.layers.primitives import Chart, Curve, Focus, SceneItem, Segments

MAX_STATES = 20
"""Largest number of states with steps; of more an even sample is shown, with the first and the last."""


def plans(view: RunView, stage: RefinementStage) -> list[Plan]:
    """Steps for every state; for inliers, outliers and errors of the last one; and the summary."""
    count = len(stage.cost_px2)
    out = []
    for k in even(np.arange(count), MAX_STATES).tolist():
        title = "The pose before refinement" if k == 0 else f"Gauss-Newton step {k}"
        charts = {"refinement": partial(chart, stage, k)}
        out.append(Plan(f"refinement-{k}", title, partial(_state, view, stage, k), charts))
    out += [
        Plan("refinement-inliers", "Matches that agree", lambda: _inliers(view, stage)),
        Plan("refinement-outliers", "Matches that do not", lambda: _outliers(view, stage)),
        Plan("refinement-error", "How sure the pose is", lambda: _error(view, stage)),
        Plan("refinement", "Refinement", lambda: _summary(view, stage), {"refinement": partial(chart, stage)}),
    ]
    return out


RISEN = 1.001
"""Ratio of errors from which on it is said why the error has grown."""
SEVERAL_FITS = (
    "That error has grown: several fits follow one another, and this one has other matches or weights than the last."
)


def _state(view: RunView, stage: RefinementStage, k: int) -> Frame:
    """One of the states, and how it moved since the one before."""
    state, count = view.aligned_pose(stage.cam_from_map[k]), len(stage.cost_px2)
    rms, inliers = np.sqrt(stage.cost_px2), stage.inlier_counts
    off = "" if view.truth is None else f", {view.length(translation_error_m(view.truth, state))} from the true one"
    if k == 0:
        moved = f"{_steps(count - 1)} follow{'s' if count == 2 else ''}, each a linear problem in {stage.dof} unknowns."
    else:
        before = view.aligned_pose(stage.cam_from_map[k - 1])
        away, turned = translation_error_m(before, state), rotation_error_deg(before, state)
        angle = f"{turned:.3f}°" if turned >= 5e-4 else "less than 0.001°"
        moved = f"The step moved the camera by {view.length(away)} and turned it by {angle}."
        if rms[k] > RISEN * rms[k - 1]:
            moved += f" {SEVERAL_FITS}"
    note = "" if count <= MAX_STATES else f"{MAX_STATES} of {count} states are shown, evenly."
    mask = _explained(view, stage, k, state)
    return Frame(
        f"At {view.position(state)}{off}, the final inliers are off by {rms[k]:.3f} px RMS, and {inliers[k]} matches "
        f"are within the bound. {moved}",
        f"Σ ‖r‖² / n = {stage.cost_px2[k]:.4g} px²,  δ = −(JᵀWJ)⁻¹ JᵀW r",
        state,
        view.colors(style.UNDECIDED, (mask, style.INLIER)),
        mask,
        note=note,
        located=True,
        items=_path(view, stage, k),
    )


def _explained(view: RunView, stage: RefinementStage, k: int, state: FloatArray) -> BoolArray:
    """Matches within the bound at a state, by the bound that the stage counted with; else the final inliers."""
    aligned, bounds = view.trace.problem.aligned, view.bounds
    errors = view.residuals_px(state)[aligned.index]
    for limits in (bounds.pixels, np.minimum(bounds.pixels, bounds.noise_px)):
        if np.count_nonzero(errors <= limits) == stage.inlier_counts[k]:
            return aligned.full_mask(errors <= limits)
    return view.trace.inlier_mask


def _path(view: RunView, stage: RefinementStage, k: int) -> tuple[SceneItem, ...]:
    """The path of the camera so far."""
    states = [camera_centre(view.aligned_pose(state)) for state in stage.cam_from_map[: k + 1]]
    ends = np.stack([states[:-1], states[1:]], axis=1) if k else np.zeros((0, 2, 3))
    return (Segments("cameras/path", "cameras", ends, one_color(style.ESTIMATE, len(ends)), 3.0),)


def _last(view: RunView, stage: RefinementStage) -> tuple[FloatArray, BoolArray]:
    """The last pose and its inliers."""
    return view.aligned_pose(stage.cam_from_map[-1]), view.trace.inlier_mask


def _inliers(view: RunView, stage: RefinementStage) -> Frame:
    state, mask = _last(view, stage)
    errors, labels = view.residuals_px(state)[mask], view.trace.problem.truth_inliers
    if not len(errors):
        told = "No match is within the bound. The pose stays where it started"
    else:
        bound = "the bound"
        if errors.max() > view.bounds.noise_px:
            bound = f"the bound, which is {view.bounds.noise_px:.3g} px and what the error of gravity may add"
        told = (
            f"{len(errors)} of {len(mask)} matches are within {bound}; the median one is off by "
            f"{np.median(errors):.2f} px and the worst by {errors.max():.2f} px. "
        )
        told += (
            "Their rays leave the sphere straight towards their points"
            if labels is None
            else f"In truth {np.count_nonzero(labels[mask])} of them are right, of {np.count_nonzero(labels)} in all"
        )
    return Frame(
        f"{told}.",
        "‖π(R p + t) − u‖ ≤ ε",
        state,
        view.colors(style.UNDECIDED, (mask, style.INLIER)),
        mask,
        located=True,
    )


def _outliers(view: RunView, stage: RefinementStage) -> Frame:
    state, mask = _last(view, stage)
    errors = view.residuals_px(state)[~mask]
    seen = errors[np.isfinite(errors)]
    far = len(errors) - len(seen)
    if not len(errors):
        told = "All matches are within the bound. None is rejected"
    elif not len(seen):
        told = f"Rejected: {len(errors):,}, all more than 90° from their bearings. No bound would accept one of them"
    else:
        told = (
            f"Rejected: {len(errors):,}, of them {far} by more than 90°. "
            f"The median of the others is off by {np.median(seen):.0f} px and the nearest by {seen.min():.2f} px"
        )
    return Frame(
        f"{told}.",
        "‖π(R p + t) − u‖ > ε",
        state,
        view.colors(style.UNDECIDED, (~mask, style.OUTLIER)),
        ~mask,
        note=f"{style.MAX_DRAWN_RAYS} of {len(errors):,} lines are drawn, evenly."
        if len(errors) > style.MAX_DRAWN_RAYS
        else "",
        located=True,
    )


def _error(view: RunView, stage: RefinementStage) -> Frame:
    state, mask = _last(view, stage)
    known = stage.expected_errors
    expected = (
        "The inliers leave the pose open, so that its error is unknown."
        if known is None
        else f"By its covariance the pose is {angle_text(known[0])} and {view.length(known[1])} off, RMS, if its "
        "inliers are right."
    )
    if view.truth is None:
        happened = "The truth is not known here, so this cannot be checked."
    else:
        turned, away = rotation_error_deg(view.truth, state), translation_error_m(view.truth, state)
        happened = f"In truth it is off by {angle_text(turned)} and {view.length(away)}."
    return Frame(
        f"{expected} {happened}",
        "Σ = σ² (JᵀWJ)⁻¹",
        state,
        view.colors(style.UNDECIDED, (mask, style.INLIER)),
        view.no_matches(),
        note=uncertainty.tilt(stage),
        located=True,
        tables=(uncertainty.table(stage, view.metric, view.extent_m),),
        focus=_error_focus(view, state),
    )


def _error_focus(view: RunView, state: FloatArray) -> Focus:
    """The focus on the drawn error of the refined pose (3, 4) and the sphere."""
    frame = Frame("", "", state, view.colors(style.UNDECIDED), view.no_matches(), located=True)
    lines = [item.points for item in uncertainty.error_items(view, frame) if isinstance(item, Segments)]
    sphere = sphere_box(camera_centre(state), 1.1 * view.sphere_m)
    return Focus("Sphere", np.vstack([sphere, *(line.reshape(-1, 3) for line in lines)]))


def _summary(view: RunView, stage: RefinementStage) -> Frame:
    rms, counts = np.sqrt(stage.cost_px2), stage.inlier_counts
    state, mask = _last(view, stage)
    return Frame(
        f"{_steps(len(rms) - 1)} in {stage.dof} degrees of freedom {'takes' if len(rms) == 2 else 'take'} the inliers "
        f"from {rms[0]:.2f} to {rms[-1]:.2f} px RMS, and their number from {counts[0]} to {counts[-1]}. "
        f"The camera ends at {view.position(state)}, and its expected error "
        f"is {uncertainty.spread(stage, view.metric, view.extent_m)}.",
        _objective(stage),
        state,
        view.colors(style.UNDECIDED, (mask, style.INLIER)),
        mask,
        note=uncertainty.tilt(stage),
        located=True,
        tables=(uncertainty.table(stage, view.metric, view.extent_m),),
    )


def _steps(count: int) -> str:
    return "1 Gauss-Newton step" if count == 1 else f"{count} Gauss-Newton steps"


def _objective(stage: RefinementStage) -> str:
    gravity = "" if stage.gravity_sd_rad in (0.0, np.inf) else " + (tilt / σ_g)²"
    return f"min over R, t of Σ (‖π(R p + t) − u‖ / σ)²{gravity}   (Algorithm 1, line 16; Algorithm 2, line 24)"


def chart(stage: RefinementStage, last: int | None = None) -> Chart:
    """RMS residual of the final inliers over the steps, up to one of them."""
    rms = np.sqrt(stage.cost_px2)[: None if last is None else last + 1]
    known = np.isfinite(rms)
    curve = Curve("RMS of the inliers", np.flatnonzero(known).astype(np.float64), rms[known], style.ESTIMATE)
    return Chart("refinement", "Residual during refinement", "Gauss-Newton step", "RMS (px)", (curve,))
