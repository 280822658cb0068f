"""Matches of two images whose relative pose is known: each feature is compared with those near its epipolar plane only.

There are a hundredth as many of them as in the whole image, so that the nearest stands out among them where it does not
among all: floors, wallpaper and windows repeat themselves.
"""

import numpy as np
from numpy.typing import NDArray

from spherloc.kernel_cache import kernel
from spherloc.types import FloatArray

RATIO = 0.8
"""Of the distances to the nearest and the second nearest descriptor near the plane."""
MAX_DISTANCE = 0.8
"""Between descriptors of length 1."""


def guided_matches(
    rays: tuple[FloatArray, FloatArray],
    descriptors: tuple[NDArray[np.float32], NDArray[np.float32]],
    rotation: FloatArray,
    direction: FloatArray,
    bound_rad: float,
) -> NDArray[np.uint32]:
    """Matches (M, 2), the best first, of bearings (N, 3) with descriptors (N, D) of length 1 of two images.

    ``rotation`` (3, 3) and the unit ``direction`` (3,) are those of the second camera from the first; a match is within
    ``bound_rad`` of its epipolar plane, and each of its features is the nearest of the other.
    """
    turned, second = np.ascontiguousarray(rays[0] @ rotation.T), np.ascontiguousarray(rays[1])
    nearest, ratios = np.full(len(turned), -1, np.int64), np.ones(len(turned))
    if len(turned) and len(second):
        limits = float(np.sin(bound_rad)), MAX_DISTANCE
        _search(turned, second, *descriptors, np.ascontiguousarray(direction), limits, nearest, ratios)
    kept = np.flatnonzero((nearest >= 0) & (ratios <= RATIO))
    kept = kept[np.argsort(ratios[kept], kind="stable")]
    return np.column_stack([kept, nearest[kept]]).astype(np.uint32)


@kernel(fastmath=True)
def _search(turned, second, first_words, second_words, t, limits, nearest, ratios):
    """Write the ``nearest`` (N,) of each feature, -1 if there is none, and the ratio of its distances, ``ratios`` (N,).

    ``turned`` (N, 3) and ``second`` (M, 3) are bearings, ``first_words`` (N, W) and ``second_words`` (M, W)
    descriptors, ``t`` (3,) the unit direction of the translation, ``limits`` the sine of the bound and the largest
    distance.
    """
    sine_bound, most_distance = limits
    count, other, size = len(turned), len(second), first_words.shape[1]
    best_of = np.full(other, np.float32(np.inf))
    first_of = np.full(other, -1)
    # |t x c|, the sine between the direction and the second bearing.
    lengths = np.empty(other)
    for j in range(other):
        x = t[1] * second[j, 2] - t[2] * second[j, 1]
        y = t[2] * second[j, 0] - t[0] * second[j, 2]
        z = t[0] * second[j, 1] - t[1] * second[j, 0]
        lengths[j] = np.sqrt(x * x + y * y + z * z)
    most = np.float32(most_distance * most_distance)
    for i in range(count):
        r0, r1, r2 = turned[i, 0], turned[i, 1], turned[i, 2]
        p0, p1, p2 = t[1] * r2 - t[2] * r1, t[2] * r0 - t[0] * r2, t[0] * r1 - t[1] * r0
        length = np.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
        least, next_least, at = np.float32(np.inf), np.float32(np.inf), -1
        for j in range(other):
            c0, c1, c2 = second[j, 0], second[j, 1], second[j, 2]
            off = abs(c0 * p0 + c1 * p1 + c2 * p2)
            if off > sine_bound * min(length, lengths[j]):
                continue
            n0, n1, n2 = c1 * r2 - c2 * r1, c2 * r0 - c0 * r2, c0 * r1 - c1 * r0
            q0, q1, q2 = t[1] * c2 - t[2] * c1, t[2] * c0 - t[0] * c2, t[0] * c1 - t[1] * c0
            noise = sine_bound * np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if p0 * n0 + p1 * n1 + p2 * n2 < -noise or q0 * n0 + q1 * n1 + q2 * n2 < -noise:
                continue  # behind one of the cameras
            distance = np.float32(0.0)
            for k in range(size):
                difference = first_words[i, k] - second_words[j, k]
                distance += difference * difference
            if distance < least:
                next_least, least, at = least, distance, j
            elif distance < next_least:
                next_least = distance
            if distance < best_of[j]:
                best_of[j], first_of[j] = distance, i
        if at >= 0 and least <= most:
            nearest[i] = at
            ratios[i] = np.sqrt(least / next_least) if next_least > 0.0 else 1.0
    for i in range(count):
        if nearest[i] >= 0 and first_of[nearest[i]] != i:
            nearest[i] = -1
