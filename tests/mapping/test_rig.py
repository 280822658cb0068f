"""Cameras that are fixed to each other: which images they took together, and maps that are joined by them."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN, camera_centre, pose, rotation_angle, so3_exp, transform, yaw_rotation
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.models.reconstruction import _joined
from spherloc.mapping.rig import (
    disagree,
    expected_poses,
    joint_of,
    misfits,
    one_camera,
    shots_of,
    went_apart,
    with_ties,
    words,
)
from spherloc.mapping.two_view.matched import _camera_in

FISHEYE = KannalaBrandt(560, 560, 205.0, 205.0, 280.0, 280.0, (0.0, 0.0, 0.0, 0.0))
LOOKS = {"left": np.radians(-70.0), "right": np.radians(70.0)}
ASIDE_M = {"left": -0.2, "right": 0.2}


def views_of(*names: str, camera=FISHEYE) -> list[View]:
    return [View(name, camera, Path(name)) for name in names]


def numbered(pattern: str, numbers=range(8)) -> list[str]:
    return [pattern.format(number) for number in numbers]


SHOTS = shots_of(views_of(*numbered("left/{:03d}.png", range(12)), *numbered("right/{:03d}.png", range(12))))


def drive() -> dict[str, np.ndarray]:
    """Poses (3, 4) of both cameras of a car that turns twice on its way, by name."""
    found, here, heading = {}, np.zeros(3), 0.0
    for step in range(12):
        heading += (0.0, 0.5, 0.0, 0.0, -0.4, -0.3)[step % 6]
        here = here + 2.0 * np.array([np.sin(heading), 0.02 * step, np.cos(heading)])
        for camera, yaw in LOOKS.items():
            aside = ASIDE_M[camera] * np.array([np.cos(heading), 0.0, -np.sin(heading)])
            turn = yaw_rotation(heading + yaw).T
            found[f"{camera}/{step:03d}.png"] = pose(turn, -turn @ (here + aside))
    return found


def of(poses: dict[str, np.ndarray], camera: str) -> dict[str, np.ndarray]:
    return {name: one for name, one in poses.items() if name.startswith(camera)}


def in_another_frame(poses: dict[str, np.ndarray], scale: float, turn: np.ndarray) -> dict[str, np.ndarray]:
    """The same map in other units, turned and moved."""
    shift = np.array([3.0, -1.0, 7.0])
    moved = {}
    for name, one in poses.items():
        centre = scale * turn @ camera_centre(one) + shift
        rotation = one[:, :3] @ turn.T
        moved[name] = pose(rotation, -rotation @ centre)
    return moved


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("left/{:03d}.png", "right/{:03d}.png"),
        ("cam0_{:04d}.jpg", "cam1_{:04d}.jpg"),
        ("{:04d}_left.jpg", "{:04d}_right.jpg"),
        ("frame{}_cam0.jpg", "frame{}_cam1.jpg"),
        ("camera-10_{}.jpg", "camera-12_{}.jpg"),
        ("20240105_1230{:02d}_cam0.jpg", "20240105_1230{:02d}_cam1.jpg"),
        ("cam0_20240105-1230{:02d}-250.jpg", "cam1_20240105-1230{:02d}-251.jpg"),  # 1 ms later
        ("slam-left_8755117091{:04d}00.png", "slam-right_8755117091{:04d}12.png"),  # 12 ns later
        ("a/17000000{:02d}.100000000.png", "b/17000000{:02d}.200000000.png"),
    ],
)
def test_images_taken_together_are_told_by_their_names(first, second):
    shots = shots_of(views_of(*numbered(first), *numbered(second)))
    one, other = ([shots[name] for name in numbered(pattern)] for pattern in (first, second))
    assert [step for _, step in one] == [step for _, step in other] == list(range(8))
    assert len({camera for camera, _ in one}) == len({camera for camera, _ in other}) == 1
    assert one[0][0] != other[0][0]


@pytest.mark.parametrize(
    "views",
    [
        views_of(*numbered("IMG_{:04d}.jpg", range(16))),  # one camera
        views_of(*[f"{camera}/2024_{word}.jpg" for camera in ("left", "right") for word in "abcdefg"]),
        views_of(*numbered("day1/{:03d}.jpg"), *numbered("day2/{:03d}.jpg", range(6, 14))),
        views_of(*numbered("left/{:03d}.jpg", range(4)), *numbered("right/{:03d}.jpg", range(4))),  # too few
        views_of(*numbered("a/{:03d}.jpg"), *numbered("b/{:03d}.jpg"), camera=Equirectangular(200, 100)),
        views_of(*[f"left/{word}.jpg" for word in "abcdefg"], *[f"right/{word}.jpg" for word in "abcdefg"]),
        views_of(*numbered("a/17000000{:02d}.100000000.png"), *numbered("b/17000000{:02d}.500000000.png")),
    ],
    ids=["one camera", "same number", "other numbers", "few", "panoramas", "no numbers", "other times"],
)
def test_other_images_are_not_taken_together(views):
    assert shots_of(views) == {}


def test_the_map_of_one_camera_is_laid_over_that_of_another():
    true = drive()
    left, right = of(true, "left"), of(true, "right")
    down = so3_exp(np.array([0.1, 0.0, -0.2]))
    other = in_another_frame(right, 0.3, down @ yaw_rotation(2.0))
    for name in ("right/003.png", "right/007.png"):  # these stand elsewhere
        other[name] = pose(other[name][:, :3], other[name][:, 3] + [0.0, 0.0, 4.0])
    joint = joint_of(left, other, (DOWN, down @ DOWN), SHOTS)
    assert joint is not None and joint.misfits == {"left/003.png", "left/007.png"}
    assert joint.poses.keys() == right.keys() - {"right/003.png", "right/007.png"}
    for name, one in joint.poses.items():
        assert rotation_angle(one[:, :3] @ right[name][:, :3].T) < np.radians(5.0)
        assert np.linalg.norm(camera_centre(one) - camera_centre(right[name])) < 0.6  # 0.4 m apart, and seen as one
    assert disagree(left, other, (DOWN, down @ DOWN), SHOTS) is None


def test_cameras_that_went_different_ways_are_not_joined(rng):
    true = drive()
    left = of(true, "left")
    strayed = {}
    for name, one in of(true, "right").items():
        centre = camera_centre(one) + rng.normal(size=3) * 4.0
        strayed[name] = pose(one[:, :3], -one[:, :3] @ centre)
    assert joint_of(left, strayed, (DOWN, DOWN), SHOTS) is None
    assert disagree(left, strayed, (DOWN, DOWN), SHOTS) == ("left", "right")
    few = dict(list(strayed.items())[:4])
    assert disagree(left, few, (DOWN, DOWN), SHOTS) is None
    assert went_apart({**left, **strayed}, SHOTS) == ("left", "right")
    assert went_apart(true, SHOTS) is None
    aside = {name: pose(one[:, :3], one[:, 3] + [0.0, 0.0, 9.0]) for name, one in of(true, "right").items()}
    assert went_apart({**left, **aside}, SHOTS) is None, "far apart, but as two fixed cameras are"


def test_an_image_is_expected_where_the_other_camera_says():
    true = drive()
    known = {name: one for name, one in true.items() if name not in ("right/002.png", "left/009.png", "left/010.png")}
    name = "left/005.png"
    known[name] = pose(known[name][:, :3], known[name][:, 3] + [0.0, 0.0, 5.0])  # one that is wrong changes nothing
    expected = expected_poses(known, SHOTS)
    assert expected.keys() == {"right/002.png", "left/009.png", "left/010.png"}
    for missing, one in expected.items():
        np.testing.assert_allclose(one, true[missing], atol=1e-9)
    assert expected_poses(of(true, "left"), SHOTS) == {}
    assert words(known, SHOTS) == "left and right, by 9 times at which they took images together"


def test_an_image_that_stands_elsewhere_than_the_other_cameras_say_is_left_out():
    true = drive()
    assert misfits(true, SHOTS) == set()
    wrong = "left/005.png"
    moved = true | {wrong: pose(true[wrong][:, :3], true[wrong][:, 3] + [0.0, 0.0, 5.0])}
    assert misfits(moved, SHOTS) == {wrong, "right/005.png"}, "of two, it is not known which is wrong"
    third = {
        name.replace("left", "back"): pose(yaw_rotation(1.0) @ one[:, :3], yaw_rotation(1.0) @ one[:, 3])
        for name, one in of(true, "left").items()
    }
    shots = shots_of(views_of(*true, *third))
    assert misfits({**moved, **third}, shots) == {wrong}, "of three, two agree"


def test_images_taken_together_are_tied():
    names = ["left/000.png", "left/001.png", "right/000.png", "right/001.png"]
    counts = np.array([[0, 80, 0, 0], [80, 0, 0, 0], [0, 0, 0, 50], [0, 0, 50, 0]])
    tied = with_ties(counts, names, SHOTS)
    assert tied[0, 2] == tied[2, 0] == tied[1, 3] == 80
    assert tied[0, 3] == 0 and tied[0, 1] == 80 and counts[0, 2] == 0
    assert one_camera(names, SHOTS).tolist() == [[k // 2 == j // 2 for j in range(4)] for k in range(4)]


def seen_by(one: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of points in an image, and which (N,) it sees within 10 m."""
    there = transform(one, points)
    pixels, inside = FISHEYE.project(there / np.linalg.norm(there, axis=1, keepdims=True))
    shown = inside & (np.abs(pixels - 280.0) < 280.0).all(axis=1) & (np.linalg.norm(there, axis=1) < 10.0)
    return np.nan_to_num(pixels), shown & (there[:, 2] > 1.0)


