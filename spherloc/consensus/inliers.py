"""Which correspondences a gravity-aligned pose explains: the inner loop of every estimator."""

import numpy as np

from spherloc.gauss_newton import AlignedMatches
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import fill_vector


@kernel()
def count_inliers(yaw, translation, matches, bound_px):
    """How many ``matches`` (``AlignedMatches``) a level pose explains: a yaw, rad, and a translation (3,), m.

    Those in front whose first-order reprojection error, as in ``refine``, is within ``bound_px`` (M,).
    """
    bearings, points, jacobian = matches.bearings, matches.points, matches.pixel_jacobian
    c, s = np.cos(yaw), np.sin(yaw)
    inliers = 0
    for k in range(len(points)):
        x = points[k, 0] * c + points[k, 2] * s + translation[0]
        y = points[k, 1] + translation[1]
        z = points[k, 2] * c - points[k, 0] * s + translation[2]
        if bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z <= 0.0:
            continue
        du = jacobian[k, 0, 0] * x + jacobian[k, 0, 1] * y + jacobian[k, 0, 2] * z
        dv = jacobian[k, 1, 0] * x + jacobian[k, 1, 1] * y + jacobian[k, 1, 2] * z
        if du * du + dv * dv <= bound_px[k] * bound_px[k] * (x * x + y * y + z * z):
            inliers += 1
    return inliers


@kernel()
def score_inliers(yaw, translation, matches, bound_px, mask):
    """Fill ``mask`` (M,) with what ``count_inliers`` counts; return how many, and the MSAC support.

    The pose is level: ``yaw``, rad, and ``translation`` (3,), m. ``matches`` are ``AlignedMatches``, ``bound_px`` (M,)
    their bounds. The support is the sum of 1 - (error / bound)^2 over the inliers, so that M - support is the MSAC cost
    in units of the squared bound (Torr and Zisserman, "MLESAC", 2000).
    """
    bearings, points, jacobian = matches.bearings, matches.points, matches.pixel_jacobian
    c, s = np.cos(yaw), np.sin(yaw)
    inliers, support = 0, 0.0
    for k in range(len(points)):
        x = points[k, 0] * c + points[k, 2] * s + translation[0]
        y = points[k, 1] + translation[1]
        z = points[k, 2] * c - points[k, 0] * s + translation[2]
        ahead = bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z > 0.0
        du = jacobian[k, 0, 0] * x + jacobian[k, 0, 1] * y + jacobian[k, 0, 2] * z
        dv = jacobian[k, 1, 0] * x + jacobian[k, 1, 1] * y + jacobian[k, 1, 2] * z
        most = bound_px[k] * bound_px[k] * (x * x + y * y + z * z)
        mask[k] = ahead and du * du + dv * dv <= most
        if mask[k]:
            inliers += 1
            support += 1.0 - (du * du + dv * dv) / most
    return inliers, support


@kernel()
def mark_each(yaws, translations, bearings, points, pixel_jacobian, bound_px):
    """The inlier masks (J, M) of J level poses: ``yaws`` (J,), rad, and ``translations`` (J, 3), m.

    Of matches with ``bearings`` (M, 3), ``points`` (M, 3), m, ``pixel_jacobian`` (M, 2, 3) and ``bound_px`` (M,).
    """
    matches = AlignedMatches(bearings, points, pixel_jacobian)
    masks = np.empty((len(yaws), len(points)), np.bool_)
    for k in range(len(yaws)):
        score_inliers(yaws[k], translations[k], matches, bound_px, masks[k])
    return masks


BLOCK = 32
"""Correspondences whose coordinates lie together, so that the machine handles several at once."""
ROWS = 10
"""Numbers of a correspondence: its point, the two rows of its pixel Jacobian, its squared bound."""


@kernel()
def pack_blocks(matches, bound_px, order):
    """The ``matches`` in the given ``order`` (K,), as ``reaches`` reads them: blocks of ROWS x BLOCK, flat.

    ``bound_px`` (M,) are their bounds. The last block is filled up with what nothing explains.
    """
    count = len(order)
    blocks = np.zeros(((count + BLOCK - 1) // BLOCK, ROWS, BLOCK))
    for b in range(len(blocks)):
        fill_vector(blocks[b, ROWS - 1], np.nan)
    for index in range(count):
        b, lane, k = index // BLOCK, index % BLOCK, order[index]
        for axis in range(3):
            blocks[b, axis, lane] = matches.points[k, axis]
            blocks[b, 3 + axis, lane] = matches.pixel_jacobian[k, 0, axis]
            blocks[b, 6 + axis, lane] = matches.pixel_jacobian[k, 1, axis]
        blocks[b, ROWS - 1, lane] = bound_px[k] * bound_px[k]
    return blocks.ravel()


@kernel()
def reaches(yaw, translation, blocks, floors):
    """Whether a level pose may explain enough: False once the count after block b is below ``floors[b]`` (B,).

    ``blocks`` are those of ``pack_blocks``, the pose is a yaw, rad, and a translation (3,), m. It counts what
    ``count_inliers`` counts, and the few points that lie just opposite of their bearing: leaving out that test saves a
    fifth of the time. So a pose that explains ``floors[b]`` correspondences of the first b + 1 blocks, for every b, is
    never turned away.
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
