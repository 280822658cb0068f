"""Refinement: its derivatives, its residual against real reprojection, and where it converges to."""

import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.geometry import DOWN, pose, rotation_angle, so3_exp, transform, yaw_rotation
from spherloc.problem import Problem
from spherloc.refine import apply_step, refine, residual_and_jacobian, residuals_px

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERAS = ("mei", "fisheye", "panorama")


def moved(aligned, truth, turn_rad, shift_m):
    return apply_step(aligned.points, truth, np.concatenate([turn_rad, shift_m]))


def pose_error(a, b):
    return rotation_angle(a[:, :3].T @ b[:, :3]), np.linalg.norm(a[:, 3] - b[:, 3])


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("dof", [4, 6])
def test_jacobian_against_central_differences(rng, scene_of, camera, dof):
    """A wrong sign or a step about another point than the residual's would converge slowly, and nobody would see."""
    for seed in range(5):
        problem = scene_of(camera, outlier_rate=0.0, correspondences=30).problem(seed)
        aligned = problem.aligned
        points, weights = aligned.points, aligned.pixel_from_bearing
        at = moved(aligned, problem.truth_cam_from_map, rng.normal(0, 0.05, 3), rng.normal(0, 0.1, 3))
        _, jacobian = residual_and_jacobian(points, weights, at, dof)
        assert jacobian.shape == (60, dof)
        for column in range(dof):
            step = np.zeros(dof)
            step[column] = 1e-5
            ahead = residual_and_jacobian(points, weights, apply_step(points, at, step), dof)[0]
            behind = residual_and_jacobian(points, weights, apply_step(points, at, -step), dof)[0]
            numeric = (ahead - behind) / 2e-5
            error = np.linalg.norm(numeric - jacobian[:, column])
            assert error < 1e-6 * np.linalg.norm(jacobian[:, column])


def test_step_of_zero_is_no_step(rng):
    at = pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    points = rng.normal(size=(7, 3))
    for dof in (4, 6):
        np.testing.assert_allclose(apply_step(points, at, np.zeros(dof)), at, atol=1e-15)


