"""Kannala-Brandt: agreement with OpenCV and COLMAP, beyond 90 degrees, the first maximum, random calibrations."""

from math import pi

import cv2
import numpy as np
import pycolmap
import pytest
from camera_samples import BEYOND_180, EVERY, angle_rad, check_invertible, pixel_grid, random_directions, sample
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.base import in_image
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError

pytestmark = pytest.mark.filterwarnings("error")

KB = [name for name in EVERY if "/" in name or name.startswith("kb-")]


def in_front(camera: KannalaBrandt, seed: int) -> np.ndarray:
    """Valid points (N, 3) up to 85 degrees from the axis, where the reference implementations work."""
    points = random_directions(seed, 5000)
    narrow = points[:, 2] > np.cos(np.radians(85.0)) * np.linalg.norm(points, axis=1)
    points = points[narrow & camera.project(points)[1]]
    assert len(points) > 500
    return points


def opencv_lens(camera: KannalaBrandt) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and coefficients in OpenCV's convention: the centre of the top-left pixel is (0, 0)."""
    matrix = np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])
    return matrix, np.array(camera.distortion)


@pytest.mark.parametrize("name", KB)
def test_projection_agrees_with_opencv_half_a_pixel_away(name):
    camera = sample(name)
    points = in_front(camera, seed=3)
    expected = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), *opencv_lens(camera))[0][0]
    np.testing.assert_allclose(camera.project(points)[0], expected + 0.5, atol=1e-8)


@pytest.mark.parametrize("name", KB)
def test_unprojection_agrees_with_opencv_half_a_pixel_away(name):
    camera = sample(name)
    pixels = camera.project(in_front(camera, seed=4))[0]
    # OpenCV's Newton iteration gives up where the curve is flat: compare the inner part, where it converges.
    pixels = pixels[np.hypot(*((pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]).T) < 0.9]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    matrix, lens = opencv_lens(camera)
    plane = cv2.fisheye.undistortPoints(pixels[None] - 0.5, matrix, lens, criteria=criteria)[0]
    expected = np.column_stack([plane, np.ones(len(plane))])
    assert angle_rad(camera.unproject(pixels)[0], expected).max() < 1e-8


@pytest.mark.parametrize("name", KB)
def test_agrees_with_colmap(name):
    camera = sample(name)
    params = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    colmap = pycolmap.Camera(model="OPENCV_FISHEYE", width=camera.width, height=camera.height, params=params)
    points = in_front(camera, seed=5)
    pixels = camera.project(points)[0]
    np.testing.assert_allclose(pixels, colmap.img_from_cam(points), atol=1e-8)
    plane = colmap.cam_from_img(pixels)
    expected = np.column_stack([plane, np.ones(len(plane))])
    # COLMAP knows no validity limit: on a lens with a maximum (Aria's rgb, from 50 degrees on) its iteration ends on
    # the far side, at another direction with the same pixel. Compare what it solved on the near side.
    with np.errstate(invalid="ignore"):
        solved = camera.project(expected)[1] & (np.abs(colmap.img_from_cam(expected) - pixels).max(axis=1) < 1e-6)
    assert solved.mean() > 0.7
    assert angle_rad(camera.unproject(pixels)[0], expected)[solved].max() < 1e-7


def test_a_lens_of_220_degrees_sees_behind_itself():
    theta = np.radians([0.0, 45.0, 89.999, 90.0, 90.001, 105.0, 110.0])
    points = np.column_stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)])
    pixels, valid = BEYOND_180.project(points)
    assert valid.all() and in_image(BEYOND_180, pixels).all()
    k1, k2, k3, k4 = BEYOND_180.distortion
    expected = 300.0 * theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) + 600.5
    np.testing.assert_allclose(pixels[:, 0], expected, rtol=1e-14)
    np.testing.assert_allclose(BEYOND_180.unproject(pixels)[0], points, atol=1e-14)


def test_the_first_maximum_ends_the_valid_range():
    camera = KannalaBrandt(1000, 1000, 300.0, 300.0, 500.0, 500.0, (-0.1, 0.0, 0.0, 0.0))
    peak = np.sqrt(1 / 0.3)  # 1 + 3 k1 theta^2 = 0
    assert camera.max_angle_rad == pytest.approx(peak, rel=1e-5)
    theta = peak * np.array([0.5, 0.999, 1.001, 1.2])
    points = np.column_stack([np.zeros(4), np.sin(theta), np.cos(theta)])
    np.testing.assert_array_equal(camera.project(points)[1], [True, True, False, False])
    rim = 500.0 + 300.0 * peak * (1 - 0.1 * peak**2)
    np.testing.assert_array_equal(camera.unproject(np.array([[500.0, rim - 0.01], [500.0, rim + 0.01]]))[1], [1, 0])


