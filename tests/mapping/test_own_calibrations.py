"""Calibrations of single images, as WoodScape has them: where they may lie, and which images have one camera."""

import json

import numpy as np
import pytest
from image_samples import camera_file, picture
from scipy.spatial.transform import Rotation

from spherloc.cameras import calibration
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError
from spherloc.mapping.alignment.fixed_images import fixed_images
from spherloc.mapping.images import found_calibrations
from spherloc.mapping.images.found_calibrations import calibrations_in, own_files
from spherloc.mapping.images.given_cameras import given_cameras
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.models.fixed_views import fixed_pairs
from spherloc.mapping.rig import shots_of

SIZE = 320, 240
CAMERAS = {"FV": (0.0, 3.7), "MVL": (90.0, 1.9), "MVR": (-90.0, 2.0), "RV": (180.0, -0.5)}
"""By name, the direction in which a camera of the car looks, degrees to the left, and how far ahead it is, m."""
LAYOUTS = ("calibration", "calibration_data/calibration", "rgb_images", "rgb_images/calibration")
TIMES = 5


def as_woodscape(name, k1=85.0, size=SIZE):
    """A calibration of one camera of a car."""
    yaw_deg, ahead = CAMERAS[name]
    turn = Rotation.from_euler("z", yaw_deg, degrees=True) * Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    lens = {"model": "radial_poly", "poly_order": 4, "k1": k1, "k2": -8.0, "k3": 12.0, "k4": -1.8}
    place = {"cx_offset": 0.5, "cy_offset": -0.5, "aspect_ratio": 1.0, "width": float(size[0]), "height": size[1]}
    extrinsic = {"quaternion": turn.as_quat().tolist(), "translation": [ahead, 0.0, 0.8]}
    return {"extrinsic": extrinsic, "intrinsic": {**lens, **place}, "name": name}


@pytest.fixture
def car(tmp_path, rng):
    """A folder with the images of four cameras, and how to put their calibrations somewhere beside it."""
    folder = tmp_path / "rgb_images"
    folder.mkdir()
    names = [f"{time:05d}_{camera}" for time in range(TIMES) for camera in CAMERAS]
    for name in names:
        picture(folder / f"{name}.png", *SIZE, rng)

    def put(place, **focal):
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        for name in names:
            camera = name.partition("_")[2]
            document = as_woodscape(camera, focal.get(camera, 85.0))
            (tmp_path / place / f"{name}.json").write_text(json.dumps(document))
        return folder

    return put


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_image_has_its_own_calibration(car, layout):
    """Images of one number were taken together, and the calibrations say how the cameras are fixed to each other."""
    folder = car(layout, FV=85.0, RV=86.0, MVL=87.0, MVR=88.0)
    found = photographs(folder, {})
    focal = {"FV": 85.0, "RV": 86.0, "MVL": 87.0, "MVR": 88.0}
    assert len(found.views) == TIMES * len(CAMERAS) and len({repr(view.camera) for view in found.views}) == 4
    for view in found.views:
        assert view.camera.model == "kannala_brandt"  # for COLMAP
    assert {name: camera.fx for name, camera in found.cameras.items()} == focal
    assert found.remarks[0] == "The calibration found beside them: FV, MVL, MVR, RV."
    shots = shots_of(found.views)
    assert len(shots) == len(found.views) and shots["00003_MVL.png"] == ("MVL", 3)
    fixed, remarks = fixed_images(folder, found.views, None)
    assert fixed is not None and remarks == [] and fixed.source == "the calibration of each image"
    assert [sorted(names) for names in fixed.times.values()] == [
        [f"{time:05d}_{camera}.png" for camera in CAMERAS] for time in range(TIMES)
    ]
    first, second = (fixed.body_from_camera[f"00000_{name}.png"] for name in ("FV", "RV"))
    np.testing.assert_allclose(first[:3, 3] - second[:3, 3], [4.2, 0.0, 0.0])
    np.testing.assert_allclose(first[:3, 2], -second[:3, 2], atol=1e-12)  # they look ahead and back


