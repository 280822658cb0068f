"""Localizing a sequence: its numbers against their definitions, its order, and one bad query among good ones."""

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest
from sequence_samples import CAMERA, true_pose, write_scene

from spherloc.datasets import load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError
from spherloc.estimators import options_type
from spherloc.experiments import SequenceResults
from spherloc.experiments.configuration import configuration_of
from spherloc.experiments.results import QueryResult
from spherloc.experiments.sequence import How, chosen_queries, localize_by_each, localize_queries
from spherloc.experiments.summary import (
    estimated_trajectory,
    summarize,
    timed,
    true_trajectory,
    vehicle_trajectory,
    wilson,
)
from spherloc_viz.commands.sequence_text import sequence_text
from tests.waiting import LIMIT_S


def scene_of(folder: Path, **keys) -> MapScene:
    scene = load_scene(write_scene(folder, **keys))
    assert isinstance(scene, MapScene)
    return scene


def solve(scene: MapScene, estimator: str = "mc") -> list:
    return list(localize_queries(scene, scene.queries, estimator, options_type(estimator)(), 0))


def results_of(scene: MapScene, rows) -> SequenceResults:
    configuration = configuration_of(scene, Path(scene.where), "mc", options_type("mc")(), 0)
    return SequenceResults(Path(scene.where).parent, configuration, tuple(rows))


