"""The bridge from pixels to radians: inliers must lie within the angle that arcs and balls allow for."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from spherloc.bounds import bounds_of
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.diagnosis import diagnose
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.geometry import DOWN, pose, so3_exp
from spherloc.problem import Problem
from spherloc.ranges import MAX_PX, MIN_PX
from spherloc.refine import residuals_px
from tests.waiting import LIMIT_S

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def angle_between(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def beside(rng, bearings, angles):
    """Bearings turned by these angles in random directions."""
    away = np.cross(bearings, rng.normal(size=bearings.shape))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.cos(angles)[:, None] * bearings + np.sin(angles)[:, None] * away


@pytest.mark.parametrize("bound_px", [1.0, 8.0, 40.0])
@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_inliers_lie_within_the_angular_bound(rng, scene_of, camera, bound_px):
    """Arcs exclude nothing only for bearings within ``Bounds.radians``: no inlier by pixels may be farther away."""
    problem = scene_of(camera, correspondences=1000, outlier_rate=0.0).problem()
    aligned = problem.aligned
    bounds = bounds_of(aligned, bound_px)
    for share in (0.9, 0.99, 0.9999, 1.0, 1.0001, 1.01):
        rays = beside(rng, aligned.bearings, np.arcsin(np.minimum(share * bound_px * aligned.radians_per_pixel, 1.0)))
        moved = Problem("moved", problem.camera, problem.pixels, rays, DOWN, DOWN)
        explained = residuals_px(moved.aligned, pose(np.eye(3), np.zeros(3))) <= bounds.pixels
        excess = angle_between(aligned.bearings, rays)[explained] - bounds.radians[explained]
        assert excess.max(initial=-1.0) <= 1e-12, f"an inlier is {excess.max():.1e} rad beyond its bound"


@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_gravity_error_within_its_bound_keeps_the_inliers(rng, scene_of, camera):
    """Exact pixels, gravity off by just the stated bound: at the true yaw and position all are inliers."""
    problem = scene_of(camera, correspondences=1000, outlier_rate=0.0, noise_px=0.0).problem()
    aligned, bound_rad = problem.aligned, np.radians(0.5)
    tilt = so3_exp(bound_rad * np.array([0.8, 0.0, 0.6]))
    tilted = pose(tilt @ problem.truth_cam_from_map[:, :3], tilt @ problem.truth_cam_from_map[:, 3])
    error, bounds = residuals_px(aligned, tilted), bounds_of(replace(aligned, gravity_bound_rad=bound_rad), 1.0)
    lost = np.count_nonzero(error > bounds.pixels)
    assert lost == 0, f"{lost} of 1000 lie outside, the worst by a factor of {np.max(error / bounds.pixels):.1f}"


@pytest.mark.parametrize("bound_px", [1e-300, 1e300, np.inf])
@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p", "auto"])
def test_a_bound_that_no_solver_can_reckon_with_is_one_sentence(scene_of, estimator, bound_px):
    """It was a division by zero, or an overflow."""
    problem = scene_of("mei").problem()
    with pytest.raises(InputError, match=r"bound_px is .*; give"):
        estimate(problem, estimator, options_type(estimator)(bound_px=bound_px))


@pytest.mark.parametrize("bound_px", [MIN_PX, MAX_PX])
@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p", "auto"])
def test_the_tightest_and_widest_bounds_give_an_answer_and_a_diagnosis(scene_of, estimator, bound_px):
    problem = scene_of("mei", correspondences=30).problem()
    trace = estimate(problem, estimator, options_type(estimator)(bound_px=bound_px))
    assert trace.cam_from_map is None or np.isfinite(trace.cam_from_map).all()
    assert diagnose(trace).summary


def test_bounds_add_up(scene_of):
    aligned = scene_of("fisheye").problem().aligned
    bare, with_gravity = bounds_of(aligned, 3.0), bounds_of(replace(aligned, gravity_bound_rad=0.01), 3.0)
    np.testing.assert_array_equal(bare.pixels, 3.0)
    np.testing.assert_allclose(bare.radians, 3.0 * aligned.radians_per_pixel, rtol=1e-3)
    np.testing.assert_allclose(with_gravity.radians, bare.radians + 0.01, rtol=1e-3)
    assert (with_gravity.pixels > bare.pixels + 1.0).all()
    assert (bounds_of(aligned, 1e4).radians == np.pi / 2).all()


def test_poles_of_a_panorama_are_not_free_inliers():
    """Exactly at a pole the Jacobian has rank 1: a bearing half a radian away must not have a residual of 0 px."""
    camera = Equirectangular(2000, 1000)
    pixels = np.array([[500.0, 0.0], [500.0, 1000.0], [700.0, 300.0]])
    bearings = camera.unproject(pixels)[0]
    # 0.5 rad from the pole, in the direction to which the column of u points.
    off = np.array([[0.0, -np.cos(0.5), np.sin(0.5)], [0.0, np.cos(0.5), np.sin(0.5)], bearings[2]])
    problem = Problem("pole", camera, pixels, off, DOWN, DOWN)
    error = residuals_px(problem.aligned, pose(np.eye(3), np.zeros(3)))
    assert error[2] < 1e-9
    assert (error[:2] > 100).all(), f"residuals of {error[:2]} px, 160 px from the pole"


TOO_MANY = """
import resource
import numpy as np
resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.diagnosis import diagnose
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.geometry import DOWN
from spherloc.problem import Problem
from spherloc.ranges import MIN_PX, MAX_PX
rng = np.random.default_rng(0)
pixels, points = rng.uniform(1, 99, (200_000, 2)), rng.uniform(-5, 5, (200_000, 3))
try:
    estimate(Problem("crowd", Equirectangular(200, 100), pixels, points, DOWN, DOWN), "mc")
except InputError as error:
    print(error)
"""


def test_too_many_correspondences_for_mc_is_an_input_error():
    """2 * 10^10 pairs fit nowhere: the user needs a sentence, not a MemoryError (or a machine that stops answering)."""
    done = subprocess.run([sys.executable, "-c", TOO_MANY], capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr.strip().splitlines()[-1]
    assert "200,000" in done.stdout or "200000" in done.stdout