@pytest.mark.parametrize(
    ("called", "one_moment"),
    [
        ("{camera}", True),
        ("00012_{camera}", True),
        ("{camera}_1700000000.000{number}", True),
        ("{camera}_1700000000.0{number}", False),
        ("0000{number}_{camera}", False),
    ],
)
def test_images_of_one_moment(tmp_path, rng, called, one_moment):
    """Each is of another camera, and no name says that they were taken one after another."""
    for number, camera in enumerate(CAMERAS):
        name = called.format(camera=camera, number=number)
        picture(tmp_path / f"{name}.png", *SIZE, rng)
        (tmp_path / f"{name}.json").write_text(json.dumps(as_woodscape(camera)))
    views = photographs(tmp_path, {}).views
    fixed, _ = fixed_images(tmp_path, views, None)
    pairs = fixed_pairs(views, fixed)
    if not one_moment:
        assert fixed is None and not pairs
        return
    assert fixed is not None and fixed.one_moment and len(pairs) == 6
    names = [view.name for view in views]
    front, rear = (next(k for k, name in enumerate(names) if camera in name) for camera in ("FV", "RV"))
    rotation, direction = pairs[min(front, rear), max(front, rear)]
    np.testing.assert_allclose(rotation, np.diag([-1.0, 1.0, -1.0]), atol=1e-12)
    np.testing.assert_allclose(direction, [0.0, 0.0, -1.0], atol=1e-12)  # each is behind the other
    assert fixed_images(tmp_path, views[:1], None)[0] is None


def test_a_folder_of_calibrations_is_given(car, tmp_path):
    """Of such as are called as the images, and of such as are called as the cameras."""
    folder = car("elsewhere", FV=85.0, RV=86.0, MVL=87.0, MVR=88.0)
    (tmp_path / "elsewhere" / "labels.json").write_text("{}")
    by_camera = tmp_path / "by camera"
    by_camera.mkdir()
    for name in CAMERAS:
        (by_camera / f"{name}.json").write_text(json.dumps(as_woodscape(name)))
    (by_camera / "calibration.yaml").write_text("nothing")
    for given, told in ((tmp_path / "elsewhere", 0), (by_camera, 1)):
        cameras, remarks = given_cameras(given, None, folder)
        assert len(remarks) == told and all("calibration.yaml" in remark for remark in remarks)
        views = photographs(folder, cameras).views
        assert len(views) == TIMES * len(CAMERAS) and all(view.camera.model == "kannala_brandt" for view in views)
        fixed, _ = fixed_images(folder, views, given)
        assert fixed is not None and len(fixed.body_from_camera) == len(views)
        assert len({view.camera.fx for view in views}) == (1 if told else 4)
    assert list(given_cameras(by_camera, "RV", folder)[0]) == ["RV"]
    with pytest.raises(CalibrationError, match=r"has no camera 'LV'; choose one of FV, MVL, MVR"):
        given_cameras(by_camera, "LV", folder)
    with pytest.raises(CalibrationError, match=r"rgb_images: none of its files can be read as a calibration; give a"):
        given_cameras(folder, None, folder)


def test_a_folder_of_the_folder_of_images(car):
    found = photographs(car("calibration").parent, {})
    assert len(found.views) == TIMES * len(CAMERAS) and {view.name.split("/")[0] for view in found.views} == {
        "rgb_images"
    }
    assert found.remarks[0] == "rgb_images: The calibration found beside them: FV, MVL, MVR, RV."


def test_files_of_the_same_numbers_are_one_camera(car):
    """And an image without a file has the camera of those that are called as it is."""
    folder = car("calibration", FV=86.0)
    (folder.parent / "calibration" / "00001_FV.json").unlink()
    found = photographs(folder, {})
    assert [camera.fx for camera in found.cameras.values()] == [86.0, 85.0]
    assert found.remarks[0] == "The calibration found beside them: FV, MVL, MVR, RV."
    by_camera = {view.name: view.camera for view in found.views}
    assert by_camera["00001_FV.png"] == by_camera["00000_FV.png"] != by_camera["00001_RV.png"]


