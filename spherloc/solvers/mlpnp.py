"""MLPnP: the maximum-likelihood pose from bearings of any central camera.

    J(v_i)^T (R p_i + t) = 0,   J(v_i) = null(v_i^T)   (linear, 2 rows a correspondence)
    min over R, t of sum |J(v_i)^T (R p_i + t) / |R p_i + t||^2   (Gauss-Newton)

J spans the tangent plane of a bearing, where its noise lives. All bearings are taken to be equally uncertain in all
directions, so that the covariance of the paper is a multiple of the identity, and the linear rows are those of ``svd``.
If the points lie in a plane the linear system has only nine unknowns, two columns of the rotation in the plane's own
axes and t, and the third column is their cross product. Works on the whole sphere; six correspondences (the paper's own
least number).

Differs from the paper: points almost in a plane are treated as if they lay in it, since Gauss-Newton, which sees the
true points, then starts closer.

Urban, Leitloff, Hinz: MLPnP - A real-time maximum likelihood solution to the perspective-n-point problem, ISPRS Annals
III-3, 2016.
"""

import numpy as np

from spherloc.geometry import tangent_basis
from spherloc.solvers.base import NO_POSES, checked, poses
from spherloc.solvers.linear_pose import (
    DEGENERATE,
    condition,
    facing,
    linear_pose,
    nearest_rotation,
    null_matrix,
    projectors,
    translation_given,
)
from spherloc.solvers.tangent_refinement import refine_on_tangents
from spherloc.types import FloatArray

PLANAR = 0.02
"""Points whose smallest spread is below this share of the largest are treated as a plane."""


class Mlpnp:
    """Maximum-likelihood PnP."""

    name = "MLPnP"
    sample_size = 6
    pinhole = False

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose."""
        bearings, points = checked(self, bearings, points)
        conditioned = condition(points)
        if conditioned is None:
            return NO_POSES
        points, middle, scale = conditioned
        start = _linear_start(bearings, points)
        if start is None:
            return NO_POSES
        rotation, translation = refine_on_tangents(tangent_basis(bearings), points, *start)
        return poses(rotation, translation / scale - rotation @ middle)


def _linear_start(bearings: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """R and t of the linear system that suits the shape of the conditioned points."""
    spread2, axes = np.linalg.eigh(points.T @ points)
    if spread2[1] <= DEGENERATE * spread2[2]:
        return None  # on a line, about which any turn is as good
    if spread2[0] <= PLANAR**2 * spread2[2]:
        return _planar_pose(bearings, projectors(bearings), points, axes[:, ::-1])
    return linear_pose(bearings, projectors(bearings), points)


def _planar_pose(
    bearings: FloatArray, projector: FloatArray, points: FloatArray, axes: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """R and t of points in the plane of the first two ``axes`` (3, 3), columns."""
    frame = np.column_stack([axes[:, 0], axes[:, 1], np.cross(axes[:, 0], axes[:, 1])])
    coordinates = points @ frame[:, :2]
    matrix = null_matrix(projector, coordinates)
    if matrix is None:
        return None
    first, second = facing(matrix, bearings, coordinates)[:, :2].T
    third = np.cross(first, second)
    length = float(np.linalg.norm(third))
    if length == 0.0:
        return None
    # The square root brings the cross product to the scale of the other two columns.
    turned = nearest_rotation(np.column_stack([first, second, third / np.sqrt(length)]))
    if turned is None:
        return None
    rotation = turned @ frame.T
    translation = translation_given(rotation, projector, points)
    return None if translation is None else (rotation, translation)
