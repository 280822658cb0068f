"""Rotations, angles and gravity alignment, at their awkward values too."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from spherloc.geometry import (
    DOWN,
    align_to_down,
    camera_centre,
    pose,
    rotation_angle,
    skew,
    so3_exp,
    transform,
    wrap_angle,
    yaw_of,
    yaw_rotation,
)

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

VECTORS = arrays(np.float64, 3, elements=st.floats(-4, 4))


def test_yaw_rotation_is_eq_1():
    """x' = x cos + z sin, z' = -x sin + z cos: the sign that everything else depends on."""
    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_array_equal(yaw_rotation(0.3) @ [1.0, 5.0, 2.0], [c + 2 * s, 5.0, -s + 2 * c])


@given(st.floats(-10, 10))
def test_yaw_comes_back(yaw):
    assert abs(np.sin((yaw_of(yaw_rotation(yaw)) - yaw) / 2)) < 1e-15


def test_yaw_of_is_the_closest_yaw(rng):
    """Of a rotation with roll and pitch: no other yaw leaves a smaller angle."""
    for rotation in Rotation.random(50, rng).as_matrix():
        best = rotation_angle(yaw_rotation(yaw_of(rotation)).T @ rotation)
        others = [rotation_angle(yaw_rotation(yaw).T @ rotation) for yaw in np.linspace(-np.pi, np.pi, 200)]
        assert best <= min(others) + 1e-12


@given(st.floats(-100, 100))
@pytest.mark.parametrize("around", [0.0, np.pi, -np.pi, 3 * np.pi])
def test_wrap_angle_keeps_the_angle_and_its_range(around, angle):
    wrapped = wrap_angle(around + angle)
    assert -np.pi <= wrapped < np.pi
    assert abs(np.sin((wrapped - around - angle) / 2)) < 1e-13


@pytest.mark.parametrize("angle", [np.nextafter(-np.pi, -4), np.nextafter(-3 * np.pi, -10), -np.pi, np.pi])
def test_wrap_angle_beside_its_ends(angle):
    """Just below -pi the modulo rounds up to a full turn: pi is outside [-pi, pi)."""
    assert -np.pi <= wrap_angle(angle) < np.pi


@given(VECTORS, VECTORS)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-9, np.pi, 6.0])
def test_so3_exp_against_scipy(rng, angle):
    """Zero, denormal and large angles alike."""
    for _ in range(20):
        axis = rng.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        np.testing.assert_allclose(so3_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=3e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-7, 1e-3, 1.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-10, np.pi])
def test_rotation_angle_keeps_its_digits(rng, angle):
    """arccos has lost all digits below 1e-8 and near pi."""
    for _ in range(20):
        axis = rng.normal(size=3)
        rotation = so3_exp(angle * axis / np.linalg.norm(axis))
        assert abs(rotation_angle(rotation) - angle) < 1e-15 + 1e-15 * angle + (5e-16 if angle > 1 else 1e-16)


@pytest.mark.parametrize("vector", [DOWN, -DOWN, [1e-13, -1, 0], [1e-10, -1, 0], [1e-10, 1, 0], [0, 0, 1], [-1, 0, 0]])
def test_align_to_down_at_special_vectors(vector):
    """Straight up is the half turn without a defined axis."""
    check_alignment(np.array(vector, dtype=float))


def test_align_to_down_of_any_vector(rng):
    for vector in rng.normal(size=(200, 3)):
        check_alignment(vector / np.linalg.norm(vector))


def check_alignment(vector):
    rotation = align_to_down(vector)
    np.testing.assert_allclose(rotation @ vector, DOWN, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) > 0
    # The smallest: it turns no further than the vector is away.
    assert rotation_angle(rotation) == pytest.approx(np.arctan2(np.hypot(vector[0], vector[2]), vector[1]), abs=1e-12)


def test_pose_centre_and_transform(rng):
    """p_cam = R p + t, and the camera's own position maps to zero."""
    rotation, translation = Rotation.random(None, rng).as_matrix(), rng.normal(size=3)
    cam_from_map = pose(rotation, translation)
    assert cam_from_map.shape == (3, 4)
    points = rng.normal(size=(5, 3))
    expected = np.array([rotation @ point + translation for point in points])
    np.testing.assert_allclose(transform(cam_from_map, points), expected, atol=1e-15)
    np.testing.assert_allclose(transform(cam_from_map, camera_centre(cam_from_map)[None]), np.zeros((1, 3)), atol=1e-15)
