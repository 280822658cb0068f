"""An image with its camera, pose, gravity and mask, as far as known: loaders make it and the front end works on it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.errors import InputError
from spherloc.images import read_image
from spherloc.types import BoolArray, ByteArray, FloatArray

PIXELS_AT_ONCE = 200_000
"""Number of pixels that are unprojected at once: a large panorama as a whole would take gigabytes."""


class Lift(Protocol):
    """Gives pixels of a reference image their map points."""

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Map points (N, 3), metres, of pixels (N, 2), and a mask (N,) of those that have one; others are NaN.

        Loads what it needs when it is first called, and raises ``InputError`` if that cannot be read.
        """
        ...


@dataclass(frozen=True, eq=False)
class Gravity:
    """Gravity in the camera frame of one image, with its uncertainty and its source."""

    down: FloatArray
    """Unit vector (3,), camera frame."""
    source: str
    """Where it comes from, in a few words, such as "the IMU" or "lines of the image"."""
    bound_rad: float | None = None
    """Bound on the angular error of ``down``; None takes the scene's."""
    sd_rad: float | None = None
    """Standard deviation of each of its two tilts; None takes a third of the bound."""
    by_map: bool = False
    """Whether it was computed from a pose and the map's gravity, whose error then does not add to its own."""


@dataclass(frozen=True, eq=False)
class View:
    """One image of a map or of a query sequence. Cheap to make: pixels and depths are read when they are asked for."""

    name: str
    """Unique within its scene, such as "image_02/0000000386.png"."""
    camera: Camera
    path: Path
    """The image file."""
    cam_from_map: FloatArray | None = None
    """Pose (3, 4): a reference's known pose, or a query's true one; None if unknown."""
    gravity: Gravity | None = None
    """Gravity in the camera frame, if it was measured."""
    timestamp_s: float | None = None
    """When it was taken, seconds."""
    lift: Lift | None = None
    """Gives map points to a reference's pixels; None if there are none."""
    mask: Callable[[], BoolArray] | None = None
    """Loads the mask (H, W) of the pixels that may be used; None for all that the camera model can see."""

    def read(self) -> ByteArray:
        """The image, (H, W, 3) BGR or (H, W) grey; read again at each call, since a sequence would fill the memory.

        Raises ``InputError`` if the file cannot be read or has another size than the calibration.
        """
        image = read_image(self.path)
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise InputError(
                f"{self.path}: is {image.shape[1]} x {image.shape[0]} pixels, but its calibration is for "
                f"{self.camera.width} x {self.camera.height}; give the calibration of this image."
            )
        return image

    def make_file(self) -> None:
        """Make the image file if it does not exist yet, such as that of a rendered image."""

    def usable_pixels(self) -> BoolArray:
        """(H, W): pixels that the camera model can see and that ``mask`` allows.

        Raises ``InputError`` if the mask cannot be read or has another size than the image.
        """
        seen = seen_pixels(self.camera)
        if self.mask is None:
            return seen
        allowed = self.mask()
        if allowed.shape != seen.shape:
            raise InputError(
                f"{self.name}: its mask is {allowed.shape[1]} x {allowed.shape[0]} pixels, the image "
                f"{seen.shape[1]} x {seen.shape[0]}; give a mask of the image's size."
            )
        return seen & allowed


@lru_cache(maxsize=8)
def seen_pixels(camera: Camera) -> BoolArray:
    """(H, W), read-only: pixels whose centre the camera model can see."""
    columns = np.arange(camera.width) + 0.5
    seen = np.empty((camera.height, camera.width), dtype=bool)
    rows = max(1, PIXELS_AT_ONCE // camera.width)
    for top in range(0, camera.height, rows):
        block = np.arange(top, min(top + rows, camera.height)) + 0.5
        u, v = np.meshgrid(columns, block)
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        seen[top : top + rows] = camera.unproject(pixels)[1].reshape(u.shape)
    seen.setflags(write=False)
    return seen


@dataclass(frozen=True, eq=False)
class Matches:
    """2D-3D correspondences of one query image, as a front end found them."""

    pixels: FloatArray
    """(N, 2) in the query image."""
    points: FloatArray
    """(N, 3), map frame, metres."""
    references: tuple[View, ...]
    """Reference images that were matched, the most similar one first."""
    reference_index: NDArray[np.int64]
    """(N,) index into ``references``."""
    reference_pixels: FloatArray
    """(N, 2) in the reference image; NaN where unknown."""
    estimated_outlier_rate: float | None = None
    """Outlier rate, 0 to 1, estimated from the statistics of the matches; None if unknown."""
    remarks: tuple[str, ...] = ()
    """What was skipped and why, in sentences."""
    verified_without_point: int = 0
    """Matches that agree with the motion between the query and a reference, but have no point in the map; counted only
    where few have one."""


Report = Callable[[int, int], None]
"""Called with the number of pieces of a long job that are done, and with their total number."""


@runtime_checkable
class NeedsPreparing(Protocol):
    """A matcher with work to do once for all queries; without ``prepare`` the first query would wait for it."""

    def prepare(self, report: Report) -> None:
        """Do this work, if it is not done; errors are reported with each query instead."""
        ...


class Matcher(Protocol):
    """Finds the 2D-3D correspondences of a query image."""

    def __call__(self, query: View) -> Matches:
        """The correspondences. Raises ``InputError`` if the query image cannot be read or has no features; a reference
        that cannot be used becomes a remark."""
        ...
