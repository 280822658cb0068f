"""The kinds of local features: how OpenCV detects each, and what its keypoints mean."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError
from spherloc.frontend import learned, trained
from spherloc.images import grey
from spherloc.types import ByteArray, FloatArray

Descriptors = NDArray[np.float32 | np.uint8]

SIFT_CONTRAST, WEAK_SIFT_CONTRAST = 0.02, 0.007
"""COLMAP's threshold (its peak threshold is a third of it), half of OpenCV's, which finds little in dim rooms; and that
for images in which this one finds little, too, such as those of plain walls."""
SMALLEST_PX = 16
"""OpenCV fails on images with a smaller side, in which there is nothing to find."""


Run = Callable[[ByteArray, ByteArray, int, Path | None], tuple[FloatArray, Any]]
"""``detect`` of one kind: image, mask, most features, weights -> keypoints (N, 5) and descriptors."""


@dataclass(frozen=True)
class Kind:
    """One kind of features."""

    run: Run
    reach: float
    """Radius of the neighbourhood that the detector uses around a keypoint, as a share of the keypoint's size."""
    binary: bool = False
    """Whether its descriptors are bits, compared by their Hamming distance."""
    learned: bool = False
    """Whether it is a network, which can take a file of weights."""
    packaged: bool = False
    """Whether the extra ``learned`` brings its weights, so that no file is needed."""
    most: int = 8000
    """Number of features that are kept, the strongest, unless the options give another."""
    on_face: Run | None = None
    """Finds them on one of the faces of a panorama; None if that is not done in another way."""
    weak: Run | None = None
    """Finds weaker ones, too; None if this kind has no threshold for that."""
    strong: float = -np.inf
    """Least score of those that are no weaker ones."""


def detect(
    method: str,
    image: ByteArray,
    mask: ByteArray,
    most: int,
    weights: Path | None,
    on_face: bool = False,
    weak: bool = False,
) -> tuple[FloatArray, Descriptors]:
    """Features of an image, (H, W) or (H, W, 3) BGR, at the non-zero pixels of ``mask`` (H, W), with ``weak`` also
    those that this kind otherwise leaves out. ``on_face`` says that the image is one of the faces of a panorama.

    Returns keypoints (N, 5): pixel u, v with the first pixel's centre at (0.5, 0.5), size px, angle rad, score; and
    descriptors (N, D). There may be more than ``most`` features. Raises ``InputError`` if this OpenCV lacks the method
    or its weights cannot be used.
    """
    if min(mask.shape) >= SMALLEST_PX and mask.any():
        kind = KINDS[method]
        run = (kind.weak if weak else None) or (kind.on_face if on_face else None) or kind.run
        keypoints, descriptors = run(image, mask, most, weights)
        if descriptors is not None and len(keypoints) > 0:
            return keypoints, descriptors
    return np.empty((0, 5)), np.empty((0, 1), np.uint8 if KINDS[method].binary else np.float32)


def keypoint_table(keypoints: Any, shift_px: float = 0.5) -> FloatArray:
    """OpenCV's keypoints as a table (N, 5); in them, the centre of the first pixel is at ``0.5 - shift_px``."""
    rows = [(point.pt[0], point.pt[1], point.size, np.radians(point.angle), point.response) for point in keypoints]
    table = np.array(rows, np.float64).reshape(-1, 5)
    table[:, :2] += shift_px
    return table


def _sift(
    image: ByteArray, mask: ByteArray, _most: int, _weights: Path | None, contrast: float = SIFT_CONTRAST
) -> tuple[FloatArray, Any]:
    # ``nfeatures`` is not used: OpenCV applies it before the mask, so that masked features would count too.
    # Without the precise upscale every keypoint lies a quarter of a pixel too far right and down.
    sift = cv2.SIFT.create(contrastThreshold=contrast, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(grey(image), mask)
    return keypoint_table(keypoints), None if descriptors is None else root_normalised(
        np.asarray(descriptors, np.float32)
    )


def root_normalised(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """RootSIFT (Arandjelovic and Zisserman 2012, Sec. 3): square roots of L1-normalised descriptors (N, D).

    Their Euclidean distance is the Hellinger distance of the histograms.
    """
    total = descriptors.sum(axis=1, keepdims=True)
    return np.sqrt(descriptors / np.maximum(total, np.finfo(np.float32).tiny))


def _orb(image: ByteArray, mask: ByteArray, most: int, _weights: Path | None) -> tuple[FloatArray, Any]:
    keypoints, descriptors = cv2.ORB.create(nfeatures=most).detectAndCompute(grey(image), mask)
    return keypoint_table(keypoints), descriptors


def _akaze(image: ByteArray, mask: ByteArray, _most: int, _weights: Path | None) -> tuple[FloatArray, Any]:
    # OpenCV 5 moved AKAZE to the contributed modules.
    create = getattr(cv2, "AKAZE_create", None) or _contributed("AKAZE_create")
    if create is None:
        raise InputError(
            f"AKAZE features are not in this OpenCV ({cv2.__version__}); install OpenCV 4 (opencv-python-headless<5), "
            "or opencv-contrib-python-headless, or take the features 'sift'."
        )
    keypoints, descriptors = create().detectAndCompute(grey(image), mask)
    return keypoint_table(keypoints), descriptors


def _surf(image: ByteArray, mask: ByteArray, _most: int, _weights: Path | None) -> tuple[FloatArray, Any]:
    create = _contributed("SURF_create")
    try:
        surf = None if create is None else create(hessianThreshold=100.0, extended=True)
    except cv2.error:  # the contributed modules are there, but were built without SURF
        surf = None
    if surf is None:
        raise InputError(
            f"SURF features are not in this OpenCV ({cv2.__version__}); build OpenCV with its contributed modules and "
            "OPENCV_ENABLE_NONFREE, or take the features 'sift'."
        )
    keypoints, descriptors = surf.detectAndCompute(grey(image), mask)
    return keypoint_table(keypoints), descriptors


def _contributed(name: str) -> Any:
    return getattr(getattr(cv2, "xfeatures2d", None), name, None)


def _aliked(
    image: ByteArray, mask: ByteArray, most: int, weights: Path | None, on_face: bool = False
) -> tuple[FloatArray, Any]:
    return trained.aliked(image, most, on_face) if weights is None else learned.aliked(image, mask, most, weights)


KINDS = {
    # Two standard deviations of the Gaussian at which the keypoint was found: each detector defines size differently.
    "sift": Kind(
        _sift,
        reach=1.0,
        weak=partial(_sift, contrast=WEAK_SIFT_CONTRAST),
        # OpenCV compares the threshold with the score, in single precision, times the number of layers of an octave.
        strong=SIFT_CONTRAST / 3 - 1e-7,
    ),
    "orb": Kind(_orb, reach=0.2, binary=True),
    "akaze": Kind(_akaze, reach=0.7, binary=True),
    "surf": Kind(_surf, reach=0.5),
    "aliked": Kind(_aliked, reach=1.0, learned=True, packaged=True, most=2048, on_face=partial(_aliked, on_face=True)),
    "disk": Kind(learned.disk, reach=1.0, learned=True, most=2048),
}
