"""Panoramas: axes, seam, poles, agreement with COLMAP."""

from math import pi

import numpy as np
import pycolmap
import pytest
from camera_samples import angle_rad, pixel_grid, random_directions

from spherloc.cameras.base import in_image
from spherloc.cameras.equirectangular import Equirectangular

pytestmark = pytest.mark.filterwarnings("error")

CAMERA = Equirectangular(2048, 1024)


@pytest.mark.parametrize(
    ("direction", "pixel"),
    [
        ([0, 0, 1], [1024, 512]),
        ([1, 0, 0], [1536, 512]),
        ([-1, 0, 0], [512, 512]),
        ([0, 1, 1], [1024, 768]),
        ([0, -1, 1], [1024, 256]),
        ([0, 0, -1], [0, 512]),
        ([0, -1, 0], [1024, 0]),
        ([0, 1, 0], [1024, 1024]),
    ],
)
def test_axes_are_those_of_opencv(direction, pixel):
    pixels, valid = CAMERA.project(np.array([direction], dtype=float))
    assert valid.all()
    np.testing.assert_allclose(pixels, [pixel], atol=1e-9)


def test_every_direction_has_a_pixel_in_the_image():
    axes = np.vstack([np.eye(3), -np.eye(3), [[-0.0, 0.0, -1.0], [1e-300, 1.0, 0.0], [0.0, -1.0, -0.0]]])
    points = np.vstack([axes, random_directions(seed=2, count=20_000)])
    pixels, valid = CAMERA.project(points)
    assert valid.all() and in_image(CAMERA, pixels).all()


def test_both_sides_of_the_seam_are_one_direction():
    rows = np.arange(0.5, 1024)
    left = np.column_stack([np.zeros_like(rows), rows])
    right = np.column_stack([np.full_like(rows, 2048), rows])
    (a, left_valid), (b, right_valid) = CAMERA.unproject(left), CAMERA.unproject(right)
    assert left_valid.all() and right_valid.all()
    np.testing.assert_allclose(a, b, atol=1e-15)
    assert (a[:, 2] < 0).all()
    for bearings in (a, b):
        u = CAMERA.project(bearings)[0][:, 0]
        assert np.minimum(u, 2048 - u).max() < 1e-9


def test_directions_next_to_the_seam_land_next_to_it():
    pixels, _ = CAMERA.project(np.array([[1e-9, 0, -1.0], [-1e-9, 0, -1.0], [0.0, 0, -1.0], [-0.0, 0, -1.0]]))
    np.testing.assert_allclose(pixels[:, 0], [2048, 0, 0, 0], atol=1e-5)


def test_poles_are_legal_and_their_jacobian_is_finite():
    columns = np.linspace(0, 2048, 33)
    for row, pole in ((0.0, [0, -1, 0]), (1024.0, [0, 1, 0])):
        pixels = np.column_stack([columns, np.full_like(columns, row)])
        bearings, valid = CAMERA.unproject(pixels)
        assert valid.all()
        np.testing.assert_allclose(bearings, np.tile(pole, (33, 1)), atol=1e-15)
        jacobian = CAMERA.unprojection_jacobian(pixels)
        assert np.isfinite(jacobian).all()
        np.testing.assert_allclose(np.linalg.norm(jacobian[:, :, 0], axis=1), 0.0, atol=1e-15)
        np.testing.assert_allclose(np.linalg.norm(jacobian[:, :, 1], axis=1), pi / 1024, rtol=1e-12)


def test_pixels_outside_the_image_are_invalid():
    outside = np.array([[-0.1, 5], [2048.1, 5], [5, -0.1], [5, 1024.1]])
    bearings, valid = CAMERA.unproject(outside)
    assert not valid.any() and np.isnan(bearings).all()


def test_the_papers_equations_follow_from_one_permutation():
    """Eq. 15-17 with x_paper = z, y_paper = x, z_paper = -y."""
    pixels = pixel_grid(CAMERA, step=31.0)
    matrix = np.array([[2048 / (2 * pi), 0, 1024], [0, -1024 / pi, 512], [0, 0, 1]])
    lon, lat, _ = np.linalg.inv(matrix) @ np.column_stack([pixels, np.ones(len(pixels))]).T
    paper = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    bearings = CAMERA.unproject(pixels)[0]
    np.testing.assert_allclose(np.column_stack([bearings[:, 2], bearings[:, 0], -bearings[:, 1]]), paper, atol=1e-14)


@pytest.mark.parametrize("size", [(2048, 1024), (1919, 961)])
def test_agrees_with_colmap(size):
    camera = Equirectangular(*size)
    colmap = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=[*map(float, size)])
    points = np.vstack([random_directions(seed=6, count=5000), np.eye(3), -np.eye(3)])
    difference = camera.project(points)[0] - colmap.img_from_cam(points)
    difference[:, 0] = (difference[:, 0] + size[0] / 2) % size[0] - size[0] / 2  # COLMAP gives the seam as the width
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)
    pixels = pixel_grid(camera, step=37.0)
    rays = np.array([colmap.cam_ray_from_img(pixel) for pixel in pixels[:500]])
    assert angle_rad(camera.unproject(pixels[:500])[0], rays).max() < 1e-12
