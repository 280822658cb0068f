"""A small world with known truth, written in the exact layout of hloc's outputs."""

import pickle
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.geometry import pose, transform, yaw_rotation
from spherloc.trajectory import wxyz_from_rotation

QUERY = "query/night/IMG_1.jpg"
REFERENCES = ("db/1.jpg", "db/2.jpg", "db/sub/3.jpg")
PANORAMA = ("EQUIRECTANGULAR", 1600, 800, (1600.0, 800.0))
FISHEYE = ("OPENCV_FISHEYE", 900, 800, (300.0, 301.0, 450.0, 400.0, 0.01, -0.004, 0.001, -0.0002))

SCENE = """
kind = "hloc"
name = "small"
model = "outputs/sfm"
images = "images"
queries = "queries.txt"
pairs = "outputs/pairs.txt"
features = "outputs/feats.h5"
matches = "outputs/matches.h5"
truth = "outputs/truth.txt"
"""


@dataclass
class World:
    """What the files are written from, and then changed by a test."""

    folder: Path
    truth: np.ndarray
    points: np.ndarray
    poses: dict[str, np.ndarray]
    pixels: dict[str, np.ndarray] = field(default_factory=dict)
    """Keypoints by image, the centre of the top-left pixel at (0.5, 0.5)."""
    point_of: dict[str, np.ndarray] = field(default_factory=dict)
    """Index of each keypoint's point, -1 for clutter."""

    @property
    def scene(self) -> Path:
        return self.folder / "scene.toml"

    @property
    def outputs(self) -> Path:
        return self.folder / "outputs"


def numbers(values):
    return " ".join(repr(float(value)) for value in np.ravel(values))


def pose_text(matrix):
    return f"{numbers(wxyz_from_rotation(matrix[:, :3]))} {numbers(matrix[:, 3])}"


def make_world(folder, rng):
    """Three fisheyes and a panorama, all upright, among 150 points; every image sees clutter too."""
    points = rng.uniform(-1.0, 1.0, (150, 3)) * (6.0, 3.0, 6.0) + (0.0, 0.0, 9.0)
    poses = {
        name: pose(rotation, -rotation @ centre)
        for name, rotation, centre in zip(
            REFERENCES,
            map(yaw_rotation, (0.0, 0.2, -0.2)),
            np.array([[0.0, 0.1, 0.0], [1.5, 0.0, 0.3], [-1.5, -0.1, 0.2]]),
            strict=True,
        )
    }
    rotation = yaw_rotation(1.1)
    world = World(folder, pose(rotation, -rotation @ np.array([0.4, 0.2, 1.0])), points, poses)
    for name, matrix in {**poses, QUERY: world.truth}.items():
        camera = camera_from_colmap(*(PANORAMA if name == QUERY else FISHEYE), name)
        seen, valid = camera.project(transform(matrix, points))
        valid &= (seen > 0).all(axis=1) & (seen < (camera.width, camera.height)).all(axis=1)
        clutter = rng.uniform(0.0, (camera.width, camera.height), (40, 2))
        pixels = np.vstack([seen[valid] + rng.normal(0.0, 0.3, (valid.sum(), 2)), clutter])
        order = rng.permutation(len(pixels))
        world.pixels[name] = pixels[order]
        world.point_of[name] = np.concatenate([np.flatnonzero(valid), np.full(40, -1)])[order]
    return world


def write_text(world, scene=SCENE):
    """The scene, the COLMAP model in text, the lists and the (empty) images."""
    model = world.outputs / "sfm"
    model.mkdir(parents=True, exist_ok=True)
    for name in (*REFERENCES, QUERY):
        (world.folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (world.folder / "images" / name).write_bytes(b"")
    world.scene.write_text(scene)
    rows = []
    for number, name in enumerate(REFERENCES, start=1):
        rows.append(f"{number} {pose_text(world.poses[name])} 1 {name}")
        ids = np.where(world.point_of[name] < 0, -1, world.point_of[name] + 1)
        rows.append(" ".join(f"{numbers(pixel)} {id}" for pixel, id in zip(world.pixels[name], ids, strict=True)))
    (model / "images.txt").write_text("\n".join(rows) + "\n")
    (model / "cameras.txt").write_text(f"1 {FISHEYE[0]} {FISHEYE[1]} {FISHEYE[2]} {numbers(FISHEYE[3])}\n")
    (model / "points3D.txt").write_text("".join(_point_rows(world)))
    panorama = f"{PANORAMA[0]} {PANORAMA[1]} {PANORAMA[2]} {numbers(PANORAMA[3])}"
    (world.folder / "queries.txt").write_text(f"{QUERY} {panorama}\n")
    (world.outputs / "pairs.txt").write_text("".join(f"{QUERY} {name}\n" for name in REFERENCES))
    # hloc writes results by the name of the file alone.
    (world.outputs / "truth.txt").write_text(f"{QUERY.rpartition('/')[2]} {pose_text(world.truth)}\n")


def _point_rows(world):
    for index, point in enumerate(world.points):
        track = [
            f"{number} {place}"
            for number, name in enumerate(REFERENCES, start=1)
            for place in np.flatnonzero(world.point_of[name] == index)
        ]
        if track:
            yield f"{index + 1} {numbers(point)} 128 128 128 0.5 {' '.join(track)}\n"


def write_features(world, path=None, dtype=np.float32, libver="latest", without=()):
    """features.h5 as hloc's extract_features does; hloc's pixels start at (0, 0)."""
    with h5py.File(path or world.outputs / "feats.h5", "w", libver=libver) as file:
        for name, pixels in world.pixels.items():
            if name in without:
                continue
            group = file.create_group(name)
            group.create_dataset("keypoints", data=(pixels - 0.5).astype(dtype)).attrs["uncertainty"] = 1.0
            group.create_dataset("descriptors", data=np.zeros((8, len(pixels)), np.float16))
            group.create_dataset("scores", data=np.ones(len(pixels), np.float16))
            size = PANORAMA[1:3] if name == QUERY else FISHEYE[1:3]
            group.create_dataset("image_size", data=np.array(size))


def matches_of(world, first, second, rng, wrong=0.3):
    """matches0 (N,) of two images: their common points, of which a share is matched wrongly."""
    place = {point: at for at, point in enumerate(world.point_of[second]) if point >= 0}
    matches = np.array([place.get(point, -1) for point in world.point_of[first]], dtype=np.int64)
    bad = (matches >= 0) & (rng.random(len(matches)) < wrong)
    matches[bad] = rng.integers(len(world.pixels[second]), size=bad.sum())
    return matches


def write_matches(world, rng, old=False, turned=False, path=None):
    """matches.h5 as hloc's match_features does, or as versions before 1.2 did; either order of a pair."""
    with h5py.File(path or world.outputs / "matches.h5", "w", libver="latest") as file:
        for reference in REFERENCES:
            first, second = (reference, QUERY) if turned else (QUERY, reference)
            matches = matches_of(world, first, second, rng)
            name = ("_" if old else "/").join(one.replace("/", "-") for one in (first, second))
            group = file.create_group(name)
            group.create_dataset("matches0", data=matches.astype(np.int16))
            group.create_dataset("matching_scores0", data=np.where(matches < 0, 0.0, 0.9).astype(np.float16))


def write_all(world, rng, **how):
    write_text(world)
    write_features(world)
    write_matches(world, rng, **how)
    return world


class Mine:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def pickled(trap, protocol):
    """A pickle that makes the file ``trap`` if anybody opens it."""
    return pickle.dumps({"loc": Mine(trap)}, protocol=protocol)
