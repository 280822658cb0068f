"""Similarity transformations: a structure-from-motion model has its own frame and scale, the map another."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from spherloc.datasets.scene_file import numbers
from spherloc.errors import InputError
from spherloc.geometry import pose
from spherloc.types import FloatArray

TOLERANCE = 1e-3
"""How far a rotation given by hand may be from orthonormal."""
LEAST_SPREAD = 0.02
"""Positions whose second extent is a smaller share of the first lie on a line, which fixes no rotation about it."""
FARTHEST = 1e9
"""In the units of either frame."""
WORST_FIT = 0.1
"""Of the extent of the positions: a larger residual means that they are not the same positions."""
LEAST_USED = 0.8
"""Share of the positions that must fit: three of four always do, whatever they are."""
_REMEDY = "give map_from_model"
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
    Raises ``InputError`` for fewer than three pairs, for positions on a line, and for positions that do not fit.
    """
    if len(old) < 3:
        raise InputError(f"{where}: only {len(old)} positions are known in both, and it takes three; {_REMEDY}.")
    if not (np.abs(old) <= FARTHEST).all():
        raise InputError(f"{where}: a position lies beyond {FARTHEST:g}; correct or remove it.")
    _check_spread(old, new, where)
    weights = np.ones(len(old))
    for _ in range(_ROUNDS):
        found = _umeyama(old, new, weights / weights.sum())
        residuals = np.linalg.norm(found.points(old) - new, axis=1)
        weights = 1.0 / np.maximum(residuals, 1e-3 + 0.1 * np.median(residuals))
    good = np.less_equal(residuals, max(_INLIER_MEDIANS * float(np.median(residuals)), 1e-3))
    used, rms = int(good.sum()), float(np.sqrt(np.mean(residuals[good] ** 2)))
    extent = float(np.sqrt(np.mean(np.sum((new - new.mean(axis=0)) ** 2, axis=1))))
    if rms > WORST_FIT * extent or used < LEAST_USED * len(old):
        raise InputError(
            f"{where}: the positions do not fit, {used} of {len(old)} by {rms:.2g} m over {extent:.2g} m; take both "
            f"from the same recording, or {_REMEDY}."
        )
    _check_spread(old[good], new[good], where)
    return Alignment(found, used, rms)


def _check_spread(old: FloatArray, new: FloatArray, where: str) -> None:
    for positions in (old, new):
        extents = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
        if not extents[1] > LEAST_SPREAD * extents[0]:
            raise InputError(f"{where}: the positions lie on a line, so that a rotation stays open; {_REMEDY}.")


def _umeyama(old: FloatArray, new: FloatArray, weights: FloatArray) -> Similarity:
    """Least weighted squares; weights (N,) that sum to 1."""
    old_mean, new_mean = weights @ old, weights @ new
    old_centred, new_centred = old - old_mean, new - new_mean
    left, sizes, right = np.linalg.svd((weights[:, None] * new_centred).T @ old_centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(sizes @ signs / (weights @ np.sum(old_centred**2, axis=1)))
    return Similarity(scale, rotation, new_mean - scale * rotation @ old_mean)
