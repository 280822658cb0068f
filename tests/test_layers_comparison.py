"""Several estimators on one problem: what the table says, what the canvas shows, what the curves count."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from spherloc import registry
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.diagnosis import diagnose
from spherloc.estimators import estimate, options_type
from spherloc.geometry import camera_centre, yaw_of
from spherloc.metrics import evaluate
from spherloc.refine import residuals_px
from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.layers.comparison import (
    PALETTE,
    Entry,
    coinciding,
    color_of,
    comparison_items,
    comparison_table,
    residual_chart,
    yaw_chart,
)
from spherloc_viz.layers.frame import RunView
from spherloc_viz.layers.primitives import Label, Segments

NAMES = ("mc-exact", "mc", "ransac-2p", "ransac-svd")


@pytest.fixture(scope="module")
def traces(scene_of: Callable[..., SyntheticScene]) -> tuple[Trace, ...]:
    problem = scene_of("panorama", correspondences=40, outlier_rate=0.3, seed=4).problem()
    return tuple(estimate(problem, name) for name in NAMES)


@pytest.fixture(scope="module")
def entries(traces: tuple[Trace, ...]) -> tuple[Entry, ...]:
    return tuple(Entry(trace, diagnose(trace)) for trace in traces)


def without_pose(trace: Trace) -> Trace:
    return replace(
        trace, cam_from_map=None, inlier_mask=np.zeros(len(trace.problem), bool), certificate=None, stages=()
    )


def lightness_and_hue(color: style.RGB) -> np.ndarray:
    """OKLab, in which equal distances look equally far apart (Ottosson 2020)."""
    value = np.array(color) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    cones = np.array(
        [
            [0.4122214708, 0.5363325363, 0.0514459929],
            [0.2119034982, 0.6806995451, 0.1073969566],
            [0.0883024619, 0.2817188376, 0.6299787005],
        ]
    )
    lab = np.array(
        [
            [0.2104542553, 0.7936177850, -0.0040720468],
            [1.9779984951, -2.4285922050, 0.4505937099],
            [0.0259040371, 0.7827717662, -0.8086757660],
        ]
    )
    return lab @ np.cbrt(cones @ linear)


def test_colours_of_estimators_mean_nothing_else() -> None:
    colors = {name: color_of(name) for name in registry.names("estimators")}
    assert len(set(colors.values())) == len(colors) <= len(PALETTE)
    meanings = [color for color, _ in style.LEGEND] + [style.SPHERE]
    for number, color in enumerate(PALETTE):
        others = [*meanings, *PALETTE[:number], *PALETTE[number + 1 :]]
        distance = min(np.linalg.norm(lightness_and_hue(color) - lightness_and_hue(other)) for other in others)
        assert distance > 0.1, (color, distance)


def test_the_table_says_what_was_found(entries: tuple[Entry, ...]) -> None:
    table = comparison_table(entries)
    for entry, row in zip(entries, table.rows, strict=True):
        value, metrics = dict(zip(table.columns, row, strict=True)), evaluate(entry.trace)
        assert metrics.rotation_error_deg is not None and metrics.translation_error_m is not None
        assert value["estimator"] == entry.trace.estimator and value["outcome"] == "success"
        assert abs(float(value["rotation"][:-1]) - metrics.rotation_error_deg) < 1e-3 and value["rotation"][-1] == "°"
        assert value["position"].endswith(" cm")
        assert abs(float(value["position"][:-3]) - 100 * metrics.translation_error_m) < 1e-2
        assert int(value["inliers"]) == np.count_nonzero(entry.trace.inlier_mask)
        assert value["F1"] == f"{100 * (metrics.f1 or 0):.0f} %" and value["time"].endswith("s")
        assert entry.diagnosis is not None and value["diagnosis"] == entry.diagnosis.cause
        assert (value["certificate"] == "–") == (entry.trace.certificate is None)


def test_no_pose_and_no_truth_leave_gaps(traces: tuple[Trace, ...]) -> None:
    blind = replace(traces[0].problem, truth_cam_from_map=None, truth_inliers=None)
    lost, unjudged = without_pose(traces[1]), estimate(blind, "mc")
    table = comparison_table([Entry(lost), Entry(unjudged)])
    first, second = (dict(zip(table.columns, row, strict=True)) for row in table.rows)
    assert first["outcome"] == "no pose" and second["outcome"] == "unknown"
    for value in (first, second):
        assert {value[key] for key in ("rotation", "position", "precision", "recall", "F1")} == {"–"}
        assert value["diagnosis"] == "…"
    assert [item.name for item in comparison_items([Entry(lost), Entry(unjudged)])] == ["comparison/mc", "names/mc"]
    chart = residual_chart([Entry(unjudged)])
    assert [curve.label for curve in chart.curves] == ["mc", "bound 3 px"]
    assert yaw_chart([Entry(lost)]) is None


def test_every_camera_is_where_its_estimator_says(entries: tuple[Entry, ...]) -> None:
    items = {item.name: item for item in comparison_items(entries)}
    labels = [item for item in items.values() if isinstance(item, Label)]
    assert sorted(name for label in labels for name in label.text.split(", ")) == sorted(NAMES)
    masts = 0
    for entry in entries:
        name = entry.trace.estimator
        lines = items[f"comparison/{name}"]
        assert isinstance(lines, Segments) and entry.trace.cam_from_map is not None
        view = RunView(entry.trace)
        centre = camera_centre(view.aligned_pose(entry.trace.cam_from_map))
        assert np.allclose(lines.points[0, 0], centre)
        assert np.all(lines.colors == color_of(name)) and len(lines.colors) == len(lines.points)
        (label,) = (label for label in labels if name in label.text.split(", "))
        assert label.position[1] < centre[1] and np.linalg.norm((label.position - centre)[[0, 2]]) < view.sphere_m
        masts += any(np.allclose(lines.points[-1], [centre, label.position]) for label in labels)
    assert masts >= 1


def moved(entry: Entry, name: str, shift: np.ndarray) -> Entry:
    """The entry as if another estimator had found a pose that stands elsewhere by ``shift`` (3,), m."""
    pose = entry.trace.cam_from_map
    assert pose is not None
    other = np.column_stack([pose[:, :3], pose[:, 3] - pose[:, :3] @ shift])
    return Entry(replace(entry.trace, estimator=name, cam_from_map=other))


def test_names_of_cameras_do_not_hide_one_another(entries: tuple[Entry, ...]) -> None:
    """Four at one place have two labels; one that stands two spheres beside them has a label higher than both."""
    sphere_m = RunView(entries[0].trace).sphere_m
    level = entries[0].trace.problem.aligned.map_turn.T @ np.array([1.0, 0.0, 0.0])
    same = [moved(entries[0], name, np.zeros(3)) for name in ("mc-exact", "mc", "auto", "ransac-2p")]
    items = comparison_items([*same, moved(entries[0], "ransac-svd", 2.0 * sphere_m * level)])
    labels = [item for item in items if isinstance(item, Label)]
    assert [label.text for label in labels] == ["mc-exact, mc, auto", "ransac-2p", "ransac-svd"]
    heights = -np.array([label.position[1] for label in labels])
    assert np.all(np.diff(heights) > 0.9 * sphere_m)


def test_curves_count_matches_within_a_residual(entries: tuple[Entry, ...]) -> None:
    chart, problem = residual_chart(entries), entries[0].trace.problem
    curves = {curve.label: curve for curve in chart.curves}
    assert list(curves) == ["truth", *NAMES, "bound 3 px", "bound 8 px"]
    poses = {entry.trace.estimator: entry.trace.cam_from_map for entry in entries}
    for label, pose in {"truth": problem.truth_cam_from_map, **poses}.items():
        assert pose is not None
        residuals = residuals_px(problem.aligned, problem.aligned.align_pose(pose))
        x, y = curves[label].x, curves[label].y
        assert x[0] == 0 and x[-1] == 16.0, "twice the largest bound"
        for k in (0, 30, 77, len(x) - 1):
            assert y[k] == np.count_nonzero(residuals <= x[k])
    assert curves["truth"].color == style.TRUTH and curves["mc"].color == color_of("mc")
    assert curves["bound 8 px"].x[0] == 8.0


def test_curves_that_cannot_be_told_apart_are_named(entries: tuple[Entry, ...]) -> None:
    twice = residual_chart([entries[0], replace(entries[0], trace=replace(entries[0].trace, estimator="auto"))])
    assert "mc-exact and auto have the same curve." in coinciding(twice)
    assert coinciding(replace(twice, curves=twice.curves[1:2])) == ""


def test_yaws_are_marked_where_they_were_found(entries: tuple[Entry, ...]) -> None:
    chart = yaw_chart(entries)
    assert chart is not None and chart.curves[0].kind == "step" and len(chart.curves[0].x) == 1440
    markers = {curve.label: curve for curve in chart.curves[1:]}
    assert list(markers) == ["truth", *NAMES]
    for entry in entries:
        assert entry.trace.cam_from_map is not None
        yaw = yaw_of(RunView(entry.trace).aligned_pose(entry.trace.cam_from_map)[:, :3])
        assert np.isclose(markers[entry.trace.estimator].x[0], np.degrees(yaw))
    heights = [curve.y[0] for curve in markers.values()]
    assert np.all(np.diff(heights) < 0), "each must show above the next"
    assert yaw_chart(entries[2:]) is None, "RANSAC counts nothing over yaw"


def test_what_was_asked_for_is_what_the_bound_shows(traces: tuple[Trace, ...]) -> None:
    wide = estimate(traces[0].problem, "mc", options_type("mc")(bound_px=5.5))
    assert [curve.label for curve in residual_chart([Entry(wide)]).curves] == ["truth", "mc", "bound 5.5 px"]
