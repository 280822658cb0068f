"""Gauss-Newton refinement of a pose on the sphere, in pixels, and the choice of its inliers.

The residual of a correspondence is r = P v', v' the unit vector towards R p + t and P the pseudo-inverse of the
unprojection's Jacobian at the measured pixel (``Problem.pixel_from_bearing``): to first order the reprojection error of
Eq. 2, in pixels, for any camera model and across panorama seams.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds
from spherloc.errors import InputError, show
from spherloc.geometry import pose, so3_exp, transform, yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.trace import RefinementStage

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MAX_ITERATIONS = 15
MAX_ROUNDS = 10
STEP_TOLERANCE = 1e-10
LEAST_FOR_SIX_DOF = 4
"""Three points leave up to four poses and two leave a curve, so fewer inliers keep the known roll and pitch."""


Robust = Literal["none", "huber", "cauchy"]


@dataclass(frozen=True, kw_only=True)
class RefinementOptions:
    """What the refinement knows about noise: the last options of every estimator."""

    noise_px: float = 1.0
    """Standard deviation of an inlier's pixel noise, px: weighs pixels against gravity, and scales the covariance."""
    gravity_sd_deg: float | None = None
    """Standard deviation of the known roll and pitch, degrees: 0 keeps them (4 DoF), inf ignores them (the paper's
    6 DoF). None takes the problem's."""
    robust: Robust = "none"
    """Kernel that weighs down large residuals."""

    def __post_init__(self) -> None:
        if not 0.0 < self.noise_px < np.inf:
            raise InputError(f"option noise_px is {show(self.noise_px)}; give a positive number of pixels.")
        if self.gravity_sd_deg is not None and not self.gravity_sd_deg >= 0.0:
            raise InputError(f"option gravity_sd_deg is {show(self.gravity_sd_deg)}; give 0 or more, or inf.")
        if self.robust not in get_args(Robust):
            raise InputError(f"option robust is {show(self.robust)}; give one of {', '.join(get_args(Robust))}.")


def residuals_px(aligned: AlignedProblem, cam_from_map: FloatArray) -> FloatArray:
    """Reprojection error (M,), pixels to first order; inf for points behind their measured bearing."""
    rays = transform(cam_from_map, aligned.points)
    length = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(length, np.finfo(float).tiny)[:, None]
    error = np.linalg.norm(np.einsum("nij,nj->ni", aligned.pixel_from_bearing, rays), axis=1)
    error[np.einsum("ni,ni->n", rays, aligned.bearings) <= 0.0] = np.inf
    return error


def refine(
    aligned: AlignedProblem, cam_from_map: FloatArray, bounds: Bounds, options: RefinementOptions
) -> tuple[FloatArray, BoolArray, RefinementStage]:
    """Refine a pose (3, 4) between the aligned frames and its inliers until neither changes.

    ``bound_px`` (M,) is each correspondence's pixel bound. Alternates Gauss-Newton on the inliers with a new choice of
    them. Returns the last pose, its inlier mask (M,), and the stage, whose poses are
    turned back.
    """
    history, bound_px = [cam_from_map], bounds.pixels
    mask = residuals_px(aligned, cam_from_map) <= bound_px
    dof = 6
    for _ in range(MAX_ROUNDS):
        if np.count_nonzero(mask) < 2:
            break
        dof = 6 if np.count_nonzero(mask) >= LEAST_FOR_SIX_DOF else 4
        history += _gauss_newton(aligned, history[-1], mask, dof)
        chosen = residuals_px(aligned, history[-1]) <= bound_px
        if np.array_equal(chosen, mask):
            break
        mask = chosen
    errors = [residuals_px(aligned, state) for state in history]
    inliers = errors[-1] <= bound_px
    stage = RefinementStage(
        dof=dof,
        cam_from_map=np.array([aligned.unalign_pose(state) for state in history]),
        cost_px2=np.array([_mean_square(error[inliers]) for error in errors]),
        inlier_counts=np.array([np.count_nonzero(error <= bound_px) for error in errors], np.int32),
    )
    return history[-1], inliers, stage


def _mean_square(error: FloatArray) -> float:
    return float(np.mean(np.square(error))) if len(error) else float("nan")


def _gauss_newton(aligned: AlignedProblem, start: FloatArray, mask: BoolArray, dof: int) -> list[FloatArray]:
    """States after each accepted step from ``start`` on the masked correspondences."""
    points, weights = aligned.points[mask], aligned.pixel_from_bearing[mask]
    states, current = [], start
    residual, jacobian = residual_and_jacobian(points, weights, current, dof)
    cost = float(residual @ residual)
    for _ in range(MAX_ITERATIONS):
        step = np.asarray(np.linalg.lstsq(jacobian, -residual, rcond=None)[0], dtype=np.float64)
        for _halving in range(8):
            candidate = apply_step(points, current, step)
            residual, jacobian = residual_and_jacobian(points, weights, candidate, dof)
            if float(residual @ residual) <= cost:
                break
            step *= 0.5
        else:
            return states
        states.append(candidate)
        current, gain, cost = candidate, cost - float(residual @ residual), float(residual @ residual)
        if np.linalg.norm(step) < STEP_TOLERANCE or gain <= 1e-12 * cost:
            break
    return states


def apply_step(points: FloatArray, cam_from_map: FloatArray, step: FloatArray) -> FloatArray:
    """The pose after a step: a rotation vector (3,) or a yaw (1,), then a translation (3,), camera frame.

    It turns about the middle of ``points``, which keeps rotation and translation from trading against each other when
    the points are far away.
    """
    middle = transform(cam_from_map, points.mean(axis=0)[None])[0]
    turn = so3_exp(step[:3]) if len(step) == 6 else yaw_rotation(step[0])
    return pose(turn @ cam_from_map[:, :3], turn @ (cam_from_map[:, 3] - middle) + middle + step[-3:])


def residual_and_jacobian(
    points: FloatArray, weights: FloatArray, cam_from_map: FloatArray, dof: int
) -> tuple[FloatArray, FloatArray]:
    """Residuals (2 K,), px, and their derivative (2 K, dof) by the step of ``apply_step`` at zero.

    ``weights`` (K, 2, 3) is ``pixel_from_bearing`` of the ``points`` (K, 3).
    """
    rays = transform(cam_from_map, points)
    length = np.linalg.norm(rays, axis=1)[:, None]
    unit = rays / length
    by_ray = (weights - np.einsum("nij,nj,nk->nik", weights, unit, unit)) / length[..., None]
    arm = rays - rays.mean(axis=0)
    # -skew(arm): columns are e_x x arm, e_y x arm, e_z x arm.
    by_turn = np.cross(np.eye(3)[None], arm[:, None, :]).transpose(0, 2, 1)
    if dof == 4:
        by_turn = by_turn[:, :, 1:2]
    jacobian = np.concatenate([by_ray @ by_turn, by_ray], axis=2)
    return np.einsum("nij,nj->ni", weights, unit).ravel(), jacobian.reshape(-1, dof)
