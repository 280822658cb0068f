"""Robust fits of a pose at narrowing bounds, and its truncated squares: compiled.

The truncated squares of a pose are sum min(|r|^2, bound^2) / noise_px^2 + |tilt|^2 / gravity_sd_rad^2, r a residual in
pixels as in ``gauss_newton``: unlike the number of inliers they tell poses apart that explain as many correspondences,
but not as well. They have many local minima. A fit at narrowing bounds, by Gauss-Newton on Geman-McClure weights,
passes by those that only the wide bound makes; fits to few random correspondences near a pose leave others.
"""

import numba
import numpy as np

from spherloc.gauss_newton import (
    LEAST_GRAVITY_SD_RAD,
    ROBUST_NONE,
    degrees_of_freedom,
    middle_of,
    normal_equations,
    polish,
    solve,
    tilt_of,
    turn,
)

NARROWINGS = (1.0, 0.4, 0.15, 0.0)
"""Shares of what gravity's error adds to the bound that the successive bounds keep."""
SCALE = 1.0 / 3.0
"""Scale of the Geman-McClure weights in bounds: the bound is three standard deviations of the noise, or so."""
MOST_STEPS = 6
"""At each bound."""
LEAST_STEP = 1e-7
"""Length of a step (rad, and m) at which a bound is done with."""
DAMPING = 1e-9
MOST_DESCENTS = 10
"""Choices of inliers on the way to a minimum of the truncated squares."""
SAMPLE, SAMPLE_STEPS, SAMPLE_DAMPING = 4, 4, 1e-6
"""Correspondences of a random fit, one more than fix a pose, and the steps and damping of its Gauss-Newton."""
PROMISING_STEPS = 3
LEAST_SAMPLES, MOST_SAMPLES = 30, 200
"""Sampling goes on for at least so many after the last improvement."""
MISSED = 1e-3
"""Probability, by Eq. 28, that no sample held inliers only, at which sampling ends."""
FINE = 0.3
"""Standard deviation of the finer part of the noise, in units of the stated noise: real matches mix sharp and blurred
ones. (Two scales: with four, normal noise is taken for a mixture more often, and real poses gain little.)"""
PRIOR = (10.0, 0.1)
"""Correspondences with stated and with finer noise that are believed in beforehand."""
FIRST_ROUNDS, ROUNDS = 20, 3
"""Of expectation and maximisation for the share of finer noise, at the first step and at the others."""
ADAPTIVE_STEPS, ADAPTIVE_END = 15, 1e-6
LEAST_FOR_NOISE = 8
"""Correspondences from which something can be said about their noise."""


@numba.njit(cache=True, nogil=True)
def errors_of(bearings, points, weights, cam_from_map, errors):
    """Write the reprojection errors (M,), px to first order; inf for points behind their measured bearing."""
    p = cam_from_map
    for k in range(len(points)):
        x = p[0, 0] * points[k, 0] + p[0, 1] * points[k, 1] + p[0, 2] * points[k, 2] + p[0, 3]
        y = p[1, 0] * points[k, 0] + p[1, 1] * points[k, 1] + p[1, 2] * points[k, 2] + p[1, 3]
        z = p[2, 0] * points[k, 0] + p[2, 1] * points[k, 1] + p[2, 2] * points[k, 2] + p[2, 3]
        if bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z > 0.0:
            du = weights[k, 0, 0] * x + weights[k, 0, 1] * y + weights[k, 0, 2] * z
            dv = weights[k, 1, 0] * x + weights[k, 1, 1] * y + weights[k, 1, 2] * z
            errors[k] = np.sqrt((du * du + dv * dv) / (x * x + y * y + z * z))
        else:
            errors[k] = np.inf


@numba.njit(cache=True, nogil=True)
def truncated_squares(bearings, points, weights, limits_px, cam_from_map, noise_px, gravity_sd_rad, most):
    """The truncated squares of a pose (3, 4) at the bounds ``limits_px`` (M,); more than ``most`` once that is passed.

    The tilt costs nothing where gravity is exact (the pose keeps it) or unknown.
    """
    p, precision, total = cam_from_map, noise_px**-2.0, 0.0
    if LEAST_GRAVITY_SD_RAD <= gravity_sd_rad < np.inf:
        total = (tilt_of(p) / gravity_sd_rad) ** 2
    for k in range(len(points)):
        x = p[0, 0] * points[k, 0] + p[0, 1] * points[k, 1] + p[0, 2] * points[k, 2] + p[0, 3]
        y = p[1, 0] * points[k, 0] + p[1, 1] * points[k, 1] + p[1, 2] * points[k, 2] + p[1, 3]
        z = p[2, 0] * points[k, 0] + p[2, 1] * points[k, 1] + p[2, 2] * points[k, 2] + p[2, 3]
        limit = limits_px[k] * limits_px[k]
        if bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z > 0.0:
            du = weights[k, 0, 0] * x + weights[k, 0, 1] * y + weights[k, 0, 2] * z
            dv = weights[k, 1, 0] * x + weights[k, 1, 1] * y + weights[k, 1, 2] * z
            limit = min(limit, (du * du + dv * dv) / (x * x + y * y + z * z))
        total += precision * limit
        if total > most:
            break
    return total


