"""Where mc-exact begins: poses within the gravity bound that explain many matches within the noise bound alone."""

import numpy as np

from spherloc.bounds import Bounds
from spherloc.consensus.pose_cells import TILT_A, Matches, parameters_of, pose_of
from spherloc.consensus.two_point_search import TwoPointSearch
from spherloc.gauss_newton import LEAST_FOR_SIX_DOF, ROBUST_CAUCHY, polish
from spherloc.geometry import pose, yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.refine import residuals_px
from spherloc.types import FloatArray

NARROWINGS, ROUNDS, STEPS = 5, 2, 10
"""Bounds from the widened one to that of the noise, choices of inliers at each, and steps on each choice."""
STARTS = 3
"""Hypotheses of the sampling, the last ones, that are tried where gravity is uncertain."""


def supported(aligned: AlignedProblem, cam_from_map: FloatArray, bound_px: float) -> int:
    """How many matches a pose (3, 4) explains."""
    return int(np.count_nonzero(residuals_px(aligned, cam_from_map) <= bound_px))


def first_pose(
    aligned: AlignedProblem, bounds: Bounds, matches: Matches, guess: TwoPointSearch
) -> tuple[FloatArray, int] | None:
    """A pose (3, 4) within the gravity bound and what it explains, from a search that took gravity as exact."""
    if not guess.found:
        return None
    best = np.argsort(-guess.support, kind="stable")[: STARTS if aligned.gravity_bound_rad > 0.0 else 1]
    poses = [pose(yaw_rotation(float(guess.yaws_rad[k])), guess.translations[k]) for k in best]
    if aligned.gravity_bound_rad > 0.0:
        poses += [tilted for level in poses for tilted in _narrowed(aligned, bounds, matches, level)]
    counts = [supported(aligned, one, bounds.noise_px) for one in poses]
    most = int(np.argmax(counts))
    return (poses[most], counts[most]) if counts[most] > 1 else None


def within_gravity(matches: Matches, cam_from_map: FloatArray, gravity_bound_rad: float) -> FloatArray:
    """The pose (3, 4), or one with the same position whose tilt is just within the gravity bound."""
    chart, at = parameters_of(matches, cam_from_map)
    tilt = float(np.arccos(min(1.0, np.cos(at[TILT_A]) * np.cos(at[TILT_A + 1]))))
    if tilt <= gravity_bound_rad:
        return cam_from_map
    # cos a cos c falls with both, and (a, c) scaled by bound / tilt is within.
    at[TILT_A:] *= gravity_bound_rad / tilt * (1.0 - 1e-9)
    while np.cos(at[TILT_A]) * np.cos(at[TILT_A + 1]) < np.cos(gravity_bound_rad):
        at[TILT_A:] *= 1.0 - 1e-3
    return pose_of(matches, chart, at)


def _narrowed(aligned: AlignedProblem, bounds: Bounds, matches: Matches, cam_from_map: FloatArray) -> list[FloatArray]:
    """Poses (3, 4) within the gravity bound from robust fits in six degrees of freedom at narrowing bounds."""
    weights = aligned.pixel_from_bearing.copy()
    widest = float(np.median(bounds.pixels))
    rotation, translation = cam_from_map[:, :3].copy(), cam_from_map[:, 3].copy()
    found = []
    for limit_px in np.geomspace(widest, bounds.noise_px, NARROWINGS):
        for _ in range(ROUNDS):
            chosen = residuals_px(aligned, pose(rotation, translation)) <= limit_px
            if np.count_nonzero(chosen) < LEAST_FOR_SIX_DOF:
                return found
            polish(
                aligned.points,
                weights,
                chosen,
                rotation,
                translation,
                limit_px / 3.0,
                aligned.gravity_bound_rad / 3.0,
                ROBUST_CAUCHY,
                STEPS,
            )
        found.append(within_gravity(matches, pose(rotation, translation), aligned.gravity_bound_rad))
    return found
