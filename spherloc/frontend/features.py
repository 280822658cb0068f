"""Local features of an image: keypoints and descriptors, within its valid pixels, across a panorama's seam."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from spherloc.cameras.base import FloatArray
from spherloc.errors import InputError, show
from spherloc.frontend.feature_cache import fetch, keep
from spherloc.frontend.feature_kinds import KINDS, Descriptors, detect
from spherloc.frontend.view import View
from spherloc.images import ByteImage

METHODS = tuple(KINDS)
MOST_FEATURES = 50_000
RIM_PX = 4.0
"""Features this close to pixels that may not be used, and farther for large ones, are the rim's and not the scene's."""
SEAM_WRAP = 0.05
"""Part of a panorama's width that is repeated beyond its seam, so that features there see both sides."""
SEAM_STEP_PX = 32
"""The wrap is a multiple of it, so that the coarse levels of the pyramid sample the same pixels as without it."""
SEAM_TWIN_PX = 1.0
"""A feature this close to the seam may be found on both sides of it."""
MOST_PIXELS = 6_000_000
"""Larger images are shrunk to this for detection, as COLMAP does: SIFT needs about 180 bytes a pixel."""


@dataclass(frozen=True)
class FeatureOptions:
    """What features are sought."""

    method: str = "sift"
    """One of ``METHODS``; SIFT is root-normalised."""
    max_features: int = 4000
    """The strongest are kept."""
    weights: Path | None = None
    """ONNX file of the learned methods, ALIKED and DISK."""

    def __post_init__(self) -> None:
        if self.method not in KINDS:
            raise InputError(f"There are no features {show(self.method)}; take one of {', '.join(METHODS)}.")
        count = self.max_features
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MOST_FEATURES:
            raise InputError(f"max_features is {show(count)}; give a whole number from 1 to {MOST_FEATURES}.")
        if KINDS[self.method].learned and self.weights is None:
            raise InputError(f"{self.method} features need a file of weights; give its ONNX file as weights.")
        if not KINDS[self.method].learned and self.weights is not None:
            raise InputError(f"{self.method} features have no weights; leave weights out, or take aliked or disk.")


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image, the strongest first. Read-only arrays of N features."""

    pixels: FloatArray
    """(N, 2), the centre of the first pixel is (0.5, 0.5)."""
    sizes_px: FloatArray
    """(N,) diameter of what the feature describes."""
    angles_rad: FloatArray
    """(N,) its orientation."""
    scores: FloatArray
    """(N,) the detector's own measure of strength."""
    descriptors: Descriptors
    """(N, D) float32, or uint8 that hold 8 bits each where ``method`` is binary (ORB, AKAZE)."""
    method: str
    image_size: tuple[int, int]
    """(width, height), px."""

    def __post_init__(self) -> None:
        count = len(self.pixels)
        shapes = (self.sizes_px.shape, self.angles_rad.shape, self.scores.shape)
        if self.pixels.shape != (count, 2) or shapes != ((count,),) * 3 or len(self.descriptors) != count:
            raise ValueError("pixels, sizes, angles, scores and descriptors of features must be of one length")
        for array in (self.pixels, self.sizes_px, self.angles_rad, self.scores, self.descriptors):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.pixels)


def extract(view: View, options: FeatureOptions | None = None) -> Features:
    """Features of an image, from the cache on disk if they were computed before.

    The same image always gives the same features in the same order. An image without any gives none. Raises
    ``InputError`` if the image, its mask or the weights cannot be read, or if this OpenCV lacks the method.
    """
    options = options or FeatureOptions()
    usable = view.usable_pixels()
    seam = view.camera.model == "equirectangular"
    path = feature_file(view.path, usable, options, seam)
    size = (view.camera.width, view.camera.height)
    arrays = fetch(path) if path else None
    if arrays is None:
        arrays = _detected(view.read(), usable.astype(np.uint8), options, seam)
        if path:
            keep(path, arrays)
    table, descriptors = arrays
    return Features(
        np.ascontiguousarray(table[:, :2]), *(table[:, column].copy() for column in (2, 3, 4)), descriptors,
        options.method, size,
    )
