"""Which matches tell where a camera went: not clouds, hills and a skyline.

Outdoors such matches may be most of all. Those far away show how the camera turned, but any direction of travel fits
them, so that one that fits a few wrong matches besides wins against the right one. And clouds drift: in ten seconds by
degrees, all alike, as things do that a camera passes, so that most matches fit a pose that the wind made.
"""

import numpy as np

from spherloc.types import BoolArray, FloatArray

SAMPLES = 500
ROUNDS = 3
APART = float(np.sin(np.radians(5.0)))
"""Sine of the least angle between the two bearings that fix a rotation."""
SKY = float(np.sin(np.radians(15.0)))
"""Sine of the elevation above which there may be nothing but sky; hills and houses reach it where they are near."""


def far_rotation(first: FloatArray, second: FloatArray, bound_rad: float) -> FloatArray | None:
    """The rotation (3, 3) that most matches with bearings (M, 3) fit alone to ``bound_rad``: that of far things.

    None if no two bearings are apart and fit one.
    """
    count = len(first)
    if count < 2:
        return None
    one, other = np.random.default_rng([count, 2]).integers(0, count, (2, SAMPLES))
    here, there = _frames(first[one], first[other]), _frames(second[one], second[other])
    turn = np.abs(np.arcsin(here[1]) - np.arcsin(there[1]))
    tried = (here[1] >= APART) & (there[1] >= APART) & (turn <= 2.0 * bound_rad)
    rotations = there[0][tried] @ np.swapaxes(here[0][tried], 1, 2)
    if len(rotations) == 0:
        return None
    fits = ((first @ np.swapaxes(rotations, 1, 2)) * second).sum(axis=2) >= np.cos(bound_rad)
    counts = np.count_nonzero(fits, axis=1)
    best, rotation = counts.max(), rotations[counts.argmax()]
    for _ in range(ROUNDS):
        near = unmoved(first, second, rotation, bound_rad)
        better = _rotation(first[near], second[near])
        more = np.count_nonzero(unmoved(first, second, better, bound_rad))
        if more <= best:
            break
        best, rotation = more, better
    return rotation


def unmoved(first: FloatArray, second: FloatArray, rotation: FloatArray, bound_rad: float) -> BoolArray:
    """(M,) matches whose bearings (M, 3) fit a rotation (3, 3) alone to ``bound_rad``."""
    return ((first @ rotation.T) * second).sum(axis=1) >= np.cos(bound_rad)


def below_sky(first: FloatArray, second: FloatArray, down: tuple[FloatArray, FloatArray]) -> BoolArray:
    """(M,) matches whose bearings (M, 3) are, in both images, not high above the horizon.

    ``down`` are the unit vectors (3,) that point down in the images.
    """
    return (first @ down[0] > -SKY) & (second @ down[1] > -SKY)


def _frames(one: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right-handed frames (K, 3, 3) of pairs of bearings (K, 3), axes in columns, and sines (K,) of their angles."""
    across = np.cross(one, other)
    sine = np.linalg.norm(across, axis=1)
    across /= np.maximum(sine, 1e-9)[:, None]
    return np.stack([one, np.cross(across, one), across], axis=2, dtype=np.float64), np.minimum(sine, 1.0)


def _rotation(first: FloatArray, second: FloatArray) -> FloatArray:
    """The rotation (3, 3) that turns bearings (M, 3) onto others, by least squares (Kabsch 1976)."""
    left, _, right = np.linalg.svd(second.T @ first)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return left @ (sign[:, None] * right)
