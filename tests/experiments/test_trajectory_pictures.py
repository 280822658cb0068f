"""Pictures of sequences from above: the map is there, names can be read, and nothing is said of the wrong place."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Annotation

from spherloc.experiments import QueryResult
from spherloc.experiments.configuration import Configuration
from spherloc.experiments.results import SequenceResults
from spherloc.geometry import pose
from spherloc_viz.plots import trajectories
from spherloc_viz.plots.trajectories import Backdrop, trajectories_png, trajectory_png
from spherloc_viz.style import OUTLIER, css

FACING_X = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Camera axes in a map whose z points up: the camera looks along x."""
SETTING = Configuration(
    scene="rooms.toml",
    scene_sha256="0" * 64,
    name="rooms",
    estimator="mc",
    options={},
    seed=0,
    versions={},
    queries=4,
    gravity_map=np.array([0.0, 0.0, -1.0]),
    thresholds=((1.0, 0.1), (5.0, 0.5)),
    registration_thresholds_m=None,
)
ROOM = Backdrop(np.random.default_rng(3).uniform(-6.0, 6.0, (800, 3)), np.array([[-2.0, 0.0, 1.5], [2.0, 0.0, 1.5]]))


def query(index: int, name: str, x: float, y: float, **changes: Any) -> QueryResult:
    at = pose(FACING_X, -FACING_X @ [x, y, 1.5])
    return replace(QueryResult(index, name, "localized", cam_from_map=at), **changes)


def without_pose(index: int, name: str, **changes: Any) -> QueryResult:
    return QueryResult(index, name, "failed", **changes)


def results(*rows: QueryResult) -> SequenceResults:
    return SequenceResults(Path("out"), SETTING, rows)


@pytest.fixture
def figure_of(monkeypatch):
    """Gives the figure of a picture instead of its bytes, drawn once."""

    def draw(picture, *about):
        monkeypatch.setattr(trajectories, "png_of", lambda figure: figure)
        figure = picture(*about)
        figure.canvas.draw()
        return figure

    return draw


def names_in(axes) -> dict[str, Annotation]:
    return {text.get_text(): text for text in axes.texts if isinstance(text, Annotation)}


