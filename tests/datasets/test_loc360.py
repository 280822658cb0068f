"""360Loc: a small tree in its layout, of a drawn room, and what is wrong with others."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.datasets.loc360 import load
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError
from spherloc.estimators import estimate
from spherloc.metrics import evaluate
from tests.frontend.textured_rooms import PANORAMA, look, standing, wallpaper

FISHEYE = DoubleSphere(300, 300, 100.0, 100.0, 150.0, 150.0, -0.2, 0.6)
PLACES = [(-1.0, -1.5, 0.0), (-0.2, -1.4, 2.0), (0.9, -0.9, 4.0)]
QUERY = (-0.1, -0.6, 5.0)


def sequence(folder, camera, places, walls):
    """Images and camera_pose.json, matrices from the camera to the world."""
    (folder / "image").mkdir(parents=True)
    poses = {}
    for number, place in enumerate(places):
        cam_from_map = np.vstack([standing(*place), [0, 0, 0, 1]])
        poses[f"{number:04d}.jpg"] = np.linalg.inv(cam_from_map).round(12).tolist()
        cv2.imwrite(str(folder / "image" / f"{number:04d}.jpg"), look(camera, cam_from_map[:3], walls)[0])
    for rows in poses.values():
        rows[3] = [0.0, 0.0, 0.0, 1.0]
    (folder / "camera_pose.json").write_text(json.dumps(poses))


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    root = tmp_path_factory.mktemp("360Loc") / "hall"
    walls = wallpaper(4)
    sequence(root / "mapping" / "daytime_360_0", PANORAMA, PLACES, walls)
    sequence(root / "query_360" / "daytime_360_1", PANORAMA, [QUERY], walls)
    sequence(root / "query_fisheye1" / "daytime_fisheye1_1", FISHEYE, [QUERY, (0.1, -0.6, 1.5)], walls)
    (root / "camera_config").mkdir()
    (root / "camera_config" / "fisheye1.yaml").write_text(
        "imgw: 300\nimgh: 300\nfx: 100.0\nfy: 100.0\ncx: 150.0\ncy: 150.0\nxi: -0.2\nalpha: 0.6\n"
    )
    return root


def scene_of(root, queries, **others) -> MapScene:
    table = {"kind": "360loc", "name": "hall", "root": str(root), "queries": queries, **others}
    return load(table, Path(root).parent / "scene.toml")


def test_fisheyes_are_localized_in_the_panoramas_of_the_map(hall):
    few = {"max_features": 1500}
    gravity = {"map": [0, 1, 0], "bound_deg": 1.0}
    scene = scene_of(hall, "query_fisheye1/daytime_fisheye1_1", gravity=gravity, frontend=few)
    assert len(scene.references) == 3 and scene.thresholds == ((2.0, 0.25), (5.0, 0.5), (10.0, 5.0))
    query = scene.queries[0]
    np.testing.assert_allclose(query.cam_from_map, standing(*QUERY), atol=1e-9)
    metrics = evaluate(estimate(scene.problem(), "mc"))
    assert metrics.rotation_error_deg is not None and metrics.translation_error_m is not None
    assert metrics.rotation_error_deg < 0.5 and metrics.translation_error_m < 0.05


def test_the_camera_is_that_of_the_folder(hall):
    scene = scene_of(hall, ["query_fisheye1", "query_360"], query_step=2)
    assert [view.name for view in scene.queries] == [
        "query_fisheye1/daytime_fisheye1_1/0000.jpg",
        "query_360/daytime_360_1/0000.jpg",
    ]
    assert [view.camera for view in scene.queries] == [FISHEYE, PANORAMA]


def test_images_that_were_not_cut_yet_are_told(hall, tmp_path):
    folder = hall / "query_fisheye1" / "night_fisheye1_2"
    folder.mkdir()
    pose = np.eye(4).tolist()
    (folder / "camera_pose.json").write_text(json.dumps({"0_0.jpg": pose, "0_1.jpg": pose}))
    try:
        scene = scene_of(hall, ["query_fisheye1"])
    finally:
        (folder / "camera_pose.json").unlink()
        folder.rmdir()
    assert len(scene.queries) == 2
    assert any(
        "2 images (query_fisheye1/night_fisheye1_2/0_0.jpg" in one and "process.py" in one for one in scene.remarks
    )


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "is not valid JSON"),
        ("[]", "holds no table of poses"),
        ('{"a.jpg": [[1, 0, 0, 0], [0, 1, 0, 0]]}', "'a.jpg' must hold 3 x 4 finite numbers"),
        ('{"a.jpg": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}', "'a.jpg' is not a rigid pose"),
        ('{"../a.jpg": []}', "is not the name of an image"),
    ],
)
def test_wrong_poses_are_told(hall, tmp_path, content, said):
    folder = tmp_path / "hall" / "query_360" / "day"
    folder.mkdir(parents=True)
    (folder / "camera_pose.json").write_text(content)
    with pytest.raises(InputError, match=r"camera_pose\.json") as caught:
        scene_of(tmp_path / "hall", "query_360")
    assert said in str(caught.value)


def test_wrong_folders_are_told(hall):
    for queries, said in (
        ("query_pinhole", "which does not exist"),
        ("camera_config", "has camera_pose.json"),
        ([], "give folders below root"),
        (3, "give folders below root"),
    ):
        with pytest.raises(InputError, match=said):
            scene_of(hall, queries)
