"""Robust fits of a pose at narrowing bounds, and its truncated squares: compiled.

The truncated squares of a pose are sum min(|r|^2, bound^2) / noise_px^2 + |tilt|^2 / gravity_sd_rad^2, r a residual in
pixels as in ``gauss_newton``: unlike the number of inliers they tell poses apart that explain as many correspondences,
but not as well. They have many local minima. A fit at narrowing bounds, by Gauss-Newton on Geman-McClure weights,
passes by those that only the wide bound makes; fits to few random correspondences near a pose leave others.
"""

import numpy as np

from spherloc.gauss_newton import (
    MIN_GRAVITY_SD_RAD,
    ROBUST_NONE,
    AlignedMatches,
    CostModel,
    degrees_of_freedom,
    empty_equations,
    middle_of,
    normal_equations,
    polish_path,
    solve,
    tilt_of,
    turn,
)
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import (
    copy_matrix,
    copy_vector,
    equal,
    fill_vector,
    mark_within,
    moved_point,
    rotation_of,
    translation_of,
    write_pose,
    write_translation_to,
)

NARROWINGS = (1.0, 0.4, 0.15, 0.0)
"""Shares of what gravity's error adds to the bound that the successive bounds keep."""
GEMAN_MCCLURE_SCALE = 1.0 / 3.0
"""Scale of the Geman-McClure weights in bounds: the bound is three standard deviations of the noise, or so."""
MAX_STEPS = 6
"""At each bound."""
MIN_STEP = 1e-7
"""Length of a step (rad, and m) at which a bound is done with."""
DAMPING = 1e-9
"""Of the Gauss-Newton steps, relative to the diagonal: just enough to solve what is almost singular."""
MAX_DESCENTS = 10
"""Choices of inliers on the way to a minimum of the truncated squares."""
SAMPLE_SIZE, SAMPLE_STEPS, SAMPLE_DAMPING = 4, 4, 1e-6
"""Correspondences of a random fit, one more than fix a pose, and the steps and damping of its Gauss-Newton."""
PROMISING_STEPS = 3
"""Robust steps from a random fit that is better than the best pose so far."""
MIN_SAMPLES, MAX_SAMPLES = 30, 200
"""Sampling goes on for at least so many after the last improvement."""
MAX_FAILURE_PROBABILITY = 1e-3
"""Probability, by Eq. 28, that no sample held inliers only, at which sampling ends."""
FINE_NOISE = 0.3
"""Standard deviation of the finer part of the noise, in units of the stated noise: real matches mix sharp and blurred
ones. (Two scales: with four, normal noise is taken for a mixture more often, and real poses gain little.)"""
PRIOR_STATED, PRIOR_FINE = 10.0, 0.1
"""Correspondences with stated and with finer noise that are believed in beforehand."""
FIRST_EM_ROUNDS, EM_ROUNDS = 20, 3
"""Of expectation and maximisation for the share of finer noise, at the first step and at the others."""
ADAPTIVE_STEPS, ADAPTIVE_LEAST_STEP = 15, 1e-6
"""Most steps of ``fit_to_noise``, and the length of a step (rad, and m) at which it ends."""
MIN_FOR_NOISE = 8
"""Correspondences from which something can be said about their noise."""


@kernel()
def errors_of(matches, cam_from_map, errors):
    """Write the reprojection ``errors`` (M,) at a pose, px to first order; inf for points behind their bearing.

    The pose is ``cam_from_map`` (3, 4). ``matches`` are ``gauss_newton.AlignedMatches``, as in all functions here.
    """
    bearings, points, jacobian, p = matches.bearings, matches.points, matches.pixel_jacobian, cam_from_map
    for k in range(len(points)):
        x = p[0, 0] * points[k, 0] + p[0, 1] * points[k, 1] + p[0, 2] * points[k, 2] + p[0, 3]
        y = p[1, 0] * points[k, 0] + p[1, 1] * points[k, 1] + p[1, 2] * points[k, 2] + p[1, 3]
        z = p[2, 0] * points[k, 0] + p[2, 1] * points[k, 1] + p[2, 2] * points[k, 2] + p[2, 3]
        if bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z > 0.0:
            du = jacobian[k, 0, 0] * x + jacobian[k, 0, 1] * y + jacobian[k, 0, 2] * z
            dv = jacobian[k, 1, 0] * x + jacobian[k, 1, 1] * y + jacobian[k, 1, 2] * z
            errors[k] = np.sqrt((du * du + dv * dv) / (x * x + y * y + z * z))
        else:
            errors[k] = np.inf


