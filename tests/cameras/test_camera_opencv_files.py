"""Calibrations that OpenCV itself wrote, against its own projections; and those of ROS."""

import json
from contextlib import suppress

import cv2
import numpy as np
import pytest
import yaml

from spherloc.cameras import opencv_files
from spherloc.cameras.calibration import about_calibration, load_camera
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


CAR = {
    "K": [[248.91888, 0, 330.49089], [0, 248.78073, 198.3587], [0, 0, 1]],
    "D": [[-0.041974899], [-0.00077017], [-0.00481088], [0.0013088]],
    "dim": [640, 480],
}
"""The front camera of a real car, as a Python script wrote it."""
FRONT = KannalaBrandt(
    640, 480, 248.91888, 248.78073, 330.99089, 198.8587, (-0.041974899, -0.00077017, -0.00481088, 0.0013088)
)


def scripted(folder, document, kind="yaml"):
    """A file of a Python script with that document."""
    path = folder / f"front.{kind}"
    path.write_text(yaml.dump(document) if kind == "yaml" else json.dumps(document))
    return path


@pytest.mark.parametrize("kind", ["yaml", "json"])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("D", np.ravel(CAR["D"]).tolist()),
        ("D", [np.ravel(CAR["D"]).tolist()]),
        ("K", np.ravel(CAR["K"]).tolist()),
        ("dim", [[640], [480]]),
        ("dim", (640, 480)),
        ("dim", [640.0, 480.0]),
    ],
)
def test_lists_of_python_scripts(tmp_path, kind, key, value):
    """In every shape that their arrays may have; YAML has tuples of Python, too."""
    path = scripted(tmp_path, CAR, kind)
    assert load_camera(path) == FRONT
    assert "since its keys K, D and dim are those of cv2.fisheye's users" in about_calibration(path)
    assert load_camera(scripted(tmp_path, CAR | {key: value}, kind)) == FRONT


@pytest.mark.parametrize("matrix", opencv_files.MATRICES)
@pytest.mark.parametrize("lens", [*opencv_files.COEFFICIENTS, "distortion", "dist"])
@pytest.mark.parametrize("size", ["DIM", "size", "image_size", "img_size", "resolution", "imageSize", None])
def test_every_name_is_read(tmp_path, matrix, lens, size):
    sides = {"width": 640, "height": 480} if size is None else {size: CAR["dim"]}
    document = {matrix: CAR["K"], lens: CAR["D"], "distortion_model": "equidistant", **sides}
    path = scripted(tmp_path, document)
    assert load_camera(path) == FRONT and about_calibration(path) == ""


SURROUND = """%YAML:1.0
---
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 302.4530598322953, 0., 496.6400146316346, 0., 320.7461859439233, 331.1998098436165, 0., 0., 1. ]
dist_coeffs: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -0.0437356, 0.0216925, -0.0263888, 0.0084123 ]
resolution: !!opencv-matrix
   rows: 2
   cols: 1
   dt: i
   data: [ 960, 640 ]
scale_xy: !!opencv-matrix
   rows: 2
   cols: 1
   dt: f
   data: [ 0.7, 0.8 ]
"""


def test_a_view_from_above(tmp_path):
    """The file of a project that draws a car's surroundings from above, with the size as an array."""
    path = tmp_path / "front.yaml"
    path.write_text(SURROUND)
    camera = load_camera(path)
    assert isinstance(camera, KannalaBrandt) and (camera.width, camera.height) == (960, 640)
    assert "those of a fisheye (cv2.fisheye), since -0.0264 would be a tangential distortion" in about_calibration(path)


FISHEYES = [
    ((640, 480), 339.9, (-0.02256, 0.01984, -0.02647, 0.00305)),
    ((1280, 720), 715.1, (-0.01854, -0.03616, 0.0996, -0.08138)),
    ((3264, 2448), 2107.9, (-0.1227, 0.2074, -0.4161, 0.2661)),
    ((1920, 1080), 543.4, (-0.03478, -0.05953, 0.06858, -0.02426)),
    ((800, 800), 351.6, (-0.1706, 0.5324, -1.5452, 1.4794)),
    ((848, 800), 285.9, (-0.0055, 0.0418, -0.0393, 0.0067)),
]
"""Size, px, focal length, px, and coefficients of real fisheyes whose numbers show what they are."""
PINHOLES = [
    ((752, 480), 458.0, (-0.283, 0.074, 0.0002, 0.00002)),
    ((800, 600), 538.0, (-0.307, 0.083, 0.0029, -0.001)),
]
"""The same of real pinholes."""
EITHER = [
    ((512, 512), 191.0, (0.0034, 0.0007, -0.002, 0.0002)),
    ((640, 360), 357.7, (-0.0972, -0.0058, -0.0078, 0.0028)),
    ((1920, 1080), 1126.0, (0.1283, -0.1972, 0.0, 0.0)),
]
"""The same of two fisheyes and a webcam, whose numbers alone do not show it."""


