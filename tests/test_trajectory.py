"""Trajectories: readers against the real files and evo's conventions, interpolation against scipy, damaged files."""

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from spherloc.errors import InputError
from spherloc.trajectory import (
    NS_PER_S,
    Trajectory,
    pose_at,
    read_euroc,
    read_newer_college,
    read_tum,
    rotation_from_wxyz,
    write_tum,
    wxyz_from_rotation,
)
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.filterwarnings("error")

TUM = """# timestamp tx ty tz qx qy qz qw
1520530308.189679351 0.841782 -0.219335 1.249975 0.003737 0.009717 -0.024328 0.999650

1520530308.19801 0.841734,-0.219345, 1.25  0.0 0.0 0.70710678 0.70710678
"""
EUROC = """#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []
1520530308189679351,0.8417820384,-0.2193354118,1.2499749141,0.9996498117,0.0037373093,0.0097169635,-0.0243283190
1520530308198012351,0.8417344970,-0.2193450998,1.2500003423,0.9996655192,0.0038381891,0.0094471392,-0.0237669833
"""
NEWER_COLLEGE = """#sec,nsec,x,y,z,qx,qy,qz,qw
1624278592,5000001,0.1,0.2,0.3,0,0,1,0
1624278592,105000000,1e-1,0.2,0.3,0.6,0,0,0.8
"""


@pytest.fixture
def written(tmp_path):
    def write(content: str | bytes) -> Path:
        path = tmp_path / "poses.txt"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def shared(name: str) -> Path:
    folder, file = name.split("/", 1)
    return real_data(folder) / file


def random_trajectory(rng: np.random.Generator, count: int, start_ns: int = 1_520_530_308_189_679_351) -> Trajectory:
    times = start_ns + np.cumsum(rng.integers(1, 200_000_000, count))
    rotations = Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()
    return Trajectory(times, np.concatenate([rotations, rng.normal(size=(count, 3, 1)) * 100.0], axis=2))


def test_tum_reads_every_digit_of_the_time_and_the_scalar_last(written):
    trajectory = read_tum(written(TUM))
    np.testing.assert_array_equal(trajectory.timestamps_ns, [1520530308189679351, 1520530308198010000])
    assert trajectory.timestamps_s[0] == 1520530308.189679351
    np.testing.assert_allclose(trajectory.map_from_body[1, :, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-8)
    np.testing.assert_array_equal(trajectory.map_from_body[1, :, 3], [0.841734, -0.219345, 1.25])


def test_euroc_reads_the_scalar_first_and_ignores_velocity_and_biases(written):
    trajectory = read_euroc(written(EUROC))
    np.testing.assert_array_equal(trajectory.timestamps_ns, [1520530308189679351, 1520530308198012351])
    expected = Rotation.from_quat([0.0037373093, 0.0097169635, -0.0243283190, 0.9996498117]).as_matrix()
    np.testing.assert_allclose(trajectory.map_from_body[0, :, :3], expected, atol=1e-15)
    longer = "\n".join(line + ",nan,1,2,3,4,5,6,7,8" if line.startswith("1") else line for line in EUROC.splitlines())
    np.testing.assert_array_equal(read_euroc(written(longer)).map_from_body, trajectory.map_from_body)


def test_newer_college_joins_seconds_and_nanoseconds(written):
    trajectory = read_newer_college(written(NEWER_COLLEGE))
    np.testing.assert_array_equal(trajectory.timestamps_ns, [1624278592005000001, 1624278592105000000])
    np.testing.assert_allclose(trajectory.map_from_body[0, :, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-15)
    np.testing.assert_allclose(
        trajectory.map_from_body[1, :, :3], Rotation.from_quat([0.6, 0, 0, 0.8]).as_matrix(), atol=1e-15
    )


def test_the_same_ground_truth_in_both_formats():
    tum = read_tum(shared("formats_real/tumvi_room1_gt_tum_first2000.txt"))
    euroc = read_euroc(shared("formats_real/tumvi_room1_gt_euroc_csv_first500.csv"))
    assert (len(tum), len(euroc)) == (1999, 499)
    assert np.abs(tum.timestamps_ns[:499] - euroc.timestamps_ns).max() < 5_001  # five decimals of a second
    np.testing.assert_allclose(tum.map_from_body[:499], euroc.map_from_body, atol=2e-6)


def test_real_file_in_nanoseconds_needs_its_unit():
    path = shared("aria_adt_fisheye/poses_world_device_tum.txt")
    trajectory = read_tum(path, unit="ns")
    assert trajectory.timestamps_ns[0] == 87551170910000 and len(trajectory) == 6
    with pytest.raises(
        InputError, match=r"line 2: the time '87551170910000' is not a time in seconds; check its unit\.$"
    ):
        read_tum(path)


@pytest.mark.parametrize("start_ns", [1_520_530_308_189_679_351, 0, -1_500_000_001])
def test_what_is_written_is_read_again(tmp_path, rng, start_ns):
    trajectory = random_trajectory(rng, 200, start_ns)
    write_tum(tmp_path / "t.txt", trajectory)
    again = read_tum(tmp_path / "t.txt")
    np.testing.assert_array_equal(again.timestamps_ns, trajectory.timestamps_ns)
    np.testing.assert_allclose(again.map_from_body, trajectory.map_from_body, rtol=1e-15, atol=1e-15)
    rows = np.loadtxt(tmp_path / "t.txt")
    np.testing.assert_allclose(
        Rotation.from_quat(rows[:, 4:]).as_matrix(), trajectory.map_from_body[:, :, :3], atol=1e-14
    )


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path, rng):
    with pytest.raises(InputError, match=r"cannot be written \(No such file or directory\); choose"):
        write_tum(tmp_path / "absent" / "t.txt", random_trajectory(rng, 2))


unit_quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)


