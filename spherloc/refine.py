"""Refinement of a pose on the sphere, in pixels, with gravity as a measurement, and the choice of its inliers.

The residual of a correspondence is r = P v', v' the unit vector towards R p + t and P the pseudo-inverse of the
unprojection's Jacobian at the measured pixel (``Problem.pixel_from_bearing``): to first order the reprojection error of
Eq. 2, in pixels, for any camera model and across panorama seams.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numba
import numpy as np

from spherloc.bounds import Bounds
from spherloc.errors import InputError, show
from spherloc.gauss_newton import (
    LEAST_GRAVITY_SD_RAD,
    ROBUST_CAUCHY,
    ROBUST_HUBER,
    ROBUST_NONE,
    degrees_of_freedom,
    levelled,
    middle_of,
    normal_equations,
    polish_path,
    solve,
    tilt_of,
)
from spherloc.geometry import skew
from spherloc.narrowing import ADAPTIVE_STEPS, errors_of, fit_to_noise
from spherloc.noise_scale import variance_factor
from spherloc.problem import AlignedProblem
from spherloc.ranges import check_options, is_number
from spherloc.trace import RefinementStage
from spherloc.types import BoolArray, FloatArray

MAX_STEPS = 15
MAX_ROUNDS = 10
MAX_RESCUES = 8
RESCUE_FACTOR = 1.5
"""By which the residuals of inliers that least squares would lose grow from one rescue to the next."""
RESCUE_REACH = 16.8
"""How much a rescue may raise the cost, in variances of the noise: 99 % of chi-square with 6 degrees of freedom, so
that the pose stays where the true one may be. Without it, one outlier near a loose bound bends the pose by degrees."""

Robust = Literal["none", "huber", "cauchy", "adaptive"]


@dataclass(frozen=True, kw_only=True)
class RefinementOptions:
    """What the refinement knows about noise: the last options of every estimator."""

    noise_px: float = 1.0
    """Standard deviation of an inlier's pixel noise, px: weighs pixels against gravity, and scales the covariance."""
    gravity_sd_deg: float | None = None
    """Standard deviation of the known roll and pitch, degrees: 0 keeps them (4 DoF), inf ignores them (the paper's
    6 DoF). None takes the problem's."""
    robust: Robust = "adaptive"
    """How residuals are weighed: "adaptive", by the likelihood under a mixture of ``noise_px`` and a third of it, whose
    shares are estimated; "none", all alike; or by a kernel that weighs down those beyond 1.345 ("huber") or around
    2.385 ("cauchy") times ``noise_px``, the usual constants, which cost 5 % efficiency if the noise is normal."""

    def __post_init__(self) -> None:
        check_options(self)
        if not (is_number(self.noise_px) and 0.0 < self.noise_px < np.inf):
            raise InputError(f"option noise_px is {show(self.noise_px)}; give a positive number of pixels.")
        sd = self.gravity_sd_deg
        if sd is not None and not (is_number(sd) and sd >= 0.0):
            raise InputError(f"option gravity_sd_deg is {show(self.gravity_sd_deg)}; give 0 or more, or inf.")
        if self.robust not in get_args(Robust):
            raise InputError(f"option robust is {show(self.robust)}; give one of {', '.join(get_args(Robust))}.")


ROBUST_CODES = {"none": ROBUST_NONE, "huber": ROBUST_HUBER, "cauchy": ROBUST_CAUCHY, "adaptive": ROBUST_NONE}
"""Kernels of ``gauss_newton``; "adaptive" is the last step's, after least squares."""


def gravity_sd_rad(aligned: AlignedProblem, options: RefinementOptions) -> float:
    """Standard deviation (rad) of each tilt of the given gravity that the options ask for."""
    return aligned.gravity_sd_rad if options.gravity_sd_deg is None else float(np.radians(options.gravity_sd_deg))


def residuals_px(aligned: AlignedProblem, cam_from_map: FloatArray) -> FloatArray:
    """Reprojection error (M,), pixels to first order; inf for points behind their measured bearing."""
    return _residuals(aligned.bearings, aligned.points, aligned.pixel_from_bearing.copy(), cam_from_map.copy())


