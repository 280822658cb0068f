"""Calibration files that are given for photographs of another size, or that state none."""

import cv2
import numpy as np
import pytest

from spherloc.cameras.calibration import load_camera
from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.cameras.scaling import scaled
from spherloc.errors import CalibrationError, InputError
from spherloc.mapping.images.given_cameras import given_cameras
from spherloc.mapping.images.photographs import photographs as find_photographs

FOCAL = 1280, 960, 400.0, 402.0, 650.0, 470.0
FISHEYE = KannalaBrandt(*FOCAL, (0.01, -0.002, 0.001, 0.0))
OPENCV = """%YAML:1.0
---
K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 400., 0., 319.5, 0., 400., 239.5, 0., 0., 1. ]
D: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0.01, -0.002, 0., 0. ]
distortion_model: equidistant
"""


@pytest.fixture
def photographs(tmp_path):
    """A folder of three photographs of 640 x 480 pixels."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for name in "abc":
        cv2.imwrite(str(folder / f"{name}.png"), np.zeros((480, 640), np.uint8))
    return folder


@pytest.mark.parametrize(
    "camera",
    [FISHEYE, Mei(*FOCAL, 1.2, (0.1, -0.02, 0.001, 0.0)), DoubleSphere(*FOCAL, 0.1, 0.6), Eucm(*FOCAL, 0.6, 1.1)],
    ids=lambda camera: camera.model,
)
def test_a_scaled_camera_sees_the_same(camera, rng):
    pixels = rng.uniform((200.0, 200.0), (1000.0, 800.0), (20, 2))
    for width, height in ((640, 480), (1920, 1440), (427, 320)):  # the last one is rounded
        smaller = scaled(camera, width, height)
        assert smaller is not None and (smaller.width, smaller.height) == (width, height)
        bearings, seen = smaller.unproject(pixels * (width / 1280, height / 960))
        assert seen.all()
        np.testing.assert_allclose(bearings, camera.unproject(pixels)[0], atol=1e-9)
    assert scaled(camera, 640, 640) is None and scaled(camera, 960, 1280) is None
    assert scaled(Equirectangular(800, 400), 400, 200) is None, "a panorama of any size needs no calibration"


def test_a_calibration_of_the_same_shape_is_scaled_and_told(tmp_path, photographs):
    file = tmp_path / "big.toml"
    file.write_text("[camera]\n" + "".join(f"{key} = {value!r}\n" for key, value in FISHEYE.to_dict().items()))
    cameras, (said,) = given_cameras(file, None, photographs)
    assert cameras == {"": scaled(FISHEYE, 640, 480)}
    assert "is for images of 1280 x 960 pixels, and was scaled to 640 x 480 pixels" in said
    cv2.imwrite(str(photographs / "big.png"), np.zeros((960, 1280), np.uint8))
    assert given_cameras(file, None, photographs) == ({"": FISHEYE}, []), "some have its size"


def test_a_calibration_is_scaled_for_a_sequence_with_folders_of_cameras_too(tmp_path, photographs):
    file = tmp_path / "big.toml"
    file.write_text("[camera]\n" + "".join(f"{key} = {value!r}\n" for key, value in FISHEYE.to_dict().items()))
    (tmp_path / "drive" / "cam0").mkdir(parents=True)
    photographs.rename(tmp_path / "drive" / "cam0" / "data")
    for place in (tmp_path / "drive", tmp_path / "drive" / "cam0"):
        assert given_cameras(file, None, place)[0] == {"": scaled(FISHEYE, 640, 480)}


def test_a_file_of_opencv_without_a_size_has_that_of_the_photographs(tmp_path, photographs):
    file = tmp_path / "kd.yml"
    file.write_text(OPENCV)
    cameras, (said,) = given_cameras(file, None, photographs)
    assert cameras == {"": KannalaBrandt(640, 480, 400.0, 400.0, 320.0, 240.0, (0.01, -0.002, 0.0, 0.0))}
    assert "states no size of images; 640 x 480 pixels, that of the photographs, are taken." in said
    cv2.imwrite(str(photographs / "big.png"), np.zeros((960, 1280), np.uint8))
    with pytest.raises(CalibrationError, match="states no size of images: add the keys image_width and image_height"):
        given_cameras(file, None, photographs)


def test_an_image_is_no_calibration(photographs):
    with pytest.raises(CalibrationError, match=r"a\.png: is an image: give the file with the calibration"):
        load_camera(photographs / "a.png")


def test_what_four_coefficients_are_taken_for_is_told(photographs):
    """Of a file that is given, which has no size, and of one beside the photographs."""
    text = "camera_matrix: [[400, 0, 320], [0, 400, 240], [0, 0, 1]]\ndist_coeffs: [0.1, 0.02, -0.03, 0.0]\n"
    file = photographs.parent / "front.yaml"
    file.write_text(text)
    cameras, remarks = given_cameras(file, None, photographs)
    assert isinstance(cameras[""], KannalaBrandt) and len(remarks) == 2 and "states no size" in remarks[0]
    assert remarks[1].startswith(f"{file}: its four coefficients are taken for those of a fisheye (cv2.fisheye), since")
    (photographs / "front.yaml").write_text(f"{text}resolution: [640, 480]\n")
    found = find_photographs(photographs, {})
    assert found.remarks[0] == "The calibration found beside them: front."
    assert found.remarks[1].startswith("front: its four coefficients are taken for those of a fisheye")


def test_a_calibration_beside_photographs_that_leaves_a_question_is_told(photographs):
    """Whatever the file is called; files that are no calibrations are not."""
    text = "camera_matrix: [[186, 0, 330], [0, 186, 238], [0, 0, 1]]\ndist_coeffs: [-0.04, -0.001, -0.005, 0.001]\n"
    (photographs / "front.yaml").write_text(f"{text}resolution: [640, 480]\n")
    (photographs / "notes.json").write_text("{}")
    (photographs / "labels.json").write_text(f'{{"shapes": "{"x" * 300_000}"}}')
    with pytest.raises(InputError) as caught:
        find_photographs(photographs, {})
    told = str(caught.value)
    assert "the four dist_coeffs may be those of a fisheye or of a pinhole: add distortion_model" in told
    assert "notes" not in told and "labels" not in told


def test_kalibr_files_of_one_camera_each_are_the_cameras_that_they_are_called(tmp_path, photographs):
    """Each of them calls its camera cam0."""
    folder = tmp_path / "calibrations"
    folder.mkdir()
    for name, focal in (("front", 300.0), ("left", 310.0)):
        (folder / f"{name}.yaml").write_text(
            "cam0:\n  camera_model: pinhole\n  distortion_model: equidistant\n  resolution: [640, 480]\n"
            f"  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  intrinsics: [{focal}, {focal}, 320.0, 240.0]\n"
        )
    cameras, remarks = given_cameras(folder, None, photographs)
    assert {name: camera.fx for name, camera in cameras.items()} == {"front": 300.0, "left": 310.0} and not remarks
    assert given_cameras(folder, "left", photographs)[0].keys() == {"left"}
