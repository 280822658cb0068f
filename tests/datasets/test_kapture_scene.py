"""Scenes of kapture datasets: which images are queries and references, and real stereo fisheyes to a pose."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kapture_samples import SENSORS, write_kapture

from spherloc.datasets import kapture, load_scene
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.metrics import evaluate
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture
def t265():
    return real_data("kapture_t265") / "samples" / "t265"


SCENE = """
kind = "kapture"
name = "T265"
root = "{root}"
{rest}
"""

GRAVITY = """
[gravity]
map = [0.0, 1.0, 0.0]
bound_deg = 1.0
"""


def scene_of(folder, root, rest):
    (folder / "scene.toml").write_text(SCENE.format(root=root, rest=rest))
    return load_scene(folder / "scene.toml")


@pytest.mark.parametrize("camera, other", [("cam001", "cam002"), ("cam002", "cam001")])
def test_localizes_a_real_frame(tmp_path, t265, camera, other):
    """Frame 2 of one camera against frames 1 and 3 of both.

    Measured over all six images: 0.11 to 0.23 degrees and 1.5 to 3.9 mm, which is what the poses, those of the
    headset's own odometry, and its stereo calibration are good for.
    """
    scene = scene_of(tmp_path, t265 / "ros_kapture", f'queries = ["{camera}/frame_000000002.jpg"]\n{GRAVITY}')
    together = "taken together with a query: not used as references."
    assert f"1 image ({other}/frame_000000002.jpg) {together}" in scene.remarks
    assert len(scene.references) == 4 and not any("2.jpg" in view.name for view in scene.references)
    query = scene.query()
    matches = scene.matcher(query)
    # From all of them, and from the other camera alone, which was 64 mm away.
    places = [index for index, view in enumerate(matches.references) if view.name.startswith(other)]
    beside = np.isin(matches.reference_index, places)
    for kept, degrees, metres in ((np.ones(len(beside), bool), 0.3, 0.006), (beside, 0.5, 0.008)):
        some = replace(
            matches,
            pixels=matches.pixels[kept],
            points=matches.points[kept],
            reference_index=matches.reference_index[kept],
            reference_pixels=matches.reference_pixels[kept],
        )
        scores = evaluate(estimate(scene.problem_of(query, some), "ransac-2p", seed=0))
        assert scores.rotation_error_deg < degrees and scores.translation_error_m < metres


def test_gravity_of_the_real_room(t265, tmp_path):
    """Edges of the door and of the panels beside it, clicked in the first image, are vertical: +y of the map."""
    scene = scene_of(tmp_path, t265 / "ros_kapture", 'queries = ["cam001/frame_000000001.jpg"]')
    view = scene.query()
    edges = [((384, 197.5), (397, 617.5)), ((539, 180), (560, 622.5)), ((547, 254), (549, 629))]
    planes = [np.cross(*view.camera.unproject(np.array(edge))[0]) for edge in edges]
    for right in planes[1:]:
        down = np.cross(planes[0], right) @ view.cam_from_map[:, :3]
        down *= np.sign(down[1]) / np.linalg.norm(down)
        assert np.degrees(np.arccos(down[1])) < 1.0
    # The mean of the cameras is a guess, and said to be one: they looked up by four degrees.
    assert 3.0 < np.degrees(np.arccos(scene.gravity_map[1])) < 5.0
    assert any("Down in the map is the mean" in remark for remark in scene.remarks)


def test_real_dataset_without_its_images(tmp_path, t265):
    with pytest.raises(
        InputError, match=r"there is no query image; 6 images \(leftraw/frame_000000001.jpg, .* not found"
    ):
        scene_of(tmp_path, t265 / "kapture", "queries = ['leftraw/*']")


IMAGES = ("left/0.jpg", "right/0.jpg", "left/1.jpg", "right/1.jpg", "right/2.jpg", "left/2.jpg", "blind/3.jpg")


def small(folder, rest):
    return scene_of(folder, write_kapture(folder / "data", IMAGES), rest + "\n[gravity]\nmap = [0, 0, -1]\n")


def names(views):
    return [view.name for view in views]


@pytest.mark.parametrize(
    ("rest", "queries", "references"),
    [
        ('queries = ["left/1.jpg"]', ["left/1.jpg"], ["left/0.jpg", "right/0.jpg", "right/2.jpg"]),
        ('queries = "*/1.jpg"', ["left/1.jpg", "right/1.jpg"], ["left/0.jpg", "right/0.jpg", "right/2.jpg"]),
        (
            'queries = ["left/1.jpg", "right/[1-9].jpg", "*/1.*"]',
            ["left/1.jpg", "right/1.jpg", "right/2.jpg"],
            ["left/0.jpg", "right/0.jpg"],
        ),
        (
            '[queries]\ndevices = ["left"]\ntimestamps = [1553180224000000000, 1553180224150000000]\nevery = 2',
            ["left/0.jpg"],
            ["left/1.jpg", "right/1.jpg", "right/2.jpg"],
        ),
        (
            'queries = ["left/1.jpg"]\n[references]\ndevices = ["right"]\nimages = ["*/0.jpg", "right/1.jpg"]',
            ["left/1.jpg"],
            ["right/0.jpg"],
        ),
    ],
)
def test_selection(tmp_path, rest, queries, references):
    scene = small(tmp_path, rest)
    assert names(scene.queries) == queries and names(scene.references) == references
    assert scene.queries[0].timestamp_s == pytest.approx(1553180224 + 0.1 * int(queries[0][-5]), abs=1e-6)
    remarks = " ".join(scene.remarks)
    assert "1 image (left/3.jpg) not found in" in remarks and "UNKNOWN_CAMERA" in remarks
    # left/2.jpg has no pose; where right/2.jpg is a query, it is no reference for another reason.
    unposed = "1 image (left/2.jpg) without a pose: not used as references." in remarks
    assert unposed == ("[references]" not in rest and "right/2.jpg" not in queries)


def test_the_example_of_a_scene(tmp_path):
    records = "".join(f"{time}, left, cam001/{time}.jpg\n" for time in range(20))
    trajectories = "".join(f"{time}, left, 1, 0, 0, 0, 0, 0, {time}\n" for time in range(20))
    images = [f"cam001/{time}.jpg" for time in range(20)]
    sensors = SENSORS.replace("left,", "cam001,").replace("right,", "cam002,")
    files = {"records_camera": records, "trajectories": trajectories}
    files = {name: content.replace("left", "cam001") for name, content in files.items()}
    write_kapture(tmp_path / "mapping", images, sensors=sensors, rigs=None, **files)
    example = kapture.EXAMPLE.replace('"cam001/*", "cam002/*"', '"cam001/*"')
    (tmp_path / "scene.toml").write_text(example)
    scene = load_scene(tmp_path / "scene.toml")
    assert names(scene.queries) == ["cam001/5.jpg", "cam001/15.jpg"]
    assert names(scene.references) == [f"cam001/{time}.jpg" for time in (0, 6, 11, 17)]


def test_a_query_needs_no_pose(tmp_path):
    scene = small(tmp_path, 'queries = ["left/2.jpg"]')
    assert scene.query().cam_from_map is None
    assert "1 image (right/2.jpg) taken together with a query: not used as references." in scene.remarks


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ('queries = ["gone.jpg"]', r"\[queries\]: 'gone.jpg' fits none of the 6 images, such as 'left/0.jpg'"),
        ("queries = []", r"\[queries\]: images is \[\]; give a list of texts"),
        ("queries = [1]", r"\[queries\]: images is \[1\]; give a list of texts"),
        ("queries = 3", r"\[queries\]: images is 3; give a list of texts"),
        ("[queries]\nevery = 0", "every is 0; give a whole number from 1"),
        ("[queries]\ntimestamps = [2, 1]", r"timestamps is \[2, 1\]; give the first and the last"),
        ("[queries]\ntimestamps = [true, 1]", r"timestamps is \[True, 1\]; give the first and the last"),
        ("[queries]\ntimestamps = [1, 2]", r"\[queries\]: fits none of the 6 images"),
        ("[queries]\nsurprise = 1", "unknown key 'surprise'"),
        ('queries = ["left/1.jpg"]\nroot2 = "x"', "unknown key 'root2'"),
        ('queries = ["left/*"]\n[references]\ndevices = ["left"]', r"\[references\]: fits none of the 3 images"),
        ('queries = ["left/1.jpg"]\n[frontend]\nratio = 7', r"The ratio of matching is 7"),
        ("", "key 'queries' is missing"),
    ],
)
def test_wrong_keys(tmp_path, rest, said):
    with pytest.raises(InputError, match=said):
        small(tmp_path, rest)


def recorded(folder, steps, cameras, sensors, rigs, trajectories):
    """A folder of kapture in which each camera takes an image at each step."""
    records = [(step, name, f"{name}/{step}.jpg") for step in steps for name in cameras]
    return write_kapture(
        folder / "data",
        [image for *_, image in records],
        sensors=sensors,
        rigs=rigs,
        trajectories=trajectories,
        records_camera="".join(f"{time}, {name}, {image}\n" for time, name, image in records),
    )


def test_points_come_from_rig_partners_first_and_from_ever_farther_away(tmp_path):
    """A straight drive with two cameras ahead and one backwards: 1, 2, 4 and 8 m away, never what looks elsewhere."""
    sensors = "".join(
        f"{name}, , camera, SIMPLE_PINHOLE, 640, 480, 500, 320, 240\n" for name in ("left", "right", "back")
    )
    rigs = "car, left, 1, 0, 0, 0, 0.25, 0, 0\ncar, right, 1, 0, 0, 0, -0.25, 0, 0\ncar, back, 0, 0, 1, 0, 0, 0, 0\n"
    steps = range(30)
    trajectories = "".join(f"{step}, car, 1, 0, 0, 0, 0, 0, {-step}\n" for step in steps)
    root = recorded(tmp_path, steps, ("left", "right", "back"), sensors, rigs, trajectories)
    scene = scene_of(tmp_path, root, 'queries = ["left/29.jpg"]')
    lifts = {view.name: names(view.lift.others) for view in scene.references}
    partner, *others = lifts["left/0.jpg"]
    assert partner == "right/0.jpg"
    assert [int(name.split("/")[1][:-4]) for name in others] == [1, 2, 4, 8]
    assert not any(name.startswith("back") for name in others)
    assert all(name.startswith("back") for name in lifts["back/5.jpg"]) and len(lifts["back/5.jpg"]) == 4


def test_panoramas_that_look_back_are_partners_too(tmp_path):
    """They see all around: every other one looks back, and one below another on a rig does; narrow images would not."""
    sensors = "".join(f"{name}, , camera, EQUIRECTANGULAR, 640, 320, 640, 320\n" for name in ("top", "low"))
    rigs = "robot, top, 1, 0, 0, 0, 0, 0, 0\nrobot, low, 0, 0, 1, 0, 0, -0.5, 0\n"
    steps = range(10)
    ahead, back = "1, 0, 0, 0, 0, 0", "0, 0, 1, 0, 0, 0"
    trajectories = "".join(
        f"{at}, robot, {back}, {at}\n" if at % 2 else f"{at}, robot, {ahead}, {-at}\n" for at in steps
    )
    root = recorded(tmp_path, steps, ("top", "low"), sensors, rigs, trajectories)
    scene = scene_of(tmp_path, root, 'queries = ["top/9.jpg"]\n[gravity]\nmap = [0, 1, 0]')
    lifts = {view.name: names(view.lift.others) for view in scene.references}
    partner, *others = lifts["top/0.jpg"]
    assert partner == "low/0.jpg"
    assert [int(name.split("/")[1][:-4]) for name in others] == [1, 2, 4, 8]


@pytest.mark.parametrize("count", [1, 2])
def test_few_references(tmp_path, count):
    root = write_kapture(
        tmp_path / "data",
        [f"left/{step}.jpg" for step in range(3)],
        sensors=SENSORS,
        rigs=None,
        trajectories="".join(f"{step}, left, 1, 0, 0, 0, 0, 0, 0\n" for step in range(3)),
        records_camera="".join(f"{step}, left, left/{step}.jpg\n" for step in range(count + 1)),
    )
    scene = scene_of(tmp_path, root, 'queries = ["left/0.jpg"]')
    assert len(scene.references) == count
    assert all(view.lift.others == () for view in scene.references)  # all were taken from one place
    assert scene.query().timestamp_s is None  # running numbers