@numba.njit(cache=True, nogil=True)
def robust_steps(bearings, points, weights, limits_px, cam_from_map, noise_px, gravity_sd_rad, most_steps):
    """Move ``cam_from_map`` (3, 4) in place by Gauss-Newton steps on Geman-McClure weights within ``limits_px``."""
    count = len(points)
    errors, near, heavy = np.empty(count), np.empty(count, np.bool_), np.empty((count, 2, 3))
    for _ in range(most_steps):
        errors_of(bearings, points, weights, cam_from_map, errors)
        for k in range(count):
            near[k] = errors[k] <= limits_px[k]
            if near[k]:
                ratio = errors[k] / (SCALE * limits_px[k])
                share = 1.0 / (1.0 + ratio * ratio)
                for a in range(2):
                    for b in range(3):
                        heavy[k, a, b] = share * weights[k, a, b]
        if not _step(points, heavy, near, cam_from_map, noise_px, gravity_sd_rad, DAMPING) > LEAST_STEP:
            break


@numba.njit(cache=True, nogil=True)
def _step(points, weights, chosen, cam_from_map, noise_px, gravity_sd_rad, damping):
    """One Gauss-Newton step on the chosen correspondences, in place; its length, 0 if there is none."""
    count, centre = middle_of(points, chosen)
    if count < 2:
        return 0.0
    dof = degrees_of_freedom(count, gravity_sd_rad)
    hessian, gradient, step, factor = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((6, 6))
    rotation, turned = cam_from_map[:, :3].copy(), np.empty((3, 3))
    middle = rotation @ centre + cam_from_map[:, 3]
    model = (noise_px, gravity_sd_rad, ROBUST_NONE, dof)
    cost = normal_equations(points, weights, chosen, centre, rotation, middle, *model, hessian, gradient)
    if not cost < np.inf or not solve(hessian, gradient, damping, factor, step):
        return 0.0
    length = np.sqrt((step * step).sum())
    turn(step, rotation, turned)
    moved = middle + step[3:] - turned @ centre
    if not np.isfinite(moved).all() or not np.isfinite(turned).all():
        return 0.0
    cam_from_map[:, :3], cam_from_map[:, 3] = turned, moved
    return length


@numba.njit(cache=True, nogil=True)
def narrow(bearings, points, weights, wide_px, tight_px, start, noise_px, gravity_sd_rad, path):
    """Fits at bounds that narrow from ``wide_px`` (M,) to ``tight_px`` (M,), each from the last: written to ``path``.

    ``path`` is (``len(NARROWINGS)``, 3, 4).
    """
    at = start.copy()
    for k, share in enumerate(NARROWINGS):
        limits = tight_px + share * (wide_px - tight_px)
        robust_steps(bearings, points, weights, limits, at, noise_px, gravity_sd_rad, np.int64(MOST_STEPS))
        path[k] = at


@numba.njit(cache=True, nogil=True)
def descend(bearings, points, weights, limits_px, cam_from_map, noise_px, gravity_sd_rad, path):
    """Least squares on the inliers and new choices of these while the truncated squares fall.

    ``cam_from_map`` (3, 4) is changed in place, the pose after each choice written to ``path`` (``MOST_DESCENTS``, 3,
    4). Returns how many, and the truncated squares.
    """
    data = (bearings, points, weights)
    errors, states = np.empty(len(points)), 0
    least = truncated_squares(*data, limits_px, cam_from_map, noise_px, gravity_sd_rad, np.inf)
    before = np.zeros(len(points), np.bool_)
    while states < MOST_DESCENTS:
        errors_of(bearings, points, weights, cam_from_map, errors)
        mask = errors <= limits_px
        if np.array_equal(mask, before):
            break
        rotation, translation = cam_from_map[:, :3].copy(), cam_from_map[:, 3].copy()
        model = (noise_px, gravity_sd_rad, np.int64(ROBUST_NONE))
        polish(points, weights, mask, rotation, translation, *model, np.int64(MOST_STEPS))
        at = np.empty((3, 4))
        at[:, :3], at[:, 3] = rotation, translation
        cost = truncated_squares(*data, limits_px, at, noise_px, gravity_sd_rad, np.inf)
        if not cost < least:
            break
        cam_from_map[:], path[states], least, before = at, at, cost, mask
        states += 1
    return states, least


