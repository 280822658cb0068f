"""Tables that go with a run."""

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.metrics import evaluate
from spherloc.outcome import judge
from spherloc.trace import Certificate, RefinementStage, Trace
from spherloc_viz.layers import uncertainty
from spherloc_viz.layers.certificate import UNKNOWABLE, chance, is_knowable, proof
from spherloc_viz.layers.frame import length, place_text
from spherloc_viz.layers.primitives import Table


def outcome_table(trace: Trace) -> Table:
    """Pose, errors, scores and times of a run."""
    metrics = evaluate(trace)
    rows: list[tuple[str, str]] = [("estimator", trace.estimator), ("outcome", verdict(trace, metrics.success))]
    if trace.cam_from_map is not None:
        judged = judge(trace)
        rows.append(("without the truth", " ".join((f"{judged.outcome}{':' * bool(judged.reasons)}", *judged.reasons))))
        rows.append(("camera position", place_text(camera_centre(trace.cam_from_map), 3)))
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        rows.append(("rotation error", f"{metrics.rotation_error_deg:.3f}°"))
        rows.append(("position error", length(metrics.translation_error_m)))
    refinement = trace.stage(RefinementStage)
    if refinement is not None and trace.cam_from_map is not None:
        rows.append(("expected error", uncertainty.spread(refinement)))
    rows.append(("inliers", f"{np.count_nonzero(trace.inlier_mask)} of {len(trace.problem)}"))
    if metrics.precision is not None and metrics.recall is not None and metrics.f1 is not None:
        rows.append(("precision / recall", f"{100 * metrics.precision:.0f} % / {100 * metrics.recall:.0f} %"))
        rows.append(("F1", f"{100 * metrics.f1:.0f} %"))
    if trace.certificate is not None:
        rows += _certificate_rows(trace.certificate)
    stages = ", ".join(f"{name} {value:.1f}" for name, value in trace.timings_ms.items() if name != "total")
    rows.append(("time", f"{trace.timings_ms['total']:.1f} ms" + (f" ({stages})" if stages else "")))
    return Table("outcome", ("", "this run"), tuple(rows))


def _certificate_rows(certificate: Certificate) -> list[tuple[str, str]]:
    rows = [("certificate", proof(certificate).capitalize())]
    rows.append(("expected false sets", f"{chance(certificate)} of {certificate.lower_bound} matches"))
    if not is_knowable(certificate):
        rows.append(("warning", UNKNOWABLE))
    return rows


def verdict(trace: Trace, success: bool | None) -> str:
    """What became of a run, in a few words; ``success`` is None if the truth is unknown."""
    if trace.cam_from_map is None:
        return "no pose"
    return {True: "success", False: "failure", None: "pose found, truth unknown"}[success]
