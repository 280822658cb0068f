"""MEI: an independent formula, the two folds, the tangential terms, random calibrations."""

from math import acos, pi, sqrt

import numpy as np
import pytest
from camera_samples import KITTI360_IMAGE_02, angle_rad, check_invertible, pixel_grid, random_directions
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError

pytestmark = pytest.mark.filterwarnings("error")


def formula(camera: Mei, point: np.ndarray) -> tuple[float, float]:
    """Eq. 9-12 and 8 with OpenCV's tangential terms, one point at a time."""
    x, y, z = point / np.linalg.norm(point)
    x, y = x / (z + camera.xi), y / (z + camera.xi)
    k1, k2, p1, p2 = camera.distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2
    x_d = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    y_d = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return camera.fx * x_d + camera.cx, camera.fy * y_d + camera.cy


def polar(theta_rad: np.ndarray, azimuth_rad: float | np.ndarray) -> np.ndarray:
    sine = np.sin(theta_rad)
    return np.column_stack([sine * np.cos(azimuth_rad), sine * np.sin(azimuth_rad), np.cos(theta_rad)])


def test_projection_agrees_with_the_formula():
    points = random_directions(seed=1, count=2000)
    pixels, valid = KITTI360_IMAGE_02.project(points)
    assert valid.sum() > 1000
    expected = np.array([formula(KITTI360_IMAGE_02, point) for point in points[valid]])
    np.testing.assert_allclose(pixels[valid], expected, atol=1e-9)


def test_tangential_terms_move_kitti360_pixels_by_half_a_pixel():
    camera = KITTI360_IMAGE_02
    k1, k2, _, _ = camera.distortion
    without = Mei(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.xi, (k1, k2, 0.0, 0.0)
    )
    pixels = pixel_grid(camera, step=20.0)
    bearings, valid = camera.unproject(pixels)
    moved = np.linalg.norm(without.project(bearings[valid])[0] - pixels[valid], axis=1)
    assert 0.4 < moved.max() < 1.0


def test_kitti360_sees_to_the_fold_of_the_sphere_and_not_beyond():
    camera = KITTI360_IMAGE_02
    fold = acos(-1 / camera.xi)
    assert np.degrees(fold) == pytest.approx(116.86, abs=0.01)
    theta = np.radians(np.linspace(0.0, 180.0, 1801))
    for azimuth in np.linspace(-pi, pi, 13):
        _, valid = camera.project(polar(theta, azimuth))
        # A millionth of the radius is given up at the rim, which is 0.08 degrees there.
        np.testing.assert_array_equal(valid, theta < fold - np.radians(0.08))


def test_points_folded_back_would_cover_pixels_of_others_and_are_rejected():
    camera = KITTI360_IMAGE_02
    folded = polar(np.radians([130.0, 150.0, 170.0]), 0.3)
    assert not camera.project(folded)[1].any()
    inside = np.array([formula(camera, point) for point in folded])
    bearings, valid = camera.unproject(inside)
    assert valid.all()
    assert (angle_rad(bearings, folded) > np.radians(20)).all()


def test_radial_distortion_that_turns_back_ends_the_image():
    camera = Mei(2000, 2000, 500.0, 500.0, 1000.0, 1000.0, 0.5, (-0.3, 0.0, 0.0, 0.0))
    fold = sqrt(1 / 0.9)  # 1 + 3 k1 r^2 = 0
    assert camera.max_radius == pytest.approx(fold, rel=1e-5)
    rim = 500.0 * fold * (1 - 0.3 * fold**2)
    _, valid = camera.unproject(np.array([[1000.0 + 0.9999 * rim, 1000.0], [1000.0 + 1.0001 * rim, 1000.0]]))
    np.testing.assert_array_equal(valid, [True, False])


def test_tangential_distortion_alone_ends_the_image_close_before_its_fold():
    camera = Mei(600, 600, 300.0, 300.0, 300.0, 300.0, 0.0, (0.0, 0.0, 0.03, 0.04))
    fold = 1 / (6 * 0.05)  # opposite to (p2, p1) the radius r - 3 r^2 hypot(p1, p2) turns back here
    assert 0.85 * fold < camera.max_radius < fold


@pytest.mark.parametrize(("xi", "end_rad"), [(0.0, pi / 2), (0.5, acos(-0.5)), (1.0, pi), (-0.5, acos(0.5))])
def test_without_a_fold_the_sphere_is_seen_up_to_its_asymptote(xi, end_rad):
    camera = Mei(100, 100, 50.0, 50.0, 50.0, 50.0, xi, (0.0, 0.0, 0.0, 0.0))
    theta = np.array([0.0, 0.5 * end_rad, end_rad - 3e-3, min(end_rad + 3e-3, pi)])
    np.testing.assert_array_equal(camera.project(polar(theta, 1.0))[1], [True, True, True, False])


