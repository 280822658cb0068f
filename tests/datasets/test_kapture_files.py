"""kapture's files, whole and broken: poses through rigs of rigs, or one sentence with the file and the line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from kapture_samples import FILES, RECORDS, RIGS, SENSORS, TRAJECTORIES, write_kapture
from mutations import mutations

from spherloc.errors import InputError, SpherlocError
from spherloc.formats.kapture_files import read_kapture
from spherloc.geometry import pose
from spherloc.trajectory import rotation_from_wxyz
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

T0 = 1553180224_000000000
STEP = 100_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("kapture")


def matrix(q, t):
    return np.vstack([pose(rotation_from_wxyz(np.array(q, float)), np.array(t, float)), [0, 0, 0, 1]])


def test_a_whole_dataset(folder):
    kapture = read_kapture(write_kapture(folder), "scene.toml")
    assert list(kapture.cameras) == ["left", "right"]
    assert kapture.cameras["left"].distortion == (0.001, 0.03, -0.03, 0.005)
    assert [record.image for record in kapture.records][:2] == ["left/0.jpg", "right/0.jpg"]
    unknown, unposed = kapture.remarks
    assert "'blind'" in unknown and "UNKNOWN_CAMERA" in unknown
    assert unposed.startswith("1 of 4 poses in ")


def test_poses_through_rigs(folder):
    """Of the sensor itself, of its rig, of the rig of its rig; not through a rig whose pose is left open."""
    kapture = read_kapture(write_kapture(folder), "scene.toml")
    right_from_head = matrix((0.8, 0, 0.6, 0), (-0.032, 0, 0.1))
    head_from_car = matrix((0.6, 0, 0, 0.8), (1, 2, 3))
    car_from_world = matrix((0.8, 0.6, 0, 0), (5, 6, 7))
    assert np.allclose(kapture.pose(T0, "right"), (right_from_head @ head_from_car @ car_from_world)[:3], atol=1e-14)
    assert np.allclose(kapture.pose(T0, "head"), (head_from_car @ car_from_world)[:3], atol=1e-14)
    assert np.allclose(
        kapture.pose(T0 + STEP, "right"), (right_from_head @ matrix((1, 0, 0, 0), (0, 0, 1)))[:3], atol=1e-14
    )
    assert np.array_equal(kapture.pose(T0 + 2 * STEP, "right"), pose(np.eye(3), np.array([0.0, 0.0, 2.0])))
    assert kapture.pose(T0 + 2 * STEP, "left") is None and kapture.pose(T0 + 3 * STEP, "left") is None
    assert kapture.carriers("left") == {"left", "head", "car", "loose"} and kapture.carriers("imu0") == {"imu0"}


def test_without_rigs(folder):
    kapture = read_kapture(
        write_kapture(folder, rigs=None, trajectories="5, left, 1, 0, 0, 0, 0, 0, 0\n"), "scene.toml"
    )
    assert kapture.pose(5, "left") is not None and kapture.carriers("left") == {"left"}


def test_deep_rigs_are_quick(folder):
    """Every device in two rigs, five hundred deep: the number of ways to the top has 150 digits."""
    rows = [
        f"r{level + 1}{side}, {'left' if level < 0 else f'r{level}{other}'}, 1, 0, 0, 0, 0, 0, 1\n"
        for level in range(-1, 500)
        for side in "ab"
        for other in ("a" if level < 0 else "ab")
    ]
    trajectories = "7, r500b, 1, 0, 0, 0, 2, 0, 0\n"
    kapture = read_kapture(write_kapture(folder, rigs="".join(rows), trajectories=trajectories), "scene.toml")
    assert np.allclose(kapture.pose(7, "left")[:, 3], [2.0, 0.0, 501.0])
    assert len(kapture.carriers("left")) == 1003


def test_the_same_places_in_two_forms_of_one_recording():
    """The T265's rig poses, composed, are the poses of its cameras that kapture's own conversion wrote."""
    samples = real_data("kapture_t265") / "samples" / "t265"
    by_rig = read_kapture(samples / "ros_kapture", "scene.toml")
    by_camera = read_kapture(samples / "kapture", "scene.toml")
    times = sorted({record.timestamp for record in by_rig.records})
    for number, time in enumerate(times):
        for device in ("001", "002"):
            composed, written = by_rig.pose(time, f"cam{device}"), by_camera.pose(number, device)
            assert np.allclose(composed, written, atol=1e-12)
    with pytest.raises(InputError, match=r"records_camera.txt is missing, kapture's list of images"):
        read_kapture(samples / "rigs_only_kapture", "scene.toml")


@pytest.mark.parametrize(
    ("name", "content", "line", "said"),
    [
        ("sensors", f"{SENSORS}left, , camera, SIMPLE_PINHOLE, 4, 4, 5, 2, 2\n", 7, "'left' is named twice"),
        ("sensors", "only, two\n", 1, "has 2 values instead of 3 or more"),
        ("sensors", "a, , camera, SIMPLE_PINHOLE, 4\n", 1, "a camera has 2 parameters"),
        ("sensors", "a, , camera, SIMPLE_PINHOLE, x, 4, 5, 2, 2\n", 1, "'x' is not a finite number"),
        ("sensors", "a, , camera, SIMPLE_PINHOLE, 4.5, 4, 5, 2, 2\n", 1, "give whole numbers"),
        ("rigs", f"{RIGS}head, left, 1, 0, 0, 0, 0, 0, 0\n", 7, "holds 'left' twice"),
        ("rigs", "left, right, 1, 0, 0, 0, 0, 0, 0\n", 1, "the rig 'left' holds 'right'"),
        ("rigs", "head, left, 1, 0, 0, 0, 0, 0\n", 1, "has 8 values instead of 9"),
        ("rigs", "head, left, 1, 0, 0, 0, 0, 0,\n", 1, "'' is not a finite number"),
        ("rigs", "head, left, 1, 1, 1, 1, 0, 0, 0\n", 1, "the length 2 instead of 1"),
        ("trajectories", f"{TRAJECTORIES}1, nobody, 1, 0, 0, 0, 0, 0, 0\n", 7, "is called 'nobody'"),
        ("trajectories", f"{TRAJECTORIES}{TRAJECTORIES.splitlines()[2]}\n", 7, "'car' has two poses at '15531802240"),
        ("trajectories", "1.5, left, 1, 0, 0, 0, 0, 0, 0\n", 1, "the timestamp '1.5' is not a whole number"),
        ("trajectories", f"{2**63}, left, 1, 0, 0, 0, 0, 0, 0\n", 1, "is not a whole number of 64 bits"),
        ("trajectories", "1, left, 1, 0, 0, 0, nan, 0, 0\n", 1, "'nan' is not a finite number"),
        ("records_camera", f"{RECORDS}1, left, left/0.jpg\n", 11, "'left/0.jpg' is named twice"),
        ("records_camera", "1, nobody, x.jpg\n", 1, "no sensor is called 'nobody'"),
        ("records_camera", "1, left\n", 1, "has 2 values instead of 3"),
    ],
)
def test_wrong_lines_are_named(folder, name, content, line, said):
    with pytest.raises(InputError) as error:
        read_kapture(write_kapture(folder, **{name: content}), "scene.toml")
    assert f"{name}.txt, line {line}: " in str(error.value) and said in str(error.value)


def test_rigs_that_hold_each_other(folder):
    rows = "a, left, 1,0,0,0,0,0,0\nb, a, 1,0,0,0,0,0,0\na, b, 1,0,0,0,0,0,0\n"
    with pytest.raises(InputError, match=r"rigs\.txt: the rig '[ab]' holds itself"):
        read_kapture(write_kapture(folder, rigs=rows, trajectories=""), "scene.toml")


@pytest.mark.parametrize("name", ["sensors", "trajectories", "records_camera"])
def test_missing_files_are_named(folder, name):
    with pytest.raises(InputError, match=rf"^scene.toml: .*{name}\.txt is missing"):
        read_kapture(write_kapture(folder, **{name: None}), "scene.toml")


def test_cameras_that_are_not_supported_are_said(folder):
    """Also a camera with a wrong number of parameters harms no other one."""
    sensors = SENSORS.replace("SIMPLE_PINHOLE, 640, 480, 500, 320, 240", "PINHOLE, 640, 480, 500, 320, 240")
    kapture = read_kapture(write_kapture(folder, sensors=sensors), "scene.toml")
    assert list(kapture.cameras) == ["left"]
    assert "'right' are skipped: " in kapture.remarks[0] and "sensors.txt, line 4" in kapture.remarks[0]


@settings(max_examples=150)
@given(
    st.sampled_from(sorted(FILES)).flatmap(
        lambda name: st.tuples(st.just(name), st.one_of(mutations(FILES[name]), st.binary(max_size=80)))
    )
)
@example(("sensors", b"a, , camera, PINHOLE, 1e300, 1e300, 1, 1, 1, 1\n"))
@example(("rigs", b"head, head, 1, 0, 0, 0, 0, 0, 0\n"))
@example(("records_camera", b"-0, left, \0\n"))
def test_any_text(folder, case):
    """A dataset, or one sentence with the file, and with the line unless all of the file is wrong."""
    name, content = case
    root = write_kapture(folder, **{name: content})
    try:
        kapture = read_kapture(root, "scene.toml")
    except SpherlocError as error:
        message = str(error)
        assert message.startswith(str(root / "sensors")) and message.isprintable() and len(message) < 600
    else:
        for record in kapture.records:
            cam_from_map = kapture.pose(record.timestamp, record.device)
            assert cam_from_map is None or np.isfinite(cam_from_map).all()
