"""A map that takes two rooms that look alike for one is cut between them; a wall between two images is no reason."""

from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from spherloc.geometry import pose
from spherloc.mapping.make import nearer_to_others
from spherloc.mapping.models.model import Reconstruction, SeenPoints, contradictions, parted, untangled

ROOMS = {"day_0", "day_1", "day_2"}, {"night_0", "night_1", "night_2", "night_3"}
NAMES = sorted(set.union(*ROOMS))


def matches_of(alike: int) -> np.ndarray:
    """(7, 7): many within a room, and ``alike`` between one image of each and one of the other."""
    counts = np.zeros((7, 7), np.int64)
    for room in ROOMS:
        for one in room:
            for other in room - {one}:
                counts[NAMES.index(one), NAMES.index(other)] = 200
    counts[NAMES.index("day_0"), NAMES.index("night_0")] = counts[NAMES.index("night_0"), NAMES.index("day_0")] = alike
    return counts


def centres_of() -> dict[str, np.ndarray]:
    """The images of both rooms among each other, a metre apart."""
    mixed = sorted(NAMES, key=lambda name: name[-1])
    return {name: np.array([1.0 * index, 0.2 * (index % 2), 0.0]) for index, name in enumerate(mixed)}


def walls(rng: np.random.Generator) -> np.ndarray:
    """(N, 3): far on all sides."""
    rays = rng.normal(size=(600, 3))
    return 12.0 * rays / np.linalg.norm(rays, axis=1, keepdims=True)


def all_of(points: np.ndarray) -> SeenPoints:
    """Points (K, 3) that are the first in the model."""
    return SeenPoints(np.arange(len(points)), points)


