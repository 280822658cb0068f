"""oDLT: the direct linear transform with the weights that make its solution statistically optimal.

    q_i n . (A p_i + b) = 0 for both equations n of a match,   q_i = 1 / (sigma z_i),   z_i the depth of point i

Noise sigma of an image point makes a residual of sigma z_i, so the rows of the plain system are far from equally
certain. Two passes: the plain system gives depths, the weighted one the pose. R is the rotation closest to A in the
norm of A's information (weighted Procrustes, one Gauss-Newton step), and t solves the weighted rows with R given (the
paper's LOST refinement). Works on the image plane of a pinhole, as the paper has it, or with the equations of bearings
on the whole sphere (``OdltSphere``), where z_i is the distance; noise is taken to be the same everywhere on either. Six
correspondences. Degenerate for points in one plane.

Differs from the paper: the first pass uses all points, and image coordinates are not normalised once more, since those
of a calibrated camera are of order one already.

Henry, Christian: Optimal DLT-based solutions for the perspective-n-point, 2024 (arXiv 2410.14164).
"""

import numpy as np

from spherloc.geometry import skew, so3_exp
from spherloc.solvers.base import NO_POSES, checked, poses
from spherloc.solvers.linear_pose import DEGENERATE, condition, nearest_rotation
from spherloc.solvers.match_rows import MatchRows, plane_rows, sphere_rows
from spherloc.types import FloatArray

MIN_DEPTH = 1e-3
"""Depths are taken to be at least this share of their median: a point at the camera must not outweigh all others."""


class Odlt:
    """Optimal direct linear transform."""

    name = "oDLT"
    sample_size = 6
    pinhole = True

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose."""
        bearings, points = checked(self, bearings, points)
        return odlt(plane_rows(bearings), points)


class OdltSphere:
    """Optimal direct linear transform of bearings."""

    name = "oDLT on the sphere"
    sample_size = 6
    pinhole = False

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose."""
        bearings, points = checked(self, bearings, points)
        return odlt(sphere_rows(bearings), points)


def odlt(rows: MatchRows, points: FloatArray, passes: int = 2) -> FloatArray:
    """At most one pose (S, 3, 4) of points (K, 3) by the equations of their matches, with depths from ``passes - 1``
    earlier passes; 1 is the plain transform."""
    conditioned = condition(points)
    if conditioned is None:
        return NO_POSES
    points, middle, scale = conditioned
    weights = np.ones(len(points))
    matrix, information = np.empty((3, 4)), np.empty((12, 12))
    for _ in range(passes):
        system = _system(rows, points, weights)
        _, stretch, right = np.linalg.svd(system, full_matrices=False)
        if stretch[-2] <= DEGENERATE * stretch[0]:
            return NO_POSES
        matrix, information = right[-1].reshape(3, 4), system.T @ system
        depths = rows.ahead(points @ matrix[:, :3].T + matrix[:, 3])
        if np.count_nonzero(depths < 0.0) > np.count_nonzero(depths > 0.0):
            matrix, depths = -matrix, -depths
        weights = 1.0 / np.maximum(depths, MIN_DEPTH * np.median(np.abs(depths)))
    rotation = nearest_rotation(matrix[:, :3])
    if rotation is None:
        return NO_POSES
    scaled = matrix[:, :3] / np.cbrt(np.linalg.det(matrix[:, :3]))
    rotation = _weighted_procrustes(rotation, scaled, np.diag(information).reshape(3, 4)[:, :3])
    translation = _translation(rows, points @ rotation.T, weights)
    return poses(rotation, translation / scale - rotation @ middle)


def _system(rows: MatchRows, points: FloatArray, weights: FloatArray) -> FloatArray:
    """The equations (2 K, 12) of [A | b], row by row."""
    known = np.column_stack([points, np.ones(len(points))]) * weights[:, None]
    return (rows.normals[:, :, :, None] * known[:, None, None, :]).reshape(-1, 12)


def _weighted_procrustes(rotation: FloatArray, matrix: FloatArray, weights: FloatArray) -> FloatArray:
    """One Gauss-Newton step of R towards min sum w_jk (matrix - R)_jk^2, from the closest rotation."""
    turns = np.stack([skew(axis) @ rotation for axis in np.eye(3)], axis=-1).reshape(9, 3)
    root = np.sqrt(weights).reshape(9, 1)
    step = np.linalg.lstsq(root * turns, root[:, 0] * (matrix - rotation).ravel(), rcond=None)[0]
    return so3_exp(np.asarray(step, dtype=np.float64)) @ rotation


def _translation(rows: MatchRows, turned: FloatArray, weights: FloatArray) -> FloatArray:
    """t (3,) from the weighted rows, the points (K, 3) being turned already."""
    right = -np.einsum("kri,ki->kr", rows.normals, turned) * weights[:, None]
    system = (rows.normals * weights[:, None, None]).reshape(-1, 3)
    return np.asarray(np.linalg.lstsq(system, right.ravel(), rcond=None)[0], dtype=np.float64)
