"""Calibrations that OpenCV itself wrote, against its own projections; and those of ROS."""

import cv2
import numpy as np
import pytest

from spherloc.cameras.calibration import load_camera
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError

MATRIX = np.array([[401.5, 0.0, 318.25], [0.0, 402.5, 239.75], [0.0, 0.0, 1.0]])
RADIAL = np.array([-0.2, 0.05, 0.001, -0.002])
FISHEYE = np.array([0.02, -0.01, 0.003, -0.0005])


def written(folder, lens, kind="yml", **others):
    """A file by OpenCV's FileStorage."""
    path = folder / f"camera.{kind}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 1 Jan 2024")
    for name, value in {"image_width": 640, "image_height": 480, **others}.items():
        storage.write(name, value)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.asarray(lens, dtype=np.float64).reshape(-1, 1))
    storage.release()
    return path


def points(rng):
    return rng.normal(size=(50, 3)) * [0.5, 0.4, 0.2] + [0.0, 0.0, 2.0]


def test_a_pinhole_as_opencv_projects_it(tmp_path):
    camera = load_camera(written(tmp_path, [*RADIAL, 0.0]))
    found, seen = camera.project(points(np.random.default_rng(1)))
    there = cv2.projectPoints(points(np.random.default_rng(1)), np.zeros(3), np.zeros(3), MATRIX, RADIAL)[0][:, 0]
    assert isinstance(camera, Mei) and seen.all()
    np.testing.assert_allclose(found, there + 0.5, atol=1e-9)


def test_a_fisheye_as_opencv_projects_it(tmp_path):
    camera = load_camera(written(tmp_path, FISHEYE, fisheye_model=1))
    places = points(np.random.default_rng(2))
    there = cv2.fisheye.projectPoints(places[:, None], np.zeros(3), np.zeros(3), MATRIX, FISHEYE)[0][:, 0]
    assert isinstance(camera, KannalaBrandt) and (camera.width, camera.height) == (640, 480)
    np.testing.assert_allclose(camera.project(places)[0], there + 0.5, atol=1e-9)


@pytest.mark.parametrize("kind", ["xml", "json"])
def test_other_forms_of_a_file_hold_the_same(tmp_path, kind):
    for lens, others in ((FISHEYE, {"fisheye_model": 1}), (RADIAL, {"xi": 1.25, "note": "a < b & c"})):
        assert load_camera(written(tmp_path, lens, kind, **others)) == load_camera(written(tmp_path, lens, **others))


FLAT = {
    "yml": """%YAML 1.2
---
image_width: 640
image_height: 480
fisheye_model: 1
K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 401.5, 0., 318.25, 0., 402.5, 239.75, 0., 0., 1. ]
D: !!opencv-nd-matrix
   sizes: [ 4 ]
   dt: d
   data: [ 0.02, -0.01, 0.003, -0.0005 ]
""",
    "xml": """<?xml version="1.0"?>
<opencv_storage><image_width>640</image_width><image_height>480</image_height><fisheye_model>1</fisheye_model>
<K type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>401.5 0. 318.25 0. 402.5 239.75 0. 0. 1.</data></K>
<D type_id="opencv-nd-matrix"><sizes>4</sizes><dt>d</dt><data>0.02 -0.01 0.003 -0.0005</data></D></opencv_storage>
""",
    "json": """{"image_width": 640, "image_height": 480, "fisheye_model": 1,
"K": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "data": [401.5, 0, 318.25, 0, 402.5, 239.75, 0, 0, 1]},
"D": {"type_id": "opencv-nd-matrix", "sizes": [4], "dt": "d", "data": [0.02, -0.01, 0.003, -0.0005]}}
""",
}
"""D as OpenCV 5 writes arrays of one dimension."""


@pytest.mark.parametrize("kind", FLAT)
def test_arrays_of_one_dimension_are_read(tmp_path, kind):
    path = tmp_path / f"flat.{kind}"
    path.write_text(FLAT[kind])
    assert load_camera(path) == load_camera(written(tmp_path, FISHEYE, fisheye_model=1))
    path.write_text(
        FLAT[kind].replace("sizes: [ 4 ]", "sizes: [ 5 ]").replace("<sizes>4", "<sizes>5").replace("[4]", "[5]")
    )
    with pytest.raises(CalibrationError, match="D: has 4 numbers in 5 rows and 1 columns"):
        load_camera(path)


@pytest.mark.parametrize("kind", FLAT)
def test_arrays_of_other_names_are_told(tmp_path, kind):
    """Such as those of a pair of cameras, which OpenCV's stereo sample writes."""
    path = tmp_path / f"intrinsics.{kind}"
    text = FLAT[kind]
    for old, new in (
        ("K: ", "M1: "),
        ("D: ", "D1: "),
        ('"K"', '"M1"'),
        ('"D"', '"D1"'),
        ("<K ", "<M1 "),
        ("<D ", "<D1 "),
    ):
        text = text.replace(old, new)
    path.write_text(text.replace("</K>", "</M1>").replace("</D>", "</D1>"))
    with pytest.raises(CalibrationError, match="has arrays of OpenCV by the names M1, D1: call those of one camera"):
        load_camera(path)


