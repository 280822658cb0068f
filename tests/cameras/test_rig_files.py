"""How the cameras of a calibration file are fixed to each other: real files of one rig, chains, mistakes."""

import json

import numpy as np
import pytest
from camera_samples import require_shared
from scipy.spatial.transform import Rotation

from spherloc.cameras.rig_files import read_rig
from spherloc.errors import CalibrationError

LENS = """camera_model: ds
  distortion_model: none
  intrinsics: [-0.2, 0.6, 300, 301, 370, 245]
  resolution: [752, 480]"""


def transform(seed, *place):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.random(random_state=seed).as_matrix(), place
    return matrix


def chain(*links):
    """A Kalibr chain with these keys and matrices, one camera each."""
    return "".join(
        f"cam{number}:\n  {LENS}\n" + "".join(f"  {key}: {matrix.tolist()}\n" for key, matrix in link.items())
        for number, link in enumerate(links)
    )


def named(**transforms):
    """A JSON of cameras by name, fixed to a device so."""
    lens = {"model": "OPENCV_FISHEYE", "width": 64, "height": 48, "params": [20, 20, 32, 24, 0, 0, 0, 0]}
    return {
        name: lens | ({} if given is None else {"T_device_camera": np.asarray(given).tolist()})
        for name, given in transforms.items()
    }


def test_two_tools_say_the_same_of_one_rig():
    """TUM VI's cameras, as Kalibr and as Basalt calibrated them; the first is 10 cm to the left of the second."""
    kalibr = read_rig(require_shared("formats_real/tumvi_kalibr_imucam_chain.yaml"))
    basalt = read_rig(require_shared("formats_real/basalt_tumvi_512_ds_calib.json"))
    assert kalibr.of_imu and basalt.of_imu and list(kalibr.body_from_camera) == list(basalt.body_from_camera)
    for name, here in kalibr.body_from_camera.items():
        there = basalt.body_from_camera[name]
        assert Rotation.from_matrix(here[:3, :3] @ there[:3, :3].T).magnitude() < np.radians(1.0)
        assert np.linalg.norm(here[:3, 3] - there[:3, 3]) < 5e-3
    first, second = basalt.body_from_camera.values()
    right = (np.linalg.inv(first) @ second)[:3, 3]
    assert right[0] == pytest.approx(0.101, abs=1e-3) and np.linalg.norm(right[1:]) < 5e-3


def test_real_glasses():
    path = require_shared("aria_adt_fisheye/calibration_fisheye624.json")
    rig, table = read_rig(path), json.loads(path.read_text())
    assert not rig.of_imu and rig.body_from_camera.keys() == table.keys()
    for name, matrix in rig.body_from_camera.items():
        np.testing.assert_array_equal(matrix, table[name]["T_device_camera"])


def test_a_chain_without_an_imu_is_fixed_to_its_first_camera(tmp_path):
    """And one with a gap to what is before the gap."""
    second, third = transform(1, 0.1, 0.0, 0.2), transform(2, 0.0, 0.3, 0.0)
    path = tmp_path / "camchain.yaml"
    path.write_text(chain({}, {"T_cn_cnm1": second}, {"T_cn_cnm1": third}))
    rig = read_rig(path)
    assert not rig.of_imu
    for name, camera_from_first in (("cam0", np.eye(4)), ("cam1", second), ("cam2", third @ second)):
        np.testing.assert_allclose(rig.body_from_camera[name] @ camera_from_first, np.eye(4), atol=1e-12)
    path.write_text(chain({}, {"T_cn_cnm1": second}, {}, {"T_cn_cnm1": third}))
    assert list(read_rig(path).body_from_camera) == ["cam0", "cam1"]
    path.write_text(chain({}, {"T_cn_cnm1": second}, {"T_cam_imu": third}))
    rig = read_rig(path)
    assert rig.of_imu and list(rig.body_from_camera) == ["cam2"]


def test_other_files_say_nothing(tmp_path):
    for text in (
        'model = "mei"\nwidth = 640\n',
        "1 OPENCV 640 480 1 1 1 1 0 0 0 0\n",
        "<?xml version='1.0'?>\n<a/>",
        "{}",
    ):
        (tmp_path / "file.txt").write_text(text)
        assert read_rig(tmp_path / "file.txt").body_from_camera == {}
    (tmp_path / "file.txt").write_text(json.dumps(named(left=None, right=transform(1, 0, 0, 0))))
    assert list(read_rig(tmp_path / "file.txt").body_from_camera) == ["right"]


BASALT = {
    "value0": {
        "intrinsics": [{}, {}],
        "T_imu_cam": [{"px": 0, "py": 0, "pz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}] * 2,
    }
}


@pytest.mark.parametrize(
    ("document", "part"),
    [
        (named(left=np.diag([1, 1, -1, 1])), "left: key 'T_device_camera' is not a rotation with a translation"),
        (named(left=[1, 2]), "left: key 'T_device_camera' is"),
        ({"value0": BASALT["value0"] | {"T_imu_cam": []}}, "key 'T_imu_cam' must be a list with an entry a camera, 2"),
        (
            {"value0": BASALT["value0"] | {"T_imu_cam": [BASALT["value0"]["T_imu_cam"][0] | {"qw": 2}] * 2}},
            "T_imu_cam of cam0: its quaternion is 2.0 long",
        ),
        ({"value0": BASALT["value0"] | {"T_imu_cam": [{"px": 1}] * 2}}, "T_imu_cam of cam0"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, document, part):
    (tmp_path / "rig.json").write_text(json.dumps(document))
    with pytest.raises(CalibrationError) as caught:
        read_rig(tmp_path / "rig.json")
    assert str(caught.value).startswith(f"{tmp_path / 'rig.json'}: ") and part in str(caught.value), caught.value
