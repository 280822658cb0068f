"""A COLMAP model: cameras, posed images and points, collected and checked while its files are read.

COLMAP's own reader accepts truncated files, trusts every count, and passes NaN on; this one says what is wrong and
where. Poses, observations and points are kept in columns, not as one object each, as in COLMAP. Layout:
doc/format.rst of COLMAP 4.2.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import CalibrationError, InputError, show
from spherloc.geometry import pose, transform
from spherloc.trajectory import rotation_from_wxyz
from spherloc.types import FloatArray, IntArray

MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5)),
    *(("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5)),
    *(("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6), ("EQUIRECTANGULAR", 2)),
)
"""Name and number of parameters of COLMAP's camera models, by id."""

SPHERE = (
    "has panoramas of the camera model SPHERE, which only the fork SphereSfM knows and whose id is another model's in "
    "COLMAP; make the model anew with COLMAP 4.1 or later and its camera model EQUIRECTANGULAR."
)

OBSERVATION = np.dtype([("pixel", "<f8", (2,)), ("point", "<i8")])
"""A keypoint's pixel (px) and the id of its point, -1 for none."""

Broken = Callable[[str], InputError]
"""Makes the error, which adds the file and the place in it to what is wrong."""

LARGEST = 1e12
"""Coordinates beyond this mean a damaged file, whatever the model's unit: computations with them would overflow."""

_NORM_TOLERANCE = 1e-3


RawCamera = tuple[str, int, int, tuple[float, ...]]
"""COLMAP's name of the camera model, width and height (px), and the parameters."""


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A posed image. Its observations are read when they are asked for."""

    name: str
    camera_id: int
    cam_from_map: FloatArray
    """Pose (3, 4), absolute, also for an image of a rig."""
    count: int
    """Number of observations."""
    load: Callable[[], NDArray[Any]]
    """The ``OBSERVATION`` records, (count,). Raises ``InputError`` if the file cannot be read any more."""

    @property
    def pixels(self) -> FloatArray:
        """(K, 2) all keypoints, with or without a point, in COLMAP's order. Raises ``InputError`` if unreadable."""
        return np.ascontiguousarray(self.load()["pixel"])

    @property
    def point_ids(self) -> NDArray[np.int64]:
        """(K,) the id of each keypoint's point, -1 for none. Raises ``InputError`` if unreadable."""
        return np.ascontiguousarray(self.load()["point"])

    def observed(self, model: "ColmapModel") -> tuple[FloatArray, FloatArray]:
        """Keypoints with a point: pixels (M, 2) and their points (M, 3). Raises ``InputError`` if unreadable."""
        observations = self.load()
        points = model.point_xyz(observations["point"])
        known = np.isfinite(points[:, 0])
        return observations["pixel"][known], points[known]


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """Columns of P points, by rising id."""

    ids: NDArray[np.int64]
    """(P,) ids of the points, rising."""
    xyz: FloatArray
    """(P, 3) positions in the model's unit, which is a metre if the model is scaled."""
    errors_px: FloatArray
    """(P,) mean reprojection error; -1 where COLMAP did not compute it."""
    track_lengths: NDArray[np.int64]
    """(P,) number of keypoints that see the point."""


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model, in columns."""

    folder: Path
    images: Mapping[str, ColmapImage]
    """Images with a pose, by name, in the order of names."""
    points: ModelPoints
    """All points, by rising id."""
    raw_cameras: Mapping[int, RawCamera]
    """Cameras as in the file, by camera id."""
    remarks: tuple[str, ...] = ()
    """What was left out and why, in sentences."""

    @cached_property
    def _cameras(self) -> dict[int, Camera | str]:
        return {}

    def camera(self, camera_id: int) -> Camera:
        """The camera of an id, converted when it is first asked for: a model with an unsupported camera is usable too.

        Raises ``CalibrationError``.
        """
        if camera_id not in self._cameras:
            name, width, height, params = self.raw_cameras[camera_id]
            where = f"{self.folder}, camera {camera_id}"
            self._cameras[camera_id] = _converted(name, width, height, params, where)
        camera = self._cameras[camera_id]
        if isinstance(camera, str):
            raise CalibrationError(camera)
        return camera

    def point_places(self, ids: NDArray[np.integer]) -> IntArray:
        """(K,) rows of the points with these ids (K,) in ``points``; -1 for ids that the model does not have."""
        if not len(self.points.ids):
            return np.full(len(ids), -1)
        place = np.minimum(np.searchsorted(self.points.ids, ids), len(self.points.ids) - 1)
        return np.where(self.points.ids[place] == ids, place, -1)

    def point_xyz(self, ids: NDArray[np.integer]) -> FloatArray:
        """(K, 3) positions of points, metres; NaN for -1 and for ids that the model does not have."""
        places = self.point_places(ids)
        xyz = np.full((len(ids), 3), np.nan)
        xyz[places >= 0] = self.points.xyz[places[places >= 0]]
        return xyz


def _converted(name: str, width: int, height: int, params: tuple[float, ...], where: str) -> Camera | str:
    try:
        return camera_from_colmap(name, width, height, params, where)
    except CalibrationError as error:
        return str(error)


@dataclass(eq=False)
class ModelParts:
    """What was read so far. Each method adds one record; ``broken`` makes the error if the record cannot be right."""

    cameras: dict[int, RawCamera] = field(default_factory=dict)
    """Cameras by camera id."""
    rigs: dict[int, dict[int, FloatArray | None]] = field(default_factory=dict)
    """By rig id and camera id, the pose (3, 4) of the camera in the rig; None where the rig leaves it open."""
    frames: dict[int, tuple[int, FloatArray | None]] = field(default_factory=dict)
    """Camera id and pose (3, 4) of each image that a frame lists, by image id; None where the rig leaves it open."""
    images: dict[int, ColmapImage] = field(default_factory=dict)
    """Images by image id, without those that have no pose."""
    counts: dict[int, int] = field(default_factory=dict)
    """Number of observations by image id, of all images."""
    names: set[str] = field(default_factory=set)
    """Names of all images."""
    points: ModelPoints = field(init=False)
    """The points; set when they are read, which is last."""

    def camera(self, number: int, camera: RawCamera, broken: Broken) -> None:
        """Add a camera."""
        if number in self.cameras:
            raise broken(f"camera {number} is there twice")
        if not np.isfinite(camera[3]).all():
            raise broken(f"a parameter of camera {number} is not a finite number")
        self.cameras[number] = camera

    def rig(self, number: int, sensors: Sequence[tuple[int, FloatArray | None]], broken: Broken) -> None:
        """Add a rig with its cameras, each with its pose (3, 4) in the rig; None where that is open."""
        cameras = dict(sensors)
        if number in self.rigs:
            raise broken(f"rig {number} is there twice")
        if len(cameras) < len(sensors) or not self.cameras.keys() >= cameras.keys():
            raise broken(f"rig {number} has a camera twice, or one that is not among the cameras")
        self.rigs[number] = cameras

    def frame(
        self, number: int, rig: int, rig_from_map: FloatArray, images: Sequence[tuple[int, int]], broken: Broken
    ) -> None:
        """Add a frame of a rig with its pose (3, 4) and pairs of a camera id and an image id."""
        if rig not in self.rigs:
            raise broken(f"frame {number} is of rig {rig}, which is not among the rigs")
        for camera, image in images:
            if camera not in self.rigs[rig]:
                raise broken(f"frame {number} has an image of camera {camera}, which is not in its rig {rig}")
            if image in self.frames:
                raise broken(f"image {image} is in two frames")
            cam_from_rig = self.rigs[rig][camera]
            if cam_from_rig is None:
                self.frames[image] = camera, None
            else:
                position = transform(cam_from_rig, rig_from_map[None, :, 3])[0]
                self.frames[image] = camera, pose(cam_from_rig[:, :3] @ rig_from_map[:, :3], position)

    def image(self, number: int, image: ColmapImage, broken: Broken) -> None:
        """Add an image, whose observations have been checked; a frame's pose replaces the image's own."""
        if number in self.counts:
            raise broken(f"image {number} is there twice")
        if not image.name:
            raise broken(f"image {number} has no name")
        if image.name in self.names:
            raise broken(f"two images have the name {show(image.name)}; give every image a name of its own")
        if image.camera_id not in self.cameras:
            raise broken(f"image {number} has the camera {image.camera_id}, which is not among the cameras")
        self.counts[number] = image.count
        self.names.add(image.name)
        if not self.rigs:
            self.images[number] = image
            return
        camera, cam_from_map = self.frames.get(number, (None, None))
        if camera != image.camera_id:
            raise broken(f"no frame has image {number} with its camera {image.camera_id}")
        if cam_from_map is not None:
            self.images[number] = replace(image, cam_from_map=cam_from_map)

    @cached_property
    def _keypoints(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ids of the images, rising, and their numbers of keypoints; used once all images are read."""
        known = sorted(self.counts)
        return np.array(known, dtype=np.int64), np.array([self.counts[number] for number in known], dtype=np.int64)

    def tracks(self, image_ids: NDArray[np.int64], places: NDArray[np.int64], broken: Broken) -> None:
        """Check the keypoints that see points: image ids (T,) and indices among the image's keypoints (T,)."""
        known, counts = self._keypoints
        index = np.searchsorted(known, image_ids)
        there = index < len(known)
        there[there] = known[index[there]] == image_ids[there]
        there[there] = places[there] < counts[index[there]]
        if not there.all():
            first = int(np.flatnonzero(~there)[0])
            raise broken(f"a point has keypoint {places[first]} of image {image_ids[first]}, which does not exist")


