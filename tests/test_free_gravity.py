"""Without gravity: P3P against truth and PoseLib, the search by it, and what auto makes of a gravity that is wrong."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.free_gravity import contradicts, search_without_gravity
from spherloc.geometry import so3_exp
from spherloc.metrics import evaluate, rotation_error_deg, translation_error_m
from spherloc.outcome import Outcome, judge
from spherloc.problem import Problem
from spherloc.solvers.p3p import p3p
from spherloc.trace import RefinementStage

SceneOf = Callable[..., SyntheticScene]


def samples(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bearings and points (K, 3, 3) all around the camera, and the poses (K, 3, 4)."""
    rng = np.random.default_rng(seed)
    rotation, translation = Rotation.random(count, rng).as_matrix(), rng.normal(size=(count, 3))
    points = 4.0 * rng.normal(size=(count, 3, 3))
    rays = points @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    bearings = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    return bearings, points, np.concatenate([rotation, translation[:, :, None]], axis=2)


def test_p3p_finds_the_true_pose_and_only_poses_that_see_the_points_there() -> None:
    bearings, points, truth = samples(2000, 3)
    poses, sample = p3p(bearings, points)
    nearest = np.full(len(truth), np.inf)
    np.minimum.at(nearest, sample, np.abs(poses - truth[sample]).max(axis=(1, 2)))
    assert np.quantile(nearest, 0.99) < 1e-6 and nearest.max() < 1e-2
    rays = points[sample] @ np.swapaxes(poses[:, :, :3], 1, 2) + poses[:, None, :, 3]
    seen = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    assert np.quantile(np.abs(seen - bearings[sample]).max(axis=(1, 2)), 0.99) < 1e-6
    np.testing.assert_allclose(np.linalg.det(poses[:, :, :3]), 1.0, atol=1e-9)


def test_p3p_finds_as_many_poses_as_poselib() -> None:
    bearings, points, _ = samples(200, 4)
    _, sample = p3p(bearings, points)
    ours = np.bincount(sample, minlength=200)
    theirs = [len(poselib.p3p(list(rows), list(given))) for rows, given in zip(bearings, points, strict=True)]
    np.testing.assert_array_equal(ours, theirs)


def test_p3p_has_no_pose_for_points_in_a_line_or_repeated() -> None:
    bearings, points, _ = samples(2, 5)
    points[0] = points[0, :1] + np.arange(3)[:, None] * (points[0, 1] - points[0, 0])
    points[1, 2], bearings[1, 2] = points[1, 1], bearings[1, 1]
    poses, _ = p3p(bearings, points)
    assert np.isfinite(poses).all()


def tilted(problem: Problem, off_deg: float, bound_deg: float) -> Problem:
    """The problem with a gravity that is off about a horizontal axis, and the bound that is stated for it."""
    axis = np.cross(problem.gravity_camera, [0.3, 0.5, 0.8])
    turn = so3_exp(np.radians(off_deg) * axis / np.linalg.norm(axis))
    return replace(problem, gravity_camera=turn @ problem.gravity_camera, gravity_bound_rad=np.radians(bound_deg))


def test_a_search_without_gravity_does_not_need_it(scene_of: SceneOf) -> None:
    problem = tilted(scene_of("mei", correspondences=150, outlier_rate=0.7, seed=1).problem(), 60.0, 1.0)
    found = search_without_gravity(problem.aligned, 3.0)
    assert found is not None and problem.truth_cam_from_map is not None
    pair = problem.aligned.unalign_pose(found), problem.truth_cam_from_map
    assert rotation_error_deg(*pair) < 0.3 and translation_error_m(*pair) < 0.05


@pytest.mark.parametrize("off_deg, bound_deg", [(7.0, 0.0), (5.0, 2.0), (90.0, 2.0)])
def test_auto_does_without_a_gravity_that_is_beyond_its_bound(
    scene_of: SceneOf, off_deg: float, bound_deg: float
) -> None:
    scene = scene_of("panorama", correspondences=120, outlier_rate=0.6, seed=2)
    trace = estimate(tilted(scene.problem(), off_deg, bound_deg), "auto")
    stage = trace.stage(RefinementStage)
    assert evaluate(trace).success and judge(trace).outcome is Outcome.LOCALIZED
    said = re.search(r"Gravity is off by ([\d.]+)°, beyond its bound of ([\d.]+)°", trace.message)
    assert said is not None and float(said[2]) == bound_deg
    assert float(said[1]) == pytest.approx(off_deg, abs=0.5)
    assert stage is not None and stage.dof == 6 and stage.gravity_sd_rad == np.inf
    assert trace.certificate is None, "what is proven of poses with that gravity says nothing of this one"


@pytest.mark.parametrize("off_deg, bound_deg", [(0.0, 0.0), (1.5, 2.0)])
def test_auto_believes_a_gravity_within_its_bound(scene_of: SceneOf, off_deg: float, bound_deg: float) -> None:
    scene = scene_of("panorama", correspondences=120, outlier_rate=0.6, seed=2)
    trace = estimate(tilted(scene.problem(), off_deg, bound_deg), "auto")
    assert evaluate(trace).success and "without it" not in trace.message


def test_wrong_matches_alone_contradict_no_gravity(scene_of: SceneOf) -> None:
    problem = scene_of("mei", correspondences=120, outlier_rate=0.0, seed=4).problem()
    shuffled = replace(problem, points=problem.points[np.random.default_rng(0).permutation(120)], truth_inliers=None)
    assert contradicts(shuffled.aligned, None, np.zeros(120, dtype=bool), 3.0, 1.0) is None
