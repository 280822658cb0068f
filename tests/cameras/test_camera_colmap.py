"""COLMAP's camera models: agreement with pycolmap in both directions, and sentences for what cannot be read."""

import numpy as np
import pycolmap
import pytest
from camera_samples import angle_rad, random_directions

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError

pytestmark = pytest.mark.filterwarnings("error")

MODELS: dict[str, tuple[list[float], type[Camera], float]] = {
    "SIMPLE_PINHOLE": ([300.0, 318.0, 243.0], Mei, 80.0),
    "PINHOLE": ([300.0, 310.0, 318.0, 243.0], Mei, 80.0),
    "SIMPLE_RADIAL": ([300.0, 318.0, 243.0, -0.05], Mei, 60.0),
    "RADIAL": ([300.0, 318.0, 243.0, -0.05, 0.02], Mei, 60.0),
    "OPENCV": ([300.0, 310.0, 318.0, 243.0, -0.05, 0.02, 1e-3, -2e-3], Mei, 60.0),
    "SIMPLE_FISHEYE": ([300.0, 318.0, 243.0], KannalaBrandt, 89.0),
    "FISHEYE": ([300.0, 310.0, 318.0, 243.0], KannalaBrandt, 89.0),
    "SIMPLE_RADIAL_FISHEYE": ([300.0, 318.0, 243.0, -0.05], KannalaBrandt, 89.0),
    "RADIAL_FISHEYE": ([300.0, 318.0, 243.0, -0.05, 0.02], KannalaBrandt, 89.0),
    "OPENCV_FISHEYE": ([300.0, 310.0, 318.0, 243.0, -0.05, 0.02, 1e-3, -2e-3], KannalaBrandt, 85.0),
    "EUCM": ([300.0, 310.0, 318.0, 243.0, 0.6, 1.1], Eucm, 89.9),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        [300.0, 310.0, 318.0, 243.0, -0.03, 0.01, -4e-3, 1e-3, 2e-4, -1e-4, 2e-3, -3e-3, 4e-3, -1e-3, -2e-3, 5e-4],
        Fisheye624,
        85.0,
    ),
    "EQUIRECTANGULAR": ([640.0, 480.0], Equirectangular, 180.0),
}
"""Parameters, the class that they become, and how far from the axis COLMAP's own functions work (degrees)."""


@pytest.mark.parametrize("model", MODELS)
def test_agrees_with_colmap_in_both_directions(model):
    params, kind, limit_deg = MODELS[model]
    camera = camera_from_colmap(model, 640, 480, params, "cameras.txt")
    colmap = pycolmap.Camera(model=model, width=640, height=480, params=params)
    assert type(camera) is kind
    points = random_directions(seed=11, count=20_000)
    points = points[angle_rad(points, np.array([[0.0, 0.0, 1.0]])) < np.radians(limit_deg)]
    pixels, valid = camera.project(points)
    assert valid.sum() > 1000
    np.testing.assert_allclose(pixels[valid], colmap.img_from_cam(points[valid]), atol=1e-9)
    rays = colmap.cam_from_img(pixels[valid])
    if rays.shape[1] == 2:
        rays = np.column_stack([rays, np.ones(len(rays))])
    bearings, seen = camera.unproject(pixels[valid])
    assert seen.all()
    ahead = np.isfinite(rays).all(axis=1)  # a plane has no place for what is behind
    np.testing.assert_array_equal(ahead, points[valid, 2] > 0.0)
    assert angle_rad(bearings, rays)[ahead].max() < 1e-7  # COLMAP's own iteration ends there


@pytest.mark.parametrize("model", MODELS)
def test_numpy_parameters_are_as_good_as_lists(model):
    params = MODELS[model][0]
    expected = camera_from_colmap(model, 640, 480, params, "x")
    assert camera_from_colmap(model, 640, 480, np.array(params), "x") == expected
    assert camera_from_colmap(model, 640, 480, tuple(params), "x") == expected


def test_every_model_of_colmap_is_read_or_refused_by_name():
    refused = set()
    for model in set(pycolmap.CameraModelId.__members__) - {"INVALID"}:
        params = pycolmap.Camera.create_from_model_name(1, model, 300.0, 640, 480).params
        try:
            camera_from_colmap(model, 640, 480, params, "x")
        except CalibrationError as error:
            refused.add(model)
            assert f"the COLMAP model '{model}' is not supported" in str(error) and "OPENCV_FISHEYE" in str(error)
    assert not refused & set(MODELS)


def test_the_panorama_of_spheresfm_is_an_equirectangular_one():
    """A fork of COLMAP 3.8 calls it SPHERE, with the number that COLMAP itself gave to another model later."""
    for model in ("SPHERE", "RAD_TAN_THIN_PRISM_FISHEYE"):
        assert camera_from_colmap(model, 4096, 2048, [1.0, 2048.0, 1024.0], "x") == Equirectangular(4096, 2048)
    with pytest.raises(CalibrationError, match=r"^x: the panorama SPHERE has the size 4096 x 1024 and the"):
        camera_from_colmap("SPHERE", 4096, 1024, [1.0, 2048.0, 512.0], "x")


@pytest.mark.parametrize(
    ("model", "size", "params", "part"),
    [
        ("RAD_TAN_THIN_PRISM_FISHEYE", (640, 480), [1.0] * 15, "give a list of 16 finite numbers, fx, fy, cx, cy, k0"),
        ("FOV", (640, 480), [1.0] * 5, "the COLMAP model 'FOV' is not supported: convert it to one of SIMPLE_PINHOLE"),
        ("pinhole", (640, 480), [1.0] * 4, "the COLMAP model 'pinhole' is not supported"),
        (None, (640, 480), [1.0] * 4, "the COLMAP model None is not supported"),
        ("PINHOLE", (640, 480), [300.0] * 3, "'params' is [300.0, 300.0, 300.0]: give a list of 4 finite numbers, fx,"),
        ("PINHOLE", (640, 480), [300.0] * 5, "give a list of 4 finite numbers, fx, fy, cx, cy"),
        ("PINHOLE", (640, 480), [300.0, np.nan, 1, 1], "give a list of 4 finite numbers"),
        ("PINHOLE", (640, 480), "300", "give a list of 4 finite numbers"),
        ("PINHOLE", (640, 480), None, "give a list of 4 finite numbers"),
        ("PINHOLE", (640, 480), [-300.0, 300, 1, 1], "'fx' is -300.0: give a finite number greater than zero"),
        ("PINHOLE", (0, 480), [300.0, 300, 1, 1], "'width' is 0"),
        ("PINHOLE", (2**63, 480), [300.0, 300, 1, 1], "'width' is 9223372036854775808"),
        ("OPENCV_FISHEYE", (640, 480), [300.0, 300, 1, 1, -1e9, 0, 0, 0], "cannot be inverted one pixel away"),
        ("EUCM", (640, 480), [300.0, 300, 320, 240, 1.5, 1], "'alpha' is 1.5: give a number from 0 to 1"),
        ("EQUIRECTANGULAR", (640, 480), [640.0, 320.0], "has the parameters 640, 320 and the size 640 x 480"),
    ],
)
def test_each_mistake_has_its_sentence(model, size, params, part):
    with pytest.raises(CalibrationError) as caught:
        camera_from_colmap(model, *size, params, "cameras.txt, camera 7")
    message = str(caught.value)
    assert message.startswith("cameras.txt, camera 7: ") and part in message
    assert message.endswith(".") and "\n" not in message and len(message) < 400