@given(unit_quaternions, st.floats(1e-150, 1e150))
@settings(max_examples=150)
def test_quaternions_of_any_length_are_scipys_rotations(wxyz, length):
    rotation = rotation_from_wxyz(wxyz * length)
    np.testing.assert_allclose(rotation, Rotation.from_quat(np.roll(wxyz, -1)).as_matrix(), atol=1e-14)
    again = wxyz_from_rotation(rotation)
    assert again[0] >= 0.0
    unit = wxyz / np.linalg.norm(wxyz)
    assert min(np.abs(again - unit).max(), np.abs(again + unit).max()) < 1e-14


def test_half_turns_lose_no_digits(rng):
    """Where w vanishes, the textbook formula divides by it."""
    axes = np.vstack([np.eye(3), rng.normal(size=(50, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for angle in (np.pi, np.pi - 1e-9, 1e-9, 0.0):
        rotations = Rotation.from_rotvec(angle * axes).as_matrix()
        np.testing.assert_allclose(rotation_from_wxyz(wxyz_from_rotation(rotations)), rotations, atol=1e-15)


@pytest.mark.parametrize("wxyz", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 0], [1, 0, 0], 1.0])
def test_no_rotation_is_refused(wxyz):
    with pytest.raises(InputError, match=r"is not a rotation: give four finite numbers, not all 0\.$"):
        rotation_from_wxyz(np.array(wxyz, dtype=float))


def test_poses_between_two_agree_with_scipy(rng):
    trajectory = random_trajectory(rng, 40)
    times = trajectory.timestamps_ns
    slerp = Slerp((times - times[0]) / NS_PER_S, Rotation.from_matrix(trajectory.map_from_body[:, :, :3]))
    for time in rng.integers(times[0], times[-1], 200):
        found = pose_at(trajectory, int(time), 1.0)
        assert found is not None
        np.testing.assert_allclose(found[:, :3], slerp((time - times[0]) / NS_PER_S).as_matrix(), atol=1e-6)
        place = [np.interp(time - times[0], times - times[0], axis) for axis in trajectory.map_from_body[:, :, 3].T]
        np.testing.assert_allclose(found[:, 3], place, atol=1e-6)


def test_nearly_equal_rotations_are_interpolated_to_the_last_digit():
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 1e-9], [0, 0, np.pi - 1e-9]]).as_matrix()
    trajectory = Trajectory(np.array([0, 100, 200]), np.concatenate([turns, np.zeros((3, 3, 1))], axis=2))
    found = pose_at(trajectory, 25, 1.0)
    assert found is not None and found[1, 0] == pytest.approx(0.25e-9, rel=1e-6)
    found = pose_at(trajectory, 150, 1.0)
    assert found is not None and np.arctan2(found[1, 0], found[0, 0]) == pytest.approx(np.pi / 2, abs=1e-8)


