"""Small COLMAP models from known truth, packed by hand in the layout of COLMAP's format documentation."""

import struct
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from spherloc.geometry import camera_centre, pose, so3_exp

NO_POINT = 2**64 - 1
EQUIRECTANGULAR, OPENCV_FISHEYE, PINHOLE = 17, 5, 1
NAMES = {EQUIRECTANGULAR: "EQUIRECTANGULAR", OPENCV_FISHEYE: "OPENCV_FISHEYE", PINHOLE: "PINHOLE"}


def wxyz(rotation):
    """Quaternion of a rotation (3, 3), by the largest of its four squares."""
    m = rotation
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0, m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    _, vectors = np.linalg.eigh(k, UPLO="U")
    quaternion = vectors[:, -1]
    return tuple(quaternion * (np.sign(quaternion[0]) or 1.0))


@dataclass(frozen=True)
class Sample:
    """What a model holds, as it is written."""

    cameras: list  # (id, model, width, height, params)
    images: list  # (id, cam_from_map (3, 4), camera id, name, [(x, y, point id or NO_POINT)])
    points: list  # (id, xyz, error, [(image id, place)])
    rigs: list = field(default_factory=list)  # (id, [(camera id, sensor_from_rig (3, 4) or None)]), the reference first
    frames: list = field(default_factory=list)  # (id, rig id, rig_from_map (3, 4), [(camera id, image id)])

    def image(self, name):
        """The image of a name."""
        return next(image for image in self.images if image[3] == name)


def sample_model(rng, images=4, points=30, models=(EQUIRECTANGULAR, OPENCV_FISHEYE)):
    """Upright cameras among points, in the old layout; every image observes every point, and one pixel has none."""
    params = {
        EQUIRECTANGULAR: (640, 320, (640.0, 320.0)),
        OPENCV_FISHEYE: (640, 480, (200.0, 201.0, 320.5, 240.5, 0.01, -0.02, 0.003, -0.0004)),
        PINHOLE: (640, 480, (400.0, 401.0, 320.5, 240.5)),
    }
    cameras = [(7 + at, model, *params[model]) for at, model in enumerate(models)]
    xyz = rng.uniform(-5, 5, (points, 3))
    tracks = [[(10 + image, place) for image in range(images)] for place in range(points)]
    made = []
    for at in range(images):
        turn = so3_exp(np.array([0.0, rng.uniform(-3, 3), 0.0])) @ so3_exp(rng.normal(0, 0.02, 3))
        cam_from_map = pose(turn, rng.uniform(-2, 2, 3))
        seen = [(*rng.uniform(1, 300, 2), 100 + place) for place in range(points)] + [(3.5, 4.5, NO_POINT)]
        made.append((10 + at, cam_from_map, cameras[at % len(cameras)][0], f"seq/{at:03}.jpg", seen))
    return Sample(cameras, made, [(100 + k, xyz[k], 0.5 + k, tracks[k]) for k in range(points)])


def with_rigs(sample, rng, frames=3):
    """The sample in the new layout: one rig of all of its cameras, one image a camera and frame."""
    ids = [camera[0] for camera in sample.cameras]
    offsets = [np.eye(3, 4)] + [pose(so3_exp(rng.normal(0, 0.5, 3)), rng.normal(0, 0.2, 3)) for _ in ids[1:]]
    images, made = [], []
    for frame in range(frames):
        rig_from_map = pose(so3_exp(np.array([0.0, rng.uniform(-3, 3), 0.0])), rng.uniform(-2, 2, 3))
        data = []
        for camera, offset in zip(ids, offsets, strict=True):
            number = 10 + len(images)
            whole = np.vstack([offset, [0, 0, 0, 1]]) @ np.vstack([rig_from_map, [0, 0, 0, 1]])
            seen = sample.images[0][4]
            images.append((number, whole[:3], camera, f"cam{camera}/{frame:03}.jpg", seen))
            data.append((camera, number))
        made.append((50 + frame, 3, rig_from_map, data))
    tracks = [[(image[0], place) for image in images] for place in range(len(sample.points))]
    points = [(*point[:3], track) for point, track in zip(sample.points, tracks, strict=True)]
    rigs = [(3, list(zip(ids, offsets, strict=True)))]
    return replace(sample, images=images, points=points, rigs=rigs, frames=made)


