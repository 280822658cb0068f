"""Readers of KITTI-360 files: what they hold, and one sentence for whatever bytes are in them."""

import io
import pickle
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import mutations
from scipy.spatial.transform import Rotation

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.formats.kitti360_files import (
    frames_in,
    read_cam_to_pose,
    read_cam_to_velo,
    read_poses,
    read_scan,
    read_timestamps,
    scan_motion,
    unwrapped,
    without_car,
)

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

# As published: a pose row of the documentation's kind, and the calibration that public code quotes.
POSES = """1 0.6 -0.8 0.0 1000.5 0.8 0.6 0.0 -20.25 0.0 0.0 1.0 115.0
2 0.6 -0.8 0.0 1001.5 0.8 0.6 0.0 -20.25 0.0 0.0 1.0 115.0
7 1 0 0 1e3 0 1 0 0 0 0 1 0
"""
CAM_TO_POSE = """image_00: 0.0371783278 -0.0986182135 0.9944306009 1.5752681039 \
0.9992675562 -0.0053553387 -0.0378902567 0.0043914093 0.0090621821 0.9951109327 0.0983468786 -0.6500000000
image_02: 1 0 0 0 0 0 1 0 0 -1 0 0
"""
CAM_TO_VELO = (
    "0.04307104361 -0.08829286498 0.995162929 0.8043914418 -0.999004371 0.007784614041 0.04392796942 0.2993489574 "
    "-0.01162548558 -0.9960641394 -0.08786966659 -0.1770225824\n"
)
TIMES = "2013-05-28 08:46:02.904094720\n2013-05-28 08:46:03.000000001\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


def write(folder, content, name="file.txt"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_poses_with_gaps(folder):
    poses = read_poses(write(folder, POSES))
    assert list(poses) == [1, 2, 7]
    np.testing.assert_array_equal(poses[2][:3, 3], [1001.5, -20.25, 115.0])
    np.testing.assert_allclose(poses[1] @ [1, 0, 0, 1], [1001.1, -19.45, 115, 1])


def test_calibrations(folder):
    cameras = read_cam_to_pose(write(folder, CAM_TO_POSE))
    assert list(cameras) == ["image_00", "image_02"]
    assert cameras["image_00"][0, 3] == 1.5752681039
    # Rounded in the file, exactly orthonormal here.
    rotation = cameras["image_00"][:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert read_cam_to_velo(write(folder, CAM_TO_VELO))[2, 3] == -0.1770225824


def test_times_keep_their_fraction(folder):
    first, second = read_timestamps(write(folder, TIMES))
    assert first == pytest.approx(1369730762.90409472, abs=1e-6) and second == pytest.approx(1369730763, abs=1e-6)


def test_frames_are_named_by_ten_digits(folder):
    place = folder / "frames"
    place.mkdir()
    for name in ("0000000012.png", "12.png", "0000000013.png.part", "0000000014.jpg", "notes.txt"):
        (place / name).touch()
    assert frames_in(place, ".png", "scene", "images") == {12}


@pytest.mark.parametrize(
    "read, text, says",
    [
        (read_poses, "", "holds no pose"),
        (read_poses, POSES.replace("1001.5", "nan"), "line 2"),
        (read_poses, POSES.replace("7 1", "2 1"), "line 3"),
        (read_poses, POSES.replace("7 1", "7.5 1"), "line 3"),
        (read_poses, POSES.replace("7 1", "-7 1"), "line 3"),
        (read_poses, POSES.replace("7 1 0", "7 1"), "line 3"),
        (read_poses, POSES.replace("7 1", "7 1.1"), "not a rotation"),
        (read_poses, POSES.replace("7 1", "7 -1"), "not a rotation"),
        (read_poses, POSES.replace("1e3", "1e300"), "line 3"),
        (read_poses, POSES.replace("1e3", "1_0"), "line 3"),
        (read_poses, POSES.replace("7 1", "7 1e308"), "not a rotation"),
        (read_cam_to_pose, CAM_TO_POSE.replace("image_02", "image_00"), "twice"),
        (read_cam_to_pose, CAM_TO_POSE.replace("image_02:", ""), "line 2"),
        (read_cam_to_velo, CAM_TO_VELO * 2, "2 lines"),
        (read_cam_to_velo, "\n", "0 lines"),
        (read_timestamps, TIMES.replace("08:46:03", "08:66:03"), "line 2"),
        (read_timestamps, "0\n", "line 1"),
    ],
)
def test_wrong_text_is_one_sentence(folder, read, text, says):
    path = write(folder, text)
    with pytest.raises(InputError) as caught:
        read(path)
    assert str(caught.value).startswith(str(path)) and says in str(caught.value)


def scan(*points):
    return b"".join(struct.pack("<4f", *point, 0.5) for point in points)


def test_scan(folder):
    """Points as they were measured; rays that hit nothing, at the origin, are none."""
    path = write(folder, scan((1.5, -2.0, 0.25), (0.0, 0.0, 0.0), (0.0, 3.0, 0.0)), "a.bin")
    np.testing.assert_array_equal(read_scan(path), [[1.5, -2.0, 0.25], [0.0, 3.0, 0.0]])


@pytest.mark.parametrize(
    "content, says",
    [
        (b"", "no point"),
        (scan((0, 0, 0)), "no point"),
        (scan((1, 2, 3)) + b"\x00" * 5, "21 bytes"),
        (scan((1, 2, 3), (1, float("nan"), 3)), "byte 16"),
        (scan((1, 2, 3), (4, 5, 6), (1, 2, float("inf"))), "byte 32"),
        (struct.pack(">4f", 12.345678, -7.654321, 1.2345678, 0.3) * 50, "byte 0"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(200)) * 2, "damaged"),
    ],
)
def test_damaged_scan_is_one_sentence(folder, content, says):
    path = write(folder, content, "b.bin")
    with pytest.raises(InputError) as caught:
        read_scan(path)
    assert str(caught.value).startswith(str(path)) and says in str(caught.value)


def test_huge_scan_is_not_read(folder):
    path = folder / "huge.bin"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="larger than 256 MiB"):
        read_scan(path)


