"""Errors and scores against their definitions, at both ends of their ranges."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from spherloc.estimators import estimate
from spherloc.geometry import pose, so3_exp
from spherloc.metrics import (
    evaluate,
    precision_recall_f1,
    ransac_success_probability,
    rotation_error_deg,
    translation_error_m,
)

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def turned_by(rng, angle_rad):
    """Two poses whose rotations differ by an angle about a random axis."""
    axis, rotation = rng.normal(size=3), Rotation.random(None, rng).as_matrix()
    other = rotation @ so3_exp(angle_rad * axis / np.linalg.norm(axis))
    return pose(rotation, rng.normal(size=3)), pose(other, rng.normal(size=3))


def test_rotation_error_is_the_papers_arccos(rng):
    for angle in rng.uniform(0.01, 3.1, 100):
        truth, estimated = turned_by(rng, angle)
        trace = np.trace(truth[:, :3].T @ estimated[:, :3])
        assert rotation_error_deg(truth, estimated) == pytest.approx(np.degrees(np.arccos((trace - 1) / 2)), abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-7, 0.9e-6, np.pi - 1e-6, np.pi - 1e-9, np.pi])
def test_rotation_error_where_arccos_fails(rng, angle):
    """arccos cannot tell 1e-9 rad from zero, and turns NaN when rounding pushes its argument above 1."""
    for _ in range(20):
        assert np.radians(rotation_error_deg(*turned_by(rng, angle))) == pytest.approx(angle, abs=3e-15)


def test_rotation_error_is_symmetric(rng):
    truth, estimated = turned_by(rng, 1.0)
    assert rotation_error_deg(truth, estimated) == pytest.approx(rotation_error_deg(estimated, truth))


def test_translation_error_is_between_the_camera_positions(rng):
    """Turning the camera on the spot changes t, but does not move the camera."""
    rotation, centre = Rotation.random(None, rng).as_matrix(), rng.normal(size=3)
    truth = pose(rotation, -rotation @ centre)
    other = Rotation.random(None, rng).as_matrix()
    assert translation_error_m(truth, pose(other, -other @ centre)) < 1e-14
    moved = centre + np.array([0.0, 3.0, 4.0])
    assert translation_error_m(truth, pose(other, -other @ moved)) == pytest.approx(5.0)


def mask(text):
    return np.array([letter == "1" for letter in text])


@pytest.mark.parametrize(
    "truth, reported, expected",
    [
        ("110010", "110010", (1, 1, 1)),
        ("1100", "1111", (0.5, 1, 2 / 3)),
        ("1111", "1100", (1, 0.5, 2 / 3)),
        ("1100", "0011", (0, 0, 0)),
        ("1100", "0000", (0, 0, 0)),
        ("0000", "1100", (0, 0, 0)),
        ("0000", "0000", (0, 0, 0)),
        ("1110", "0111", (2 / 3, 2 / 3, 2 / 3)),
    ],
)
def test_precision_recall_f1(truth, reported, expected):
    """Nothing true or nothing reported gives 0, not a division by zero."""
    assert precision_recall_f1(mask(truth), mask(reported)) == pytest.approx(expected)


@given(st.floats(0.001, 0.999), st.integers(1, 6), st.integers(1, 500))
def test_eq_28_as_printed(w, n, k):
    assert ransac_success_probability(w, n, k) == pytest.approx(1 - (1 - w**n) ** k, abs=1e-12)


@pytest.mark.parametrize(
    "w, n, k, expected",
    [(1.0, 2, 1, 1.0), (1.0, 2, 0, 0.0), (0.0, 2, 100, 0.0), (0.5, 2, 0, 0.0), (1e-9, 2, 10, 1e-17)],
)
def test_eq_28_at_its_ends(w, n, k, expected):
    """Printed, 1 - (1 - 1e-18)^10 is 0."""
    assert ransac_success_probability(w, n, k) == pytest.approx(expected, rel=1e-9)


def test_evaluate_scores_a_run_against_the_truth(scene_of):
    trace = estimate(scene_of("panorama", outlier_rate=0.3).problem())
    truth, estimated = trace.problem.truth_cam_from_map, trace.cam_from_map
    scores = evaluate(trace)
    assert scores.success is True
    assert scores.rotation_error_deg == rotation_error_deg(truth, estimated)
    assert scores.translation_error_m == translation_error_m(truth, estimated)
    assert scores.t_error_m == pytest.approx(np.linalg.norm(truth[:, 3] - estimated[:, 3]))
    assert (scores.precision, scores.recall, scores.f1) == precision_recall_f1(
        trace.problem.truth_inliers, trace.inlier_mask
    )


@pytest.mark.parametrize("shift_m, turn_deg, success", [(0.09, 0.9, True), (0.11, 0.0, False), (0.0, 1.1, False)])
def test_success_needs_both_errors_small(scene_of, shift_m, turn_deg, success):
    """1 degree and 0.1 m, Sec. VI-A.2."""
    trace = estimate(scene_of("panorama", outlier_rate=0.0).problem(), "ransac-2p")
    truth = trace.problem.truth_cam_from_map
    rotation = so3_exp(np.radians([0.0, turn_deg, 0.0])) @ truth[:, :3]
    centre = -truth[:, :3].T @ truth[:, 3] + [shift_m, 0.0, 0.0]
    assert evaluate(replace(trace, cam_from_map=pose(rotation, -rotation @ centre))).success is success


def test_no_pose_has_failed(scene_of):
    trace = replace(estimate(scene_of("panorama").problem(), "ransac-2p"), cam_from_map=None)
    scores = evaluate(trace)
    assert scores.success is False
    assert scores.rotation_error_deg is scores.translation_error_m is scores.t_error_m is None


def test_unknown_truth_gives_none(scene_of):
    """Not 0, and not a failure: nothing is known."""
    problem = replace(scene_of("panorama").problem(), truth_cam_from_map=None, truth_inliers=None)
    scores = evaluate(estimate(problem, "ransac-2p"))
    assert set(vars(scores).values()) == {None}
    only_labels = replace(scene_of("panorama").problem(), truth_cam_from_map=None)
    scores = evaluate(estimate(only_labels, "ransac-2p"))
    assert scores.success is None and scores.precision is not None
