"""A sequence on the canvas: places, colours by error, and what has no pose."""

from dataclasses import replace

import numpy as np

from spherloc.experiments.results import FAILED, LOCALIZED, QueryResult
from spherloc.geometry import align_to_down, pose
from spherloc_viz import style
from spherloc_viz.layers.primitives import Label, Points, Segments
from spherloc_viz.layers.scene import trajectory_items

LIMIT_M = 1.0


def row(index: int, found: tuple[float, float, float] | None, truth: tuple[float, float, float] | None) -> QueryResult:
    """A query whose camera was found and truly was at these places, unturned."""
    poses = [None if place is None else pose(np.eye(3), -np.array(place)) for place in (found, truth)]
    status = FAILED if found is None else LOCALIZED
    return QueryResult(index, f"q{index}", status, float(index), cam_from_map=poses[0], truth_cam_from_map=poses[1])


def drawn(rows: list[QueryResult], map_turn: np.ndarray) -> tuple[Points, Segments, Segments]:
    dots, truth, errors, *_ = trajectory_items(rows, map_turn, LIMIT_M)
    assert isinstance(dots, Points) and isinstance(truth, Segments) and isinstance(errors, Segments)
    return dots, truth, errors


def test_dots_stand_where_cameras_were_found_and_have_the_colour_of_their_error() -> None:
    turn = align_to_down(np.array([0.0, 0.0, -1.0]))
    rows = [row(0, (0, 0, 0), (0, 0, 0)), row(1, (1, 0.5, 0), (1, 0, 0)), row(2, (2, 9, 0), (2, 0, 0))]
    dots, truth, errors = drawn(rows, turn)
    assert np.allclose(dots.positions, np.array([[0, 0, 0], [1, 0.5, 0], [2, 9, 0]]) @ turn.T)
    assert dots.ids is None and dots.photographs == ("q0", "q1", "q2")
    assert [tuple(color) for color in dots.colors] == [style.ERROR_RAMP[0], style.ERROR_RAMP[-1], style.OUTLIER]
    assert len(truth.points) == 2 and np.allclose(truth.points[1], np.array([[1, 0, 0], [2, 0, 0]]) @ turn.T)
    assert np.allclose(np.linalg.norm(errors.points[:, 1] - errors.points[:, 0], axis=1), [0, 0.5, 9])


def test_failures_are_marked_where_they_should_be_and_gaps_are_left_open() -> None:
    rows = [row(0, (0, 0, 0), (0, 0, 0)), row(1, None, (1, 0, 0)), row(2, (2, 0, 0), None), row(3, None, None)]
    dots, truth, errors = drawn(rows, np.eye(3))
    assert np.allclose(dots.positions, [[0, 0, 0], [1, 0, 0], [2, 0, 0]]) and dots.photographs == ("q0", "q1", "q2")
    assert tuple(dots.colors[1]) == style.OUTLIER and tuple(dots.colors[2]) == style.ESTIMATE
    assert len(truth.points) == 1 and len(errors.points) == 1
    assert np.isfinite(dots.positions).all() and dots.radius_m > 0


def test_true_positions_of_photographs_without_times_are_not_joined() -> None:
    rows = [row(k, (k, 1, 0), (k, 0, 0)) for k in range(3)]
    assert len(drawn(rows, np.eye(3))[1].points) == 2
    for unordered in ([replace(one, timestamp_s=None) for one in rows], rows[::-1]):
        dots, truth, errors = drawn(unordered, np.eye(3))
        assert len(truth.points) == 0 and len(dots.positions) == len(errors.points) == 3


def test_a_single_query_has_a_dot_of_some_size() -> None:
    dots, truth, errors = drawn([row(0, (5, 5, 5), None)], np.eye(3))
    assert len(dots.positions) == 1 and dots.radius_m > 0 and len(truth.points) == len(errors.points) == 0


def test_dots_leave_room_between_places_whatever_their_order() -> None:
    """Photographs of two rooms by turns, some at one spot; one that is far away does not make the others large."""
    places = [(10.0 * (k % 2), 0.1 * k, 0.0) for k in range(40)]
    dots, *_ = drawn([row(k, place, None) for k, place in enumerate([*places, places[-1], (1e8, 0, 0)])], np.eye(3))
    assert 0.01 < dots.radius_m < 0.02
    close = [row(k, (1e-4 * k, 0.0, 10.0 * (k % 2)), None) for k in range(40)]
    assert 0.005 < drawn(close, np.eye(3))[0].radius_m < 0.02  # still to be seen


def test_the_ramp_spans_the_successes() -> None:
    colors = style.error_colors(np.array([0.0, 0.1, 0.2, 50.0, np.inf, np.nan]), 2.0)
    assert [tuple(color) for color in colors[:3]] == list(style.ERROR_RAMP)
    assert all(tuple(color) == style.OUTLIER for color in colors[3:])
    assert style.error_scale(np.array([0.0, np.nan]), 2.0) == 2.0 and style.error_scale(np.array([3.0]), 2.0) == 2.0
    assert tuple(style.error_colors(np.array([0.0]), 2.0)[0]) == style.ERROR_RAMP[0]


def test_few_queries_are_named_above_their_dots() -> None:
    turn = align_to_down(np.array([0.0, 0.0, -1.0]))
    rows = [row(0, (0, 0, 0), None), row(1, None, None), row(2, (2, 0, 0), None)]
    dots, _, _, *names = trajectory_items(rows, turn, LIMIT_M)
    assert isinstance(dots, Points)
    for name, text, place in zip(names, ("q0", "q2"), dots.positions, strict=True):
        assert isinstance(name, Label) and name.text == text
        assert name.position[1] < place[1] and np.allclose(name.position[[0, 2]], place[[0, 2]])
    assert len(trajectory_items([row(k, (k, 0, 0), None) for k in range(13)], turn, LIMIT_M)) == 3
