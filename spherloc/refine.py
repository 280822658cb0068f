"""Refinement of a pose on the sphere, in pixels, with gravity as a measurement, and the choice of its inliers.

The residual of a correspondence is r = P v', v' the unit vector towards R p + t and P the pseudo-inverse of the
unprojection's Jacobian at the measured pixel (``Problem.pixel_from_bearing``): to first order the reprojection error of
Eq. 2, in pixels, for any camera model and across panorama seams.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from spherloc.bounds import Bounds
from spherloc.errors import InputError, show
from spherloc.gauss_newton import (
    MIN_GRAVITY_SD_RAD,
    ROBUST_CAUCHY,
    ROBUST_HUBER,
    ROBUST_NONE,
    AlignedMatches,
    CostModel,
    Noise,
    degrees_of_freedom,
    empty_equations,
    levelled,
    middle_of,
    normal_equations,
    polish_path,
    solve,
    tilt_of,
)
from spherloc.geometry import skew
from spherloc.kernel_cache import kernel
from spherloc.narrowing import ADAPTIVE_STEPS, errors_of, fit_to_noise
from spherloc.noise_scale import variance_factor
from spherloc.problem import AlignedProblem
from spherloc.ranges import check_options, is_number
from spherloc.small_arrays import (
    copy_matrix,
    copy_vector,
    count_true,
    equal,
    fill_matrix,
    fill_vector,
    mark_within,
    moved_point,
    rotation_of,
    sum_of_squares,
    translation_of,
)
from spherloc.trace import RefinementStage
from spherloc.types import BoolArray, FloatArray, IntArray

MAX_STEPS = 15
MAX_ROUNDS = 10
MAX_RESCUES = 8
"""Steps of one fit; choices of inliers; fits of a rescue."""
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


def matches_of(aligned: AlignedProblem) -> AlignedMatches:
    """The matches as kernels take them.

    All are copies: kernels also call each other with arrays of their own, which may be written to, and a read-only
    array would be another type, for which all of them are compiled once more.
    """
    return AlignedMatches(aligned.bearings.copy(), aligned.points.copy(), aligned.pixel_from_bearing.copy())


def noise_of(aligned: AlignedProblem, options: RefinementOptions) -> Noise:
    """What weighs pixels against gravity."""
    return Noise(float(options.noise_px), gravity_sd_rad(aligned, options))


def residuals_px(aligned: AlignedProblem, cam_from_map: FloatArray) -> FloatArray:
    """Reprojection error (M,), pixels to first order; inf for points behind their measured bearing."""
    return _residuals(matches_of(aligned), cam_from_map.copy())


def inlier_counts(aligned: AlignedProblem, cam_from_map: FloatArray, bound_px: float) -> IntArray:
    """How many correspondences each of P poses (P, 3, 4) between the aligned frames explains within ``bound_px``."""
    return _inlier_counts(matches_of(aligned), cam_from_map, bound_px)


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
    matches, noise, robust = matches_of(aligned), noise_of(aligned, options), ROBUST_CODES[options.robust]
    path = np.empty((2 + (MAX_ROUNDS + MAX_RESCUES) * MAX_STEPS, 3, 4))
    path[0] = cam_from_map
    limits, lost = np.empty(len(aligned.points)), np.empty(len(aligned.points), np.bool_)
    kept, limit_px = _alternate(matches, bounds.pixels, bounds.noise_px, path, noise, robust, limits, lost)
    if lost.any():
        kept += rescue(matches, limits, lost, path, kept, noise)
    return path[:kept].copy(), limit_px


def fitted_path(
    aligned: AlignedProblem, cam_from_map: FloatArray, limits_px: FloatArray, options: RefinementOptions
) -> FloatArray:
    """The poses (I, 3, 4) after each step of a fit to what a pose explains within ``limits_px`` (M,), weighed as the
    options ask for. Aligned frames."""
    matches, noise, state = matches_of(aligned), noise_of(aligned, options), cam_from_map.copy()
    path = np.empty((max(MAX_STEPS, ADAPTIVE_STEPS), 3, 4))
    if options.robust == "adaptive":
        return path[: fit_to_noise(matches, limits_px, state, noise, path)]
    mask = _residuals(matches, state) <= limits_px
    rotation, translation, robust = state[:, :3].copy(), state[:, 3].copy(), ROBUST_CODES[options.robust]
    return path[: polish_path(matches, mask, rotation, translation, noise, robust, MAX_STEPS, path)]


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
    matches, noise = matches_of(aligned), noise_of(aligned, options)
    inliers, costs, counts = _account(matches, limits_px, path)
    last = path[-1].copy()
    dof, centre, steps = _step_covariance(matches, inliers, last, noise, ROBUST_CODES[options.robust])
    if measured and np.isfinite(steps).all():
        factor = variance_factor(matches, last, inliers, options.noise_px, dof)
        measured_noise = Noise(float(options.noise_px * np.sqrt(factor)), noise.gravity_sd_rad)
        dof, centre, steps = _step_covariance(matches, inliers, last, measured_noise, ROBUST_NONE)
    stage = RefinementStage(
        dof=dof,
        cam_from_map=aligned.unalign_poses(path),
        cost_px2=costs,
        inlier_counts=counts,
        covariance=_covariance(aligned, last, centre, steps),
        gravity_sd_rad=noise.gravity_sd_rad,
        tilt_rad=float(tilt_of(last)),
    )
    return last, inliers, stage


def _covariance(aligned: AlignedProblem, cam_from_map: FloatArray, centre: FloatArray, steps: FloatArray) -> FloatArray:
    """Covariance (6, 6) as in ``RefinementStage``, from that of a step (w, d) about ``centre`` (3,), aligned frames."""
    rotation = cam_from_map[:, :3]
    middle = rotation @ centre + cam_from_map[:, 3]
    # The position -R^T t = c - R^T m moves by R^T (w x m - d).
    by_step, to_map = np.zeros((6, 6)), -(rotation @ aligned.map_turn).T
    by_step[:3, :3] = aligned.camera_turn.T
    by_step[3:, :3] = to_map @ skew(middle)
    by_step[3:, 3:] = to_map
    return by_step @ steps @ by_step.T


@kernel()
def _residuals(matches, cam_from_map):
    """Reprojection errors (M,), px, of ``matches`` at ``cam_from_map`` (3, 4); see ``residuals_px``."""
    errors = np.empty(len(matches.points))
    errors_of(matches, cam_from_map, errors)
    return errors


@kernel()
def _inlier_counts(matches, poses, bound_px):
    """How many ``matches`` are within ``bound_px`` (px) at each of the ``poses`` (P, 3, 4): (P,)."""
    counts, errors = np.zeros(len(poses), np.int64), np.empty(len(matches.points))
    for p in range(len(poses)):
        errors_of(matches, poses[p], errors)
        for k in range(len(errors)):
            counts[p] += errors[k] <= bound_px
    return counts


@kernel()
def _alternate(matches, wide_px, tight_px, path, noise, robust, limits, lost):
    """Fit and choose inliers in turn from ``path[0]``; return how many poses of ``path`` (I, 3, 4) lead to the best.

    ``matches``, ``noise`` and ``robust`` are as in ``gauss_newton.polish``. ``wide_px`` (M,) are the bounds while
    gravity is kept, ``tight_px`` the one bound once the tilt is estimated. Also returned is an inlier's bound, if below
    ``wide_px`` (else inf). ``limits`` (M,) are set to the bounds of the end, and ``lost`` (M,) to what the start
    explains within these, if that is more than the best explains (else to none).
    """
    states, count = 1, len(matches.points)
    first_errors, errors, mask = np.empty(count), np.empty(count), np.empty(count, np.bool_)
    errors_of(matches, path[0], errors)
    inliers, limit_px = mark_within(errors, wide_px, mask), np.inf
    fill_vector(lost, False)
    if inliers < 2:
        return states, limit_px
    if noise.gravity_sd_rad < MIN_GRAVITY_SD_RAD and tilt_of(path[0]) > 0.0:
        copy_matrix(levelled(path[0], middle_of(matches.points, mask)[1]), path[1])
        states = 2
        errors_of(matches, path[1], errors)
        inliers = mark_within(errors, wide_px, mask)
    copy_vector(errors, first_errors)
    copy_vector(wide_px, limits)
    kept, most, least_cost, before = states, -1, np.inf, np.empty(count, np.bool_)
    rotation, translation = rotation_of(path[states - 1]), translation_of(path[states - 1])
    most_steps = np.int64(MAX_STEPS)
    for _ in range(MAX_ROUNDS):
        if limit_px == np.inf and degrees_of_freedom(inliers, noise.gravity_sd_rad) == 6:
            limit_px, most = tight_px, -1
            for k in range(count):
                limits[k] = min(wide_px[k], limit_px)
        states += polish_path(matches, mask, rotation, translation, noise, robust, most_steps, path[states:])
        errors_of(matches, path[states - 1], errors)
        copy_vector(mask, before)
        inliers = mark_within(errors, limits, mask)
        cost = sum_of_squares(errors, mask)
        if inliers > most or (inliers == most and cost < least_cost):
            kept, most, least_cost = states, inliers, cost
        if inliers < 2 or equal(mask, before):
            break
    if mark_within(first_errors, limits, lost) <= most:
        fill_vector(lost, False)
    return kept, limit_px


@kernel()
def rescue(matches, limits_px, explained, path, states, noise):
    """Move on from the last of the ``states`` of ``path`` until as many as are in ``explained`` (M,) are inliers.

    These are ``matches`` within ``limits_px`` (M,). The next poses are written to ``path`` (I, 3, 4); returns how many,
    0 if in vain.

    Least squares on those explained, each of them weighing more the more often it was found to be outside. In vain too
    if the pose ends farther from the least-squares one, in the latter's residuals, than ``noise`` explains: then it
    would be bent towards an outlier.
    """
    count = len(matches.points)
    errors, fitted, inside = np.empty(count), np.empty(count, np.bool_), np.empty(count, np.bool_)
    errors_of(matches, path[states - 1], errors)
    members = mark_within(errors, limits_px, fitted)
    cost = sum_of_squares(errors, fitted)
    variance = max(noise.sd_px * noise.sd_px, cost / max(2 * members, 1))
    scaled, steps = AlignedMatches(matches.bearings, matches.points, matches.pixel_jacobian.copy()), 0
    rotation, translation = rotation_of(path[states - 1]), translation_of(path[states - 1])
    robust, most_steps = np.int64(ROBUST_NONE), np.int64(MAX_STEPS)
    for _ in range(MAX_RESCUES):
        rest = path[states + steps :]
        steps += polish_path(scaled, explained, rotation, translation, noise, robust, most_steps, rest)
        errors_of(matches, path[states + steps - 1], errors)
        if sum_of_squares(errors, fitted) - cost > RESCUE_REACH * variance:
            return 0
        if mark_within(errors, limits_px, inside) >= count_true(explained):
            return steps
        for k in range(count):
            if explained[k] and not inside[k]:
                for a in range(2):
                    for b in range(3):
                        scaled.pixel_jacobian[k, a, b] *= RESCUE_FACTOR
    return 0


@kernel()
def _account(matches, limits_px, path):
    """Inlier mask (M,) of the last pose of ``path`` (I, 3, 4); mean squared residual of these, px^2, and inliers.

    The latter two (I,) are of every pose. Inliers are ``matches`` within ``limits_px`` (M,).
    """
    errors, inliers, mask = (
        np.empty(len(limits_px)),
        np.empty(len(limits_px), np.bool_),
        np.empty(len(limits_px), np.bool_),
    )
    errors_of(matches, path[-1], errors)
    found = mark_within(errors, limits_px, inliers)
    costs, counts = np.empty(len(path)), np.empty(len(path), np.int32)
    for k in range(len(path)):
        errors_of(matches, path[k], errors)
        counts[k] = mark_within(errors, limits_px, mask)
        costs[k] = sum_of_squares(errors, inliers) / found if found > 0 else np.nan
    return inliers, costs, counts


@kernel()
def _step_covariance(matches, inliers, cam_from_map, noise, robust):
    """Degrees of freedom; middle (3,) of the ``inliers`` (M,), m; covariance (6, 6) of a step (w, d), rad and m.

    The step is from the pose ``cam_from_map`` (3, 4); its covariance is NaN if it has none. ``matches``, ``noise`` and
    ``robust`` are as in ``gauss_newton.polish``.
    """
    count, centre = middle_of(matches.points, inliers)
    dof = degrees_of_freedom(count, noise.gravity_sd_rad)
    covariance = np.empty((6, 6))
    fill_matrix(covariance, np.nan)
    if count < 2 or (dof == 4 and noise.gravity_sd_rad == np.inf):
        return dof, centre, covariance
    rotation = rotation_of(cam_from_map)
    middle = moved_point(rotation, translation_of(cam_from_map), centre)
    system, factor, column = empty_equations(), np.empty((6, 6)), np.empty(6)
    normal_equations(matches, inliers, centre, rotation, middle, CostModel(noise, robust, dof), system)
    for k in range(6):  # column by column: the step of a unit gradient
        fill_vector(system.gradient, 0.0)
        system.gradient[k] = -1.0
        if not solve(system, 0.0, factor, column):
            fill_matrix(covariance, np.nan)
            return dof, centre, covariance
        for a in range(6):
            covariance[a, k] = column[a]
    if dof == 4:
        covariance[0, 0] = covariance[2, 2] = 0.0
    for a in range(6):
        for b in range(a, 6):
            covariance[a, b] = covariance[b, a] = 0.5 * (covariance[a, b] + covariance[b, a])
    return dof, centre, covariance