def wrapped_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pixels between points of a panorama, over the seam where that is shorter."""
    across = np.abs(a[:, 0] - b[:, 0])
    return np.hypot(np.minimum(across, CAMERA.width - across), a[:, 1] - b[:, 1])


@pytest.mark.usefixtures("drawn")
def test_errors_and_scores_are_what_they_are_defined_to_be(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, queries=4)
    for place, (row, trace) in enumerate(solve(scene)):
        assert trace is not None and row.cam_from_map is not None and row.status == "localized"
        truth, found = true_pose(place), row.cam_from_map
        angle = Rotation.from_matrix(truth[:, :3].T @ found[:, :3]).magnitude()
        assert row.rotation_error_deg == pytest.approx(np.degrees(angle), abs=1e-9)
        centre = np.linalg.solve(found[:, :3], -found[:, 3])
        expected = np.array([1.5 * place, 0.3 * place**1.5, 1.7])
        assert row.translation_error_m == pytest.approx(np.linalg.norm(centre - expected), abs=1e-9)
        np.testing.assert_allclose(row.position_m, centre, atol=1e-9)
        np.testing.assert_allclose(row.true_position_m, expected, atol=1e-9)
        matches = scene.matcher(scene.queries[place])
        there, _ = CAMERA.project(matches.points @ truth[:, :3].T + truth[:, 3])
        right = wrapped_distance(there, matches.pixels) <= 8.0
        assert row.true_outlier_rate == pytest.approx(1.0 - right.mean())
        reported, hits = trace.inlier_mask.sum(), (trace.inlier_mask & right).sum()
        assert row.precision == pytest.approx(hits / reported) and row.recall == pytest.approx(hits / right.sum())
        assert row.f1 == pytest.approx(2 * hits / (reported + right.sum()))
        assert (row.matches, row.inliers, row.references) == (60, reported, 1)
        assert row.estimated_outlier_rate == 0.4 and row.estimating_ms == trace.timings_ms["total"]
        assert row.diagnosis == "ok" and row.rotation_error_deg < 0.3 and row.translation_error_m < 0.1


@pytest.mark.usefixtures("drawn")
def test_a_bad_query_is_one_row_and_the_others_go_on(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, queries=6, few=[1], broken=[2], unknown=[3], wrong=[4])
    rows = [row for row, _ in solve(scene)]
    assert [row.index for row in rows] == list(range(6))
    assert [row.status for row in rows] == ["localized", "failed", "unreadable", "localized", "doubtful", "localized"]
    assert "1 usable of 1 correspondences" in rows[1].message and rows[1].remarks == ("image1.png: few matches.",)
    assert rows[1].matches == 1 and rows[1].estimated_outlier_rate == 0.4 and rows[1].inliers is None
    assert "image2.png" in rows[2].message and rows[2].matches is None
    assert rows[3].rotation_error_deg is None and rows[3].precision is None and rows[3].inliers
    assert rows[4].diagnosis == "wrong reference image" and rows[4].translation_error_m > 0.5
    summary = summarize(results_of(scene, rows))
    assert (summary.localized, summary.doubtful, summary.failed, summary.unreadable) == (3, 1, 1, 1)
    assert summary.without_truth == 1 and "any 2 fix a pose" in rows[4].message
    # Judged: all but the unreadable one and the one without truth; the one with too few matches is a failure.
    assert [(rate.successes, rate.judged) for rate in summary.success] == [(2, 4), (2, 4)]
    assert summary.scored == 3 and summary.registration_success == ()
    f1 = [rows[place].f1 for place in (0, 4, 5)]
    assert summary.mean_f1 == pytest.approx(sum(f1) / 3) and min(f1) < 0.5 < max(f1)
    errors = [row.translation_error_m for row in rows if row.translation_error_m is not None]
    assert summary.median_translation_error_m == sorted(errors)[1]


@pytest.mark.usefixtures("drawn")
def test_a_readable_image_that_no_matcher_takes_is_a_failure(tmp_path: Path) -> None:
    def refuse(view):
        raise InputError(f"{view.name}: the pairs name no reference for it.")

    scene = replace(scene_of(tmp_path, queries=2, broken=[1]), matcher=refuse)
    rows = [row for row, _ in solve(scene)]
    assert [row.status for row in rows] == ["failed", "unreadable"]
    assert [(rate.successes, rate.judged) for rate in summarize(results_of(scene, rows)).success] == [(0, 1)] * 2


@pytest.mark.usefixtures("drawn")
def test_poses_are_judged_by_registration_where_the_scene_says_so(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, queries=5, registered=True, unknown=[0, 1, 2, 3, 4], few=[2], wrong=[3])
    rows = [row for row, _ in solve(scene)]
    assert [row.registration_error_m is None for row in rows] == [False, True, True, False, False]
    assert rows[3].registration_error_m == np.inf and rows[0].registration_error_m < 0.05
    assert rows[1].remarks == ("Not registered: image1.png: no depth to register.",)
    summary = summarize(results_of(scene, rows))
    # The second query could not be registered; the third has no pose, which is a failure.
    rates = [(rate.metres, rate.successes, rate.judged) for rate in summary.registration_success]
    assert rates == [(0.05, 2, 4), (0.2, 2, 4)] and summary.not_registered == 1
    assert summary.success == () and summary.without_truth == 5


@pytest.mark.usefixtures("drawn")
def test_the_next_query_is_matched_while_one_is_solved(tmp_path: Path) -> None:
    """The second query is being matched when the first result is there, and never more than one ahead."""
    scene = scene_of(tmp_path, queries=4)
    begun, go_on = [], threading.Event()

    def watched(view):
        begun.append((view.name, threading.current_thread().name))
        if view.name == "image1.png":
            assert go_on.wait(LIMIT_S)
        return scene.matcher(view)

    found = localize_queries(replace(scene, matcher=watched), scene.queries, "mc", options_type("mc")(), 0)
    assert next(found)[0].query == "image0.png"  # though the matching of image1.png is not done
    assert [name for name, _ in begun][:1] == ["image0.png"] and len(begun) <= 2
    go_on.set()
    assert [row.query for row, _ in found] == ["image1.png", "image2.png", "image3.png"]
    assert all(thread.startswith("spherloc-matching") for _, thread in begun)


@pytest.mark.usefixtures("drawn")
def test_a_bug_in_a_matcher_is_not_hidden(tmp_path: Path) -> None:
    def broken(view):
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError):
        solve(replace(scene_of(tmp_path), matcher=broken, kind="rendered"))


@pytest.mark.usefixtures("drawn")
def test_a_bug_in_an_extension_costs_its_query_and_names_it(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, queries=3, crashing=[1])
    rows = [row for row, _ in solve(scene)]
    assert [row.status for row in rows] == ["localized", "failed", "localized"]
    assert (
        "scene.toml: the dataset 'drawn' of the extension drawn-matches failed (KeyError: 'depth')" in rows[1].message
    )
    with pytest.raises(InputError, match="of the extension drawn-matches failed"):
        scene.problem(query="image1.png")


def sequence_of(count: int):
    """As much of a scene as choosing queries asks for."""
    views = tuple(SimpleNamespace(name=f"image{place}.png", cam_from_map=None) for place in range(count))
    return MapScene("walk", "walk.toml", views, views[:1], None, np.array([0.0, 0.0, -1.0]))  # pyright: ignore


bound = st.none() | st.integers(-12, 12)


@settings(max_examples=60)
@given(bound, bound, st.none() | st.integers(-3, 4), st.integers(1, 9))
def test_slices_choose_what_python_does(first, last, step, count) -> None:
    word = ":".join(
        "" if part is None else str(part) for part in ([first, last] if step is None else [first, last, step])
    )
    expected = [] if step == 0 else sorted(range(count)[slice(first, last, step)])
    scene = sequence_of(count)
    if not expected:
        with pytest.raises(InputError, match="chooses none of the"):
            chosen_queries(scene, [word])
    else:
        assert [view.name for view in chosen_queries(scene, [word])] == [f"image{place}.png" for place in expected]


def test_names_and_slices_together_keep_the_order_of_the_sequence() -> None:
    scene = sequence_of(8)
    chosen = chosen_queries(scene, ["image5.png", "0:3:2", "image0.png"])
    assert [view.name for view in chosen] == ["image0.png", "image2.png", "image5.png"]
    assert len(chosen_queries(scene, [])) == 8
    with pytest.raises(InputError, match=r"no query image 'image9.png'; there are image0.png"):
        chosen_queries(scene, ["image9.png"])
    with pytest.raises(InputError, match="no query image '1:x'"):
        chosen_queries(scene, ["1:x"])


@settings(max_examples=60)
@given(st.integers(1, 400), st.floats(0, 1))
def test_wilson_intervals_are_scipys(judged: int, share: float) -> None:
    successes = round(share * judged)
    expected = binomtest(successes, judged).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson(successes, judged), (expected.low, expected.high), atol=1e-12)


def test_limits_are_not_included_and_both_count(tmp_path: Path) -> None:
    def row(degrees: float, metres: float) -> QueryResult:
        truth = np.eye(3, 4)
        return QueryResult(
            0, "a", "localized", rotation_error_deg=degrees, translation_error_m=metres, cam_from_map=truth,
            truth_cam_from_map=truth,
        )  # fmt: skip

    rows = [row(1.0, 0.0), row(0.99, 0.0999), row(0.0, 0.1), row(1.5, 0.2), row(0.1, 90.0)]
    scene = replace(sequence_of(5), thresholds=((1.0, 0.1), (2.0, 0.25)), where=str(tmp_path / "s.toml"))
    (tmp_path / "s.toml").write_text("")
    assert [rate.successes for rate in summarize(results_of(scene, rows)).success] == [1, 4]


@pytest.mark.usefixtures("drawn")
def test_success_is_told_of_each_folder_too_and_what_is_doubtful(tmp_path: Path) -> None:
    """Folders are cameras, or times of day: their success rates are published apart. A doubtful pose can be right."""
    scene = replace(scene_of(tmp_path), thresholds=((1.0, 0.1), (2.0, 0.25)))

    def row(index: int, name: str, degrees: float, truth: bool = True) -> QueryResult:
        pose = np.eye(3, 4)
        return QueryResult(
            index, name, "localized", cam_from_map=pose, truth_cam_from_map=pose if truth else None,
            rotation_error_deg=degrees if truth else None, translation_error_m=0.05 if truth else None,
        )  # fmt: skip

    rows = [row(0, "day/0.png", 0.5), row(1, "day/1.png", 1.5), row(2, "night/0.png", 1.5)]
    rows.append(row(3, "other/0.png", 0.0, truth=False))
    told = results_of(scene, rows)
    lines = sequence_text(told, summarize(told), scene).splitlines()
    assert "    day: 50.0 / 100.0 % of 2" in lines and "    night: 0.0 / 100.0 % of 1" in lines
    assert not any(line.startswith("    other") for line in lines)
    assert "  trajectory: times are places in the sequence, as not all queries have a time" in lines
    back = results_of(scene, [replace(one, timestamp_s=9.0 - one.index) for one in rows])
    words = sequence_text(back, summarize(back), scene)
    assert "times are places in the sequence, as those of the queries do not always grow" in words
    wrong = replace(rows[3], status="doubtful", diagnosis="ambiguous")
    rows[2:] = [replace(rows[2], status="doubtful", diagnosis="ok"), wrong, replace(wrong, diagnosis="ok")]
    doubted = results_of(scene, rows)
    words = [line for line in sequence_text(doubted, summarize(doubted), scene).splitlines() if ": doubtful" in line]
    shown = [line.split(": ", 1)[1].split(", at")[0] for line in words]
    assert shown == ["doubtful (right, as the truth shows)", "doubtful (ambiguous)", "doubtful"]
    tagged = [replace(row, remarks=(f"{row.query}: has no tags.",)) for row in rows[:2]]
    lines = sequence_text(results_of(scene, tagged), summarize(results_of(scene, tagged)), scene).splitlines()
    assert "  day/0.png and 1 more: has no tags" in lines, "images that have the same are named once"
    alone = results_of(scene, rows[:2])
    assert "    day: " not in sequence_text(alone, summarize(alone), scene)


@pytest.mark.usefixtures("drawn")
def test_one_estimator_initialises_and_the_other_tracks(tmp_path: Path) -> None:
    """The initialiser solves the first query, one that is not localized, and the one after; its time counts."""
    scene = scene_of(tmp_path, queries=6, wrong=[2])
    how = How("ransac-2p", options_type("ransac-2p")(iterations=50), 0, ("mc", options_type("mc")()))
    found = list(localize_by_each(scene, [(view, [0]) for view in scene.queries], [how]))
    first = [any("Initialised by mc." in remark for remark in row.remarks) for _, row, _ in found]
    used = [trace.estimator for _, _, trace in found]
    assert [row.status == "localized" for _, row, _ in found] == [True, True, False, True, True, True]
    assert first == [True, False, True, True, False, False]
    assert used == ["mc" if one else "ransac-2p" for one in first]
    times = [row.estimating_ms - trace.timings_ms["total"] for _, row, trace in found]
    assert times[2] > 0.0 and times[:2] + times[3:] == [0.0] * 5  # tracked in vain, then initialised


@pytest.mark.usefixtures("drawn")
def test_a_vehicle_is_where_its_camera_says(tmp_path: Path) -> None:
    """A point of the vehicle goes through the camera to the same place in the map."""
    scene = scene_of(tmp_path, queries=3)
    rotation = Rotation.from_euler("xyz", [10.0, -80.0, 35.0], degrees=True).as_matrix()
    vehicle_from_camera = np.column_stack([rotation, [0.8, -0.3, 1.4]])
    rows = [row for row, _ in solve(scene)]
    found = vehicle_trajectory(results_of(scene, rows), vehicle_from_camera)
    in_camera = np.array([2.0, -1.0, 5.0])
    in_vehicle = rotation @ in_camera + vehicle_from_camera[:, 3]
    for row, map_from_vehicle in zip(rows, found.map_from_body, strict=True):
        in_map = row.cam_from_map[:, :3].T @ (in_camera - row.cam_from_map[:, 3])
        np.testing.assert_allclose(map_from_vehicle[:, :3] @ in_vehicle + map_from_vehicle[:, 3], in_map, atol=1e-9)


@pytest.mark.usefixtures("drawn")
def test_trajectories_hold_camera_poses_at_their_times(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, queries=4, few=[1], unknown=[2], timed=True)
    rows = [row for row, _ in solve(scene)]
    results = results_of(scene, rows)
    estimated, truth = estimated_trajectory(results), true_trajectory(results)
    assert timed(results.rows)
    start = 1520530308_250_000_000
    assert estimated.timestamps_ns.tolist() == [start, start + 200_000_000, start + 300_000_000]
    assert truth.timestamps_ns.tolist() == [start, start + 100_000_000, start + 300_000_000]
    for pose, place in zip(estimated.map_from_body, (0, 2, 3), strict=True):
        whole = np.vstack([rows[place].cam_from_map, [0, 0, 0, 1]])
        np.testing.assert_allclose(pose, np.linalg.inv(whole)[:3], atol=1e-12)
    # The same two times, or none: places in the sequence are the times of all.
    for rows_ in (
        [rows[0], replace(rows[1], timestamp_s=rows[0].timestamp_s), *rows[2:]],
        [replace(rows[0], timestamp_s=None), *rows[1:]],
    ):
        untimed = results_of(scene, rows_)
        assert not timed(untimed.rows)
        assert estimated_trajectory(untimed).timestamps_ns.tolist() == [0, 2_000_000_000, 3_000_000_000]