def test_the_first_of_several_maxima_counts():
    """theta_d rises again after a dip: directions in the dip and beyond have a pixel of their own only by accident."""
    camera = KannalaBrandt(1000, 1000, 300.0, 300.0, 500.0, 500.0, (-0.5, 0.1, 0.0, 0.0))
    theta = np.linspace(0, pi, 2000)
    slope = np.gradient(theta * (1 - 0.5 * theta**2 + 0.1 * theta**4), theta)
    first, last = theta[slope < 0].min(), theta[slope < 0].max()
    assert first < 1.2 < 1.3 < last < pi - 0.5
    assert camera.max_angle_rad == pytest.approx(first, abs=0.01)


def test_an_equidistant_lens_sees_all_but_the_point_straight_behind():
    camera = KannalaBrandt(900, 900, 120.0, 120.0, 450.0, 450.0, (0.0, 0.0, 0.0, 0.0))
    points = np.array([[0.0, 0.0, -1.0], [1e-3, 0.0, -1.0]])
    pixels, valid = camera.project(points)
    np.testing.assert_array_equal(valid, [False, True])
    np.testing.assert_allclose(pixels[1], [450 + 120 * (pi - np.arctan(1e-3)), 450])
    np.testing.assert_array_equal(camera.unproject(np.array([[450 + 120 * pi + 1, 450], [450, 450]]))[1], [False, True])


def test_a_nearly_flat_curve_is_still_inverted():
    """The slope falls to 1e-4 without reaching zero: Newton's steps jump there, the answer must not."""
    # slope 1 + 3 k1 s + 5 k2 s^2 has its minimum 1e-4 at s = 1
    k2 = (1 - 1e-4) / 5
    camera = KannalaBrandt(1000, 1000, 300.0, 300.0, 500.0, 500.0, (-10 * k2 / 3, k2, 0.0, 0.0))
    assert camera.max_angle_rad > 3.1
    pixels = np.column_stack([np.linspace(500.0, 900.0, 20_001), np.full(20_001, 500.0)])
    bearings, valid = camera.unproject(pixels)
    assert valid.all()
    assert np.abs(camera.project(bearings)[0] - pixels).max() < 1e-9
    assert (np.diff(bearings[:, 2]) < 0).all()


def kb_cameras() -> st.SearchStrategy[KannalaBrandt]:
    def build(scale, lens, fx, ratio, cx, cy) -> KannalaBrandt | None:
        try:
            lens = tuple(scale * k for k in lens)
            return KannalaBrandt(800, 700, fx, fx * ratio, cx, cy, lens)  # pyright: ignore[reportArgumentType]
        except CalibrationError:
            return None

    return st.builds(
        build,
        st.sampled_from([0.0, 1e-4, 0.01, 0.1, 1.0, 10.0]),
        st.tuples(*[st.floats(-1.0, 1.0)] * 4),
        st.floats(50.0, 1500.0),
        st.floats(0.8, 1.25),
        st.floats(200.0, 600.0),
        st.floats(200.0, 500.0),
    ).filter(lambda camera: camera is not None)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(kb_cameras(), st.integers(0, 2**32 - 1))
def test_any_calibration_is_invertible_exactly_where_it_says_so(camera, seed):
    rng = np.random.default_rng(seed)
    rim = camera.max_angle_rad * (1 - 10.0 ** rng.uniform(-12, -2, size=100))
    azimuth = rng.uniform(-pi, pi, size=100)
    at_rim = np.column_stack([np.sin(rim) * np.cos(azimuth), np.sin(rim) * np.sin(azimuth), np.cos(rim)])
    check_invertible(camera, seed, at_rim)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(kb_cameras())
def test_the_pixel_of_the_rim_itself_looks_within_the_rim(camera):
    rim = np.array([np.sin(camera.max_angle_rad), 0.0, np.cos(camera.max_angle_rad)])
    pixels = camera.project(np.vstack([rim, rim * [-1, 1, 1]]))[0]
    pixels = np.vstack([pixels + np.array([shift, 0.0]) for shift in 1e-12 * np.arange(-3, 4)])
    bearings, seen = camera.unproject(pixels)
    np.testing.assert_array_equal(camera.project(bearings)[1], seen)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(kb_cameras())
def test_the_image_is_nowhere_mirrored(camera):
    """Beyond a fold neighbouring pixels would see their directions in reverse order."""
    pixels = pixel_grid(camera, step=40.0)
    bearings, valid = camera.unproject(pixels)
    jacobian = camera.unprojection_jacobian(pixels)
    orientation = np.sum(np.cross(jacobian[:, :, 0], jacobian[:, :, 1]) * bearings, axis=1)
    assert (orientation[valid] > 0).all()
