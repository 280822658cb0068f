"""Faces of a panorama: each direction on one of them, upright, and drawn where it belongs."""

import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.faces import panorama_faces

PANORAMA = Equirectangular(400, 200)


@pytest.fixture
def bearings(rng):
    some = rng.normal(size=(5000, 3))
    return some / np.linalg.norm(some, axis=1, keepdims=True)


def test_faces_are_rotations_and_hold_all_that_is_theirs(bearings):
    faces = panorama_faces(PANORAMA, 1.4, 10**7)
    products = faces.face_from_camera @ faces.face_from_camera.transpose(0, 2, 1)
    assert (
        len(faces) == 12
        and np.allclose(products, np.eye(3))
        and np.allclose(np.linalg.det(faces.face_from_camera), 1.0)
    )
    face = faces.nearest(bearings)
    local = np.einsum("nij,nj->ni", faces.face_from_camera[face], bearings)
    assert np.degrees(np.arccos(local[:, 2].min())) < 37.4
    pixels = local[:, :2] / local[:, 2:] * faces.focal_px + faces.size_px / 2
    assert pixels.min() > 5 and pixels.max() < faces.size_px - 5
    for one in range(12):
        mine = face == one
        assert np.allclose(faces.bearings(one, pixels[mine]), bearings[mine])


def test_a_face_is_upright_and_as_sharp_as_asked():
    faces = panorama_faces(PANORAMA, 2.0, 10**7)
    middle = np.full((1, 2), faces.size_px / 2)
    for face in range(1, 11):
        axis, below, right = (faces.bearings(face, middle + step)[0] for step in ([0, 0], [0, 1], [1, 0]))
        assert below[1] > axis[1] and abs(right[1] - axis[1]) < 1e-4  # y is down
        assert np.linalg.norm(right - axis) * 400 / (2 * np.pi) == pytest.approx(0.5, rel=1e-3)


def test_all_faces_together_keep_within_the_limit():
    for most in (10_000, 100_000):
        faces = panorama_faces(Equirectangular(4000, 2000), 1.4, most)
        assert 0.9 * most < len(faces) * faces.size_px**2 <= most
        width_deg = 2 * np.degrees(np.arctan(faces.size_px / 2 / faces.focal_px))
        assert 80 <= width_deg < 83


def test_faces_draw_what_the_panorama_shows():
    """Also across its seam and at its poles, and what may not be used of it."""
    u, v = np.meshgrid(np.arange(400) + 0.5, np.arange(200) + 0.5)
    seen, _ = PANORAMA.unproject(np.column_stack([u.ravel(), v.ravel()]))
    image = np.round(127.5 + 100 * seen.reshape(200, 400, 3)).astype(np.uint8)
    usable = (v < 190).astype(np.uint8)
    faces = panorama_faces(PANORAMA, 1.0, 10**7)
    belongs = 0
    centres = np.arange(faces.size_px) + 0.5
    grid = np.column_stack([part.ravel() for part in np.meshgrid(centres, centres)])
    for face in range(12):
        drawn, allowed, own = faces.cut(face, image, usable)
        bearing = faces.bearings(face, grid)
        latitude_row = (np.arcsin(bearing[:, 1]) / np.pi + 0.5) * 200
        assert np.abs(drawn.reshape(-1, 3) - (127.5 + 100 * bearing))[allowed.ravel() > 0].max() < 3.0
        clear = np.abs(latitude_row - 190) > 0.6
        assert np.array_equal(allowed.ravel()[clear] > 0, latitude_row[clear] < 190)
        solid_angle = bearing @ faces.face_from_camera[face, 2]
        belongs += (own.ravel() * solid_angle**3).sum() / faces.focal_px**2
    assert 4 * np.pi < belongs < 1.35 * 4 * np.pi  # once, and the rims