def test_cameras_of_two_cars_are_told_apart(car):
    """The cameras of another car that are called the same have other numbers."""
    folder = car("calibration")
    for name in ("00003_FV", "00004_FV"):
        (folder.parent / "calibration" / f"{name}.json").write_text(json.dumps(as_woodscape("FV", 90.0)))
    found = photographs(folder, {})
    assert found.cameras["FV"].fx == 90.0 and len(found.cameras) == 2
    (folder.parent / "calibration" / "00000_FV.json").write_text(json.dumps(as_woodscape("FV", 95.0)))
    (folder.parent / "calibration" / "00001_FV.json").write_text(json.dumps(as_woodscape("FV", 95.0)))
    assert {name: camera.fx for name, camera in photographs(folder, {}).cameras.items() if name[:2] == "FV"} == {
        **{"FV": 95.0, "FV (2)": 90.0},
        **{"FV, MVL, MVR, RV": 85.0},
    }


@pytest.mark.parametrize("layout", ["calibration", "rgb_images"])
def test_only_the_files_of_images_that_are_mapped_are_read(car, monkeypatch, layout):
    folder, read = car(layout), []
    for number in range(1000, 4000):
        (folder.parent / layout / f"{number:05d}_FV.json").write_text("{")
        if layout == "rgb_images":
            (folder / f"{number:05d}_FV.png").write_bytes(b"")
    load = calibration.load_camera
    monkeypatch.setattr(found_calibrations, "load_camera", lambda path, *more: read.append(path) or load(path, *more))
    images = [f"{time:05d}_{camera}.png" for time in range(TIMES) for camera in CAMERAS]
    found = calibrations_in(folder, images=images)
    assert list(found.of_image) == images and len(read) == len(images) and len(found.cameras) == 1


def test_other_files_that_are_called_as_images_are_no_calibrations(car, rng):
    """Such as labels of what is seen in them; and a calibration among others that cannot be read is told."""
    folder = car("calibration", FV=86.0)
    broken = folder.parent / "calibration" / "00002_FV.json"
    broken.write_text("{}")
    told = [remark for remark in photographs(folder, {}).remarks if "is not used" in remark]
    assert len(told) == 1 and told[0].startswith(f"The calibration of 00002_FV.png is not used: {broken}: ")
    for path in broken.parent.iterdir():
        path.write_text('{"shapes": []}')
    assert calibrations_in(folder, images=[path.name for path in folder.iterdir()]).of_image == {}
    lens = KannalaBrandt(*SIZE, 90.0, 90.0, 160.0, 120.0, (0.0, 0.0, 0.0, 0.0))
    (folder / "lens.toml").write_text(camera_file(lens))
    found = photographs(folder, {})
    assert {view.camera.fx for view in found.views} == {90.0} and "lens" in found.remarks[0] and len(found.remarks) == 1


def test_a_given_calibration_counts_first(car):
    lens = KannalaBrandt(*SIZE, 90.0, 90.0, 160.0, 120.0, (0.0, 0.0, 0.0, 0.0))
    folder = car("rgb_images")
    assert {view.camera for view in photographs(folder, {"": lens}).views} == {lens}


def test_a_file_for_each_camera(car):
    """Four images with a file each, and files that are called as the cameras in the names of images."""
    folder = car("elsewhere")
    for name in CAMERAS:
        (folder / f"{name}.json").write_text(json.dumps(as_woodscape(name, 85.0 + len(name))))
    found = photographs(folder, {})
    assert found.remarks[0] == "The calibration found beside them: FV, MVL, MVR, RV."
    fixed, _ = fixed_images(folder, found.views, None)
    assert fixed is not None and fixed.source == "the calibration of FV and of MVL and of MVR and of RV"
    assert len(fixed.times) == TIMES
    for name in CAMERAS:
        (folder / f"00000_{name}.png").rename(folder / f"{name}.png")
    own = own_files(folder, [f"{name}.png" for name in CAMERAS])
    assert own == {f"{name}.png": folder / f"{name}.json" for name in CAMERAS}