@kernel()
def truncated_squares(matches, limits_px, cam_from_map, noise, most):
    """The truncated squares of a pose at the bounds ``limits_px`` (M,); more than ``most`` once that is passed.

    Of ``matches`` at ``cam_from_map`` (3, 4), in variances of ``noise``, a ``gauss_newton.Noise``. The tilt costs
    nothing where gravity is exact (the pose keeps it) or unknown.
    """
    bearings, points, jacobian, p = matches.bearings, matches.points, matches.pixel_jacobian, cam_from_map
    precision, total = noise.sd_px**-2.0, 0.0
    if MIN_GRAVITY_SD_RAD <= noise.gravity_sd_rad < np.inf:
        total = (tilt_of(p) / noise.gravity_sd_rad) ** 2
    for k in range(len(points)):
        x = p[0, 0] * points[k, 0] + p[0, 1] * points[k, 1] + p[0, 2] * points[k, 2] + p[0, 3]
        y = p[1, 0] * points[k, 0] + p[1, 1] * points[k, 1] + p[1, 2] * points[k, 2] + p[1, 3]
        z = p[2, 0] * points[k, 0] + p[2, 1] * points[k, 1] + p[2, 2] * points[k, 2] + p[2, 3]
        limit = limits_px[k] * limits_px[k]
        if bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z > 0.0:
            du = jacobian[k, 0, 0] * x + jacobian[k, 0, 1] * y + jacobian[k, 0, 2] * z
            dv = jacobian[k, 1, 0] * x + jacobian[k, 1, 1] * y + jacobian[k, 1, 2] * z
            limit = min(limit, (du * du + dv * dv) / (x * x + y * y + z * z))
        total += precision * limit
        if total > most:
            break
    return total


@kernel()
def robust_steps(matches, limits_px, cam_from_map, noise, most_steps):
    """Move ``cam_from_map`` (3, 4) in place by ``most_steps`` Gauss-Newton steps on Geman-McClure weights.

    Only ``matches`` within ``limits_px`` (M,) of the pose count, chosen anew for each step; ``noise`` is a
    ``gauss_newton.Noise``.
    """
    bearings, points, jacobian = matches.bearings, matches.points, matches.pixel_jacobian
    count = len(points)
    errors, near, scaled_jacobian = np.empty(count), np.empty(count, np.bool_), np.empty((count, 2, 3))
    for _ in range(most_steps):
        errors_of(matches, cam_from_map, errors)
        for k in range(count):
            near[k] = errors[k] <= limits_px[k]
            if near[k]:
                ratio = errors[k] / (GEMAN_MCCLURE_SCALE * limits_px[k])
                share = 1.0 / (1.0 + ratio * ratio)
                for a in range(2):
                    for b in range(3):
                        scaled_jacobian[k, a, b] = share * jacobian[k, a, b]
        if not _step(AlignedMatches(bearings, points, scaled_jacobian), near, cam_from_map, noise, DAMPING) > MIN_STEP:
            break


@kernel()
def _step(matches, chosen, cam_from_map, noise, damping):
    """One Gauss-Newton step of a pose on the ``chosen`` (M,) ``matches``, in place; its length, 0 if there is none.

    The pose is ``cam_from_map`` (3, 4), ``noise`` a ``gauss_newton.Noise``, ``damping`` is added to the scaled
    diagonal. The length is that of the rotation vector, rad, and the translation, m, together.
    """
    count, centre = middle_of(matches.points, chosen)
    if count < 2:
        return 0.0
    step, factor = np.empty(6), np.empty((6, 6))
    rotation, turned = rotation_of(cam_from_map), np.empty((3, 3))
    middle = moved_point(rotation, translation_of(cam_from_map), centre)
    model = CostModel(noise, np.int64(ROBUST_NONE), degrees_of_freedom(count, noise.gravity_sd_rad))
    system = empty_equations()
    cost = normal_equations(matches, chosen, centre, rotation, middle, model, system)
    if not cost < np.inf or not solve(system, damping, factor, step):
        return 0.0
    square = 0.0
    for k in range(6):
        square += step[k] * step[k]
    turn(step, rotation, turned)
    translation = np.empty(3)
    for k in range(3):
        middle[k] += step[3 + k]
    write_translation_to(middle, turned, centre, translation)
    for a in range(3):
        for b in range(3):
            if not np.isfinite(turned[a, b]):
                return 0.0
        if not np.isfinite(translation[a]):
            return 0.0
    write_pose(turned, translation, cam_from_map)
    return np.sqrt(square)