@numba.njit(cache=True, nogil=True)
def search_nearby(bearings, points, weights, wide_px, limits_px, start, noise_px, gravity_sd_rad, best, least):
    """Look for a better pose than ``best`` by fits to few random ones of what ``start`` explains within ``wide_px``.

    ``best`` (3, 4), of ``least`` truncated squares, is changed in place; returns its truncated squares. Every call
    draws alike.
    """
    data = (bearings, points, weights)
    errors = np.empty(len(points))
    errors_of(bearings, points, weights, start, errors)
    around = np.flatnonzero(errors <= wide_px)
    if len(around) <= SAMPLE:
        return least
    state, drawn, improved = np.uint64(0x9E3779B97F4A7C15), 0, 0
    needed = _samples_needed(bearings, points, weights, limits_px, best, around, errors)
    sample, chosen = np.empty(SAMPLE, np.int64), np.ones(SAMPLE, np.bool_)
    while drawn < MOST_SAMPLES and (drawn < needed or drawn < improved + LEAST_SAMPLES):
        for k in range(SAMPLE):
            fresh = False
            while not fresh:
                state, place = _draw(state, len(around))
                sample[k], fresh = around[place], True
                for other in range(k):
                    fresh = fresh and sample[other] != sample[k]
        drawn += 1
        at = start.copy()
        for _ in range(SAMPLE_STEPS):
            _step(points[sample], weights[sample], chosen, at, noise_px, gravity_sd_rad, SAMPLE_DAMPING)
        if truncated_squares(*data, limits_px, at, noise_px, gravity_sd_rad, least) >= least:
            continue
        robust_steps(*data, limits_px, at, noise_px, gravity_sd_rad, np.int64(PROMISING_STEPS))
        cost = truncated_squares(*data, limits_px, at, noise_px, gravity_sd_rad, least)
        if cost >= least:
            continue
        least, best[:], improved = cost, at, drawn
        needed = _samples_needed(bearings, points, weights, limits_px, best, around, errors)
    return least


@numba.njit(cache=True, nogil=True)
def _samples_needed(bearings, points, weights, limits_px, best, around, errors):
    """Samples from ``around`` after which one was surely drawn from inliers of the best pose only (Eq. 28)."""
    errors_of(bearings, points, weights, best, errors)
    inliers = 0
    for k in around:
        inliers += errors[k] <= limits_px[k]
    clean = (inliers / len(around)) ** SAMPLE
    return 1 if clean >= 1.0 else int(min(np.log(MISSED) / np.log1p(-max(clean, 1e-9)), MOST_SAMPLES))


@numba.njit(cache=True, nogil=True)
def share_of_fine(errors, near, limits_px, noise_px, share, rounds, fine):
    """Share of the ``near`` correspondences with the finer noise, from a guess; their probabilities to ``fine`` (M,).

    Expectation and maximisation of a mixture of two normal distributions in the plane, cut off at ``limits_px`` (M,).
    """
    wide, sharp = 0.5 / noise_px**2, 0.5 / (FINE * noise_px) ** 2
    for _ in range(rounds):
        total, count = 0.0, 0
        for k in range(len(errors)):
            if near[k]:
                square, most = errors[k] * errors[k], limits_px[k] * limits_px[k]
                blurred = (1.0 - share) * wide * np.exp(-wide * square) / -np.expm1(-wide * most)
                crisp = share * sharp * np.exp(-sharp * square) / -np.expm1(-sharp * most)
                fine[k] = crisp / (blurred + crisp) if crisp > 0.0 else 0.0
                total, count = total + fine[k], count + 1
        share = (total + PRIOR[1]) / (count + PRIOR[0] + PRIOR[1])
    return share


@numba.njit(cache=True, nogil=True)
def fit_to_noise(bearings, points, weights, limits_px, cam_from_map, noise_px, gravity_sd_rad, path):
    """Maximise the likelihood of what lies within ``limits_px`` (M,) under a mixture of stated and finer noise.

    The share of the finer noise is estimated with the pose: normal noise of ``noise_px`` is fitted by least squares,
    and where most matches are much sharper, they decide. ``cam_from_map`` (3, 4) is changed in place, the pose after
    each step written to ``path`` (``ADAPTIVE_STEPS``, 3, 4); returns the steps.
    """
    count = len(points)
    errors, near = np.empty(count), np.empty(count, np.bool_)
    fine, heavy = np.empty(count), np.empty((count, 2, 3))
    share = PRIOR[1] / (PRIOR[0] + PRIOR[1])
    for done in range(ADAPTIVE_STEPS):
        errors_of(bearings, points, weights, cam_from_map, errors)
        for k in range(count):
            near[k] = errors[k] <= limits_px[k]
        if np.count_nonzero(near) < LEAST_FOR_NOISE:
            return done
        rounds = ROUNDS if done else FIRST_ROUNDS
        share = share_of_fine(errors, near, limits_px, noise_px, share, rounds, fine)
        for k in range(count):
            if near[k]:
                scale = np.sqrt(1.0 - fine[k] + fine[k] / (FINE * FINE))
                for a in range(2):
                    for b in range(3):
                        heavy[k, a, b] = scale * weights[k, a, b]
        length = _step(points, heavy, near, cam_from_map, noise_px, gravity_sd_rad, DAMPING)
        path[done] = cam_from_map
        if not length > ADAPTIVE_END:
            return done + 1
    return ADAPTIVE_STEPS


@numba.njit(cache=True, nogil=True)
def _draw(state, count):
    """The next state of xorshift64, and a number below ``count``."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    return state, np.int64((state >> np.uint64(33)) % np.uint64(count))