def test_the_keys_of_opencv_2(tmp_path):
    path = written(tmp_path, RADIAL, "xml", distortion_model="plumb_bob")
    wanted = load_camera(path)
    for key in ("camera_matrix", "distortion_coefficients", "image_width", "image_height"):
        path.write_text(path.read_text().replace(key, "_".join(map(str.capitalize, key.split("_")))))
    path.write_text(path.read_text().replace("Image_", "image_"))
    assert "<Camera_Matrix" in path.read_text() and load_camera(path) == wanted


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<opencv_storage><image_width>640", "line 1 is not valid XML"),
        ("<calibration><f>400</f></calibration>", "a 'calibration', not OpenCV's 'opencv_storage'"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>', "defines entities"),
        ("<opencv_storage><image_width>640</image_width></opencv_storage>", "this XML has no known key at its top"),
        ("<opencv_storage><image_width>640</image_width><K>1</K><D>2</D></opencv_storage>", "image_height"),
    ],
)
def test_another_xml_is_told(tmp_path, text, told):
    path = tmp_path / "camera.xml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=told):
        load_camera(path)


def test_mei_has_its_mirror(tmp_path):
    camera = load_camera(written(tmp_path, RADIAL, xi=np.array([[1.25]])))
    assert isinstance(camera, Mei) and camera.xi == 1.25 and camera.distortion == tuple(RADIAL)


def test_matrices_may_be_called_k_and_d(tmp_path):
    """As programs write them that calibrate fisheyes and omnidirectional cameras."""
    path = written(tmp_path, RADIAL, xi=np.array([[1.25]]))
    wanted = load_camera(path)
    path.write_text(path.read_text().replace("camera_matrix", "K").replace("distortion_coefficients", "D"))
    assert load_camera(path) == wanted
    path.write_text(path.read_text().replace("image_width", "columns"))
    with pytest.raises(CalibrationError, match="key 'image_width' is missing"):
        load_camera(path)


EUROC = """%YAML:1.0
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS: {rows: 4, cols: 4, data: [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [401.5, 402.5, 318.25, 239.75]
distortion_model: MODEL
distortion_coefficients: [0.02, -0.01, 0.003, -0.0005]
"""


def test_the_camera_of_a_euroc_folder(tmp_path):
    path = tmp_path / "sensor.yaml"
    path.write_text(EUROC.replace("MODEL", "equidistant"))
    assert load_camera(path) == KannalaBrandt(640, 480, 401.5, 402.5, 318.75, 240.25, tuple(FISHEYE))
    path.write_text(EUROC.replace("MODEL", "radial-tangential"))
    assert load_camera(path) == Mei(640, 480, 401.5, 402.5, 318.75, 240.25, 0.0, tuple(FISHEYE))
    for wrong, said in (("fov", "the distortion_model 'fov' is not supported"), ("[1]", "is not supported")):
        path.write_text(EUROC.replace("MODEL", wrong))
        with pytest.raises(CalibrationError, match=said):
            load_camera(path)


ROS = """image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [401.5, 0, 318.25, 0, 402.5, 239.75, 0, 0, 1]}
distortion_model: equidistant
distortion_coefficients:
  rows: 1
  cols: 4
  data: [0.02, -0.01, 0.003, -0.0005]
"""


def test_ros(tmp_path):
    path = tmp_path / "ros.yaml"
    path.write_text(ROS)
    assert load_camera(path) == KannalaBrandt(640, 480, 401.5, 402.5, 318.75, 240.25, tuple(FISHEYE))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ROS.replace("distortion_model: equidistant\n", ""), "may be those of a fisheye or of a pinhole"),
        (ROS.replace("equidistant", "rational_polynomial"), "'rational_polynomial' is not supported"),
        (ROS.replace("401.5, 0,", "401.5, 3,"), "camera_matrix: is not a matrix"),
        (ROS.replace("cols: 4", "cols: 5"), "has 4 numbers in 1 rows and 5 columns"),
        (ROS.replace("[0.02, -0.01, 0.003, -0.0005]", "[a, 1, 2, 3]"), "distortion_coefficients"),
        (ROS.replace("cols: 4", "cols: 5").replace("-0.0005]", "-0.0005, 1]"), "calibrate with k1, k2, k3, k4 alone"),
        (ROS.replace("image_width: 640\n", ""), "key 'image_width' is missing"),
        (ROS.replace("[0.02", "[.nan"), "data"),
        ("%YAML:1.0\n---\na: !!opencv-matrix [1]\ndistortion_coefficients: 3\n", "is not valid YAML"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, said):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError) as caught:
        load_camera(path)
    assert said in str(caught.value) and str(path) in str(caught.value)