def test_gaps_and_ends_have_no_pose(rng):
    poses = random_trajectory(rng, 4).map_from_body
    trajectory = Trajectory(np.array([0, 1, 3, 4]) * NS_PER_S, poses)
    inside, gap = NS_PER_S // 2, 2 * NS_PER_S
    assert pose_at(trajectory, inside, 1.0) is not None
    assert pose_at(trajectory, inside, 0.999) is None
    assert pose_at(trajectory, gap, 1.5) is None
    assert pose_at(trajectory, gap, 2.0) is not None
    for number, time in enumerate(trajectory.timestamps_ns):
        at = pose_at(trajectory, int(time), 0.0)
        assert at is not None
        np.testing.assert_array_equal(at, poses[number])
    assert pose_at(trajectory, -1, 10.0) is None
    assert pose_at(trajectory, 4 * NS_PER_S + 1, 10.0) is None


@pytest.mark.parametrize(
    ("times", "poses", "part"),
    [
        ([0.0, 1.0], np.zeros((2, 3, 4)), "whole nanoseconds"),
        ([0, 1], np.zeros((3, 3, 4)), "one pose a time"),
        ([0, 1], np.full((2, 3, 4), np.nan), "finite"),
        ([1, 1], np.zeros((2, 3, 4)), "must grow"),
        ([1, 0], np.zeros((2, 3, 4)), "must grow"),
    ],
)
def test_an_impossible_trajectory_cannot_exist(times, poses, part):
    with pytest.raises(InputError, match=part):
        Trajectory(np.array(times), poses)


ROW = "1.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("content", "line", "part"),
    [
        ("", None, "holds no pose; give lines of t tx ty tz"),
        ("# nothing\n\n", None, "holds no pose"),
        (ROW + "1.0 0 0 0 0 0 0 1", 2, "its time is not after the one before"),
        (ROW + "0.5 0 0 0 0 0 0 1", 2, "its time is not after the one before"),
        (ROW + "2.0 0 0 0 0 0 1", 2, "has 7 columns; give t tx ty tz qx qy qz qw"),
        (ROW + "2.0 0 0 0 0 0 0 1 0", 2, "has 9 columns"),
        ("timestamp tx ty tz qx qy qz qw\n" + ROW, 1, "the time is 'timestamp', not a number; correct it, and start"),
        (ROW + "2.0 0 0 x 0 0 0 1", 2, "could not convert string to float: 'x'"),
        (ROW + "2.0 0 0 nan 0 0 0 1", 2, "is not finite"),
        (ROW + "2.0 0 0 0 0 0 -inf 1", 2, "is not finite"),
        (ROW + "2.0 0 0 0 0 0 0 0", 2, "the quaternion has the length 0 instead of 1"),
        (ROW + "2.0 0 0 0 0 0 0.5 0.5", 2, "the quaternion has the length 0.707"),
        (ROW + "2.0 1e10 0 0 0 0 0 1", 2, "farther than 1e+09 m"),
        ("nan 0 0 0 0 0 0 1", 1, "not a time in seconds"),
        ("1e30 0 0 0 0 0 0 1", 1, "not a time in seconds"),
        ("1e999999999999 0 0 0 0 0 0 1", 1, "not a time in seconds"),
        ("1" * 4000 + " 0 0 0 0 0 0 1", 1, "not a time in seconds"),
        ("1_0 0 0 0 0 0 0 1", 1, "characters that are not part of a number"),
        ("\u0661 0 0 0 0 0 0 1", 1, "characters that are not part of a number"),
        (ROW + "0 " * 5000, 2, "longer than 4096 bytes"),
        (ROW + "#" * 4096 + "2.0 0 0 0 0 0 0 1", 2, "longer than 4096 bytes"),
    ],
)
def test_each_mistake_has_its_sentence(written, content, line, part):
    path = written(content)
    with pytest.raises(InputError) as caught:
        read_tum(path)
    message = str(caught.value)
    assert message.startswith(f"{path}, line {line}: " if line else f"{path}: ")
    assert part in message and message.endswith(".") and "\n" not in message and len(message) < 300 + len(str(path))


