"""Parts of a map with different scales: two rooms, of which one is as much too large or too small as COLMAP made it."""

import numpy as np
import pycolmap
import pytest

from spherloc.geometry import camera_centre
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.models.pair_evidence import PairEvidence
from spherloc.mapping.models.part_scales import with_one_scale
from tests.mapping.test_joining import Rooms


def scaled_behind_the_door(rooms: Rooms, factor: float) -> Reconstruction:
    """A map of both rooms, the second scaled from the door, with the points that fit it."""
    door, poses = camera_centre(rooms.true["door.png"]), dict(rooms.true)
    for name in ("b0.png", "b1.png", "b2.png", "b3.png"):
        turn, centre = poses[name][:, :3], camera_centre(poses[name])
        poses[name] = np.column_stack([turn, -turn @ (door + factor * (centre - door))])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(rooms.camera)
    for name, one in sorted(poses.items()):
        number = rooms.ids[name]
        image = pycolmap.Image(name=name, keypoints=rooms.seen[name], camera_id=rooms.camera_id, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(one))
    first, second = rooms.points["a"], door + factor * (rooms.points["b"] - door)
    through = set(range(300, 380))  # points of the second room that are seen from the first
    for number, point in enumerate(np.concatenate([first, second])):
        names = [name for name in poses if name.startswith("a" if number < 300 else "b")]
        if number not in through:
            names.append("door.png")
        track = pycolmap.Track()
        for name in names:
            track.add_element(rooms.ids[name], number)
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    for number in sorted(through):
        track = pycolmap.Track()
        for name in ("a3.png", "door.png"):
            track.add_element(rooms.ids[name], number)
        model.add_point3D(rooms.points["b"][number - 300], track, np.zeros(3, np.uint8))
    counts = np.zeros((len(rooms.ids), len(rooms.ids)), np.int64)
    return Reconstruction(model, poses, counts, (), counts, rooms.path, rooms.ids)


@pytest.fixture
def rooms(tmp_path, rng) -> Rooms:
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    return Rooms(tmp_path, rng)


@pytest.mark.parametrize("factor", [9.0, 0.3])
def test_a_part_is_scaled_to_the_rest(rooms, factor):
    evidence = PairEvidence(rooms.matched())
    made = with_one_scale(scaled_behind_the_door(rooms, factor), evidence)
    names = sorted(rooms.true)
    found, true = (np.array([camera_centre(one[name]) for name in names]) for one in (made.poses, rooms.true))
    apart, true_apart = (np.linalg.norm(one[:, None] - one, axis=2) for one in (found, true))
    np.testing.assert_allclose(apart * true_apart.sum() / apart.sum(), true_apart, atol=0.05)  # metres
    assert [set(pair) for pair in made.joints] == [{"door.png", "b0.png"}]


def test_a_map_with_one_scale_stays_as_it_is(rooms):
    evidence = PairEvidence(rooms.matched())
    made = scaled_behind_the_door(rooms, 1.0)
    assert with_one_scale(made, evidence) is made
