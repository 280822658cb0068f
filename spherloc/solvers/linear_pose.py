"""What the linear solvers share: conditioning, null vectors, the nearest rotation, the translation of a rotation.

All of it sees conditioned points: moved by their mean and scaled to a root mean square distance of 1, so that the
origin and the unit of the map do not matter. Functions that find nothing return None.
"""

import numpy as np

from spherloc.types import FloatArray

DEGENERATE = 1e-9
"""Singular values below this, relative to the largest, are zero: several poses would solve the system."""


def condition(points: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """Conditioned points (K, 3), the mean (3,) that was taken off and the scale; None if all points coincide."""
    middle = points.mean(axis=0)
    moved = points - middle
    size = float(np.sqrt(np.mean(np.einsum("ni,ni->n", moved, moved))))
    if not size > 1e-12 * (1.0 + float(np.abs(middle).max())):
        return None
    return moved / size, middle, 1.0 / size


def projectors(bearings: FloatArray) -> FloatArray:
    """I - v v^T (K, 3, 3) of each bearing: it keeps what is orthogonal to v, and |(I - v v^T) x| = |v x x|."""
    return np.eye(3) - bearings[:, :, None] * bearings[:, None, :]


def null_matrix(projector: FloatArray, coordinates: FloatArray) -> FloatArray | None:
    """M (3, C + 1) of norm 1 that best solves v x M [x; 1] = 0 for coordinates x (K, C); None if several do."""
    width = coordinates.shape[1] + 1
    known = np.ones((len(coordinates), width))
    known[:, :-1] = coordinates
    system = (projector[:, :, :, None] * known[:, None, None, :]).reshape(-1, 3 * width)
    _, stretch, right = np.linalg.svd(system, full_matrices=False)
    return right[-1].reshape(3, width) if stretch[-2] > DEGENERATE * stretch[0] else None


def facing(matrix: FloatArray, bearings: FloatArray, coordinates: FloatArray) -> FloatArray:
    """M (3, C + 1) with the sign with which more points lie in front of their bearings."""
    rays = coordinates @ matrix[:, :-1].T + matrix[:, -1]
    ahead = np.count_nonzero(np.einsum("ni,ni->n", rays, bearings) > 0.0)
    return matrix if 2 * ahead >= len(bearings) else -matrix


def nearest_rotation(matrix: FloatArray) -> FloatArray | None:
    """The rotation (3, 3) closest to a matrix; None for a mirror image or one of rank 1."""
    left, stretch, right = np.linalg.svd(matrix)
    rotation = left @ right
    return rotation if np.linalg.det(rotation) > 0.0 and stretch[1] > DEGENERATE * stretch[0] else None


def translation_given(rotation: FloatArray, projector: FloatArray, points: FloatArray) -> FloatArray | None:
    """t (3,) that minimizes the sum of |v x (R p + t)|^2; None if all bearings are parallel."""
    normal = projector.sum(axis=0)
    if np.linalg.det(normal) <= DEGENERATE * len(points) ** 3:
        return None
    return -np.linalg.solve(normal, np.einsum("nij,nj->i", projector, points @ rotation.T))


def linear_pose(
    bearings: FloatArray, projector: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """R and t by the direct linear transform: null vector, rotation, translation."""
    matrix = null_matrix(projector, points)
    if matrix is None:
        return None
    rotation = nearest_rotation(facing(matrix, bearings, points)[:, :3])
    translation = None if rotation is None else translation_given(rotation, projector, points)
    return None if rotation is None or translation is None else (rotation, translation)
