"""COLMAP's cameras.txt and kapture's sensors.txt as calibration files."""

import pytest

from spherloc.cameras.calibration import camera_names, load_camera
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError
from spherloc.mapping.images.given_cameras import given_cameras

TWO = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 OPENCV_FISHEYE 848 800 284.5 285.5 424.4 393.7 0.001 0.031 -0.03 0.005
3 EQUIRECTANGULAR 1920 960 1920 960"""
FIRST = KannalaBrandt(848, 800, 284.5, 285.5, 424.4, 393.7, (0.001, 0.031, -0.03, 0.005))


def test_cameras_by_their_ids(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(TWO)
    assert camera_names(path) == ("1", "3")
    assert load_camera(path) == load_camera(path, "1") == FIRST
    assert load_camera(path, "3").model == "equirectangular"
    with pytest.raises(CalibrationError, match=r"cameras\.txt: has no camera '2': choose one of 1, 3\.$"):
        load_camera(path, "2")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1 FOV 848 800 284.5 285.5 424.4 393.7 0.9", "the COLMAP model 'FOV' is not supported"),
        ("1 PINHOLE 848 800 284.5 285.5 424.4", "give a list of 4 finite numbers"),
        ("1 PINHOLE 848 800 284.5 285.5 424.4 wide", "'284.5 285.5 424.4 wide' are not numbers"),
    ],
)
def test_a_line_that_cannot_be_used_is_named(tmp_path, line, said):
    path = tmp_path / "cameras.txt"
    path.write_text(line)
    with pytest.raises(CalibrationError, match=f"camera 1: .*{said}|camera 1.*{said}"):
        load_camera(path)


def test_a_map_gets_the_cameras_of_a_file_by_name(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(TWO)
    found, remarks = given_cameras(path, None, tmp_path)
    assert list(found) == ["1", "3"] and found["1"] == FIRST and not remarks
    assert given_cameras(path, "3", tmp_path) == ({"3": found["3"]}, [])


KAPTURE = """# kapture format: 1.1
# sensor_id, name, sensor_type, [sensor_params]+
left, the left one, camera, OPENCV_FISHEYE, 848, 800, 284.5, 285.5, 424.4, 393.7, 0.001, 0.031, -0.03, 0.005
right, , camera, UNKNOWN_CAMERA, 848, 800
imu, , accelerometer
"""


def test_the_cameras_among_the_sensors_of_kapture(tmp_path):
    """Those with a calibration; a file of kapture that has none is no calibration."""
    path = tmp_path / "sensors.txt"
    path.write_text(KAPTURE)
    assert camera_names(path) == ("left",) and load_camera(path) == load_camera(path, "left") == FIRST
    with pytest.raises(CalibrationError, match=r"sensors\.txt: has no camera 'right': choose one of left\.$"):
        load_camera(path, "right")
    for broken in (KAPTURE.replace("848, 800, 284.5", "wide, 800, 284.5"), "# kapture format: 1.1\nimu, , gyroscope"):
        path.write_text(broken)
        with pytest.raises(CalibrationError, match=r"kapture's sensors\.txt"):
            load_camera(path)