def test_maps_of_single_cameras_become_one(tmp_path, rng):
    """In COLMAP's database: a house on each side of the way, of which either camera sees one."""
    true = drive()
    names = sorted(true)
    middle = np.mean([camera_centre(one) for one in true.values()], axis=0)
    points = middle + rng.uniform(-1.0, 1.0, (900, 3)) * [14.0, 4.0, 14.0]
    sides = {"left": points[::2], "right": points[1::2]}
    seen = {name: seen_by(true[name], sides[name.split("/")[0]]) for name in names}
    path = tmp_path / "matches.db"
    counts = np.zeros((len(names), len(names)), np.int64)
    with pycolmap.Database.open(str(path)) as database:
        camera_id, rig_id = _camera_in(pycolmap, database, FISHEYE)
        camera, ids = database.read_camera(camera_id), {}
        for name in names:
            image = pycolmap.Image(name=name, camera_id=camera_id)
            image.image_id = ids[name] = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            database.write_keypoints(ids[name], seen[name][0].astype(np.float32))
        for i, j in np.argwhere(np.triu(one_camera(names, SHOTS), 1)).tolist():
            both = np.flatnonzero(seen[names[i]][1] & seen[names[j]][1])
            if len(both) < 15:
                continue
            counts[i, j] = counts[j, i] = len(both)
            first, second = true[names[i]], true[names[j]]
            turn = second[:, :3] @ first[:, :3].T
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = np.column_stack([both, both]).astype(np.uint32)
            geometry.cam2_from_cam1 = pycolmap.Rigid3d(pose(turn, second[:, 3] - turn @ first[:, 3]))
            database.write_matches(ids[names[i]], ids[names[j]], geometry.inlier_matches)
            database.write_two_view_geometry(ids[names[i]], ids[names[j]], geometry)

    def model_of(side: str, scale: float, turn: np.ndarray) -> Reconstruction:
        poses = in_another_frame(of(true, side), scale, turn)
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(camera)
        for name in sorted(poses):
            image = pycolmap.Image(name=name, keypoints=seen[name][0], camera_id=camera_id, image_id=ids[name])
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[name]))
        return Reconstruction(model, poses, counts, (), counts, path, ids)

    turn = so3_exp(np.array([0.05, 1.0, 0.1]))
    models = [model_of("left", 1.0, np.eye(3)), model_of("right", 2.5, turn)]
    gravity = {name: Gravity(one[:, :3] @ DOWN, "lines", 0.02) for name, one in true.items()}
    tied = with_ties(counts, names, SHOTS)
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    (whole,) = _joined(models, SHOTS, gravity, counts, tied)
    assert whole.joined and whole.poses.keys() == true.keys()
    assert {track.image_id for one in whole.model.points3D.values() for track in one.track.elements} == set(
        ids.values()
    )
    left = {name: one for name, one in whole.poses.items() if name.startswith("left")}
    # Bundle adjustment moves and scales the whole map freely: the way of the left camera says how.
    size = np.linalg.norm(np.ptp([camera_centre(true[name]) for name in left], axis=0))
    scale = np.linalg.norm(np.ptp([camera_centre(one) for one in left.values()], axis=0)) / size
    for step in range(12):
        one, other = whole.poses[f"left/{step:03d}.png"], whole.poses[f"right/{step:03d}.png"]
        assert np.linalg.norm(camera_centre(one) - camera_centre(other)) < 0.9 * scale
        assert abs(rotation_angle(other[:, :3] @ one[:, :3].T) - np.radians(140.0)) < np.radians(3.0)
    assert _joined(models[:1], SHOTS, gravity, counts, tied) == ()