def test_four_dof_step_keeps_roll_and_pitch(rng):
    at = pose(yaw_rotation(0.4), rng.normal(size=3))
    after = apply_step(rng.normal(size=(7, 3)), at, np.array([0.3, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(after[:, :3], yaw_rotation(0.7), atol=1e-15)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("least", [2, 3, 4, 60])
def test_converges_to_the_truth_without_noise(rng, scene_of, camera, least):
    """From 2 degrees and 10 cm off; 2 and 3 points keep the gravity, so there roll and pitch start right."""
    for seed in range(10):
        problem = scene_of(camera, outlier_rate=0.0, noise_px=0.0, correspondences=least).problem(seed)
        aligned = problem.aligned
        turn = rng.normal(0, 0.02, 3) * ([1, 1, 1] if least >= 4 else [0, 1, 0])
        start = moved(aligned, problem.truth_cam_from_map, turn, rng.normal(0, 0.05, 3))
        found, inliers, stage = refine(aligned, start, np.full(len(problem), 200.0))
        rotation, shift = pose_error(problem.truth_cam_from_map, found)
        residual = residuals_px(aligned, found)
        assert stage.dof == (6 if least >= 4 else 4)
        assert inliers.all()
        assert np.sqrt(np.mean(residual**2)) < 1e-6, f"seed {seed}: stuck at {residual} px"
        # A second pose may explain few points as well; with many there is one.
        if least == 60:
            assert rotation < 1e-9 and shift < 1e-9


@pytest.mark.parametrize("camera", CAMERAS)
def test_noise_and_outliers(scene_of, camera):
    """From the truth, at 1 px noise: the cost falls, the inliers are the true ones, and the history says so."""
    problem = scene_of(camera, outlier_rate=0.5, noise_px=1.0).problem(3)
    aligned, bound = problem.aligned, np.full(100, 4.0)
    found, inliers, stage = refine(aligned, problem.truth_cam_from_map, bound)
    rotation, shift = pose_error(problem.truth_cam_from_map, found)
    assert rotation < 0.01 and shift < 0.05
    np.testing.assert_array_equal(inliers, residuals_px(aligned, found) <= bound)
    assert np.count_nonzero(inliers & ~problem.truth_inliers) <= 1
    np.testing.assert_array_equal(stage.cam_from_map[0], problem.truth_cam_from_map)
    np.testing.assert_allclose(stage.cam_from_map[-1], found, atol=1e-14)
    assert stage.inlier_counts[-1] == np.count_nonzero(inliers)
    assert stage.cost_px2[-1] == pytest.approx(np.mean(residuals_px(aligned, found)[inliers] ** 2))
    assert stage.cost_px2[-1] < stage.cost_px2[0]
    assert len(stage.cam_from_map) == len(stage.cost_px2) == len(stage.inlier_counts)


def test_too_few_inliers_leave_the_pose(scene_of):
    """One inlier fixes nothing: no step, no crash."""
    problem = scene_of("mei", outlier_rate=0.0).problem()
    far = pose(yaw_rotation(2.0), np.array([100.0, 50.0, 0.0]))
    found, inliers, stage = refine(problem.aligned, far, np.full(100, 1e-6))
    assert inliers.sum() == 0 and len(stage.cam_from_map) == 1
    np.testing.assert_array_equal(found, far)
    assert np.isnan(stage.cost_px2).all()


def real_reprojection_error(problem, cam_from_map):
    """|project(R p + t) - pixel|, across the seam of a panorama the short way."""
    pixels, valid = problem.camera.project(transform(cam_from_map, problem.points))
    assert valid.all()
    shift = pixels - problem.pixels
    if isinstance(problem.camera, Equirectangular):
        shift[:, 0] = (shift[:, 0] + problem.camera.width / 2) % problem.camera.width - problem.camera.width / 2
    return np.linalg.norm(shift, axis=1)


@pytest.mark.parametrize("camera", CAMERAS)
def test_residual_is_the_reprojection_error_to_first_order(rng, scene_of, camera):
    """Ten times closer to the truth, the relative difference is ten times smaller."""
    problem = scene_of(camera, outlier_rate=0.0, noise_px=0.0).problem(1)
    turn, shift = rng.normal(size=3), rng.normal(size=3)
    gaps = []
    for size in (1e-3, 1e-4, 1e-5):
        near = moved(problem.aligned, problem.truth_cam_from_map, size * turn, size * shift)
        real, mine = real_reprojection_error(problem, near), residuals_px(problem.aligned, near)
        clear = real > 0.1 * np.median(real)
        gaps.append(np.max(np.abs(mine - real)[clear] / real[clear]))
    assert gaps[1] < 0.15 * gaps[0] and gaps[2] < 0.15 * gaps[1] and gaps[2] < 1e-2


def seam_problem():
    """A panorama all of whose pixels lie within 2 px of its seam."""
    camera = Equirectangular(2048, 1024)
    rng = np.random.default_rng(5)
    u = np.where(rng.random(40) < 0.5, rng.uniform(0, 2, 40), rng.uniform(2046, 2048, 40))
    pixels = np.column_stack([u, rng.uniform(200, 800, 40)])
    points = camera.unproject(pixels)[0] * rng.uniform(1, 9, (40, 1))
    return Problem("seam", camera, pixels, points, DOWN, DOWN, truth_cam_from_map=pose(np.eye(3), np.zeros(3)))


def test_residual_across_the_seam():
    """A point seen at column 1 that projects to column 2047 is 2 px off, not 2046."""
    problem = seam_problem()
    near = pose(yaw_rotation(0.01), np.array([0.002, 0.001, 0.0]))
    crossed = np.abs(problem.camera.project(transform(near, problem.points))[0][:, 0] - problem.pixels[:, 0]) > 1000
    assert crossed.sum() > 5
    np.testing.assert_allclose(residuals_px(problem.aligned, near), real_reprojection_error(problem, near), rtol=0.03)
    found, inliers, _ = refine(problem.aligned, near, np.full(40, 30.0))
    assert inliers.all() and np.abs(found - problem.truth_cam_from_map).max() < 1e-9


def test_points_behind_their_bearing_are_infinitely_wrong(scene_of):
    """P v' is small for a point exactly behind as well: it must never be an inlier."""
    problem = scene_of("panorama", outlier_rate=0.0, noise_px=0.0).problem()
    truth = problem.truth_cam_from_map
    behind = transform(truth, problem.points) * -1.0
    mirrored = Problem("behind", problem.camera, problem.pixels, (behind - truth[:, 3]) @ truth[:, :3], DOWN, DOWN)
    assert np.isinf(residuals_px(mirrored.aligned, truth)).all()
    centre = -truth[:, :3].T @ truth[:, 3]
    at_centre = Problem("centre", problem.camera, problem.pixels, np.tile(centre, (100, 1)), DOWN, DOWN)
    assert not np.isnan(residuals_px(at_centre.aligned, truth)).any()
