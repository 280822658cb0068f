"""Photographs as JPEG in the page's own text, small enough to be sent while a person waits."""

import base64
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc_viz.layers.photograph import modified, photograph, shrunk

QUALITIES = (82, 70, 55, 40)
MOST_BYTES = 85_000
"""A JPEG is encoded with less quality while it is larger; as text it takes a third more."""


def photo_uri(path: Path | None, width_px: int) -> str | None:
    """The image of a file, at most that wide, as a data URI (cached); None without one."""
    return None if path is None else _photo_uri(path, modified(path), width_px)


@lru_cache(maxsize=16)
def _photo_uri(path: Path, changed_ns: int, width_px: int) -> str | None:
    photo = photograph(path)
    return None if photo is None else jpeg_uri(shrunk(photo.image, width_px / photo.image.shape[1]))


def jpeg_uri(image: NDArray[np.uint8]) -> str:
    """An image (H, W, 3) sRGB as a data URI."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    data = b""
    for quality in QUALITIES:
        data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= MOST_BYTES:
            break
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
