"""Several estimators on one problem: a table, their cameras side by side, and their curves in one chart."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spherloc import registry
from spherloc.diagnosis import Diagnosis
from spherloc.geometry import camera_centre, yaw_of
from spherloc.metrics import evaluate, extent_of, is_beyond
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.trace import Certificate, ConsensusStage, Trace, YawStage
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.camera_shape import camera
from spherloc_viz.layers.frame import RunView, length_text, one_color
from spherloc_viz.layers.outcome import is_knowable
from spherloc_viz.layers.primitives import Chart, Curve, Label, SceneItem, Segments, Table

PALETTE: tuple[style.RGB, ...] = (
    (150, 205, 20),
    (255, 135, 60),
    (20, 120, 130),
    (90, 75, 235),
    (150, 100, 60),
    (255, 205, 170),
    (155, 15, 75),
    (160, 240, 190),
    (120, 20, 140),
    (70, 120, 20),
)
"""Colours of estimators: far from each other and from those of ``style.LEGEND``, which mean something else."""
FIRST = ("mc-exact", "mc", "ransac-2p", "auto")
"""Estimators that have the first colours; others follow in alphabetical order."""
NO_VALUE = "–"
COLUMNS = (
    "estimator",
    "outcome",
    "rotation",
    "position",
    "inliers",
    "precision",
    "recall",
    "F1",
    "time",
    "certificate",
    "diagnosis",
)
REACH = 2.0
"""Residuals are shown up to this many times the largest noise bound."""
SAMPLES = 120
"""Number of points of a residual curve."""
SMALLER = 0.09
"""Cameras at one position are nested: each is smaller than the one before by this share of the first one's size."""
SIZE, TOWER, STOREY = 1.9, 1.75, 1.1
"""Size of the first camera, and heights of the lowest label and of each label above it, in sphere radii."""
ROW, NEAR = 3, 6.0
"""Most names on a label, and the distance within which labels at one height would hide each other, in sphere radii."""
LOWER = 0.07
"""Markers at one yaw differ in height: each is lower than the one before by this share of the first one's height."""


@dataclass(frozen=True, eq=False)
class Entry:
    """One estimator's run."""

    trace: Trace
    diagnosis: Diagnosis | None = None
    """Diagnosis of the run; None until it is known."""

    @property
    def color(self) -> style.RGB:
        """Colour of the estimator."""
        return color_of(self.trace.estimator)


def color_of(estimator: str) -> style.RGB:
    """The colour of a registered estimator, always the same."""
    known = registry.names("estimators")
    order = [*(name for name in FIRST if name in known), *(name for name in known if name not in FIRST)]
    return PALETTE[order.index(estimator) % len(PALETTE)]


def comparison_table(entries: Sequence[Entry]) -> Table:
    """A table with a row for each estimator, all values as text."""
    return Table("comparison", COLUMNS, tuple(_row(entry) for entry in entries))


def _row(entry: Entry) -> tuple[str, ...]:
    trace, metrics = entry.trace, evaluate(entry.trace)
    turn, shift = metrics.rotation_error_deg, metrics.translation_error_m
    return (
        trace.estimator,
        outcome(trace),
        NO_VALUE if turn is None else f"{turn:.3f}°" if turn < 10 else f"{turn:.0f}°",
        NO_VALUE if shift is None else _length(shift, trace.problem),
        f"{np.count_nonzero(trace.inlier_mask)}",
        *(
            NO_VALUE if share is None or trace.cam_from_map is None else f"{100 * share:.0f} %"
            for share in (metrics.precision, metrics.recall, metrics.f1)
        ),
        duration_text(trace.timings_ms["total"]),
        NO_VALUE if trace.certificate is None else _proof(trace.certificate),
        "…" if entry.diagnosis is None else str(entry.diagnosis.cause),
    )


def outcome(trace: Trace) -> str:
    """The outcome of a run in a word or two."""
    if trace.cam_from_map is None:
        return "no pose"
    return {True: "success", False: "failure", None: "unknown"}[evaluate(trace).success]


def _length(metres: float, problem: Problem) -> str:
    extent_m = extent_of(problem.points)
    if not problem.metric or is_beyond(metres, extent_m):
        return length_text(metres, problem.metric, extent_m)
    return f"{100 * metres:.2f} cm" if metres < 1.0 else f"{metres:.2f} m" if metres < 100 else f"{metres:.0f} m"


def duration_text(ms: float) -> str:
    """A duration as text, in a unit that suits its length."""
    return f"{ms:.1f} ms" if ms < 100 else f"{ms:.0f} ms" if ms < 1e4 else f"{ms / 1e3:.1f} s"


def _proof(certificate: Certificate) -> str:
    proof = "optimal" if certificate.proven else f"gap {certificate.gap}"
    return proof if is_knowable(certificate) else f"{proof}, not knowable"


