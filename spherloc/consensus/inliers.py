"""Which correspondences a gravity-aligned pose explains: the inner loop of every estimator."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def count_inliers(yaw, translation, bearings, points, weights, bound_px):
    """Correspondences whose first-order reprojection error is within their bound; as in ``refine``."""
    c, s = np.cos(yaw), np.sin(yaw)
    inliers = 0
    for k in range(len(points)):
        x = points[k, 0] * c + points[k, 2] * s + translation[0]
        y = points[k, 1] + translation[1]
        z = points[k, 2] * c - points[k, 0] * s + translation[2]
        if bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z <= 0.0:
            continue
        du = weights[k, 0, 0] * x + weights[k, 0, 1] * y + weights[k, 0, 2] * z
        dv = weights[k, 1, 0] * x + weights[k, 1, 1] * y + weights[k, 1, 2] * z
        if du * du + dv * dv <= bound_px[k] * bound_px[k] * (x * x + y * y + z * z):
            inliers += 1
    return inliers


@numba.njit(cache=True, nogil=True)
def score_inliers(yaw, translation, bearings, points, weights, bound_px, mask):
    """Fill ``mask`` (M,) with what ``count_inliers`` counts; return how many, and the MSAC support.

    The support is the sum of 1 - (error / bound)^2 over the inliers, so that M - support is the MSAC cost in units of
    the squared bound (Torr and Zisserman, "MLESAC", 2000).
    """
    c, s = np.cos(yaw), np.sin(yaw)
    inliers, support = 0, 0.0
    for k in range(len(points)):
        x = points[k, 0] * c + points[k, 2] * s + translation[0]
        y = points[k, 1] + translation[1]
        z = points[k, 2] * c - points[k, 0] * s + translation[2]
        ahead = bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z > 0.0
        du = weights[k, 0, 0] * x + weights[k, 0, 1] * y + weights[k, 0, 2] * z
        dv = weights[k, 1, 0] * x + weights[k, 1, 1] * y + weights[k, 1, 2] * z
        most = bound_px[k] * bound_px[k] * (x * x + y * y + z * z)
        mask[k] = ahead and du * du + dv * dv <= most
        if mask[k]:
            inliers += 1
            support += 1.0 - (du * du + dv * dv) / most
    return inliers, support


@numba.njit(cache=True, nogil=True)
def mark_each(yaws, translations, bearings, points, weights, bound_px):
    """The inlier masks (J, M) of J poses."""
    masks = np.empty((len(yaws), len(points)), np.bool_)
    for k in range(len(yaws)):
        score_inliers(yaws[k], translations[k], bearings, points, weights, bound_px, masks[k])
    return masks


BLOCK = 32
"""Correspondences whose coordinates lie together, so that the machine handles several at once."""
ROWS = 10
"""Numbers a correspondence: its point, its two weights, its squared bound."""


@numba.njit(cache=True, nogil=True)
def pack_blocks(points, weights, bound_px, order):
    """The correspondences in the given order, as ``bound_count`` reads them: blocks of ROWS x BLOCK, flat.

    The last block is filled up with what nothing explains.
    """
    count = len(order)
    blocks = np.zeros(((count + BLOCK - 1) // BLOCK, ROWS, BLOCK))
    blocks[:, ROWS - 1] = np.nan
    for place in range(count):
        b, lane, k = place // BLOCK, place % BLOCK, order[place]
        for axis in range(3):
            blocks[b, axis, lane] = points[k, axis]
            blocks[b, 3 + axis, lane] = weights[k, 0, axis]
            blocks[b, 6 + axis, lane] = weights[k, 1, axis]
        blocks[b, ROWS - 1, lane] = bound_px[k] * bound_px[k]
    return blocks.ravel()


@numba.njit(cache=True, nogil=True)
def reaches(yaw, translation, blocks, floors):
    """Whether a pose may explain enough: False once the count after block b is below ``floors[b]``.

    It counts what ``count_inliers`` counts, and the few points that lie just opposite of their bearing: leaving out
    that test saves a fifth of the time. So a pose that explains ``floors[b]`` correspondences of the first b + 1
    blocks, for every b, is never turned away.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    tx, ty, tz = translation[0], translation[1], translation[2]
    inliers = 0
    for b in range(len(floors)):
        row = blocks[b * ROWS * BLOCK : (b + 1) * ROWS * BLOCK]
        for k in range(BLOCK):
            x = row[k] * c + row[2 * BLOCK + k] * s + tx
            y = row[BLOCK + k] + ty
            z = row[2 * BLOCK + k] * c - row[k] * s + tz
            du = row[3 * BLOCK + k] * x + row[4 * BLOCK + k] * y + row[5 * BLOCK + k] * z
            dv = row[6 * BLOCK + k] * x + row[7 * BLOCK + k] * y + row[8 * BLOCK + k] * z
            inliers += du * du + dv * dv <= row[9 * BLOCK + k] * (x * x + y * y + z * z)
        if inliers < floors[b]:
            return False
    return True
