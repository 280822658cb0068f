"""Calibrations in JSON: cameras by name as those of Project Aria's glasses, and nerfstudio's transforms.json."""

import json

import numpy as np
import pycolmap
import pytest
from camera_samples import random_directions, require_shared

from spherloc.cameras.calibration import camera_names, load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError

FISHEYE = {"fl_x": 1072.0, "fl_y": 1070.0, "cx": 1488.5, "cy": 998.0, "w": 3008, "h": 2000, "k1": 0.03, "k2": 0.006}
TABLE = {"model": "OPENCV_FISHEYE", "width": 640, "height": 480, "params": [190, 191, 320, 240, 0.1, 0, 0, 0]}


def written(folder, document):
    path = folder / "lens.json"
    path.write_text(json.dumps(document))
    return path


def test_the_glasses_file_has_its_cameras_by_name():
    """One focal length, and the principal point counts from the centre of the first pixel."""
    path = require_shared("aria_adt_fisheye/calibration_fisheye624.json")
    tables = json.loads(path.read_text())
    assert camera_names(path) == tuple(tables) == ("camera-rgb", "camera-slam-left", "camera-slam-right")
    assert load_camera(path) == load_camera(path, "camera-rgb")
    points = random_directions(seed=3, count=2000)
    points = points[points[:, 2] > 0.2]
    for name, table in tables.items():
        camera = load_camera(path, name)
        focal, cx, cy, *lens = table["params"]
        colmap = pycolmap.Camera(
            model="RAD_TAN_THIN_PRISM_FISHEYE",
            width=table["size"][0],
            height=table["size"][1],
            params=[focal, focal, cx + 0.5, cy + 0.5, *lens],
        )
        pixels, seen = camera.project(points)
        assert seen.sum() > 500
        np.testing.assert_allclose(pixels[seen], colmap.img_from_cam(points[seen]), atol=1e-6)
    with pytest.raises(CalibrationError, match=r"has no camera 'left': choose one of camera-rgb, camera-slam-left"):
        load_camera(path, "left")


def test_cameras_of_colmaps_models_by_name(tmp_path):
    path = written(
        tmp_path, {"left": TABLE, "right": {**TABLE, "params": [180, *TABLE["params"][1:]]}, "rig": {"T": []}}
    )
    assert camera_names(path) == ("left", "right")
    assert load_camera(path, "right") == KannalaBrandt(640, 480, 180, 191, 320, 240, (0.1, 0, 0, 0))


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "OPENCV", "PINHOLE", None])
def test_transforms_json(tmp_path, model):
    """As COLMAP's camera of the same parameters; without a camera_model it is OPENCV."""
    named = {} if model is None else {"camera_model": model}
    camera = load_camera(written(tmp_path, {**FISHEYE, **named, "frames": [{"file_path": "a.jpg"}]}))
    lens = {"OPENCV_FISHEYE": [0.03, 0.006, 0, 0], "PINHOLE": []}.get(model, [0.03, 0.006, 0, 0])
    params = [1072.0, 1070.0, 1488.5, 998.0, *lens]
    colmap = pycolmap.Camera(model=model or "OPENCV", width=3008, height=2000, params=params)
    points = random_directions(seed=5, count=500)
    points = points[points[:, 2] > 0.5]
    pixels, seen = camera.project(points)
    assert seen.sum() > 100
    np.testing.assert_allclose(pixels[seen], colmap.img_from_cam(points[seen]), atol=1e-6)


def test_a_panorama_and_one_focal_length_in_transforms_json(tmp_path):
    panorama = {"camera_model": "EQUIRECTANGULAR", "w": 400, "h": 200, "frames": []}
    assert load_camera(written(tmp_path, panorama)) == Equirectangular(400, 200)
    assert camera_names(tmp_path / "lens.json") == ()
    one = {key: value for key, value in FISHEYE.items() if key != "fl_y"} | {"camera_model": "OPENCV_FISHEYE"}
    assert load_camera(written(tmp_path, one)) == KannalaBrandt(
        3008, 2000, 1072, 1072, 1488.5, 998, (0.03, 0.006, 0, 0)
    )


def test_a_camera_table_of_this_project_as_json(tmp_path):
    lens = (0.02, -0.01, *[0.0] * 10)
    table = {"width": 640, "height": 480, "fx": 200, "fy": 201, "cx": 320, "cy": 240, "distortion": lens}
    camera = Fisheye624(640, 480, 200, 201, 320, 240, lens)
    for document in ({"model": "fisheye624", **table}, {"camera": {"model": "fisheye624", **table}}):
        assert load_camera(written(tmp_path, document)) == camera, "its principal point is taken as it is"
    assert camera_names(tmp_path / "lens.json") == ()


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ({"left": {**TABLE, "model": "WIDE"}}, "left.*the COLMAP model 'WIDE' is not supported"),
        ({"left": {**TABLE, "params": [1, 2]}}, "left.*key 'params' is .*give a list of 8 finite numbers"),
        ({"left": {**TABLE, "params": "many"}}, "left.*'params' is 'many': give a list"),
        ({"left": {**TABLE, "width": 6.5}}, "left.*key 'width' is 6.5"),
        (
            {"left": {"model": "FISHEYE624", "size": [64, 48], "params": [1.0]}},
            "left.*list of 15 finite numbers",
        ),
        (
            {"left": {"model": "fisheye624", "size": [64, 48], "params": [1.0] * 16}},
            "left.*model 'fisheye624' does not say in which order .*: call it RAD_TAN_THIN_PRISM_FISHEYE if .*16, or "
            "FISHEYE624 if they are Project Aria's 15",
        ),
        ({**TABLE, "model": "kannala_brandt"}, "top level: model 'kannala_brandt' .* call it OPENCV_FISHEYE if"),
        (
            {**TABLE, "model": "mei"},
            "model 'mei' does not say in which order the numbers in 'params' are: give each by",
        ),
        ({"model": "mei", "width": 64}, "top level: .*key 'height' is missing"),
        ({"model": "RICOH THETA", "params": 1}, "this JSON has no known key at its top"),
        ({"left": {"model": "OPENCV", "params": []}}, "left.*key 'width' is missing"),
        ({**FISHEYE, "camera_model": "SPHERICAL"}, "camera_model 'SPHERICAL' is not supported"),
        ({**FISHEYE, "fl_x": "wide"}, "fl_x"),
        ({"fl_x": 100.0}, "key 'w' is missing"),
        ({"lens": 1}, "this JSON has no known key at its top"),
        ([1, 2], "line 1|neither"),
    ],
)
def test_wrong_files_are_told_where(tmp_path, document, said):
    with pytest.raises(CalibrationError, match=rf"lens\.json.*{said}"):
        load_camera(written(tmp_path, document))
