"""Cameras that are fixed to each other, as their calibration says: one moment of them, which nothing else places, and
two."""

import json
import shutil
from itertools import product

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from test_own_calibrations import CAMERAS, as_woodscape

from spherloc.cameras.calibration import load_camera
from spherloc.datasets import load_scene
from spherloc.geometry import camera_centre, inverse_pose, pose, rotation_angle, transform
from spherloc.mapping.alignment.fixed_images import fixed_images
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.models.fixed_views import freed_if_loose
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from spherloc.worlds import build_world
from spherloc.worlds.render import draw

SIZE = 512, 384


def calibration(name):
    """Of a camera of a car that looks down by 20 degrees."""
    document = as_woodscape(name, 136.0, SIZE)
    turn = Rotation.from_quat(document["extrinsic"]["quaternion"]) * Rotation.from_euler("x", -20.0, degrees=True)
    document["extrinsic"]["quaternion"] = turn.as_quat().tolist()
    document["extrinsic"]["translation"][1] = {"MVL": 0.95, "MVR": -0.95}.get(name, 0.0)
    return document


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    """A folder with the images of a car's four cameras at two moments and their calibrations, the true poses and the
    distance of what each pixel shows, m."""
    folder = tmp_path_factory.mktemp("car") / "moments"
    folder.mkdir()
    world, poses, ranges = build_world("street", 3), {}, {}
    start = world.route(10)[4]
    ahead = start[2, :3] * [1.0, 1.0, 0.0]
    ahead /= np.linalg.norm(ahead)
    body = np.column_stack([ahead, np.cross([0.0, 0.0, 1.0], ahead), [0.0, 0.0, 1.0]])
    for moment, name in product(range(2), CAMERAS):
        document = calibration(name)
        path = folder / f"0000{moment}_{name}.json"
        path.write_text(json.dumps(document))
        extrinsic = document["extrinsic"]
        turn = body @ Rotation.from_quat(extrinsic["quaternion"]).as_matrix()
        centre = camera_centre(start) - [0.0, 0.0, 1.0] + body @ extrinsic["translation"] + 0.6 * moment * ahead
        cam_from_world = inverse_pose(pose(turn, centre))
        drawn = draw(world, load_camera(path, None, SIZE), cam_from_world)
        image = path.with_suffix(".png")
        cv2.imwrite(str(image), drawn.image)
        poses[image.name], ranges[image.name] = cam_from_world, drawn.range_m
    return folder, poses, ranges


def of_one_moment(car, target):
    """The same at the first moment, in another folder."""
    folder, poses, ranges = car
    shutil.copytree(folder, target, ignore=shutil.ignore_patterns("00001*"))
    return target, {name: one for name, one in poses.items() if name.startswith("00000")}, ranges


def made_of(folder, target):
    views = photographs(folder, {}).views
    fixed, _ = fixed_images(folder, views, None)
    return make_map(MapRequest(views, folder, ScaleMeasurement(fixed=fixed)), target), fixed


def test_the_calibration_places_the_images_of_one_moment(car, tmp_path):
    """In metres, where no three of them see a point; and each point is where the picture shows it."""
    folder, poses, ranges = of_one_moment(car, tmp_path / "moment")
    made, fixed = made_of(folder, tmp_path / "map")
    assert fixed.one_moment and made.scale.source.startswith(
        "the calibration of each image, which places the images of"
    )
    assert set(made.written.poses) == set(poses)
    names = sorted(poses)
    for name in names[1:]:
        relative, true = (
            (one[name][:, :3] @ one[names[0]][:, :3].T, one[name] @ [*camera_centre(one[names[0]]), 1.0])
            for one in (made.written.poses, poses)
        )
        assert rotation_angle(relative[0] @ true[0].T) < 1e-6
        np.testing.assert_allclose(relative[1], true[1], atol=1e-6)
        assert made.written.poses[name][:, 2] @ poses[name][:, 2] > np.cos(np.radians(1.0)), "up"
    off = []
    for image in made.made.model.images.values():
        for seen in (one for one in image.points2D if one.has_point3D()):
            point = made.made.model.point3D(seen.point3D_id).xyz
            column, row = np.floor(seen.xy).astype(int)
            distance = np.linalg.norm(transform(made.written.poses[image.name], point[None])[0])
            off.append(distance / ranges[image.name][row, column] - 1.0)
    assert len(off) > 600 and np.median(np.abs(off)) < 0.03 and np.mean(np.abs(off) < 0.1) > 0.7
    scene = load_scene(made.written.scene)
    assert [view.name for view in scene.queries] == names, "the map without one of them would not show it"


def test_fixed_cameras_tie_two_moments(car, tmp_path):
    """In metres, though two moments are too few for maps of single cameras to be joined by them."""
    folder, poses, _ = car
    made, fixed = made_of(folder, tmp_path / "map")
    assert not fixed.one_moment and set(made.written.poses) == set(poses)
    assert "at 2 times" in made.scale.source
    names = sorted(poses)
    centres, true = (np.array([camera_centre(one[name]) for name in names]) for one in (made.written.poses, poses))
    turn = Rotation.align_vectors(true - true.mean(axis=0), centres - centres.mean(axis=0))[0]
    off = turn.apply(centres - centres.mean(axis=0)) - (true - true.mean(axis=0))
    assert np.linalg.norm(off, axis=1).max() < 0.03

    assert freed_if_loose(pycolmap, made.made) is made.made
    late = made.made.model.image(made.made.ids["00001_MVL.png"])  # as if it had been taken a moment before
    before = late.projection_center()
    cam_from_map = late.cam_from_world().matrix()
    shifted = pose(cam_from_map[:, :3], cam_from_map[:, 3] + [0.1, 0.0, 0.0])
    made.made.model.frame(late.frame_id).rig_from_world = pycolmap.Rigid3d(shifted)
    made.made.model.update_point_3d_errors()
    freed = freed_if_loose(pycolmap, made.made)
    assert freed is not made.made
    assert np.linalg.norm(camera_centre(freed.poses["00001_MVL.png"]) - before) < 0.03


def test_a_calibration_of_another_car_places_nothing(car, tmp_path):
    """What looks ahead in this one looks to the left in that one."""
    wrong, poses, _ = of_one_moment(car, tmp_path / "wrong")
    order = list(CAMERAS)
    for name, other in zip(order, (*order[2:], *order[:2]), strict=True):
        (wrong / f"00000_{name}.json").write_text(json.dumps(calibration(other) | {"name": name}))
    made, fixed = made_of(wrong, tmp_path / "map")
    assert fixed.one_moment and not made.scale.source
    assert "turned against each other" in made.scale.why_unknown and "otherwise than it says" in made.scale.why_unknown
    assert len(made.written.poses) < len(poses)