def _pose_numbers(matrix):
    return (*wxyz(matrix[:, :3]), *matrix[:, 3])


def binary_files(sample):
    """Content of the files of the binary form, by name; rigs and frames where the sample has them."""
    cameras = struct.pack("<Q", len(sample.cameras))
    for number, model, width, height, params in sample.cameras:
        cameras += struct.pack(f"<IiQQ{len(params)}d", number, model, width, height, *params)
    images = struct.pack("<Q", len(sample.images))
    for number, matrix, camera, name, seen in sample.images:
        images += struct.pack("<I7dI", number, *_pose_numbers(matrix), camera) + name.encode() + b"\0"
        images += struct.pack("<Q", len(seen)) + b"".join(struct.pack("<ddQ", *item) for item in seen)
    points = struct.pack("<Q", len(sample.points))
    for number, xyz, error, track in sample.points:
        points += struct.pack("<Q3d3BdQ", number, *xyz, 1, 2, 3, error, len(track))
        points += b"".join(struct.pack("<II", *item) for item in track)
    files = {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}
    if sample.rigs:
        rigs = struct.pack("<Q", len(sample.rigs))
        for number, sensors in sample.rigs:
            rigs += struct.pack("<IIiI", number, len(sensors), 0, sensors[0][0])
            for camera, offset in sensors[1:]:
                rigs += struct.pack("<iIB", 0, camera, offset is not None)
                rigs += struct.pack("<7d", *_pose_numbers(offset)) if offset is not None else b""
        frames = struct.pack("<Q", len(sample.frames))
        for number, rig, matrix, data in sample.frames:
            frames += struct.pack("<II7dI", number, rig, *_pose_numbers(matrix), len(data))
            frames += b"".join(struct.pack("<iIQ", 0, camera, image) for camera, image in data)
        files |= {"rigs.bin": rigs, "frames.bin": frames}
    return files


def _text(*values):
    return " ".join(repr(float(value)) if isinstance(value, float) else str(value) for value in values)


def text_files(sample):
    """Content of the files of the text form, by name; rigs and frames where the sample has them."""
    cameras, images, points, rigs, frames = (["# a comment"] for _ in range(5))
    for number, model, width, height, params in sample.cameras:
        cameras.append(_text(number, NAMES.get(model, model), width, height, *params))
    for number, matrix, camera, name, seen in sample.images:
        images.append(_text(number, *_pose_numbers(matrix), camera, name))
        images.append(_text(*(v for x, y, p in seen for v in (float(x), float(y), -1 if p == NO_POINT else p))))
    for number, xyz, error, track in sample.points:
        points.append(_text(number, *xyz, 1, 2, 3, float(error), *(v for item in track for v in item)))
    for number, sensors in sample.rigs:
        rest = [
            ("CAMERA", camera, *((0,) if offset is None else (1, *_pose_numbers(offset))))
            for camera, offset in sensors[1:]
        ]
        rigs.append(_text(number, len(sensors), "CAMERA", sensors[0][0], *(v for item in rest for v in item)))
    for number, rig, matrix, data in sample.frames:
        ids = [v for camera, image in data for v in ("CAMERA", camera, image)]
        frames.append(_text(number, rig, *_pose_numbers(matrix), len(data), *ids))
    files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    if sample.rigs:
        files |= {"rigs.txt": rigs, "frames.txt": frames}
    return {name: ("\n".join(lines) + "\n").encode() for name, lines in files.items()}


def write(folder: Path, files) -> Path:
    """Write a model's files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def mean_down(sample):
    """Mean of the +y axes of the images, a unit vector in the map frame."""
    mean = np.mean([image[1][1, :3] for image in sample.images], axis=0)
    return mean / np.linalg.norm(mean)


def centres(sample):
    """Camera positions by image name."""
    return {image[3]: camera_centre(image[1]) for image in sample.images}
