"""Errors of a whole trajectory: ATE after an alignment, and RPE from each pose to the next, as evo defines them."""

from dataclasses import dataclass

import numpy as np

from spherloc.geometry import rotation_angle
from spherloc.types import FloatArray

MIN_POSES = 3
"""Fewer positions fix no alignment."""


@dataclass(frozen=True)
class TrajectoryError:
    """Root mean squares over the poses that have both an estimate and a truth."""

    poses: int
    """How many."""
    ate_m: float
    """Of the distances between the positions as they are: the map's frame is the truth's."""
    ate_rigid_m: float | None
    """After the best rotation and translation; None for fewer than 3 poses or where these do not fix it."""
    ate_similarity_m: float | None
    """After the best scale too."""
    rpe_m: float | None
    """Of the translation's error from each pose to the next one, m; None where the poses have no order in time."""
    rpe_deg: float | None
    """Of its rotation's error, degrees."""


def trajectory_error(truth: FloatArray, estimate: FloatArray, ordered: bool) -> TrajectoryError | None:
    """Errors of ``estimate`` (P, 3, 4) against ``truth`` (P, 3, 4), both map_from_camera; None for no poses.

    ``ordered`` says whether the poses follow each other in time.
    """
    if not len(truth):
        return None
    places, true_places = estimate[:, :, 3], truth[:, :, 3]
    moves = _moves(truth, estimate) if ordered and len(truth) > 1 else None
    return TrajectoryError(
        poses=len(truth),
        ate_m=_root_mean_square(places - true_places),
        ate_rigid_m=_aligned_error(places, true_places, with_scale=False),
        ate_similarity_m=_aligned_error(places, true_places, with_scale=True),
        rpe_m=None if moves is None else _root_mean_square(moves[:, :, 3]),
        rpe_deg=None if moves is None else _root_mean_square_angle(moves),
    )


def align(places: FloatArray, true_places: FloatArray, with_scale: bool) -> tuple[float, FloatArray, FloatArray] | None:
    """Scale, rotation (3, 3) and translation (3,) that bring places (P, 3) closest to the true ones (P, 3).

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. None for
    fewer than 3 places, or if they all lie on a line.
    """
    if len(places) < MIN_POSES:
        return None
    middle, true_middle = places.mean(axis=0), true_places.mean(axis=0)
    moved, true_moved = places - middle, true_places - true_middle
    left, stretch, right = np.linalg.svd(true_moved.T @ moved / len(places))
    if stretch[1] <= 1e-12 * max(stretch[0], 1e-300):
        return None
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(stretch @ signs / np.mean(np.sum(moved**2, axis=1))) if with_scale else 1.0
    return scale, rotation, true_middle - scale * rotation @ middle


def _aligned_error(places: FloatArray, true_places: FloatArray, with_scale: bool) -> float | None:
    found = align(places, true_places, with_scale)
    if found is None:
        return None
    scale, rotation, translation = found
    return _root_mean_square(scale * places @ rotation.T + translation - true_places)


def _moves(truth: FloatArray, estimate: FloatArray) -> FloatArray:
    """(P - 1, 3, 4): the true move from each pose to the next, inverted, times the estimated one."""
    true_moves, moves = _between(truth), _between(estimate)
    rotations = np.swapaxes(true_moves[:, :, :3], 1, 2)
    shift = moves[:, :, 3] - true_moves[:, :, 3]
    return np.concatenate([rotations @ moves[:, :, :3], np.einsum("pij,pj->pi", rotations, shift)[:, :, None]], axis=2)


def _between(poses: FloatArray) -> FloatArray:
    """(P - 1, 3, 4): each next pose seen from the one before."""
    rotations = np.swapaxes(poses[:-1, :, :3], 1, 2)
    shift = poses[1:, :, 3] - poses[:-1, :, 3]
    return np.concatenate([rotations @ poses[1:, :, :3], np.einsum("pij,pj->pi", rotations, shift)[:, :, None]], axis=2)


def _root_mean_square(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _root_mean_square_angle(moves: FloatArray) -> float:
    angles = np.array([rotation_angle(move[:, :3]) for move in moves])
    return float(np.degrees(np.sqrt(np.mean(angles**2))))
