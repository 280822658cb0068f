"""What the linear solvers share: conditioning, null vectors, the nearest rotation, the translation of a rotation.

All of it sees conditioned points: moved by their mean and scaled to a root mean square distance of 1, so that the
origin and the unit of the map do not matter. Functions that find nothing return None.
"""

import numpy as np

from spherloc.geometry import tangent_basis
from spherloc.types import BoolArray, FloatArray

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


def condition_each(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """``condition`` for each of B sets of points (B, K, 3): points, means (B, 3), scales (B,), and which exist (B,).

    Where all points of a set coincide, they are only moved.
    """
    middle = points.mean(axis=1)
    moved = points - middle[:, None]
    size = np.sqrt(np.einsum("bki,bki->bk", moved, moved).mean(axis=1))
    exists = size > 1e-12 * (1.0 + np.abs(middle).max(axis=1))
    scale = 1.0 / np.where(exists, size, 1.0)
    return moved * scale[:, None, None], middle, scale, exists


def null_matrix(normals: FloatArray, coordinates: FloatArray) -> FloatArray | None:
    """M (3, C + 1) of norm 1 that best solves n . M [x; 1] = 0 for both normals n of each of K matches (K, 2, 3) and
    coordinates x (K, C); None if several do."""
    width = coordinates.shape[1] + 1
    known = np.ones((len(coordinates), width))
    known[:, :-1] = coordinates
    system = (normals[:, :, :, None] * known[:, None, None, :]).reshape(-1, 3 * width)
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
    """t (3,) that minimizes the sum of x^T P x, x = R p + t, for ``projector`` P (K, 3, 3), the sum of n n^T over the
    two normals of a match; None if all bearings are parallel."""
    normal = projector.sum(axis=0)
    if np.linalg.det(normal) <= DEGENERATE * len(points) ** 3:
        return None
    return -np.linalg.solve(normal, np.einsum("nij,nj->i", projector, points @ rotation.T))


def tangents_of(bearings: FloatArray) -> FloatArray:
    """``tangent_basis`` of each of B samples of unit bearings (B, K, 3): (B, K, 2, 3)."""
    samples, count = bearings.shape[:2]
    return tangent_basis(bearings.reshape(-1, 3)).reshape(samples, count, 2, 3)


def linear_poses(
    bearings: FloatArray, points: FloatArray, tangents: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """R (B, 3, 3) and t (B, 3) by the direct linear transform (null vector, rotation, translation), and which exist.

    ``bearings`` (B, K, 3) are unit vectors, ``points`` (B, K, 3) conditioned. The two rows of a correspondence are
    those of its tangents n (B, K, 2, 3), of mean length 1: n . (A p + b) = 0. What does not exist is the identity and
    zero.
    """
    samples, count = points.shape[:2]
    known = np.concatenate([points, np.ones((samples, count, 1))], axis=2)
    system = (tangents[:, :, :, :, None] * known[:, :, None, None, :]).reshape(samples, 2 * count, 12)
    stretch, right = np.linalg.svd(system, full_matrices=False)[1:]
    exists = stretch[:, -2] > DEGENERATE * stretch[:, 0]
    matrices = right[:, -1].reshape(samples, 3, 4)
    rays = np.einsum("bij,bkj->bki", matrices[:, :, :3], points) + matrices[:, None, :, 3]
    ahead = np.count_nonzero(np.einsum("bki,bki->bk", rays, bearings) > 0.0, axis=1)
    matrices = np.where((2 * ahead >= count)[:, None, None], matrices, -matrices)
    left, stretch, right = np.linalg.svd(matrices[:, :, :3])
    rotations = left @ right
    exists &= (np.linalg.det(rotations) > 0.0) & (stretch[:, 1] > DEGENERATE * stretch[:, 0])
    projector = np.einsum("bkri,bkrj->bkij", tangents, tangents)
    normal = projector.sum(axis=1)
    exists &= np.linalg.det(normal) > DEGENERATE * count**3
    rotations[~exists], normal[~exists] = np.eye(3), np.eye(3)
    turned = np.einsum("bij,bkj->bki", rotations, points)
    moment = np.einsum("bkij,bkj->bi", projector, turned)
    translations = -np.linalg.solve(normal, moment[:, :, None])[:, :, 0]
    translations[~exists] = 0.0
    return rotations, translations, exists
