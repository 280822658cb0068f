"""Estimates the ratio of the real noise to the stated noise, so that the covariance of a pose holds on real matches.

Least squares with residuals r_k and Jacobians J_k has the covariance (sum J' J)^-1 if the noise has unit variance and
all residuals are independent. Matches that share a map point or a pixel are not, so their scores J' r are added first:
with B the sum of the outer products of these sums over G groups, trace((sum J' J)^-1 B) / d estimates the variance of
the noise times the share by which repeated matches count too often (the cluster-robust covariance as one number,
which is steadier than the matrix where there are few matches).
"""

import numpy as np

from spherloc.problem import AlignedProblem
from spherloc.types import BoolArray, FloatArray, IntArray

PRIOR_GROUPS = 10.0
"""Weight of the prior: as if this number of groups of matches with the stated noise had been measured before."""
SHARED_PX = 0.15
"""Error that all matches share, px: no calibration or map is more accurate, however many matches there are."""
_GENERIC_DIRECTION = np.array([0.7390851332151607, 0.5671432904097838, 0.9159655941772190])
"""A direction in which no two different points have the same coordinate, for practical purposes."""


def variance_factor(
    aligned: AlignedProblem, cam_from_map: FloatArray, inliers: BoolArray, noise_px: float, dof: int
) -> float:
    """The factor for the covariance of an aligned pose (3, 4) that assumes a noise of ``noise_px``.

    ``inliers`` (M,) are the fitted matches, ``dof`` the degrees of freedom of the pose. 1 if there are too few inliers.
    """
    if np.count_nonzero(inliers) <= dof:
        return 1.0
    points, pixel_jacobian = aligned.points[inliers], aligned.pixel_from_bearing[inliers]
    ray = points @ cam_from_map[:, :3].T + cam_from_map[:, 3]
    length = np.linalg.norm(ray, axis=1)[:, None]
    ray = ray / length
    residual = np.einsum("nij,nj->ni", pixel_jacobian, ray) / noise_px
    by_ray = (pixel_jacobian - residual[:, :, None] * noise_px * ray[:, None, :]) / noise_px
    # A rotation w moves the ray by w x ray at any distance; a translation d by d / distance.
    by_turn = np.cross(ray[:, None, :], by_ray)
    jacobian = np.concatenate([by_turn, by_ray / length[..., None]], axis=2)
    if dof == 4:
        jacobian = jacobian[:, :, [1, 3, 4, 5]]
    scale = 1.0 / np.maximum(np.sqrt(np.einsum("nia,nia->a", jacobian, jacobian)), 1e-300)
    jacobian = jacobian * scale
    groups = _groups(points, aligned.bearings[inliers])
    count = int(groups.max()) + 1
    scores = np.zeros((count, dof))
    np.add.at(scores, groups, np.einsum("nia,ni->na", jacobian, residual))
    information = np.einsum("nia,nib->ab", jacobian, jacobian) + 1e-12 * np.eye(dof)
    factor = np.trace(np.linalg.solve(information, scores.T @ scores)) / dof
    # Each of the two rows of a residual loses half of the pose's degrees of freedom.
    factor *= count / max(count - 0.5 * dof, 1.0)
    factor = (PRIOR_GROUPS + count * factor) / (PRIOR_GROUPS + count)
    shared = (SHARED_PX / noise_px) ** 2 * np.count_nonzero(inliers) / dof
    return float(factor + shared)


def _groups(points: FloatArray, bearings: FloatArray) -> IntArray:
    """Group numbers (K,) of the matches: those with the same point or the same bearing are in one group."""
    by_point = np.unique(points @ _GENERIC_DIRECTION, return_inverse=True)[1]
    by_bearing = np.unique(bearings @ _GENERIC_DIRECTION, return_inverse=True)[1]
    count = len(points)
    if by_point.max() == count - 1 and by_bearing.max() == count - 1:
        return np.arange(count)
    from scipy.sparse import coo_array  # takes a quarter of a second
    from scipy.sparse.csgraph import connected_components

    shape = (int(by_point.max()) + int(by_bearing.max()) + 2,) * 2
    edges = coo_array((np.ones(count), (by_point, by_point.max() + 1 + by_bearing)), shape=shape)
    return connected_components(edges, directed=False)[1][by_point].astype(np.int64)