def named_by_all(size, f, lens):
    """A file by names that users of both kinds give."""
    matrix = [[f, 0, size[0] / 2], [0, f, size[1] / 2], [0, 0, 1]]
    return {"camera_matrix": matrix, "dist_coeffs": list(lens), "image_size": list(size)}


@pytest.mark.parametrize(("kind", "real"), [(KannalaBrandt, one) for one in FISHEYES] + [(Mei, p) for p in PINHOLES])
def test_four_coefficients_that_show_what_they_are(tmp_path, kind, real):
    path = scripted(tmp_path, named_by_all(*real))
    camera = load_camera(path)
    assert type(camera) is kind and camera.distortion == real[2]
    told = "a fisheye (cv2.fisheye)" if kind is KannalaBrandt else "a pinhole"
    assert about_calibration(path).startswith(f"its four coefficients are taken for those of {told}, since ")


@pytest.mark.parametrize("real", EITHER)
def test_four_coefficients_that_may_be_either(tmp_path, real):
    """The names of cv2.fisheye's tutorial decide, and a fifth coefficient is a pinhole's."""
    document = named_by_all(*real)
    with pytest.raises(CalibrationError, match="the four dist_coeffs may be those of a fisheye or of a pinhole: add"):
        load_camera(scripted(tmp_path, document))
    with pytest.raises(CalibrationError, match="may be those"):
        about_calibration(tmp_path / "front.yaml")
    tutorial = {"K": document["camera_matrix"], "D": document["dist_coeffs"], "DIM": document["image_size"]}
    assert isinstance(load_camera(scripted(tmp_path, tutorial)), KannalaBrandt)
    five = scripted(tmp_path, document | {"dist_coeffs": [*real[2], 0.0]})
    assert isinstance(load_camera(five), Mei) and about_calibration(five) == ""


def test_a_pinhole_that_would_cover_a_part_of_the_image(tmp_path):
    lens = (-0.15, -0.01, 0.018, 0.0)  # as a pinhole's its curve turns back inside the image
    path = scripted(tmp_path, named_by_all((640, 480), 248.0, lens))
    assert isinstance(load_camera(path), KannalaBrandt)
    assert "since a pinhole with them would cover" in about_calibration(path)


def test_no_pinhole_is_taken_for_a_fisheye(rng):
    """Of any focal length and usual distortion."""
    for _ in range(200):
        f, (k1, p1, p2) = rng.uniform(400.0, 3000.0), rng.normal(size=3) * (0.15, 0.003, 0.003)
        lens = (k1, max(0.5 * k1**2, 0.0) + rng.normal() * 0.02, p1, p2)
        with suppress(CalibrationError):
            assert isinstance(opencv_files.opencv(named_by_all((752, 480), f, lens)), Mei), (f, lens)


@pytest.mark.parametrize(
    ("document", "said"),
    [
        (CAR | {"K": [[1, 0, 2], [0, 1]]}, "K: is [[1, 0, 2], [0, 1]]: give rows of the same length."),
        (CAR | {"K": [[1, 0], [0, 1]]}, "K: has 4 numbers: give 9."),
        (CAR | {"K": 3}, "K: is 3: give a matrix, as a list of its rows."),
        (CAR | {"D": [["a"], [1], [2], [3]]}, "D: camera key 'data'"),
        (CAR | {"D": [[[1]]]}, "D: camera key 'data'"),
        (CAR | {"D": [1, 2, 3, 4, 5]}, "D has 5 numbers: calibrate with k1, k2, p1, p2 alone."),
        (CAR | {"dim": [640]}, "dim: has 1 numbers: give 2."),
        (CAR | {"dim": [640.5, 480]}, "camera key 'width' is 640.5"),
        ({"K": CAR["K"], "dim": [640, 480]}, "has arrays of OpenCV by the names K:"),
        ({"D": CAR["D"], "dim": [640, 480]}, "key 'K' is missing"),
        ({"K": CAR["K"], "D": CAR["D"]}, "states no size of images"),
        ({"dist": 3, "dim": [640, 480]}, "no known key at its top"),
    ],
)
def test_wrong_lists_are_told(tmp_path, document, said):
    for kind in ("yaml", "json"):
        path = scripted(tmp_path, document, kind)
        with pytest.raises(CalibrationError) as caught:
            load_camera(path)
        assert said in str(caught.value) and str(path) in str(caught.value)


def test_arrays_that_python_alone_reads_are_told(tmp_path):
    path = scripted(tmp_path, {"K": np.array(CAR["K"]), "D": np.array(CAR["D"])})
    with pytest.raises(CalibrationError, match="line 1 has an array of NumPy: write it as a list, by its tolist"):
        load_camera(path)