def legend_of(figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_map_and_directions_of_view_are_drawn(figure_of):
    figure = figure_of(trajectory_png, results(query(0, "a.png", -3.0, 1.0), query(1, "b.png", 3.0, -2.0)), ROOM)
    (axes,) = figure.axes
    assert any(len(line.get_xdata()) == len(ROOM.points) for line in axes.lines)
    assert {"points of the map", "images of the map: 2", "direction of view"} <= set(legend_of(figure))
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    inside = (ROOM.points[:, :2] >= [left, bottom]).all(axis=1) & (ROOM.points[:, :2] <= [right, top]).all(axis=1)
    assert inside.mean() > 0.5
    far = replace(ROOM, points=np.concatenate([ROOM.points, 100.0 * ROOM.points[:80]]))
    (axes,) = figure_of(trajectory_png, results(query(0, "a.png", -3.0, 1.0), query(1, "b.png", 3.0, -2.0)), far).axes
    assert np.ptp(axes.get_xlim()) < 15.0, "points far away are cut"
    assert axes.get_xlabel() == "x of the map, metres" and axes.get_ylabel() == "y of the map, metres"
    arrows = next(drawn for drawn in axes.collections if hasattr(drawn, "U"))
    np.testing.assert_allclose([arrows.U, arrows.V], [[1.0, 1.0], [0.0, 0.0]], atol=1e-12)


def test_names_are_whole_and_apart(figure_of):
    """Three queries side by side at the right edge, as a rig of cameras gives them."""
    near = [query(k, f"camera_right_{k}.png", 5.5 + 0.01 * k, 5.5) for k in range(3)]
    (axes,) = figure_of(trajectory_png, results(*near, query(3, "first.png", -5.0, -5.0)), ROOM).axes
    boxes = {name: text.get_window_extent() for name, text in names_in(axes).items()}
    assert len(boxes) == 4
    edge = axes.get_window_extent()
    for name, box in boxes.items():
        assert edge.x0 <= box.x0 and box.x1 <= edge.x1 and edge.y0 <= box.y0 and box.y1 <= edge.y1, name
        assert not any(box.overlaps(other) for called, other in boxes.items() if called != name), name


def test_failures_are_named_among_many_queries(figure_of):
    rows = [query(k, f"image{k}.png", 0.5 * k - 5.0, 0.0) for k in range(20)]
    rows[4] = replace(rows[4], status="doubtful")
    rows += [without_pose(20 + k, f"cost$_{k}$.png") for k in range(6)]
    figure = figure_of(trajectory_png, results(*rows), ROOM)
    named = names_in(figure.axes[0])
    assert list(named) == ["image4.png"] and named["image4.png"].get_color() == css(OUTLIER)
    lost = next(text for text in legend_of(figure) if "place unknown" in text)
    assert lost.endswith("cost$_0$.png, cost$_1$.png, cost$_2$.png, cost$_3$.png and 2 more")
    assert not any(text.get_parse_math() for text in figure.legends[0].get_texts())


def test_a_failure_with_a_known_place_is_named_there(figure_of):
    truth = pose(FACING_X, -FACING_X @ [2.0, 3.0, 1.5])
    rows = [query(0, "a.png", -2.0, -2.0), without_pose(1, "lost.png", truth_cam_from_map=truth)]
    named = names_in(figure_of(trajectory_png, results(*rows), ROOM).axes[0])
    np.testing.assert_allclose(named["lost.png"].xy, [2.0, 3.0], atol=1e-12)


def test_queries_in_a_small_part_of_the_map_have_a_panel_of_their_own(figure_of):
    rows = [query(k, f"{k}.png", 0.1 * k, 0.0) for k in range(3)]
    whole, alone = figure_of(trajectory_png, results(*rows), ROOM).axes
    assert np.ptp(whole.get_xlim()) > 8.0 and np.ptp(alone.get_xlim()) < 1.0
    assert not names_in(whole) and len(names_in(alone)) == 3


def test_the_bar_of_colours_says_what_it_measures(figure_of):
    seen = query(0, "a.png", -3.0, 0.0)
    truth = {"truth_cam_from_map": seen.cam_from_map, "rotation_error_deg": 0.1}
    rows = [replace(seen, translation_error_m=0.05, **truth), query(1, "b.png", 3.0, 0.0)]
    _, bar = figure_of(trajectory_png, results(*rows), ROOM).axes
    assert bar.get_ylabel() == "position error, metres"


def test_the_picture_of_several_estimators_has_the_map(figure_of):
    truth = pose(FACING_X, -FACING_X @ [2.0, 3.0, 1.5])
    found = results(query(0, "a.png", -2.0, -2.0), without_pose(1, "lost.png", truth_cam_from_map=truth))
    figure = figure_of(trajectories_png, [("mc", found), ("ransac-2p", found)], ROOM)
    assert {"points of the map", "images of the map: 2"} <= set(legend_of(figure))
    assert any(text.get_text() == "lost.png" for text in figure.axes[-1].texts)


def test_the_legend_of_several_estimators_tells_lines_and_crosses(figure_of):
    true = [pose(FACING_X, -FACING_X @ [x, 3.0, 1.5]) for x in (-2.0, 0.0, 2.0)]
    near = query(0, "a.png", -2.0, 3.05, truth_cam_from_map=true[0], translation_error_m=0.05, rotation_error_deg=0.1)
    off = query(1, "b.png", -1.0, 3.0, truth_cam_from_map=true[1], translation_error_m=1.0, rotation_error_deg=0.1)
    lost = without_pose(2, "c.png", truth_cam_from_map=true[2])
    dashes, cross = "error beyond 0.5 m, to the true position", "without a pose, or with one outside the picture"
    for rows, said in (
        ((near,), set()),
        ((near, off), {dashes}),
        ((near, lost), {cross}),
        ((off, lost), {dashes, cross}),
    ):
        several = [("mc", results(near, near, near)), ("other", results(*rows))]
        legend = legend_of(figure_of(trajectories_png, several, ROOM))
        assert {dashes, cross} & set(legend) == said
        assert len(legend) == len(set(legend))


def test_results_of_some_queries_are_drawn_beside_those_of_all(figure_of):
    """An estimator may have localized more queries before, of which the picture shows all."""
    rows = [query(k, f"{k}.png", 2.0 * k - 4.0, 1.0) for k in range(5)]
    rows = [replace(row, truth_cam_from_map=row.cam_from_map, translation_error_m=0.0) for row in rows]
    for several in ((results(*rows), results(*rows[:2])), (results(*rows[:2]), results(*rows))):
        (axes,) = figure_of(trajectories_png, [(str(k), found) for k, found in enumerate(several)], ROOM).axes
        (truth,) = [line for line in axes.lines if line.get_label() == "truth"]
        assert len(truth.get_xdata()) == 5


def test_several_estimators_are_compared_by_errors_where_there_is_truth_else_by_what_is_localized(figure_of):
    posed, doubted = query(0, "a.png", -2.0, -2.0), replace(query(1, "b.png", 2.0, 1.0), status="doubtful")
    legend = legend_of(figure_of(trajectories_png, [("mc", results(posed, doubted)), ("other", results(posed))], ROOM))
    assert {"mc: 1 of 2 localized", "other: 1 of 1 localized"} <= set(legend)
    right = replace(posed, truth_cam_from_map=posed.cam_from_map, rotation_error_deg=0.1, translation_error_m=0.05)
    assert "mc: 1 of 2 within 0.5 m" in legend_of(figure_of(trajectories_png, [("mc", results(right, doubted))], ROOM))


def test_unordered_photographs_are_not_joined(figure_of):
    rows = [query(k, f"{k}.png", 2.0 * k - 4.0, 0.0) for k in range(3)]
    rows = [replace(row, truth_cam_from_map=row.cam_from_map) for row in rows]
    (axes,) = figure_of(trajectory_png, results(*rows), ROOM).axes
    assert not [line for line in axes.lines if line.get_linestyle() != "None" and len(line.get_xdata()) > 1]


def test_a_map_without_points_or_results_is_drawn():
    empty = Backdrop(np.zeros((0, 3)), np.zeros((0, 3)))
    assert trajectory_png(results(without_pose(0, "街.png")), empty).startswith(b"\x89PNG")


def test_images_of_the_map_beside_the_queries_are_framed_and_named(figure_of):
    rows = [query(0, "new_0", 0.0, 0.0), query(1, "new_1", 4.0, 0.0)]
    images = np.array([[-1.0, 0.0, 1.5], [2.0, 0.0, 1.5], [6.0, 0.0, 1.5], [60.0, 0.0, 1.5]])
    street = Backdrop(np.random.default_rng(3).uniform(-60.0, 60.0, (800, 3)), images, ("a", "b", "c", "far"))
    _, near = figure_of(trajectory_png, results(*rows), street).axes
    left, right = near.get_xlim()
    assert left < -1.0 and 6.0 < right < 20.0
    assert {"a", "b", "c", "new_0", "new_1"} == set(names_in(near))