def test_pinhole_is_the_special_case_of_xi_0():
    camera = Mei(640, 480, 320.0, 310.0, 300.0, 200.0, 0.0, (0.0, 0.0, 0.0, 0.0))
    pixels, _ = camera.project(np.array([[1.0, -2.0, 4.0]]))
    np.testing.assert_allclose(pixels, [[300 + 320 / 4, 200 - 310 / 2]], rtol=1e-15)


@pytest.mark.parametrize(
    ("xi", "lens"),
    [
        (0.3, (4.246334505614473, -1.98041361, -0.49662448948, -0.6658317)),
        (0.0, (3.7593, -1.95605, 0.4444454, -0.59364)),
    ],
)
def test_newton_steps_that_leave_the_disc_are_brought_back(xi, lens):
    camera = Mei(1000, 800, 300.0, 300.0, 500.0, 400.0, xi, lens)
    azimuth = np.linspace(-pi, pi, 2001)
    for share in (0.9, 0.99, 0.999, 0.9999):
        x, y = share * camera.max_radius * np.cos(azimuth), share * camera.max_radius * np.sin(azimuth)
        s = x**2 + y**2
        reach = (xi + np.sqrt(1 + s * (1 - xi**2))) / (1 + s)
        pixels, valid = camera.project(np.column_stack([reach * x, reach * y, reach - xi]))
        assert valid.all() and camera.unproject(pixels)[1].all()


def mei_cameras() -> st.SearchStrategy[Mei]:
    coefficient = st.floats(-2.0, 2.0)
    tangential = st.floats(-0.05, 0.05) | st.floats(-1.0, 1.0)

    def build(xi, lens, fx, ratio, cx, cy) -> Mei | None:
        try:
            return Mei(800, 700, fx, fx * ratio, cx, cy, xi, lens)
        except CalibrationError:
            return None

    return st.builds(
        build,
        st.floats(-0.9, 5.0) | st.sampled_from([0.0, 1.0, 1.0 + 1e-12]),
        st.tuples(coefficient, coefficient, tangential, tangential),
        st.floats(100.0, 2000.0),
        st.floats(0.8, 1.25),
        st.floats(200.0, 600.0),
        st.floats(200.0, 500.0),
    ).filter(lambda camera: camera is not None)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(mei_cameras(), st.integers(0, 2**32 - 1))
def test_any_calibration_is_invertible_exactly_where_it_says_so(camera, seed):
    check_invertible(camera, seed)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(mei_cameras(), st.integers(0, 2**32 - 1))
def test_directions_at_the_rim_are_found_again(camera, seed):
    """Close to a fold plain Newton steps leave the disc: the patient ones must bring every such pixel home."""
    rng = np.random.default_rng(seed)
    radius = camera.max_radius * (1 - 10.0 ** rng.uniform(-9, -1, size=300))
    azimuth = rng.uniform(-pi, pi, size=300)
    s = radius**2
    root = np.sqrt(np.maximum(1 + s * (1 - camera.xi**2), 0))
    reach = radius * (camera.xi + root) / (1 + s)
    points = np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), (root - camera.xi * s) / (1 + s)])
    pixels, valid = camera.project(points)
    assert valid.sum() > 250
    bearings, seen = camera.unproject(pixels)
    np.testing.assert_array_equal(seen, valid)
    error = np.linalg.norm(camera.project(bearings)[0] - pixels, axis=1)[valid]
    # Hundreds of focal lengths away, far outside of any image, a pixel has few digits left.
    assert (error < 1e-6 * (1 + 1e-2 * np.linalg.norm(pixels, axis=1)[valid])).all()


@settings(max_examples=100, derandomize=True, deadline=None)
@given(mei_cameras(), st.floats(-pi, pi))
def test_the_radius_grows_with_the_angle_wherever_the_model_is_valid(camera, azimuth):
    """No two directions of one meridian share a pixel: the validity limit lies before every fold."""
    theta = np.linspace(0.0, pi, 400)
    pixels, valid = camera.project(polar(theta, azimuth))
    last = int(valid.sum())
    assume(last > 3)
    assert valid[:last].all() and not valid[last:].any()
    along = (pixels[:last] - [camera.cx, camera.cy]) / [camera.fx, camera.fy] @ [np.cos(azimuth), np.sin(azimuth)]
    assert (np.diff(along) > 0).all()


@settings(max_examples=100, derandomize=True, deadline=None)
@given(mei_cameras())
def test_the_image_is_nowhere_mirrored(camera):
    """Beyond a fold neighbouring pixels would see their directions in reverse order."""
    pixels = pixel_grid(camera, step=40.0)
    bearings, valid = camera.unproject(pixels)
    jacobian = camera.unprojection_jacobian(pixels)
    orientation = np.sum(np.cross(jacobian[:, :, 0], jacobian[:, :, 1]) * bearings, axis=1)
    assert (orientation[valid] > 0).all()