@kernel()
def narrow(matches, wide_px, tight_px, start, noise, path):
    """Fits from ``start`` (3, 4) at bounds that narrow from ``wide_px`` (M,) to ``tight_px`` (M,), each from the last.

    To ``matches`` with ``noise``, a ``gauss_newton.Noise``. The pose at each bound is written to ``path``
    (``len(NARROWINGS)``, 3, 4).
    """
    state, limits = np.empty((3, 4)), np.empty(len(wide_px))
    copy_matrix(start, state)
    for index in range(len(NARROWINGS)):
        for k in range(len(limits)):
            limits[k] = tight_px[k] + NARROWINGS[index] * (wide_px[k] - tight_px[k])
        robust_steps(matches, limits, state, noise, np.int64(MAX_STEPS))
        copy_matrix(state, path[index])


@kernel()
def descend(matches, limits_px, cam_from_map, noise, path):
    """Least squares on the inliers and new choices of these while the truncated squares fall.

    Of ``matches`` with ``noise``, a ``gauss_newton.Noise``. ``cam_from_map`` (3, 4) is changed in place, the pose after
    each choice written to ``path`` (``MAX_DESCENTS``, 3, 4). Returns how many, and the truncated squares at the bounds
    ``limits_px`` (M,).
    """
    count, states = len(matches.points), 0
    errors, before, mask = np.empty(count), np.zeros(count, np.bool_), np.empty(count, np.bool_)
    state, no_path = np.empty((3, 4)), np.empty((0, 3, 4))
    least = truncated_squares(matches, limits_px, cam_from_map, noise, np.inf)
    while states < MAX_DESCENTS:
        errors_of(matches, cam_from_map, errors)
        mark_within(errors, limits_px, mask)
        if equal(mask, before):
            break
        rotation, translation = rotation_of(cam_from_map), translation_of(cam_from_map)
        robust, most_steps = np.int64(ROBUST_NONE), np.int64(MAX_STEPS)
        polish_path(matches, mask, rotation, translation, noise, robust, most_steps, no_path)
        write_pose(rotation, translation, state)
        cost = truncated_squares(matches, limits_px, state, noise, np.inf)
        if not cost < least:
            break
        copy_matrix(state, cam_from_map)
        copy_matrix(state, path[states])
        copy_vector(mask, before)
        least = cost
        states += 1
    return states, least


@kernel()
def search_nearby(matches, wide_px, limits_px, start, noise, best, least):
    """Look for a better pose than ``best`` by fits to few random ones of what ``start`` explains within ``wide_px``.

    Of ``matches`` with ``noise``, a ``gauss_newton.Noise``. ``best`` (3, 4), of ``least`` truncated squares at the
    bounds ``limits_px`` (M,), is changed in place; returns its truncated squares. Every call draws alike.
    """
    errors = np.empty(len(matches.points))
    errors_of(matches, start, errors)
    around, size = np.empty(len(errors), np.int64), 0
    for k in range(len(errors)):
        if errors[k] <= wide_px[k]:
            around[size] = k
            size += 1
    if size <= SAMPLE_SIZE:
        return least
    around = around[:size]
    random_state, drawn, improved = np.uint64(0x9E3779B97F4A7C15), 0, 0
    needed = _samples_needed(matches, limits_px, best, around, errors)
    sample, chosen, state = np.empty(SAMPLE_SIZE, np.int64), np.empty(SAMPLE_SIZE, np.bool_), np.empty((3, 4))
    few = AlignedMatches(np.empty((SAMPLE_SIZE, 3)), np.empty((SAMPLE_SIZE, 3)), np.empty((SAMPLE_SIZE, 2, 3)))
    fill_vector(chosen, True)
    while drawn < MAX_SAMPLES and (drawn < needed or drawn < improved + MIN_SAMPLES):
        for k in range(SAMPLE_SIZE):
            fresh = False
            while not fresh:
                random_state, index = _draw(random_state, len(around))
                sample[k], fresh = around[index], True
                for other in range(k):
                    fresh = fresh and sample[other] != sample[k]
        drawn += 1
        copy_matrix(start, state)
        _take(matches, sample, few)
        for _ in range(SAMPLE_STEPS):
            _step(few, chosen, state, noise, SAMPLE_DAMPING)
        if truncated_squares(matches, limits_px, state, noise, least) >= least:
            continue
        robust_steps(matches, limits_px, state, noise, np.int64(PROMISING_STEPS))
        cost = truncated_squares(matches, limits_px, state, noise, least)
        if cost >= least:
            continue
        copy_matrix(state, best)
        least, improved = cost, drawn
        needed = _samples_needed(matches, limits_px, best, around, errors)
    return least


