"""The rectified virtual camera: what it sees is what a pinhole of that field of view would."""

import cv2
import numpy as np
import pytest
from pose_samples import around

from spherloc.solvers.epnp import VirtualPinhole
from spherloc.solvers.match_rows import image_plane


@pytest.mark.parametrize("fov_deg", [60.0, 120.0, 160.0])
def test_sees_what_lies_in_its_image(fov_deg, rng):
    """Point by point, by the angles to both sides."""
    bearings, _, _ = around(rng, 2000)
    expected = [
        z > 0 and abs(np.degrees(np.arctan2(x, z))) <= fov_deg / 2 and abs(np.degrees(np.arctan2(y, z))) <= fov_deg / 2
        for x, y, z in bearings
    ]
    np.testing.assert_array_equal(VirtualPinhole(fov_deg).sees(bearings), expected)
    assert 10 < np.count_nonzero(expected) < 1500


def test_edges_belong_to_the_image():
    sixty = np.radians(60.0) * (1 - 1e-12)
    inside = [[0, 0, 1], [np.sin(sixty), 0, np.cos(sixty)], [0, -np.sin(sixty), np.cos(sixty)]]
    outside = [
        [0, 0, -1],
        [1, 0, 0],
        [np.sin(1.01 * sixty), 0, np.cos(1.01 * sixty)],
        [0, np.sin(sixty), -np.cos(sixty)],
    ]
    assert VirtualPinhole().sees(np.array(inside, float)).all()
    assert not VirtualPinhole().sees(np.array(outside, float)).any()


def test_image_plane_is_opencvs_projection(rng):
    bearings, _, _ = around(rng, 100)
    bearings = bearings[bearings[:, 2] > 0.1]
    expected = cv2.projectPoints(bearings, np.zeros(3), np.zeros(3), np.eye(3), None)[0][:, 0]
    np.testing.assert_allclose(image_plane(bearings), expected, atol=1e-12)
