"""The query image as a panorama of the gravity-aligned camera frame: what the unit sphere wears."""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.problem import Problem
from spherloc.types import FloatArray
from spherloc_viz.layers.photograph import modified, photograph, shrunk

PANORAMA = Equirectangular(1024, 512)
DIM = 0.7
"""Brightness that the photograph keeps, so that dots stand out on it."""
UNSEEN = 96
"""Grey of what the camera does not see."""
SHARPNESS = 1.5
"""Pixels of the photograph by those of the panorama, at least: fewer would blur, many more would glitter."""


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
    """``density`` is how many pixels of the camera a radian takes; ``turn`` holds ``camera_turn``."""
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
