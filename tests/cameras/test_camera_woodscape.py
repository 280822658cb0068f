"""WoodScape's calibrations against what its own scripts compute, how its cameras are fixed to the car, and mistakes."""

import json

import numpy as np
import pytest
from camera_samples import INLINE, random_directions
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from spherloc.cameras.base import in_image
from spherloc.cameras.calibration import camera_names, load_camera
from spherloc.cameras.radial_poly import RadialPoly
from spherloc.cameras.rig_files import read_rig
from spherloc.errors import CalibrationError
from spherloc.mapping.images.lens import for_colmap

LENS = {
    **{"model": "radial_poly", "poly_order": 4, "k1": 339.749, "k2": -31.988, "k3": 48.275, "k4": -7.201},
    **{"cx_offset": 3.942, "cy_offset": -3.093, "aspect_ratio": 1.0, "width": 1280.0, "height": 966.0},
}
PLACE = {
    "quaternion": [0.5946970238045494, -0.5837953694518585, 0.39063952590941586, -0.3910488170060691],
    "translation": [3.7484, 0.0, 0.6578],
}
FRONT = {"extrinsic": PLACE, "intrinsic": LENS, "name": "FV"}
"""A real camera at the front of a car, which looks ahead and down."""


def written(folder, document):
    path = folder / "00000_FV.json"
    path.write_text(json.dumps(document))
    return path


def as_woodscape_projects(lens, points):
    """Pixels (N, 2) of points (N, 3), with the centre of the first at (0, 0)."""
    x, y, z = points.T
    chi = np.hypot(x, y)
    theta = np.pi / 2 - np.arctan2(z, chi)
    rho = sum(lens[f"k{power}"] * theta**power for power in range(1, 5))
    u = rho * x / chi + lens["cx_offset"] + lens["width"] / 2 - 0.5
    v = rho * y / chi * lens["aspect_ratio"] + lens["cy_offset"] + lens["height"] / 2 - 0.5
    return np.column_stack([u, v])


@pytest.mark.parametrize("aspect", [1.0, 0.97])
def test_projects_as_woodscape(tmp_path, aspect):
    lens = LENS | {"aspect_ratio": aspect}
    path = written(tmp_path, FRONT | {"intrinsic": lens})
    camera, points = load_camera(path), random_directions(3, 2000)
    pixels, seen = camera.project(points)
    assert seen.mean() > 0.5 and load_camera(path, "FV") == camera and camera_names(path) == ()
    np.testing.assert_allclose(pixels[seen], as_woodscape_projects(lens, points[seen]) + 0.5, atol=1e-9)


def test_the_camera_is_where_the_car_has_it(tmp_path):
    rig = read_rig(written(tmp_path, FRONT))
    assert list(rig.body_from_camera) == ["FV"] and not rig.of_imu
    matrix = rig.body_from_camera["FV"]
    np.testing.assert_array_equal(matrix[:3, 3], PLACE["translation"])
    right, down, ahead = matrix[:3, :3].T
    assert right @ [0, -1, 0] > 0.99 and ahead @ [1, 0, 0] > 0.8 and down @ [0, 0, -1] > 0.8
    path = written(tmp_path, {key: value for key, value in FRONT.items() if key != "extrinsic"})
    assert read_rig(path).body_from_camera == {} and load_camera(path) == INLINE["radial-poly-woodscape"]


@given(k1=st.floats(100.0, 800.0), lens=st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3))
def test_angles_come_back_to_the_end_of_the_curve(k1, lens):
    try:
        camera = RadialPoly(1280, 966, k1, k1, 640.0, 483.0, tuple(lens))
    except CalibrationError:
        return
    angles = np.linspace(0.01, 0.999, 50) * camera.max_angle_rad
    points = np.column_stack([np.sin(angles), 0.0 * angles, np.cos(angles)])
    pixels, seen = camera.project(points)
    assert seen.all() and (np.diff(pixels[:, 0]) > 0.0).all()
    back, there = camera.unproject(pixels)
    assert there.all()
    np.testing.assert_allclose(back, points, atol=1e-9)
    beyond = min(camera.max_angle_rad + 0.01, np.pi)
    assert not camera.project(np.array([[np.sin(beyond), 0.0, np.cos(beyond)]]))[1][0]


@pytest.mark.parametrize(
    ("document", "said"),
    [
        (FRONT | {"intrinsic": LENS | {"model": "pinhole"}}, "intrinsic: the model 'pinhole' with poly_order 4 is not"),
        (FRONT | {"intrinsic": LENS | {"poly_order": 5}}, "with poly_order 5 is not supported: give radial_poly"),
        (FRONT | {"intrinsic": LENS | {"k1": 0}}, "intrinsic: camera key 'k1' is 0"),
        (FRONT | {"intrinsic": LENS | {"k3": None}}, "camera key 'k3' is None: give a finite number"),
        (FRONT | {"intrinsic": LENS | {"width": 0.5}}, "camera key 'width' is 0.5"),
        (FRONT | {"intrinsic": {"model": "radial_poly"}}, "intrinsic: key 'k1' is missing"),
        (FRONT | {"intrinsic": LENS | {"k2": -1e6}}, "cannot be inverted one pixel away"),
    ],
)
def test_wrong_lenses_are_told(tmp_path, document, said):
    path = written(tmp_path, document)
    with pytest.raises(CalibrationError) as caught:
        load_camera(path)
    assert said in str(caught.value) and str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ({"quaternion": [0, 0, 0, 2], "translation": [0, 0, 0]}, "extrinsic: its quaternion is 2.0 long"),
        ({"quaternion": [0, 0, 1], "translation": [0, 0, 0]}, "give a list of 4 finite numbers, x, y, z, w"),
        ({"quaternion": [0, 0, 0, 1]}, "extrinsic: key 'translation' is missing"),
        (3, "extrinsic: the camera is 3"),
    ],
)
def test_wrong_places_are_told(tmp_path, place, said):
    path = written(tmp_path, FRONT | {"extrinsic": place})
    with pytest.raises(CalibrationError) as caught:
        read_rig(path)
    assert said in str(caught.value) and str(caught.value).startswith(f"{path}: ")


def test_another_name_is_told(tmp_path):
    with pytest.raises(CalibrationError, match="describes the camera 'FV' only: ask for it instead of 'RV'"):
        load_camera(written(tmp_path, FRONT), "RV")


def test_lenses_for_colmap(tmp_path):
    """Kannala-Brandt has no even powers; a lens that needs more terms is written as FISHEYE624."""
    for changed, model in (({}, "kannala_brandt"), ({"k2": -60.0, "k3": 90.0, "k4": -20.0}, "fisheye624")):
        lens = load_camera(written(tmp_path, FRONT | {"intrinsic": LENS | changed}))
        fitted, remark = for_colmap(lens)
        assert fitted.model == model and "The lens (radial_poly) is written as" in remark
        points = random_directions(5, 3000)
        points = points[points[:, 2] > np.cos(np.radians(85.0)) * np.linalg.norm(points, axis=1)]
        there = lens.project(points)[0]
        inside = in_image(lens, there)
        off = np.linalg.norm(fitted.project(points)[0] - there, axis=1)[inside]
        assert inside.sum() > 500 and off.max() < 0.45 and np.sqrt((off**2).mean()) < 0.1


def test_the_scipy_order_of_quaternions(tmp_path):
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    path = written(tmp_path, FRONT | {"extrinsic": {"quaternion": turn.as_quat().tolist(), "translation": [1, 2, 3]}})
    np.testing.assert_allclose(read_rig(path).body_from_camera["FV"][:3, :3], turn.as_matrix(), atol=1e-12)
