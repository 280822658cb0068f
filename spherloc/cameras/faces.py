"""Virtual pinhole images of a panorama: faces, for programs and networks that know only flat images.

The faces look at the twelve corners of an icosahedron with one corner straight up. Each direction belongs to the face
whose axis is nearest; that is at most 37.4 degrees away, so that a face's stretching stays below 1.6. All faces but the
two at the poles are upright in the image, so that level cameras see the same thing the same way up.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import atan, ceil, cos, pi, radians, sin, tan, tau

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.types import BoolArray, ByteArray, FloatArray

FloatImage = NDArray[np.float32]

FIELD_OF_VIEW_DEG = 80.0
"""Width and height of each face: the directions that belong to it and a border of at least two degrees."""
RIM_PX = 2
"""Width of the rim that a face shares with its neighbours, in its pixels: a feature between two faces is then found by
one of them, even if each places it a little outside itself."""


@dataclass(frozen=True, eq=False)
class Faces:
    """F square pinhole images of one panorama."""

    panorama: Equirectangular
    face_from_camera: FloatArray
    """(F, 3, 3) rotations from the panorama's frame to the faces', whose +z is the axis and +y is down."""
    size_px: int
    """Width and height of a face."""
    focal_px: float
    """Focal length, px; the principal point is the centre of the face, (size_px / 2, size_px / 2)."""

    def __len__(self) -> int:
        return len(self.face_from_camera)

    def bearings(self, face: int, pixels: FloatArray) -> FloatArray:
        """Unit bearings (N, 3) in the panorama's frame of pixels (N, 2) of a face."""
        flat = (pixels - self.size_px / 2) / self.focal_px
        rays = np.column_stack([flat, np.ones(len(flat))]) @ self.face_from_camera[face]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def nearest(self, bearings: FloatArray) -> NDArray[np.int64]:
        """Indices (N,) of the faces to which bearings (N, 3) belong."""
        return (bearings @ self.face_from_camera[:, 2].T).argmax(axis=1)

    def cut(self, face: int, image: ByteArray, usable: ByteArray) -> tuple[ByteArray, ByteArray, BoolArray]:
        """A face of a panorama (H, W) or (H, W, 3), whose usable pixels are those where ``usable`` (H, W) is not zero.

        Returns the face's image and its usable pixels, ``size_px`` wide and high, and the mask of the pixels that
        belong to it, with a rim of ``RIM_PX`` that belongs to its neighbours too. The given image may have another size
        than the panorama's camera.
        """
        u, v, own = _lookup(self, face, usable.shape[1], usable.shape[0])
        drawn = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        allowed = cv2.remap(usable, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP)
        return np.asarray(drawn, np.uint8), np.asarray(allowed, np.uint8), own


@lru_cache(maxsize=12)
def _lookup(faces: Faces, face: int, width: int, height: int) -> tuple[FloatImage, FloatImage, BoolArray]:
    """Columns and rows (S, S) in an image, as OpenCV counts them, of a face's pixels, and the mask of its own
    pixels with the rim."""
    centres = np.arange(faces.size_px) + 0.5
    grid = np.column_stack([part.ravel() for part in np.meshgrid(centres, centres)]).astype(np.float64)
    bearings = faces.bearings(face, grid)
    pixels, _ = Equirectangular(width, height).project(bearings)
    shape = (faces.size_px, faces.size_px)
    # OpenCV's first pixel has its centre at 0; rows end at the poles, columns wrap around.
    u = (pixels[:, 0] - 0.5).astype(np.float32).reshape(shape)
    v = (pixels[:, 1] - 0.5).clip(0, height - 1).astype(np.float32).reshape(shape)
    own = (faces.nearest(bearings) == face).reshape(shape).astype(np.uint8)
    return u, v, cv2.dilate(own, np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)).astype(bool)


@lru_cache(maxsize=8)
def panorama_faces(panorama: Equirectangular, sharpness: float, most_pixels: int) -> Faces:
    """The faces of a panorama.

    ``sharpness`` is the number of pixels at a face's centre per pixel of the panorama's horizon, along one axis; it is
    lowered so that all faces together have at most ``most_pixels``.
    """
    half = tan(radians(FIELD_OF_VIEW_DEG / 2))
    rotations = np.stack([_upright(latitude, longitude) for latitude, longitude in _ICOSAHEDRON])
    rotations.setflags(write=False)
    size = min(2 * half * sharpness * panorama.width / tau, (most_pixels / len(rotations)) ** 0.5 - 1)
    return Faces(panorama, rotations, max(1, ceil(size)), size / (2 * half))


_BELT = atan(0.5)
"""Latitude of the ten corners of an icosahedron that are not at its poles."""
_ICOSAHEDRON = (
    (pi / 2, 0.0),
    *((_BELT, tau * k / 5) for k in range(5)),
    *((-_BELT, tau * (k + 0.5) / 5) for k in range(5)),
    (-pi / 2, 0.0),
)
"""Latitudes and longitudes of the axes, rad."""


def _upright(latitude: float, longitude: float) -> FloatArray:
    """Rotation (3, 3) to the face that looks in that direction, with its columns along the panorama's meridian."""
    east = np.array([cos(longitude), 0.0, -sin(longitude)])
    axis = np.array([cos(latitude) * sin(longitude), -sin(latitude), cos(latitude) * cos(longitude)])
    return np.stack([east, np.cross(axis, east), axis])