def test_mistakes_of_the_other_formats(written):
    with pytest.raises(InputError, match=r"line 2: has 9 columns; give timestamp \[ns\], x"):
        read_euroc(written(NEWER_COLLEGE))
    with pytest.raises(InputError, match="line 2: has 8 columns; give sec,nsec,x,y,z"):
        read_newer_college(written(EUROC))
    with pytest.raises(InputError, match=r"line 1: nsec is '1000000000'; give nanoseconds from 0"):
        read_newer_college(written("1,1000000000,0,0,0,0,0,0,1"))
    mixed = EUROC + "1520530309000000000,0,0,0,1,0,0,0,1,2,3,4,5,6,7,8,9\n"
    with pytest.raises(InputError, match=r"line 4: has 17 columns; give .* in every line"):
        read_euroc(written(mixed))


def test_comments_may_hold_anything(written):
    content = b"\xef\xbb\xbf# \xff\xfe\r\n# \xc3\xa9_\r\n" + TUM.replace("\n", "\r\n").encode()
    assert len(read_tum(written(content))) == 2


def test_missing_files_and_folders(tmp_path):
    for path in (tmp_path / "absent", tmp_path, tmp_path / "a\0b"):
        with pytest.raises(InputError, match=r"give the path of a trajectory\.$"):
            read_tum(path)


def test_huge_files_are_refused_before_they_are_read(tmp_path):
    path = tmp_path / "huge.txt"
    with path.open("wb") as file:
        file.truncate((1 << 30) + 1)  # sparse: takes no room
    with pytest.raises(InputError, match="larger than 1024 MiB"):
        read_tum(path)
    with path.open("wb") as file:
        file.truncate(1 << 29)
    with pytest.raises(InputError, match="line 1: is longer than 4096 bytes"):
        read_tum(path)


READERS = {"tum": (read_tum, TUM), "euroc": (read_euroc, EUROC), "newer-college": (read_newer_college, NEWER_COLLEGE)}


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_a_trajectory_or_one_sentence(written, name):
    read, text = READERS[name]
    rng = random.Random(f"damaged {name}")
    outcomes = {"read": 0, "refused": 0}
    for _ in range(600):
        data = bytearray(text.encode())
        for _ in range(rng.randint(0, 3)):
            at = rng.randrange(len(data))
            data[at] = rng.choice([data[at] ^ (1 << rng.randrange(8)), rng.choice(b" \n,#.-+e0\x00\xff_xnN")])
        data = data[: rng.choice([len(data), rng.randrange(len(data))])]
        path = written(bytes(data))
        try:
            trajectory = read(path)
        except InputError as error:
            message = str(error)
            assert message.startswith(str(path)) and message.endswith(".") and "\n" not in message
            outcomes["refused"] += 1
        else:
            rotations = trajectory.map_from_body[:, :, :3]
            np.testing.assert_allclose(
                rotations @ rotations.transpose(0, 2, 1), [np.eye(3)] * len(rotations), atol=1e-12
            )
            outcomes["read"] += 1
    assert min(outcomes.values()) > 5