def refine(
    aligned: AlignedProblem, cam_from_map: FloatArray, bounds: Bounds, options: RefinementOptions
) -> tuple[FloatArray, BoolArray, RefinementStage]:
    """Refine a pose (3, 4) between the aligned frames and its inliers until neither changes.

    Alternates Gauss-Newton on the inliers with a new choice of them: at first by ``bounds.pixels``, and once the tilt
    is estimated by ``bounds.noise_px``, since gravity's error is no longer in the residuals. Least squares may lose
    inliers on the way or go round in circles, so what counts is the round that ended with the most inliers (ties: the
    smaller cost). Where the start explains more than that, by the same bound, its inliers are fitted with growing
    weights on those that would be lost. So the consensus of the start is kept, unless that takes a pose that noise
    cannot have brought about (``RESCUE_REACH``). Exact gravity turns the start to a pure yaw first.

    Returns the pose, its inlier mask (M,), and the stage, whose poses and covariance are those of the problem's own
    frames.
    """
    path, limit_px = refined_path(aligned, cam_from_map, bounds, options)
    return record(aligned, path, np.minimum(bounds.pixels, limit_px), options)


def refined_path(
    aligned: AlignedProblem, cam_from_map: FloatArray, bounds: Bounds, options: RefinementOptions
) -> tuple[FloatArray, float]:
    """The poses (I + 1, 3, 4) of ``refine`` between the aligned frames, and its inliers' bound where it is below
    ``bounds.pixels`` (else inf)."""
    # A copy may be written to: one type of array, so that the kernels below are compiled once.
    data = (aligned.bearings, aligned.points, aligned.pixel_from_bearing.copy())
    model = (options.noise_px, gravity_sd_rad(aligned, options), ROBUST_CODES[options.robust])
    return _alternate(*data, bounds.pixels, bounds.noise_px, cam_from_map.copy(), *model)


def fitted_path(
    aligned: AlignedProblem, cam_from_map: FloatArray, limits_px: FloatArray, options: RefinementOptions
) -> FloatArray:
    """The poses (I, 3, 4) after each step of a fit to what a pose explains within ``limits_px`` (M,), weighed as the
    options ask for. Aligned frames."""
    weights, state = aligned.pixel_from_bearing.copy(), cam_from_map.copy()
    model = (options.noise_px, gravity_sd_rad(aligned, options))
    path = np.empty((max(MAX_STEPS, ADAPTIVE_STEPS), 3, 4))
    if options.robust == "adaptive":
        return path[: fit_to_noise(aligned.bearings, aligned.points, weights, limits_px, state, *model, path)]
    mask = _residuals(aligned.bearings, aligned.points, weights, state) <= limits_px
    rotation, translation = state[:, :3].copy(), state[:, 3].copy()
    steps = (*model, ROBUST_CODES[options.robust], MAX_STEPS, path)
    return path[: polish_path(aligned.points, weights, mask, rotation, translation, *steps)]


def record(
    aligned: AlignedProblem,
    path: FloatArray,
    limits_px: FloatArray,
    options: RefinementOptions,
    measured: bool = False,
) -> tuple[FloatArray, BoolArray, RefinementStage]:
    """What ``refine`` returns of a path of poses (I + 1, 3, 4) between the aligned frames, whose last is the result.

    Its inliers are the correspondences within ``limits_px`` (M,). ``measured`` has the covariance be that of the noise
    that the residuals show (``noise_scale``), not that of the stated noise.
    """
    data, sd = (aligned.points, aligned.pixel_from_bearing.copy()), gravity_sd_rad(aligned, options)
    inliers, costs, counts = _account(aligned.bearings, *data, limits_px, path)
    last = path[-1].copy()
    model = (options.noise_px, sd, ROBUST_CODES[options.robust])
    dof, centre, steps = _step_covariance(*data, inliers, last, *model)
    if measured and np.isfinite(steps).all():
        factor = variance_factor(aligned, last, inliers, options.noise_px, dof)
        model = (options.noise_px * np.sqrt(factor), sd, ROBUST_NONE)
        dof, centre, steps = _step_covariance(*data, inliers, last, *model)
    stage = RefinementStage(
        dof=dof,
        cam_from_map=_unaligned(aligned, path),
        cost_px2=costs,
        inlier_counts=counts,
        covariance=_covariance(aligned, last, centre, steps),
        gravity_sd_rad=sd,
        tilt_rad=float(tilt_of(last)),
    )
    return last, inliers, stage