def make_points(ids: ArrayLike, xyz: ArrayLike, errors_px: ArrayLike, track_lengths: ArrayLike) -> ModelPoints:
    """Columns in the order of ids."""
    numbers = np.asarray(ids, dtype=np.int64)
    order = np.argsort(numbers, kind="stable")
    return ModelPoints(
        ids=numbers[order],
        xyz=np.asarray(xyz, dtype=np.float64).reshape(-1, 3)[order],
        errors_px=np.asarray(errors_px, dtype=np.float64)[order],
        track_lengths=np.asarray(track_lengths, dtype=np.int64)[order],
    )


def read_pose(numbers: Sequence[float], broken: Broken, what: str) -> FloatArray:
    """Pose (3, 4) from a unit quaternion, w first, and a translation; raises what ``broken`` makes for others."""
    values = np.asarray(numbers, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        norm = float(np.linalg.norm(values[:4]))
    if not ((np.abs(values) <= LARGEST).all() and abs(norm - 1.0) <= _NORM_TOLERANCE):
        raise broken(f"the pose of {what} is {show(list(numbers))}, not a unit quaternion and a possible translation")
    return pose(rotation_from_wxyz(values[:4]), values[4:])


def check_observations(observations: NDArray[Any], broken: Broken, what: str) -> None:
    """Raise what ``broken`` makes unless all ``OBSERVATION`` records have a finite pixel and a possible point."""
    possible = (np.abs(observations["pixel"]) <= LARGEST).all(axis=1) & (observations["point"] >= -1)
    if not possible.all():
        first = int(np.flatnonzero(~possible)[0]) + 1
        raise broken(f"observation {first} of {what} has no possible pixel or point")
