"""Maps that are joined by single pairs of images: two rooms with a door between them, in COLMAP's database."""

from itertools import combinations

import numpy as np
import pycolmap
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.geometry import camera_centre, pose, so3_exp, transform, yaw_rotation
from spherloc.mapping.models import reconstruction
from spherloc.mapping.models.joining import joined_by_pairs
from spherloc.mapping.models.model import Reconstruction, untangled
from spherloc.mapping.models.pair_evidence import PairEvidence, distance_of
from spherloc.mapping.two_view.matched import Matched, _camera_in
from tests.mapping.test_rig import in_another_frame

PANORAMA = Equirectangular(1000, 500)
BOUND_RAD = np.radians(0.5)
ROOMS = {"a": -4.0, "b": 4.0}
"""Middle of each room along x; the door is at 0."""


def standing_at(x: float, z: float, yaw: float) -> np.ndarray:
    rotation = yaw_rotation(yaw)
    return pose(rotation, -rotation @ [x, 0.0, z])


def images() -> dict[str, np.ndarray]:
    poses = {
        f"{room}{k}.png": standing_at(middle + x, z, k + middle)
        for room, middle in ROOMS.items()
        for k, (x, z) in enumerate([(-1.5, -0.6), (-0.7, 0.5), (0.3, -0.4), (1.4, 0.3)])
    }
    return poses | {"door.png": standing_at(0.0, 0.0, 2.0)}


class Rooms:
    """Points on the walls of two rooms, seen from within each and from the door, and their maps."""

    def __init__(self, folder, rng) -> None:
        self.path, self.rng, self.true = folder / "matches.db", rng, images()
        walls = rng.uniform(-1.0, 1.0, (300, 3)) * [2.8, 1.4, 2.8]
        far = rng.integers(0, 2, len(walls)) * 2
        walls[np.arange(len(walls)), far] = np.sign(walls[np.arange(len(walls)), far]) * 2.8
        self.points = {room: walls + np.array([middle, 0.0, 0.0]) for room, middle in ROOMS.items()}
        self.seen, self.bearings, self.matches, self.fits = {}, {}, {}, {}
        for name, one in self.true.items():
            rays = transform(one, np.concatenate(list(self.points.values())))
            pixels = PANORAMA.project(rays / np.linalg.norm(rays, axis=1, keepdims=True))[0]
            self.seen[name] = pixels + rng.normal(size=pixels.shape) * 0.2
            self.bearings[name] = PANORAMA.unproject(self.seen[name])[0]
        for one, other in combinations(sorted(self.true), 2):
            rooms = [{"a": [0], "b": [300], "d": [0, 300]}[name[0]] for name in (one, other)]
            both = [number for start in rooms[0] if start in rooms[1] for number in range(start, start + 300)]
            if "door.png" in (one, other) and {one, other}.isdisjoint({"a3.png", "b0.png"}):
                both = []
            if (one, other) == ("a3.png", "door.png"):
                both += range(300, 380)  # through the door it sees a part of the other room
            if both:
                self.add(one, other, np.column_stack([both, both]), self.relative(one, other))

    def relative(self, one: str, other: str) -> np.ndarray:
        first, second = self.true[one], self.true[other]
        turn = second[:, :3] @ first[:, :3].T
        return pose(turn, second[:, 3] - turn @ first[:, 3])

    def add(self, one: str, other: str, found: np.ndarray, relative: np.ndarray, wrong: int = 0) -> None:
        """Matches that fit a relative pose (3, 4), and more of them that fit none."""
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = found.astype(np.uint32)
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(relative)
        self.fits[one, other] = geometry
        self.matches[one, other] = np.concatenate([found, self.rng.integers(0, 600, (wrong, 2))])

    def matched(self, without: tuple[str, ...] = ()) -> Matched:
        """What was matched, written into the database, without some of the images."""
        names = [name for name in sorted(self.true) if name not in without]
        place = {name: index for index, name in enumerate(names)}
        with pycolmap.Database.open(str(self.path)) as database:
            self.camera_id, rig_id = _camera_in(pycolmap, database, PANORAMA)
            self.camera, self.ids = database.read_camera(self.camera_id), {}
            for name in names:
                image = pycolmap.Image(name=name, camera_id=self.camera_id)
                image.image_id = self.ids[name] = database.write_image(image)
                frame = pycolmap.Frame()
                frame.rig_id = rig_id
                frame.add_data_id(image.data_id)
                database.write_frame(frame)
                database.write_keypoints(self.ids[name], self.seen[name].astype(np.float32))
            for (one, other), geometry in self.fits.items():
                if {one, other} <= place.keys():
                    pair = self.ids[one], self.ids[other]
                    database.write_matches(*pair, self.matches[one, other].astype(np.uint32))
                    database.write_two_view_geometry(*pair, geometry)
        verified = {
            (place[one], place[other]): geometry
            for (one, other), geometry in self.fits.items()
            if {one, other} <= place.keys()
        }
        none = np.zeros((len(names), len(names)), np.int64)
        cameras, bearings = dict.fromkeys(names, PANORAMA), {name: self.bearings[name] for name in names}
        return Matched(self.path, self.ids, cameras, bearings, BOUND_RAD, verified, verified, {}, {}, none)

    def model_of(self, room: str, scale: float, turn: np.ndarray) -> Reconstruction:
        """A map of one room in a frame of its own."""
        inside = {name: one for name, one in self.true.items() if name.startswith(room)}
        poses, start = in_another_frame(inside, scale, turn), 0 if room == "a" else 300
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(self.camera)
        for name in sorted(poses):
            number = self.ids[name]
            image = pycolmap.Image(name=name, keypoints=self.seen[name], camera_id=self.camera_id, image_id=number)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[name]))
        centres = np.array([camera_centre(one) for one in inside.values()])
        moved = np.array([camera_centre(one) for one in poses.values()])
        rotation = poses[min(poses)][:, :3].T @ inside[min(poses)][:, :3]
        offset = moved[0] - scale * rotation @ centres[0]
        for number, point in enumerate(scale * self.points[room] @ rotation.T + offset, start=start):
            track = pycolmap.Track()
            for name in poses:
                track.add_element(self.ids[name], number)
            model.add_point3D(point, track, np.zeros(3, np.uint8))
        counts = np.zeros((len(self.ids), len(self.ids)), np.int64)
        return Reconstruction(model, poses, counts, (), counts, self.path, self.ids)