def _unaligned(aligned: AlignedProblem, path: FloatArray) -> FloatArray:
    """Poses (K, 3, 4) of the problem's own frames. The ends are those of ``unalign_pose`` to the last bit."""
    turned = aligned.camera_turn.T @ path
    turned[:, :, :3] = turned[:, :, :3] @ aligned.map_turn
    turned[0], turned[-1] = aligned.unalign_pose(path[0]), aligned.unalign_pose(path[-1])
    return turned


def _covariance(aligned: AlignedProblem, cam_from_map: FloatArray, centre: FloatArray, steps: FloatArray) -> FloatArray:
    """Covariance (6, 6) as in ``RefinementStage``, from that of a step (w, d) about ``centre`` (3,), aligned frames."""
    rotation = cam_from_map[:, :3]
    middle = rotation @ centre + cam_from_map[:, 3]
    # The position -R^T t = c - R^T m moves by R^T (w x m - d).
    by_step = np.zeros((6, 6))
    by_step[:3, :3] = aligned.camera_turn.T
    by_step[3:, :3] = -aligned.map_turn.T @ rotation.T @ skew(middle)
    by_step[3:, 3:] = -aligned.map_turn.T @ rotation.T
    return by_step @ steps @ by_step.T


@numba.njit(cache=True, nogil=True)
def _residuals(bearings, points, weights, cam_from_map):
    """See ``residuals_px``."""
    errors = np.empty(len(points))
    errors_of(bearings, points, weights, cam_from_map, errors)
    return errors


@numba.njit(cache=True, nogil=True)
def _alternate(bearings, points, weights, wide_px, tight_px, start, noise_px, gravity_sd_rad, robust):
    """The states (I + 1, 3, 4) from ``start`` (3, 4) to the one to return; an inlier's bound, if below ``wide_px``."""
    path = np.empty((2 + (MAX_ROUNDS + MAX_RESCUES) * MAX_STEPS, 3, 4))
    path[0], states = start, 1
    errors = _residuals(bearings, points, weights, start)
    mask = errors <= wide_px
    if np.count_nonzero(mask) < 2:
        return path[:1], np.inf
    if gravity_sd_rad < LEAST_GRAVITY_SD_RAD and tilt_of(start) > 0.0:
        path[1], states = levelled(start, middle_of(points, mask)[1]), 2
        errors = _residuals(bearings, points, weights, path[1])
        mask = errors <= wide_px
    first_errors, limit_px = errors, np.inf
    kept, most, least_cost = states, -1, np.inf
    rotation, translation = path[states - 1, :, :3].copy(), path[states - 1, :, 3].copy()
    most_steps = np.int64(MAX_STEPS)
    for _ in range(MAX_ROUNDS):
        if limit_px == np.inf and degrees_of_freedom(np.count_nonzero(mask), gravity_sd_rad) == 6:
            limit_px, most = tight_px, -1
        states += polish_path(
            points, weights, mask, rotation, translation, noise_px, gravity_sd_rad, robust, most_steps, path[states:]
        )
        errors = _residuals(bearings, points, weights, path[states - 1])
        before, mask = mask, errors <= np.minimum(wide_px, limit_px)
        inliers, cost = np.count_nonzero(mask), np.sum(errors[mask] ** 2)
        if inliers > most or (inliers == most and cost < least_cost):
            kept, most, least_cost = states, inliers, cost
        if inliers < 2 or np.array_equal(mask, before):
            break
    limits = np.minimum(wide_px, limit_px)
    if np.count_nonzero(first_errors <= limits) > most:
        explained = first_errors <= limits
        kept += _rescue(bearings, points, weights, limits, explained, path, kept, noise_px, gravity_sd_rad)
    return path[:kept].copy(), limit_px


