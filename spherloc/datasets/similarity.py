"""Similarity transformations: a structure-from-motion model has its own frame and scale, the map another."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from spherloc.cameras.base import FloatArray
from spherloc.datasets.scene_file import numbers
from spherloc.errors import InputError
from spherloc.geometry import pose

TOLERANCE = 1e-3
"""How far a rotation given by hand may be from orthonormal."""
LEAST_SPREAD = 0.02
"""Positions whose second extent is a smaller share of the first lie on a line, which fixes no rotation about it."""
FARTHEST = 1e9
"""In the units of either frame."""
_ROUNDS = 30
_INLIER_MEDIANS = 4.0


@dataclass(frozen=True, eq=False)
class Similarity:
    """x_to = scale rotation x_from + translation."""

    scale: float
    rotation: FloatArray
    """(3, 3)"""
    translation: FloatArray
    """(3,)"""

    def points(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) in the other frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def pose(self, cam_from_old: FloatArray) -> FloatArray:
        """``cam_from_new`` (3, 4) of a camera, whose own axes keep their length."""
        rotation = cam_from_old[:, :3] @ self.rotation.T
        return pose(rotation, self.scale * cam_from_old[:, 3] - rotation @ self.translation)


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity that was fitted to pairs of points."""

    similarity: Similarity
    used: int
    """Pairs that fit."""
    rms_m: float
    """Of their residuals."""
    extent_m: float
    """Root mean square distance of the positions from their mean."""


def similarity_of(value: Any, key: str, where: str) -> Similarity:
    """A similarity given as ``[[...], [...], [...]]``, 3 x 4: scale times rotation, and translation.

    Raises ``InputError`` for another shape, and if the 3 x 3 part is no rotation times a positive scale.
    """
    matrix = numbers(value, (3, 4), key, where)
    left, sizes, right = np.linalg.svd(matrix[:, :3])
    scale = float(sizes.mean())
    if not 1e-9 <= scale <= 1e9 or np.ptp(sizes) > TOLERANCE * scale or np.linalg.det(left @ right) < 0:
        raise InputError(f"{where}: the 3 x 3 part of {key} is no rotation times a positive scale; correct it.")
    return Similarity(scale, left @ right, matrix[:, 3])


def align(old: FloatArray, new: FloatArray, where: str) -> Alignment:
    """The similarity that takes the positions ``old`` (N, 3) to ``new`` (N, 3), against a few wrong ones among them.

    Umeyama's closed form (1991), reweighted so that the sum of distances is least instead of that of squares.
    Raises ``InputError`` for fewer than three pairs and for positions on a line.
    """
    if len(old) < 3:
        raise InputError(f"{where}: {len(old)} positions are known in both frames, and an alignment needs three.")
    if not (np.abs(old) <= FARTHEST).all():
        raise InputError(f"{where}: a position lies beyond {FARTHEST:g}; correct or remove it.")
    weights = np.ones(len(old))
    for _ in range(_ROUNDS):
        found = _umeyama(old, new, weights, where)
        residuals = np.linalg.norm(found.points(old) - new, axis=1)
        weights = 1.0 / np.maximum(residuals, 1e-3 + 0.1 * np.median(residuals))
    good = np.less_equal(residuals, _INLIER_MEDIANS * max(float(np.median(residuals)), 1e-9))
    rms = float(np.sqrt(np.mean(residuals[good] ** 2)))
    extent = float(np.sqrt(np.mean(np.sum((new - new.mean(axis=0)) ** 2, axis=1))))
    return Alignment(found, int(good.sum()), rms, extent)


def _umeyama(old: FloatArray, new: FloatArray, weights: FloatArray, where: str) -> Similarity:
    """Least weighted squares."""
    weights = weights / weights.sum()
    old_mean, new_mean = weights @ old, weights @ new
    old_centred, new_centred = old - old_mean, new - new_mean
    for centred in (old_centred, new_centred):
        extents = np.linalg.svd(np.sqrt(weights)[:, None] * centred, compute_uv=False)
        if not extents[1] > LEAST_SPREAD * extents[0]:
            raise InputError(f"{where}: the positions lie on a line, which leaves open the rotation about it.")
    left, sizes, right = np.linalg.svd((weights[:, None] * new_centred).T @ old_centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(sizes @ signs / (weights @ np.sum(old_centred**2, axis=1)))
    return Similarity(scale, rotation, new_mean - scale * rotation @ old_mean)