def model_of(points: np.ndarray) -> Reconstruction:
    """A model of COLMAP in which every image sees all points."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=200, height=100, params=[200, 100], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    poses = {}
    for index, (name, centre) in enumerate(sorted(centres_of().items()), start=1):
        poses[name] = pose(np.eye(3), -centre)
        image = pycolmap.Image(name=name, keypoints=np.zeros((len(points), 2)), camera_id=1, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[name]))
    for row, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(index, row) for index in range(1, len(NAMES) + 1)])
        model.add_point3D(point, track)
    counts = matches_of(alike=90)
    ids = {name: index for index, name in enumerate(NAMES, start=1)}
    return Reconstruction(model, poses, counts, (), counts, Path("unused"), ids).judged()


def test_images_in_sight_of_each_other_that_hardly_match(rng):
    poses = {name: pose(np.eye(3), -centre) for name, centre in centres_of().items()}
    seen = dict.fromkeys(NAMES, all_of(walls(rng)))
    against = contradictions(poses, NAMES, matches_of(alike=90), seen)
    assert against and all((one in ROOMS[0]) != (other in ROOMS[0]) for one, other in against)
    assert ("day_0", "night_0") not in against  # these do match
    near = {name: all_of(centre + 0.3 * (walls(rng) / 12.0)) for name, centre in centres_of().items()}
    assert contradictions(poses, NAMES, matches_of(alike=90), near) == ()  # a wall round each


def test_the_ends_of_a_walk_need_not_match(rng):
    """Of three in a row, the first and the last have no match; only where they are about as near do they contradict."""
    counts = np.array([[0, 90, 0], [90, 0, 80], [0, 80, 0]])
    seen = dict.fromkeys("abc", all_of(walls(rng)))

    def at(*metres):
        poses = {name: pose(np.eye(3), -np.array([0.0, 0.0, x])) for name, x in zip("abc", metres, strict=True)}
        return contradictions(poses, list("abc"), counts, seen)

    assert at(0.0, 0.2, 1.2) == ()
    assert set(map(frozenset, at(0.0, 0.6, 1.2))) == {frozenset("ac")}


def test_fisheyes_that_look_opposite_ways_need_not_match(rng):
    """The front camera of a robot, and the one at its back as it stands a little farther on; not one that turns."""
    counts = np.array([[0, 10, 300, 0], [10, 0, 0, 300], [300, 0, 0, 0], [0, 300, 0, 0]])
    seen = dict.fromkeys("abcd", all_of(walls(rng)))

    def turned(degrees: float, **kinds) -> tuple[tuple[str, str], ...]:
        back = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        poses = {name: pose(np.eye(3), -np.array([0.0, 0.0, z])) for name, z in zip("ac", (0.0, 0.7), strict=True)}
        poses |= {name: pose(back, -back @ [0.0, 0.0, z]) for name, z in zip("bd", (0.3, 1.0), strict=True)}
        return contradictions(poses, list("abcd"), counts, seen, **kinds)

    two = {"a": 1, "b": 2, "c": 1, "d": 2}
    assert ("a", "b") not in turned(180.0, lenses=two)
    assert ("a", "b") in turned(180.0)  # panoramas see all around
    assert ("a", "b") in turned(90.0, lenses=two)
    assert ("a", "b") in turned(180.0, lenses=dict.fromkeys("abcd", 1))  # of one camera that turned around


def test_a_map_of_two_rooms_in_one_place_is_cut_between_them(rng):
    parts = untangled(parted(model_of(walls(rng))))
    assert [set(part.poses) for part in parts] == [ROOMS[1], ROOMS[0]]
    for part in parts:
        assert part.contradictions == ()
        assert {image.name for image in map(part.model.image, part.model.reg_image_ids())} == set(part.poses)
    left = parts[0].without({"night_3"})
    assert nearer_to_others(left, parts[1:]) == ROOMS[0]  # none of them is tried in the larger map, night_3 is


def two_of(rng, both: int, distance_m: float = 12.0) -> dict[str, SeenPoints]:
    """What two images see, each 300 points around it: ``both`` of them are the same, the others are its own."""
    points = walls(rng) * distance_m / 12.0
    return {
        "a": SeenPoints(np.arange(300), points[:300]),
        "b": SeenPoints(np.arange(300 - both, 600 - both), points[300 - both : 600 - both]),
    }


def side_by_side(seen: dict[str, SeenPoints]) -> tuple[tuple[str, str], ...]:
    """The contradictions of two images that are half a metre apart and match well."""
    poses = {name: pose(np.eye(3), -np.array([0.5 * index, 0.0, 0.0])) for index, name in enumerate("ab")}
    return contradictions(poses, ["a", "b"], np.array([[0, 300], [300, 0]]), seen, {"a", "b"})


def test_images_that_match_but_see_other_things_around_them(rng):
    """A bookcase that stands in two rooms: many matches, and nothing else is seen from both."""
    assert side_by_side(two_of(rng, both=20)) == (("a", "b"),)
    assert side_by_side(two_of(rng, both=120)) == ()
    assert side_by_side(two_of(rng, both=20, distance_m=0.4)) == ()  # a wall round each: they need not see the same
    poses = {name: pose(np.eye(3), -np.array([0.5 * index, 0.0, 0.0])) for index, name in enumerate("ab")}
    counts = np.array([[0, 300], [300, 0]])
    for panoramas in ((), {"a"}):  # fisheyes look to one side
        assert contradictions(poses, ["a", "b"], counts, two_of(rng, both=20), panoramas) == ()


def test_an_image_that_one_pair_put_among_others_is_left_out_alone(rng):
    """Of four in a row and one that only one of them matches, that one goes, though other pairs have fewer matches."""
    names = ["a", "b", "c", "d", "x"]
    points = walls(rng)
    centres = dict(zip(names, np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [1.5, 0.0, 0.6]]), strict=True))
    sees = dict.fromkeys(names[:4], range(300)) | {"x": range(100, 400)}
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=200, height=100, params=[200, 100], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    poses = {name: pose(np.eye(3), -centre) for name, centre in centres.items()}
    for index, name in enumerate(names, start=1):
        image = pycolmap.Image(name=name, keypoints=np.zeros((600, 2)), camera_id=1, image_id=index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[name]))
    for row, point in enumerate(points):
        seen_by = [index for index, name in enumerate(names, start=1) if row in sees[name]]
        model.add_point3D(point, pycolmap.Track([pycolmap.TrackElement(index, row) for index in seen_by]))
    counts = np.zeros((5, 5), np.int64)
    for one, other, matches in ((0, 1, 60), (1, 2, 60), (2, 3, 60), (0, 2, 20), (1, 3, 20), (2, 4, 300)):
        counts[one, other] = counts[other, one] = matches
    ids = {name: index for index, name in enumerate(names, start=1)}
    made = Reconstruction(model, poses, counts, (("b", "x"), ("c", "x")), counts, Path("unused"), ids)
    assert [sorted(part.poses) for part in parted(made)] == [["a", "b", "c", "d"]]