@numba.njit(cache=True, nogil=True)
def _rescue(bearings, points, weights, limits_px, explained, path, states, noise_px, gravity_sd_rad):
    """Move on from the last of ``states`` until as many as are in ``explained`` are inliers; the steps, 0 if in vain.

    Least squares on these, each of them weighing more the more often it was found to be outside. In vain too if the
    pose ends farther from the least-squares one, in the latter's residuals, than noise explains: then it would be bent
    towards an outlier.
    """
    errors = _residuals(bearings, points, weights, path[states - 1])
    fitted = errors <= limits_px
    cost = np.sum(errors[fitted] ** 2)
    variance = max(noise_px * noise_px, cost / max(2 * np.count_nonzero(fitted), 1))
    heavy, steps = weights.copy(), 0
    rotation, translation = path[states - 1, :, :3].copy(), path[states - 1, :, 3].copy()
    for _ in range(MAX_RESCUES):
        rest = path[states + steps :]
        model = (noise_px, gravity_sd_rad, np.int64(ROBUST_NONE), np.int64(MAX_STEPS))
        steps += polish_path(points, heavy, explained, rotation, translation, *model, rest)
        errors = _residuals(bearings, points, weights, path[states + steps - 1])
        if np.sum(errors[fitted] ** 2) - cost > RESCUE_REACH * variance:
            return 0
        inside = errors <= limits_px
        if np.count_nonzero(inside) >= np.count_nonzero(explained):
            return steps
        for k in np.flatnonzero(explained & ~inside):
            heavy[k] *= RESCUE_FACTOR
    return 0


@numba.njit(cache=True, nogil=True)
def _account(bearings, points, weights, limits_px, path):
    """Inlier mask (M,) of the last state; mean squared residual of these, and number of inliers, at every state."""
    inliers = _residuals(bearings, points, weights, path[-1]) <= limits_px
    costs, counts = np.full(len(path), np.nan), np.zeros(len(path), np.int32)
    for k in range(len(path)):
        errors, total = _residuals(bearings, points, weights, path[k]), 0.0
        for i in range(len(errors)):
            counts[k] += errors[i] <= limits_px[i]
            total += errors[i] ** 2 if inliers[i] else 0.0
        if inliers.any():
            costs[k] = total / np.count_nonzero(inliers)
    return inliers, costs, counts


@numba.njit(cache=True, nogil=True)
def _step_covariance(points, weights, inliers, cam_from_map, noise_px, gravity_sd_rad, robust):
    """Degrees of freedom; middle (3,) of the inliers; covariance (6, 6) of a step (w, d), NaN if it has none."""
    count, centre = middle_of(points, inliers)
    dof = degrees_of_freedom(count, gravity_sd_rad)
    covariance = np.full((6, 6), np.nan)
    if count < 2 or (dof == 4 and gravity_sd_rad == np.inf):
        return dof, centre, covariance
    rotation = cam_from_map[:, :3].copy()
    middle = rotation @ centre + cam_from_map[:, 3]
    hessian, factor, unit, column = np.empty((6, 6)), np.empty((6, 6)), np.zeros(6), np.empty(6)
    normal_equations(
        points, weights, inliers, centre, rotation, middle, noise_px, gravity_sd_rad, robust, dof, hessian, unit
    )
    for k in range(6):
        unit[:] = 0.0
        unit[k] = -1.0
        if not solve(hessian, unit, 0.0, factor, column):
            return dof, centre, np.full((6, 6), np.nan)
        covariance[:, k] = column
    if dof == 4:
        covariance[0, 0] = covariance[2, 2] = 0.0
    return dof, centre, 0.5 * (covariance + covariance.T)
