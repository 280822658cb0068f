"""Features and matches of photographs, judged by poses that others have measured."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.frontend.features import FeatureOptions, extract
from spherloc.frontend.matching import match
from spherloc.frontend.view import View
from tests.frontend.pictures import view_of
from tests.needs import real_data

CAMERA = Equirectangular(1920, 960)


@pytest.fixture
def pair():
    """The two panoramas as views with the poses of COLMAP's model."""
    folder = real_data("stella_equirect_pair")
    views = []
    for line in (folder / "colmap_equirect" / "0" / "images.txt").read_text().splitlines():
        words = line.split()
        if words[-1].endswith(".jpg"):
            numbers = np.array(words[1:8], float)
            rotation = Rotation.from_quat(numbers[:4], scalar_first=True).as_matrix()
            views.append(View(words[-1], CAMERA, folder / words[-1], np.column_stack([rotation, numbers[4:]])))
    return sorted(views, key=lambda view: view.name)


def epipolar_deg(first, second, first_pixels, second_pixels):
    """(N,) angle between the second bearings and the epipolar planes of the first ones, degrees."""
    relative = second.cam_from_map[:, :3] @ first.cam_from_map[:, :3].T
    across = second.cam_from_map[:, 3] - relative @ first.cam_from_map[:, 3]
    bearings, others = CAMERA.unproject(first_pixels)[0] @ relative.T, CAMERA.unproject(second_pixels)[0]
    normals = np.cross(across, bearings)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.degrees(np.arcsin(np.abs((normals * others).sum(axis=1))))


@pytest.mark.parametrize("method, expected", [("sift", 500), ("orb", 500)])
def test_panoramas_match(pair, method, expected):
    first, second = (extract(view, FeatureOptions(method)) for view in pair)
    found = match(first, second)
    error = epipolar_deg(*pair, first.pixels[found.query_index], second.pixels[found.reference_index])
    assert (error < 0.3).sum() > expected and (error < 0.3).mean() > 0.7


def test_panoramas_match_across_any_seam(pair, tmp_path):
    """One is rolled, so that its seam lies where most matches were: there are as many matches there."""
    first, second = extract(pair[0]), extract(pair[1])
    found = match(first, second)
    error = epipolar_deg(*pair, first.pixels[found.query_index], second.pixels[found.reference_index])
    columns = second.pixels[found.reference_index, 0][error < 0.3]
    seam = 60 * np.bincount((columns // 60).astype(int)).argmax() + 31
    expected = np.abs(columns - seam) < 60

    image = np.roll(cv2.imread(str(pair[1].path)), -seam, axis=1)
    rolled = extract(view_of(tmp_path, image))
    found = match(first, rolled)
    back = (rolled.pixels[found.reference_index] + np.array([seam, 0])) % (1920, 1e6)
    error = epipolar_deg(*pair, first.pixels[found.query_index], back)
    again = np.abs(back[:, 0][error < 0.3] - seam) < 60
    assert expected.sum() > 40 and again.sum() > 0.9 * expected.sum()
    assert (error < 0.3).sum() > 0.93 * len(columns)


def test_a_dim_fisheye_has_features_all_over(tmp_path):
    """An indoor photograph: features in most of the image, none at the black rim of the lens."""
    path = real_data("aria_adt_fisheye") / "images" / "camera-rgb_87551237472175.png"
    distortion = (0.394091358527, -0.548741152556, 0.778500221599, -0.4553790203)
    camera = KannalaBrandt(1408, 1408, 611.8529287, 611.8500556, 715.7118008, 716.4760432, distortion)
    found = extract(View("aria", camera, path))
    cells = np.unique((found.pixels // 176).astype(int), axis=0)
    assert len(found) > 1500 and len(cells) > 35
    repeated = match(found, found)
    assert np.array_equal(repeated.query_index, repeated.reference_index)
