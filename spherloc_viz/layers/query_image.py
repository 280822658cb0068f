"""The query image for display: read once and cached, and converted to a panorama for the unit sphere."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.images import read_image
from spherloc.problem import Problem
from spherloc.types import FloatArray

MAX_PIXELS = 4_000_000
"""Number of pixels to which larger photographs are shrunk, so that cached ones take little memory."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """An image for the screen."""

    image: NDArray[np.uint8]
    """(H, W, 3) sRGB, read-only."""
    scale: float
    """Ratio of its width to that of the file's image."""


def photograph(path: Path | None) -> Photograph | None:
    """The image of that file (cached until the file changes); None without one, or if it cannot be read any more."""
    if path is None:
        return None
    try:
        return _read(path, modified(path))
    except InputError:
        return None


def modified(path: Path) -> int:
    """When a file was last written, ns; 0 if it has gone."""
    try:
        return path.stat().st_mtime_ns
    except (OSError, ValueError):
        return 0


@lru_cache(maxsize=8)
def _read(path: Path, changed_ns: int) -> Photograph:
    """The image of a file; ``changed_ns`` is part of the cache's key, so that a changed file is read again."""
    image = read_image(path)
    height, width = image.shape[:2]
    scale = min(1.0, (MAX_PIXELS / (width * height)) ** 0.5)
    image = shrunk(image, scale)
    rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB), np.uint8)
    rgb.setflags(write=False)
    return Photograph(rgb, image.shape[1] / width)


def shrunk(image: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    """The image at a scale of at most 1, without aliasing."""
    if scale >= 1.0:
        return image
    height, width = image.shape[:2]
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


PANORAMA = Equirectangular(1024, 512)
DIM = 0.7
"""Factor of the photograph's brightness, so that dots stand out on it."""
UNSEEN = 96
"""Grey level of directions that the camera does not see."""
SHARPNESS = 1.5
"""Least number of photograph pixels per panorama pixel: with fewer it would blur, with many more it would flicker."""


def sphere_texture(problem: Problem) -> NDArray[np.uint8] | None:
    """The query image (H, W, 3) sRGB, dimmed, by longitude and latitude of the aligned camera frame; None without one.

    Its pixels are those of the equirectangular model: the middle column looks along +z of the aligned frame, +x is to
    its right, and the lowest row looks down. Cached by image and camera; read-only.
    """
    if problem.image is None:
        return None
    turn = problem.aligned.camera_turn
    density = 1.0 / float(np.median(problem.aligned.radians_per_pixel))
    return _texture(problem.image, modified(problem.image), problem.camera, turn.tobytes(), round(density, 3))


@lru_cache(maxsize=8)
def _texture(path: Path, changed_ns: int, camera: Camera, turn: bytes, density: float) -> NDArray[np.uint8] | None:
    """The texture; ``density`` is the camera's number of pixels per radian, ``turn`` the bytes of ``camera_turn``."""
    photo = photograph(path)
    if photo is None:
        return None
    panorama_density = PANORAMA.width / (2.0 * np.pi)
    image = shrunk(photo.image, SHARPNESS * panorama_density / (density * photo.image.shape[1] / camera.width))
    seen, x, y = _map(camera, np.frombuffer(turn).reshape(3, 3), image.shape[1], image.shape[0])
    # Both sides of a panorama's seam are the same place; beside any other border nothing is seen.
    border = cv2.BORDER_WRAP if isinstance(camera, Equirectangular) else cv2.BORDER_REPLICATE
    texture = np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border), np.uint8)
    texture = np.asarray(cv2.convertScaleAbs(texture, alpha=DIM), np.uint8)
    texture[~seen] = UNSEEN
    texture.setflags(write=False)
    return texture


def _map(camera: Camera, turn: FloatArray, width: int, height: int) -> tuple[NDArray, NDArray, NDArray]:
    """For each pixel of the panorama whether the camera sees it, and where (OpenCV's x and y) in its image, now
    ``width`` x ``height``."""
    pixels, valid = camera.project(_directions() @ turn)
    u, v = np.ascontiguousarray(pixels.T, dtype=np.float32)
    with np.errstate(invalid="ignore"):
        seen = valid & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
    x = np.where(seen, u * np.float32(width / camera.width) - np.float32(0.5), np.float32(0.0))
    y = np.where(seen, v * np.float32(height / camera.height) - np.float32(0.5), np.float32(0.0))
    np.clip(y, 0.0, height - 1.0, out=y)
    shape = (PANORAMA.height, PANORAMA.width)
    return seen.reshape(shape), x.reshape(shape), y.reshape(shape)


@lru_cache(maxsize=1)
def _directions() -> FloatArray:
    """Unit vectors (H W, 3) of the panorama's pixels, row by row."""
    columns, rows = np.meshgrid(np.arange(PANORAMA.width) + 0.5, np.arange(PANORAMA.height) + 0.5)
    places: FloatArray = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    bearings, _ = PANORAMA.unproject(places)
    bearings.setflags(write=False)
    return bearings