@pytest.fixture
def rooms(tmp_path, rng) -> Rooms:
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    return Rooms(tmp_path, rng)


def join(rooms: Rooms, without: tuple[str, ...] = ()) -> list[list[str]]:
    matched = rooms.matched(without)
    models = [rooms.model_of("a", 1.0, np.eye(3)), rooms.model_of("b", 0.4, so3_exp(np.array([0.1, 2.0, 0.2])))]
    rooms.made = joined_by_pairs(models, matched, PairEvidence(matched), lambda *_: None)
    return [sorted(one.poses) for one in rooms.made]


def test_two_rooms_are_joined_by_the_picture_in_the_door(rooms):
    assert join(rooms) == [sorted(rooms.true)]
    (whole,) = rooms.made
    names = sorted(rooms.true)
    found = np.array([camera_centre(whole.poses[name]) for name in names])
    true = np.array([camera_centre(rooms.true[name]) for name in names])
    apart, true_apart = (np.linalg.norm(one[:, None] - one, axis=2) for one in (found, true))
    scale = apart.sum() / true_apart.sum()
    np.testing.assert_allclose(apart / scale, true_apart, atol=0.02)  # metres
    assert whole.contradictions == ()
    assert [set(pair) for pair in whole.joints] == [{"door.png", "b0.png"}], "the only pair between the rooms"


def test_two_rooms_without_a_picture_between_them_stay_apart(rooms):
    assert [len(names) for names in join(rooms, ("door.png",))] == [4, 4]


def test_one_thing_at_two_places_does_not_join_rooms(rooms):
    thing = np.flatnonzero(np.linalg.norm(rooms.points["a"] - [-4.0, 0.0, 2.8], axis=1) < 1.0)[:40]
    found = np.column_stack([thing, thing + 300])
    shift = pose(np.eye(3), np.array([8.0, 0.0, 0.0]))  # the second room put onto the first
    as_if = rooms.true["b1.png"][:, :3] @ (shift[:, 3])
    moved = pose(rooms.true["b1.png"][:, :3], rooms.true["b1.png"][:, 3] + as_if)
    first = rooms.true["a2.png"]
    turn = moved[:, :3] @ first[:, :3].T
    rooms.add("a2.png", "b1.png", found, pose(turn, moved[:, 3] - turn @ first[:, 3]), wrong=60)
    assert [len(names) for names in join(rooms, ("door.png",))] == [4, 4]
    rooms.path.unlink()
    assert join(rooms) == [sorted(rooms.true)], "the picture in the door says where the second room is"