def test_scan_of_a_moving_scanner_is_unwrapped(rng):
    """Every point is measured in the scanner's frame at the time when the beam passes it."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.01, -0.02, 0.05]).as_matrix()
    motion[:3, 3] = [-1.1, 0.05, 0.02]
    rotation_vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    still = rng.uniform(-30, 30, (500, 3))
    measured = still.copy()
    for _ in range(60):  # the turn depends on the measured azimuth, which depends on the turn
        turns = np.arctan2(measured[:, 1], measured[:, 0])[:, None] / (2 * np.pi)
        measured = Rotation.from_rotvec(turns * rotation_vector).inv().apply(still - turns * motion[:3, 3])
    settled = np.abs(unwrapped(measured, motion) - still).max(axis=1)
    assert np.median(settled) < 1e-9 and np.quantile(settled, 0.95) < 1e-6
    assert np.median(np.linalg.norm(measured - still, axis=1)) > 0.2
    ahead, behind_left = np.array([[10.0, 0.0, 0.0]]), np.array([[-10.0, 1e-9, 0.0]])
    np.testing.assert_allclose(unwrapped(ahead, motion), ahead)
    half = Rotation.from_rotvec(rotation_vector / 2).apply(behind_left) + motion[:3, 3] / 2
    np.testing.assert_allclose(unwrapped(behind_left, motion), half)


def test_motion_is_the_scanner_s_own():
    """From the frame before, else the one after; a turn about the IMU swings a scanner that sits in front of it."""
    poses = {frame: np.eye(4) for frame in (3, 4, 9)}
    poses[4][:3, 3] = [1.0, 0.0, 0.0]
    poses[4][:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    imu_from_velodyne = np.eye(4)
    imu_from_velodyne[:3, 3] = [2.0, 0.0, 0.0]
    backwards = scan_motion(poses, 4, imu_from_velodyne)
    # Before, the scanner was at (2, 0) in the world; now it is at (1, 2) and looks along +y.
    np.testing.assert_allclose(backwards[:3, 3], [-2.0, -1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(scan_motion(poses, 3, imu_from_velodyne), backwards)
    assert scan_motion(poses, 9, imu_from_velodyne) is None


def npy(array):
    """A file of numpy's."""
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


MASK = npy(np.eye(6, 4, dtype=np.uint8))


def read_mask(path):
    return without_car(path, Equirectangular(40, 20))


def test_mask_of_the_car(folder):
    allowed = read_mask(write(folder, npy(np.array([[0, 0], [0, 1]], dtype=np.uint8)), "mask.npy"))
    assert allowed.shape == (20, 40) and allowed[:10].all() and allowed[:, :20].all() and not allowed[10:, 20:].any()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        npy(np.zeros(5)),
        npy(np.zeros((0, 5))),
        npy(np.zeros((3, 4, 5))),
        npy(np.zeros((2, 2), dtype="U3")),
        MASK.replace(b"(6, 4)", b"(9999, 9999)").replace(b"      \n", b"\n"),
        pickle.dumps([1]),
    ],
)
def test_wrong_mask_is_one_sentence(folder, content):
    path = write(folder, content, "wrong.npy")
    with pytest.raises(InputError, match="mask of the car") as caught:
        read_mask(path)
    assert str(caught.value).startswith(str(path))


READERS = {
    "mask": (read_mask, MASK),
    "poses": (read_poses, POSES),
    "cam_to_pose": (read_cam_to_pose, CAM_TO_POSE),
    "cam_to_velo": (read_cam_to_velo, CAM_TO_VELO),
    "timestamps": (read_timestamps, TIMES),
    "scan": (read_scan, scan((1.5, -2.0, 0.25), (7.0, 8.0, -1.0), (0.0, 3.0, 0.0))),
}


@pytest.mark.parametrize("kind", READERS)
@given(data=st.data())
@settings(max_examples=60)
def test_any_bytes_are_read_or_refused(folder, kind, data):
    read, sample = READERS[kind]
    path = write(folder, data.draw(st.one_of(mutations(sample), st.binary(max_size=80))), f"fuzz-{kind}")
    try:
        found = read(path)
    except InputError as error:
        message = str(error)
        assert message.startswith(str(path)) and message.isprintable() and len(message) < 600
        assert message.endswith(".")
    else:
        values = found.values() if isinstance(found, dict) else [found]
        assert all(np.isfinite(value).all() for value in values)
