"""Estimates the ratio of the real noise to the stated noise, so that the covariance of a pose holds on real matches.

Least squares with residuals r_k and Jacobians J_k has the covariance (sum J' J)^-1 if the noise has unit variance and
all residuals are independent. Matches that share a map point or a pixel are not, so their scores J' r are added first:
with B the sum of the outer products of these sums over G groups, trace((sum J' J)^-1 B) / d estimates the variance of
the noise times the share by which repeated matches count too often (the cluster-robust covariance as one number,
which is steadier than the matrix where there are few matches).
"""

import numpy as np

from spherloc.gauss_newton import AlignedMatches
from spherloc.kernel_cache import kernel
from spherloc.types import BoolArray, FloatArray, IntArray

PRIOR_GROUPS = 10.0
"""Weight of the prior: as if this number of groups of matches with the stated noise had been measured before."""
SHARED_PX = 0.15
"""Error that all matches share, px: no calibration or map is more accurate, however many matches there are."""
_RIDGE = 1e-12
"""Added to the diagonal of a scaled information matrix, for the inverse where a direction is undetermined."""
_GENERIC_DIRECTION = np.array([0.7390851332151607, 0.5671432904097838, 0.9159655941772190])
"""A direction in which no two different points have the same coordinate, for practical purposes."""


def variance_factor(
    matches: AlignedMatches, cam_from_map: FloatArray, inliers: BoolArray, noise_px: float, dof: int
) -> float:
    """The factor for the covariance of an aligned pose (3, 4) that assumes a noise of ``noise_px``.

    ``inliers`` (M,) are the fitted matches, ``dof`` the degrees of freedom of the pose. 1 if there are too few inliers.
    """
    if np.count_nonzero(inliers) <= dof:
        return 1.0
    groups = _groups(matches.points[inliers], matches.bearings[inliers])
    count = int(groups.max()) + 1
    factor = _sum_of_squares(matches, inliers, groups, cam_from_map, float(noise_px), dof, np.zeros((count, 6))) / dof
    # Each of the two rows of a residual loses half of the pose's degrees of freedom.
    factor *= count / max(count - 0.5 * dof, 1.0)
    factor = (PRIOR_GROUPS + count * factor) / (PRIOR_GROUPS + count)
    shared = (SHARED_PX / noise_px) ** 2 * np.count_nonzero(inliers) / dof
    return float(factor + shared)


@kernel()
def _sum_of_squares(matches, inliers, groups, cam_from_map, noise_px, dof, scores):
    """trace((sum J' J)^-1 B), where B is the sum of the outer products of the groups' scores.

    J is of a step (w, d), rad and m, from the pose ``cam_from_map`` (3, 4), in the order w_x, w_z, w_y, d: a pose with
    4 for ``dof`` moves by the last four. ``groups`` (K,) are the numbers of the groups of the ``inliers`` (M,) among
    the ``matches``; residuals count in units of ``noise_px``. Zeros ``scores`` (G, 6) are overwritten.
    """
    jacobian, n, information = np.empty(6), 0, np.zeros((6, 6))
    for k in range(len(inliers)):
        if not inliers[k]:
            continue
        x, y, z = cam_from_map[0, 3], cam_from_map[1, 3], cam_from_map[2, 3]
        for b in range(3):
            x += cam_from_map[0, b] * matches.points[k, b]
            y += cam_from_map[1, b] * matches.points[k, b]
            z += cam_from_map[2, b] * matches.points[k, b]
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        for row in range(2):
            by_x, by_y, by_z = (
                matches.pixel_jacobian[k, row, 0],
                matches.pixel_jacobian[k, row, 1],
                matches.pixel_jacobian[k, row, 2],
            )
            residual = by_x * x + by_y * y + by_z * z
            by_x, by_y, by_z = by_x - residual * x, by_y - residual * y, by_z - residual * z
            # A rotation w moves the ray by w x ray at any distance; a translation d by d / distance.
            jacobian[0], jacobian[1], jacobian[2] = y * by_z - z * by_y, x * by_y - y * by_x, z * by_x - x * by_z
            jacobian[3], jacobian[4], jacobian[5] = by_x / length, by_y / length, by_z / length
            for a in range(6):
                jacobian[a] /= noise_px
                scores[groups[n], a] += jacobian[a] * residual / noise_px
                for b in range(a + 1):
                    information[a, b] += jacobian[a] * jacobian[b]
        n += 1
    # With L L' = sum J' J, scaled to a diagonal of 1, the trace is that of the sum of |L^-1 s|^2 over the scores s.
    first, total, scale = 6 - dof, 0.0, np.ones(6)
    for a in range(first, 6):
        if information[a, a] > 0.0:
            scale[a] = 1.0 / np.sqrt(information[a, a])
    for a in range(first, 6):
        for b in range(first, a + 1):
            rest = information[a, b] * scale[a] * scale[b]
            for k in range(first, b):
                rest -= information[a, k] * information[b, k]
            information[a, b] = rest / information[b, b] if a > b else np.sqrt(rest + _RIDGE)
    for g in range(len(scores)):
        for a in range(first, 6):
            rest = scores[g, a] * scale[a]
            for k in range(first, a):
                rest -= information[a, k] * scores[g, k]
            scores[g, a] = rest / information[a, a]
            total += scores[g, a] ** 2
    return total


def _groups(points: FloatArray, bearings: FloatArray) -> IntArray:
    """(K,) number of each match's group: those with the same point, or the same bearing, are together."""
    along_point, along_bearing = points @ _GENERIC_DIRECTION, bearings @ _GENERIC_DIRECTION
    count = len(points)
    if _are_different(along_point) and _are_different(along_bearing):
        return np.arange(count)
    by_point = np.unique(along_point, return_inverse=True)[1]
    by_bearing = np.unique(along_bearing, return_inverse=True)[1]
    from scipy.sparse import coo_array  # takes a quarter of a second
    from scipy.sparse.csgraph import connected_components

    shape = (int(by_point.max()) + int(by_bearing.max()) + 2,) * 2
    edges = coo_array((np.ones(count), (by_point, by_point.max() + 1 + by_bearing)), shape=shape)
    return connected_components(edges, directed=False)[1][by_point].astype(np.int64)


def _are_different(values: FloatArray) -> bool:
    """Whether no two of the ``values`` (K,) are equal."""
    ordered = np.sort(values)
    return not (ordered[1:] == ordered[:-1]).any()