def comparison_items(entries: Sequence[Entry]) -> tuple[SceneItem, ...]:
    """Every estimated camera in its estimator's colour, with its name on a mast; cameras that are not clearly apart
    share a mast, with ``ROW`` names on a label."""
    cameras: list[Segments] = []
    groups: list[tuple[FloatArray, list[int]]] = []
    found = [entry for entry in entries if entry.trace.cam_from_map is not None]
    for number, entry in enumerate(found):
        view = RunView(entry.trace)
        assert entry.trace.cam_from_map is not None
        pose, name = view.aligned_pose(entry.trace.cam_from_map), entry.trace.estimator
        centre = camera_centre(pose)
        group = next((one for one in groups if np.linalg.norm(one[0] - centre) < view.sphere_m), None)
        if group is None:
            groups.append(group := (centre, []))
        size_m = SIZE * view.sphere_m * max(0.3, 1.0 - SMALLER * len(group[1]))
        group[1].append(number)
        cameras.append(camera(f"comparison/{name}", pose, size_m, entry.color, 2.5))
    labels: list[Label] = []
    for centre, members in groups:
        names = [found[number].trace.estimator for number in members]
        sphere_m, color = RunView(found[members[0]].trace).sphere_m, found[members[0]].color
        rows = [names[k : k + ROW] for k in range(0, len(names), ROW)]
        for row in rows:
            top = _free(centre - np.array([0.0, TOWER * sphere_m, 0.0]), labels, sphere_m)
            labels.append(Label(f"names/{row[0]}", "cameras", top, ", ".join(row)))
        mast = Segments("", "cameras", np.array([[centre, labels[-1].position]]), one_color(color, 1), 0.0)
        cameras[members[0]] = _joined(cameras[members[0]], mast)
    return (*cameras, *labels)


def _free(place: FloatArray, labels: Sequence[Label], sphere_m: float) -> FloatArray:
    """The lowest place (3,) for one more label, above or at a place (3,), at which no other hides it."""
    reach_m, storey_m = NEAR * sphere_m, STOREY * sphere_m
    near = [
        label.position[1]
        for label in labels
        if np.hypot(*(label.position - place)[[0, 2]]) < reach_m  # -y is up
    ]
    for y in sorted(near, reverse=True):
        if abs(place[1] - y) < storey_m:
            place = np.array([place[0], y - storey_m, place[2]])
    return place


def _joined(one: Segments, other: Segments) -> Segments:
    """Both as one item, which is named and drawn like the first."""
    points, colors = np.concatenate([one.points, other.points]), np.concatenate([one.colors, other.colors])
    return Segments(one.name, one.layer, points, colors, one.width_px)


def residual_chart(entries: Sequence[Entry]) -> Chart:
    """Number of matches with a residual of at most x px, for every estimator's pose and, if known, the true one."""
    bounds = sorted({float(entry.trace.options.bound_px) for entry in entries})
    x = np.linspace(0.0, REACH * bounds[-1], SAMPLES)
    problem = entries[0].trace.problem
    curves = []
    if problem.truth_cam_from_map is not None:
        curves.append(Curve("truth", x, _within(entries[0].trace, problem.truth_cam_from_map, x), style.TRUTH))
    for entry in entries:
        pose = entry.trace.cam_from_map
        if pose is not None:
            curves.append(Curve(entry.trace.estimator, x, _within(entry.trace, pose, x), entry.color))
    height = max([1.0, *(float(curve.y[-1]) for curve in curves)])
    for bound in bounds:
        at = np.array([bound])
        curves.append(Curve(f"bound {bound:g} px", at, np.array([height]), style.UNDECIDED, "marker"))
    return Chart("comparison-residuals", "Matches within x px of the pose", "residual (px)", "matches", tuple(curves))


def coinciding(chart: Chart) -> str:
    """A sentence for each set of equal curves, of which only the last can be seen; empty if all differ."""
    groups: dict[bytes, list[str]] = {}
    for curve in chart.curves:
        groups.setdefault(curve.x.tobytes() + curve.y.tobytes(), []).append(curve.label)
    return " ".join(
        f"{', '.join(labels[:-1])} and {labels[-1]} have the same curve."
        for labels in groups.values()
        if len(labels) > 1
    )


def _within(trace: Trace, cam_from_map: FloatArray, x: FloatArray) -> FloatArray:
    aligned = trace.problem.aligned
    residuals = np.sort(residuals_px(aligned, aligned.align_pose(cam_from_map)))
    return np.searchsorted(residuals, x, side="right").astype(np.float64)


def yaw_chart(entries: Sequence[Entry]) -> Chart | None:
    """The counts of one estimator over yaw, with the yaws that all of them found; None if no estimator has counts."""
    counted = next(filter(None, (_counts(entry.trace) for entry in entries)), None)
    if counted is None:
        return None
    label, counts = counted
    yaws = np.degrees(np.linspace(-np.pi, np.pi, len(counts) + 1)[:-1])
    curve = Curve(label, yaws, counts.astype(np.float64), style.UNDECIDED, "step")
    peak = max(1.0, float(counts.max()))
    return Chart("comparison-yaw", "The yaw that each found", "yaw (°)", label, (curve, *yaw_markers(entries, peak)))


def _counts(trace: Trace) -> tuple[str, np.ndarray] | None:
    arcs, consensus = trace.stage(YawStage), trace.stage(ConsensusStage)
    if arcs is not None:
        return "arcs that overlap", arcs.overlap
    return None if consensus is None else ("matches at most", consensus.bound)


def yaw_markers(entries: Sequence[Entry], height: float) -> tuple[Curve, ...]:
    """The true yaw, if it is known, and every estimator's, each lower than the one before so that all can be seen."""
    view = RunView(entries[0].trace)
    poses = [] if view.truth is None else [("truth", view.truth, style.TRUTH)]
    for entry in entries:
        if entry.trace.cam_from_map is not None:
            poses.append((entry.trace.estimator, view.aligned_pose(entry.trace.cam_from_map), entry.color))
    return tuple(
        Curve(
            label,
            np.array([np.degrees(yaw_of(pose[:, :3]))]),
            np.array([height * max(0.2, 1.0 - LOWER * place)]),
            color,
            "marker",
        )
        for place, (label, pose, color) in enumerate(poses)
    )
