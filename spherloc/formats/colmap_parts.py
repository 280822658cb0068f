"""What the walks through a COLMAP model's files, binary or text, collect and check.

COLMAP's own reader takes a truncated file for a shorter one, believes every count, and passes NaN on. So a walk goes
first, and says where what is wrong. On its way it collects the columns of observations and points, for which COLMAP has
an object each. Layout: doc/format.rst of COLMAP 4.2.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spherloc.errors import InputError, show
from spherloc.types import FloatArray

MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5)),
    *(("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5)),
    *(("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6), ("EQUIRECTANGULAR", 2)),
)
"""Name and number of parameters of COLMAP's camera models, by id."""

ORDER = ("cameras", "rigs", "frames", "images", "points3D")
"""Files in an order in which each refers only to what was read before it. Rigs and frames came with COLMAP 3.12."""

SPHERE = (
    "has panoramas of the camera model SPHERE, which only the fork SphereSfM knows and whose id is another model's in "
    "COLMAP; make the model anew with COLMAP 4.1 or later and its camera model EQUIRECTANGULAR."
)

OBSERVATION = np.dtype([("pixel", "<f8", (2,)), ("point", "<i8")])
"""A pixel and the id of its point, -1 for none."""

Broken = Callable[[str], InputError]
"""Makes the error that says at which place of which file what is wrong."""

LARGEST = 1e12
"""Coordinates beyond this are damage, whatever the model's unit: what is computed from them would overflow."""

_NORM_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Observed:
    """An image as its file has it."""

    name: str
    camera_id: int
    count: int
    """Number of observations."""
    load: Callable[[], NDArray[Any]]
    """The ``OBSERVATION`` records, (count,). Raises ``InputError`` if the file cannot be read any more."""


@dataclass(frozen=True, eq=False)
class Points:
    """Columns of P points, by rising id."""

    ids: NDArray[np.int64]
    """(P,)"""
    xyz: FloatArray
    """(P, 3), in the model's unit, metres if it is scaled."""
    errors_px: FloatArray
    """(P,) mean reprojection error; -1 where COLMAP did not compute it."""
    track_lengths: NDArray[np.int64]
    """(P,) number of keypoints that see the point."""


def make_points(ids: ArrayLike, xyz: ArrayLike, errors_px: ArrayLike, track_lengths: ArrayLike) -> Points:
    """Columns in the order of ids."""
    numbers = np.asarray(ids, dtype=np.int64)
    order = np.argsort(numbers, kind="stable")
    return Points(
        ids=numbers[order],
        xyz=np.asarray(xyz, dtype=np.float64).reshape(-1, 3)[order],
        errors_px=np.asarray(errors_px, dtype=np.float64)[order],
        track_lengths=np.asarray(track_lengths, dtype=np.int64)[order],
    )


@dataclass(eq=False)
class ModelParts:
    """What was found so far. Its methods take what a file says next; ``broken`` makes the error if it cannot be."""

    cameras: set[int] = field(default_factory=set)
    rigs: dict[int, set[int]] = field(default_factory=dict)
    """Camera ids by rig id."""
    camera_of_image: dict[int, int] = field(default_factory=dict)
    """Camera id by image id, of the images that a frame lists."""
    images: dict[int, Observed] = field(default_factory=dict)
    """By id."""
    points: Points = field(default_factory=lambda: make_points([], [], [], []))

    def camera(self, number: int, params: Sequence[float], broken: Broken) -> None:
        """A camera."""
        if number in self.cameras:
            raise broken(f"camera {number} is there twice")
        if not np.isfinite(params).all():
            raise broken(f"a parameter of camera {number} is not a finite number")
        self.cameras.add(number)

    def rig(self, number: int, cameras: Sequence[int], broken: Broken) -> None:
        """A rig and the cameras among its sensors."""
        if number in self.rigs:
            raise broken(f"rig {number} is there twice")
        if len(set(cameras)) < len(cameras) or not self.cameras.issuperset(cameras):
            raise broken(f"rig {number} has a camera twice, or one that is not among the cameras")
        self.rigs[number] = set(cameras)

    def frame(self, number: int, rig: int, images: Sequence[tuple[int, int]], broken: Broken) -> None:
        """A frame of a rig with pairs of a camera id and an image id."""
        if rig not in self.rigs:
            raise broken(f"frame {number} is of rig {rig}, which is not among the rigs")
        for camera, image in images:
            if camera not in self.rigs[rig]:
                raise broken(f"frame {number} has an image of camera {camera}, which is not in its rig {rig}")
            if image in self.camera_of_image:
                raise broken(f"image {image} is in two frames")
            self.camera_of_image[image] = camera

    def image(self, number: int, image: Observed, broken: Broken) -> None:
        """An image; its observations have been checked."""
        if number in self.images:
            raise broken(f"image {number} is there twice")
        if not image.name:
            raise broken(f"image {number} has no name")
        if image.camera_id not in self.cameras:
            raise broken(f"image {number} has the camera {image.camera_id}, which is not among the cameras")
        if self.rigs and self.camera_of_image.get(number) != image.camera_id:
            raise broken(f"no frame has image {number} with its camera {image.camera_id}")
        self.images[number] = image

    @cached_property
    def _keypoints(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ids of the images, rising, and their numbers of keypoints; asked for once all images are there."""
        known = sorted(self.images)
        counts = [self.images[number].count for number in known]
        return np.array(known, dtype=np.int64), np.array(counts, dtype=np.int64)

    def tracks(self, image_ids: NDArray[np.int64], places: NDArray[np.int64], broken: Broken) -> None:
        """Which keypoints see some of the points: image ids (T,) and places among the image's keypoints (T,)."""
        known, counts = self._keypoints
        index = np.searchsorted(known, image_ids)
        there = index < len(known)
        there[there] = known[index[there]] == image_ids[there]
        there[there] = places[there] < counts[index[there]]
        if not there.all():
            first = int(np.flatnonzero(~there)[0])
            raise broken(f"a point has keypoint {places[first]} of image {image_ids[first]}, which does not exist")


def check_pose(numbers: Sequence[float], broken: Broken, what: str) -> None:
    """Raise what ``broken`` makes unless ``numbers`` are a unit quaternion and a finite translation."""
    values = np.asarray(numbers, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        length = float(np.linalg.norm(values[:4]))
    if not ((np.abs(values) <= LARGEST).all() and abs(length - 1.0) <= _NORM_TOLERANCE):
        raise broken(f"the pose of {what} is {show(list(numbers))}, no unit quaternion and possible translation")


def check_observations(observations: NDArray[Any], broken: Broken, what: str) -> None:
    """Raise what ``broken`` makes unless all ``OBSERVATION`` records have a finite pixel and a possible point."""
    possible = (np.abs(observations["pixel"]) <= LARGEST).all(axis=1) & (observations["point"] >= -1)
    if not possible.all():
        first = int(np.flatnonzero(~possible)[0]) + 1
        raise broken(f"observation {first} of {what} has no possible pixel or point")
