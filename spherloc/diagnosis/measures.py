"""How far apart two poses are, and how well correspondences fix one. Poses are between the aligned frames."""

import numpy as np

from spherloc.gauss_newton import LEAST_GRAVITY_SD_RAD
from spherloc.geometry import camera_centre, rotation_angle, transform
from spherloc.problem import AlignedProblem
from spherloc.types import BoolArray, FloatArray

SINGULAR = 1e-12
"""Information below this share of what each unknown has by itself is rounding."""


def apart(one: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Angle (rad) and distance (m) between two poses (3, 4)."""
    turn = rotation_angle(one[:, :3] @ other[:, :3].T)
    return turn, float(np.linalg.norm(camera_centre(one) - camera_centre(other)))


def pose_sd(
    aligned: AlignedProblem,
    cam_from_map: FloatArray,
    mask: BoolArray,
    noise_px: float,
    gravity_sd_rad: float,
    drop: int,
) -> tuple[float, float, float]:
    """Standard deviations of rotation (rad), position (m) and tilt (rad) in their worst directions.

    They are those of the masked correspondences less the ``drop`` on which the position hangs most: where the others
    leave a valley of poses open, some pose in it agrees with a wrong match too, which then seems to fix it.
    """
    each = _information(aligned, cam_from_map, mask) / noise_px**2
    weight = max(gravity_sd_rad, LEAST_GRAVITY_SD_RAD) ** -2.0
    information = each.sum(axis=0) + np.diag([weight, 0.0, weight, 0.0, 0.0, 0.0])
    for _ in range(min(drop, len(each) - 3)):
        spread = np.linalg.norm(_inverse(information - each)[:, 3:, 3:], ord=2, axis=(1, 2))
        worst = int(np.argmax(spread))
        information = information - each[worst]
        each = np.delete(each, worst, axis=0)
    covariance = _inverse(information)
    return _worst(covariance[:3, :3]), _worst(covariance[3:, 3:]), _worst(covariance[0:3:2, 0:3:2])


def _worst(covariance: FloatArray) -> float:
    """Standard deviation in the direction in which it is largest."""
    return float(np.sqrt(np.linalg.norm(covariance, ord=2)))


def _information(aligned: AlignedProblem, cam_from_map: FloatArray, mask: BoolArray) -> FloatArray:
    """What each masked correspondence says (K, 6, 6) of a turn and a shift of the camera, in its frame, at 1 px."""
    rays, weights = transform(cam_from_map, aligned.points[mask]), aligned.pixel_from_bearing[mask]
    length = np.linalg.norm(rays, axis=1)[:, None]
    unit = rays / length
    by_ray = (weights - np.einsum("nij,nj,nk->nik", weights, unit, unit)) / length[..., None]
    # Columns e_x x ray, e_y x ray, e_z x ray.
    by_turn = by_ray @ np.cross(np.eye(3)[None], rays[:, None, :]).transpose(0, 2, 1)
    jacobian = np.concatenate([by_turn, -by_ray], axis=2)
    return np.einsum("nij,nik->njk", jacobian, jacobian)


def _inverse(information: FloatArray) -> FloatArray:
    """Inverses of information matrices (..., 6, 6), large instead of infinite where something is undetermined."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("...ii->...i", information), SINGULAR))
    scale = scale[..., :, None] * scale[..., None, :]
    return np.linalg.inv(information * scale + SINGULAR * np.eye(6)) * scale
