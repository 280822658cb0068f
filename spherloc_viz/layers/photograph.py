"""Photographs of a problem, read once and kept: for the sphere, the image panel and enlarged keypoints."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError
from spherloc.images import read_image

MOST_PIXELS = 4_000_000
"""Larger photographs are shrunk to this many pixels, so that those that are kept take little memory."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """An image for the screen."""

    image: NDArray[np.uint8]
    """(H, W, 3) sRGB, read-only."""
    scale: float
    """Its pixels by those of the file."""


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
    """``changed_ns`` has a file that was written anew read anew."""
    image = read_image(path)
    height, width = image.shape[:2]
    scale = min(1.0, (MOST_PIXELS / (width * height)) ** 0.5)
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
