"""Learned features and matching through OpenCV 5, with the weight files (ONNX) that the user gives."""

import os
import subprocess
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.errors import MAX_REASON, InputError, shorten
from spherloc.files import open_file, reading
from spherloc.types import ByteArray, FloatArray

ALIKED_INPUT_PX = 640
DISK_INPUT_PX = 1024
"""Width and height of these networks' input: OpenCV scales images to it, and the published files are made for it."""

_CREATE = {"ALIKED": "ALIKED_create", "DISK": "DISK_create", "LightGlue": "LightGlueMatcher_create"}

TRIAL_S = 120.0
_TRIAL = """
import sys, cv2, numpy as np
network = getattr(cv2, sys.argv[1])(sys.argv[2])
if hasattr(network, "detectAndCompute"):
    network.detectAndCompute(np.zeros((64, 64, 3), np.uint8), None)
"""
"""Script that loads a network and, if it finds features, runs it once; the parent process reports its errors."""

_one_at_a_time = Lock()
"""Held during a run: OpenCV's networks keep the state of a run, and all threads share them."""


def aliked(image: ByteArray, _mask: ByteArray, _most: int, weights: Path | None) -> tuple[FloatArray, Any]:
    """ALIKED features (Zhao et al. 2023) of an image: keypoints (N, 5) as in ``feature_kinds.detect``, descriptors.

    The mask is not used: OpenCV's ALIKED takes none. Raises ``InputError`` if the file is not a network of ALIKED.
    """
    rows, descriptors = _detect("ALIKED", weights, image, None)
    # The network's -1 and 1 are the centres of the first and the last pixel; OpenCV takes them for the image's borders.
    scale = np.array(image.shape[1::-1]) / ALIKED_INPUT_PX
    rows[:, :2] = rows[:, :2] * (ALIKED_INPUT_PX - 1) / ALIKED_INPUT_PX + 0.5 * scale
    return rows, descriptors


def disk(image: ByteArray, mask: ByteArray, _most: int, weights: Path | None) -> tuple[FloatArray, Any]:
    """DISK features (Tyszkiewicz et al. 2020), returned as by ``aliked``."""
    rows, descriptors = _detect("DISK", weights, image, mask)
    rows[:, :2] += 0.5 * np.array(image.shape[1::-1]) / DISK_INPUT_PX  # the centre of a pixel of the network
    return rows, descriptors


def lightglue(
    weights: Path | None,
    query: tuple[FloatArray, NDArray[np.float32], tuple[int, int]],
    reference: tuple[FloatArray, NDArray[np.float32], tuple[int, int]],
) -> NDArray[np.int64]:
    """Index pairs (K, 2) that LightGlue (Lindenberger et al. 2023) finds between two images with features of ALIKED.

    Each image is given by pixels (N, 2), descriptors (N, D) and its size (width, height). Raises ``InputError`` if
    the file is not a network of LightGlue for such descriptors.
    """
    (pixels, descriptors, size), (other_pixels, other_descriptors, other_size) = query, reference
    matcher = _network("LightGlue", weights)
    with _one_at_a_time:
        try:
            matcher.setPairInfo(pixels.astype(np.float32), other_pixels.astype(np.float32), size, other_size)
            found = matcher.match(descriptors, other_descriptors)
        except cv2.error as error:
            raise _refusal("LightGlue", weights, error) from None
    return np.array([(match.queryIdx, match.trainIdx) for match in found], np.int64).reshape(-1, 2)


def _detect(name: str, weights: Path | None, image: ByteArray, mask: ByteArray | None) -> tuple[FloatArray, Any]:
    network = _network(name, weights)
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    with _one_at_a_time:
        try:
            keypoints, descriptors = network.detectAndCompute(colour, mask)
        except cv2.error as error:
            raise _refusal(name, weights, error) from None
    rows = np.array([(*point.pt, point.size, 0.0, point.response) for point in keypoints], np.float64).reshape(-1, 5)
    return rows, descriptors


def _network(name: str, weights: Path | None) -> Any:
    if weights is None:
        raise InputError(f"{name} needs a file of weights; give its ONNX file as weights.")
    create = getattr(cv2, _CREATE[name], None)
    if create is None:
        raise InputError(
            f"{name} is not in this OpenCV ({cv2.__version__}); install OpenCV 5 (opencv-python-headless>=5), or take "
            "the features 'sift' with the matching 'nearest'."
        )
    with reading(weights, f"give the ONNX file of {name}"), open_file(weights) as file:
        status = os.fstat(file.fileno())
    return _loaded(name, create, weights, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=3)
def _loaded(name: str, create: Callable[[str], Any], weights: Path, _changed: int, _size: int) -> Any:
    _try_in_child(name, weights)
    try:
        return create(str(weights))
    except cv2.error as error:
        raise _refusal(name, weights, error) from None


def _try_in_child(name: str, weights: Path) -> None:
    """Raise ``InputError`` if a damaged file crashes or blocks a child process, as some do with OpenCV 5.0."""
    command = [sys.executable, "-c", _TRIAL, _CREATE[name], str(weights)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=TRIAL_S, check=False)
    except subprocess.TimeoutExpired:
        raise InputError(f"{weights}: OpenCV takes too long to load it; give an ONNX file of {name}.") from None
    if done.returncode < 0:
        raise InputError(f"{weights}: OpenCV crashes on it, so it is damaged; give an ONNX file of {name}.")


def _refusal(name: str, weights: Path | None, error: cv2.error) -> InputError:
    said = shorten(" ".join(str(getattr(error, "err", error)).split()), MAX_REASON)
    return InputError(f"{weights}: OpenCV cannot use it for {name} ({said}); give an ONNX file of {name}.")
