"""How well matches fix a pose: their information on it, its standard deviations, and the matches that it hangs on.
Poses are between the aligned frames.
"""

import numpy as np

from spherloc.gauss_newton import MIN_GRAVITY_SD_RAD
from spherloc.geometry import transform
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, gravity_sd_rad
from spherloc.types import BoolArray, FloatArray

SINGULAR = 1e-12
"""Information below this share of what each unknown has by itself counts as zero: it is rounding."""
ROUNDS = 8
"""In how many rounds the matches are chosen on which a position depends most."""


def pose_sd(
    aligned: AlignedProblem,
    cam_from_map: FloatArray,
    mask: BoolArray,
    noise_px: float,
    gravity_sd_rad: float,
    drop: int,
) -> tuple[float, float, float]:
    """Standard deviations of rotation (rad), position (m) and tilt (rad) in their worst directions.

    They follow from the correspondences of ``mask`` (M,) at an aligned pose (3, 4), without the ``drop`` ones on which
    the position depends most: where the others allow a whole range of poses, one of them also agrees with some wrong
    match, which then seems to fix the position.
    """
    each = _information(aligned, cam_from_map, mask) / noise_px**2
    information = each.sum(axis=0) + _prior(gravity_sd_rad)
    for _ in range(min(drop, len(each) - 3)):
        worst = int(np.argmax(_position_without(each, information)))
        information = information - each[worst]
        each = np.delete(each, worst, axis=0)
    covariance = _inverse(information)
    return _worst(covariance[:3, :3]), _worst(covariance[3:, 3:]), _worst(covariance[0:3:2, 0:3:2])


def pivotal(
    aligned: AlignedProblem, cam_from_map: FloatArray, mask: BoolArray, options: RefinementOptions, drop: int
) -> BoolArray:
    """The ``drop`` correspondences of ``mask`` (M,) on which the position of an aligned pose (3, 4) depends most (M,).

    They are chosen a few at a time, in ``ROUNDS`` rounds: one that is left depends on those that are taken out.
    """
    chosen, found = np.flatnonzero(mask), np.zeros(len(mask), dtype=bool)
    each = _information(aligned, cam_from_map, mask) / options.noise_px**2
    information = each.sum(axis=0) + _prior(gravity_sd_rad(aligned, options))
    for some in np.array_split(np.arange(drop), min(drop, ROUNDS)):
        worst = np.argsort(-_position_without(each, information), kind="stable")[: len(some)]
        information = information - each[worst].sum(axis=0)
        found[chosen[worst]] = True
        each, chosen = np.delete(each, worst, axis=0), np.delete(chosen, worst)
    return found


def _prior(gravity_sd_rad: float) -> FloatArray:
    """Information (6, 6) of the known gravity on the tilt."""
    weight = max(gravity_sd_rad, MIN_GRAVITY_SD_RAD) ** -2.0
    return np.diag([weight, 0.0, weight, 0.0, 0.0, 0.0])


def _position_without(each: FloatArray, information: FloatArray) -> FloatArray:
    """Variances (K,) of the position in its worst direction without each one's information (K, 6, 6) of the whole
    (6, 6)."""
    return np.linalg.norm(_inverse(information - each)[:, 3:, 3:], ord=2, axis=(1, 2))


def _worst(covariance: FloatArray) -> float:
    """Standard deviation in the direction in which it is largest."""
    return float(np.sqrt(np.linalg.norm(covariance, ord=2)))


def _information(aligned: AlignedProblem, cam_from_map: FloatArray, mask: BoolArray) -> FloatArray:
    """Information matrices (K, 6, 6) of the masked correspondences on a rotation (rad) and a translation (m) of the
    camera, in its frame, for noise of 1 px."""
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