def test_rooms_that_look_alike_are_joined_where_nothing_contradicts(rooms):
    every = np.arange(300)
    first, second = rooms.true["a2.png"], rooms.true["b1.png"]
    moved = pose(second[:, :3], second[:, 3] + second[:, :3] @ [8.0, 0.0, 0.0])
    turn = moved[:, :3] @ first[:, :3].T
    relative = pose(turn, moved[:, 3] - turn @ first[:, 3])
    rooms.add("a2.png", "b1.png", np.column_stack([every, every + 300]), relative, wrong=250)
    # The pair fits all around; but then the other photographs stand side by side, and do not match.
    assert [len(names) for names in join(rooms, ("door.png",))] == [4, 4]
    rooms.path.unlink()
    assert join(rooms) == [sorted(rooms.true)]


def test_images_are_misplaced_if_most_of_their_matches_fit_elsewhere(rooms):
    """In the wrong room, or in the right one and beside its place, where far matches still fit."""
    evidence = PairEvidence(rooms.matched())
    assert evidence.misplaced(rooms.true) == set()

    def moved(metres: float) -> dict[str, np.ndarray]:
        shift = np.array([metres, 0.0, 0.0])
        return {
            name: pose(one[:, :3], one[:, 3] + one[:, :3] @ shift) if name.startswith("b") else one
            for name, one in rooms.true.items()
        }

    for metres in (4.2, 0.8):
        assert evidence.misplaced(moved(metres)) == {("b0.png", "door.png")}, "the only pair between them and the rest"
    assert evidence.misplaced(moved(0.02)) == set()


def test_a_map_is_held_together_by_the_matches_of_its_weakest_part(rooms):
    """The door alone, with 80 points of the one room that it shows the other."""
    evidence = PairEvidence(rooms.matched())
    held = evidence.least_holding(rooms.true)
    assert held == min(
        sum(evidence.between(rooms.true, part, rooms.true.keys() - part).counts.values())
        for part in (
            {name for name in rooms.true if name.startswith("b")},
            {"door.png", *(n for n in rooms.true if n[0] == "b")},
        )
    )
    assert evidence.least_holding({name: one for name, one in rooms.true.items() if name != "door.png"}) == 0


def test_the_distance_is_that_on_which_points_agree(rng):
    turn, direction = so3_exp(np.array([0.1, -0.7, 0.2])), np.array([0.6, 0.0, 0.8])
    points = rng.normal(size=(60, 3)) * 4.0
    rays = points @ turn.T + 1.3 * direction
    rays += rng.normal(size=rays.shape) * 0.003
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    wrong = rng.normal(size=(60, 3))
    mixed = np.where(np.arange(60)[:, None] % 2, rays, wrong / np.linalg.norm(wrong, axis=1, keepdims=True))
    for seen in (rays, mixed):
        found = distance_of(points, seen, turn, direction)
        assert found is not None and abs(found - 1.3) < 0.03
    assert distance_of(points, wrong, turn, direction) is None, "they agree on none"
    assert distance_of(points[:4], rays[:4], turn, direction) is None, "too few"
    far = points * 500.0
    parallel = far @ turn.T + 1.3 * direction
    parallel /= np.linalg.norm(parallel, axis=1, keepdims=True)
    assert distance_of(far, parallel, turn, direction) is None, "far points do not tell it"


def test_a_model_without_points_is_none(monkeypatch, tmp_path):
    """COLMAP gives one with images where bundle adjustment diverged: other conditions for a first pair are tried."""
    tried = []

    def mapped(_pycolmap, _database, _folder, options, _tell):
        tried.append(options.mapper.init_min_num_inliers)
        return {0: pycolmap.Reconstruction()}

    monkeypatch.setattr(reconstruction, "_mapped", mapped)
    assert reconstruction._models(pycolmap, tmp_path / "matches.db", tmp_path, 3, lambda *_: None) == []
    assert tried == [50, 25, 15]


def test_two_maps_of_the_same_images_are_one(rooms):
    rooms.matched()
    first, second = (rooms.model_of("a", scale, np.eye(3)) for scale in (1.0, 2.0))
    (left,) = untangled([first, second])
    assert left.poses == first.poses
