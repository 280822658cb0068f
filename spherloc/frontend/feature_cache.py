"""Keeps the features of an image on disk, by all that they depend on."""

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spherloc.disk_cache import cache_folder, key_of, make_room_once, store, used
from spherloc.files import read_file
from spherloc.frontend.feature_kinds import Descriptors
from spherloc.images import MAX_BYTES
from spherloc.types import BoolArray, FloatArray

VERSION = 2
"""Raised when the same options give other features, so that old files are not taken for them."""

_DAMAGED = (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error, NotImplementedError)


def feature_file(image: Path, usable: BoolArray, options: Any, seam: bool) -> Path | None:
    """Where the features of an image are kept: named by its content, its usable pixels (H, W) and the options.

    None if a file cannot be read: whoever needs it says so.
    """
    contents = [_content(file) for file in (image, options.weights) if file is not None]
    if any(content is None for content in contents):
        return None
    said = (VERSION, cv2.__version__, options.method, options.max_features, seam, usable.shape)
    return cache_folder("features") / f"{key_of(said, np.packbits(usable).tobytes(), *contents)}.npz"


def keep(path: Path, table: FloatArray, descriptors: Descriptors) -> None:
    """Store keypoints (N, 5) and descriptors (N, D)."""
    make_room_once(path.parent)
    content = io.BytesIO()
    np.savez(content, table=table, descriptors=descriptors)
    store(path, content.getvalue())


def fetch(path: Path) -> tuple[FloatArray, Descriptors] | None:
    """What ``keep`` stored; None if there is nothing, or a damaged file."""
    content = _content(path)
    if content is None:
        return None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:  # before numpy believes a damaged header
                return None
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            table, descriptors = stored["table"], stored["descriptors"]
    except _DAMAGED:
        return None
    whole = table.dtype == np.float64 and descriptors.dtype in (np.float32, np.uint8) and descriptors.ndim == 2
    if not whole or table.shape != (len(descriptors), 5):
        return None
    used(path)
    return table, descriptors


def _content(path: Path) -> bytes | None:
    try:
        return read_file(path, MAX_BYTES)
    except OSError:
        return None