@kernel()
def _take(matches, sample, few):
    """Write those matches to ``few``, K matches, whose indices are in ``sample`` (K,)."""
    for k in range(len(sample)):
        copy_vector(matches.bearings[sample[k]], few.bearings[k])
        copy_vector(matches.points[sample[k]], few.points[k])
        copy_matrix(matches.pixel_jacobian[sample[k]], few.pixel_jacobian[k])


@kernel()
def _samples_needed(matches, limits_px, best, around, errors):
    """Samples from ``around`` (K,) after which one was surely drawn from inliers of the ``best`` pose only (Eq. 28).

    Inliers are ``matches`` within ``limits_px`` (M,); ``errors`` (M,) px are written.
    """
    errors_of(matches, best, errors)
    inliers = 0
    for k in around:
        inliers += errors[k] <= limits_px[k]
    clean = (inliers / len(around)) ** SAMPLE_SIZE
    if clean >= 1.0:
        return 1
    return int(min(np.log(MAX_FAILURE_PROBABILITY) / np.log1p(-max(clean, 1e-9)), MAX_SAMPLES))


@kernel()
def share_of_fine(errors, near, limits_px, noise_px, share, rounds, fine_probability):
    """Share of the ``near`` (M,) matches with the finer noise, from a guess ``share``, after so many ``rounds``.

    Expectation and maximisation of a mixture of two normal distributions in the plane, of standard deviation
    ``noise_px`` and a finer one, cut off at ``limits_px`` (M,), from ``errors`` (M,) px. Each one's probability of
    finer noise is written to ``fine_probability`` (M,).
    """
    wide, sharp = 0.5 / noise_px**2, 0.5 / (FINE_NOISE * noise_px) ** 2
    for _ in range(rounds):
        total, count = 0.0, 0
        for k in range(len(errors)):
            if near[k]:
                square, most = errors[k] * errors[k], limits_px[k] * limits_px[k]
                blurred = (1.0 - share) * wide * np.exp(-wide * square) / -np.expm1(-wide * most)
                crisp = share * sharp * np.exp(-sharp * square) / -np.expm1(-sharp * most)
                fine_probability[k] = crisp / (blurred + crisp) if crisp > 0.0 else 0.0
                total, count = total + fine_probability[k], count + 1
        share = (total + PRIOR_FINE) / (count + PRIOR_STATED + PRIOR_FINE)
    return share


@kernel()
def fit_to_noise(matches, limits_px, cam_from_map, noise, path):
    """Maximise the likelihood of what lies within ``limits_px`` (M,) under a mixture of stated and finer noise.

    The share of the finer noise is estimated with the pose: normal noise of the stated size is fitted by least squares,
    and where most matches are much sharper, they decide. ``cam_from_map`` (3, 4) is changed in place, the pose after
    each step written to ``path`` (``ADAPTIVE_STEPS``, 3, 4); returns the steps.
    """
    bearings, points, jacobian = matches.bearings, matches.points, matches.pixel_jacobian
    count = len(points)
    errors, near = np.empty(count), np.empty(count, np.bool_)
    fine_probability, scaled_jacobian = np.empty(count), np.empty((count, 2, 3))
    share = PRIOR_FINE / (PRIOR_STATED + PRIOR_FINE)
    for done in range(ADAPTIVE_STEPS):
        errors_of(matches, cam_from_map, errors)
        if mark_within(errors, limits_px, near) < MIN_FOR_NOISE:
            return done
        rounds = EM_ROUNDS if done else FIRST_EM_ROUNDS
        share = share_of_fine(errors, near, limits_px, noise.sd_px, share, rounds, fine_probability)
        for k in range(count):
            if near[k]:
                scale = np.sqrt(1.0 - fine_probability[k] + fine_probability[k] / (FINE_NOISE * FINE_NOISE))
                for a in range(2):
                    for b in range(3):
                        scaled_jacobian[k, a, b] = scale * jacobian[k, a, b]
        length = _step(AlignedMatches(bearings, points, scaled_jacobian), near, cam_from_map, noise, DAMPING)
        copy_matrix(cam_from_map, path[done])
        if not length > ADAPTIVE_LEAST_STEP:
            return done + 1
    return ADAPTIVE_STEPS


@kernel()
def _draw(random_state, count):
    """The state of xorshift64 after ``random_state`` (uint64), and a random number from 0 to ``count`` - 1."""
    random_state ^= random_state << np.uint64(13)
    random_state ^= random_state >> np.uint64(7)
    random_state ^= random_state << np.uint64(17)
    return random_state, np.int64((random_state >> np.uint64(33)) % np.uint64(count))
