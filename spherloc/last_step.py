"""The last step of every estimator: from the poses that a search found to the one that is reported.

The pose with the most inliers is not always the best one: where gravity is uncertain, many poses have as many inliers.
So the candidates are compared by their sums of truncated squares (``narrowing``) at the bound on the noise, and the
reported inliers are those of the best candidate.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spherloc.bounds import Bounds
from spherloc.gauss_newton import MIN_GRAVITY_SD_RAD, ROBUST_NONE, AlignedMatches, Noise, polish_path
from spherloc.narrowing import MAX_DESCENTS, NARROWINGS, descend, narrow, search_nearby, truncated_squares
from spherloc.problem import AlignedProblem
from spherloc.refine import (
    MAX_STEPS,
    RESCUE_REACH,
    RefinementOptions,
    fitted_path,
    matches_of,
    noise_of,
    record,
    refined_path,
    residuals_px,
)
from spherloc.trace import RefinementStage
from spherloc.types import BoolArray, FloatArray

MAX_STARTS = 4
"""Largest number of poses of a search that are refined."""
ALTERNATIVE_SHARE = 0.6
"""Least share of the largest number of inliers that a start must have: poses with fewer never turn out the best."""


def conclude(
    aligned: AlignedProblem, starts: Sequence[FloatArray], bounds: Bounds, options: RefinementOptions
) -> tuple[FloatArray, BoolArray, RefinementStage]:
    """The pose with the least sum of truncated squares that is found from the ``starts`` (3, 4) of a search, best
    first.

    The first four starts that explain enough are refined by ``refine`` and, where gravity is uncertain, by fits at
    bounds that narrow from one that allows for gravity's error to that of the noise; random fits nearby follow. The
    squares are truncated at the bound on the noise or, where gravity is kept, at one that allows for its error. Every
    candidate is improved until that sum no longer falls. The inliers of the best one are fitted once more, weighted as
    ``options.robust`` says; this fit is the result unless it is farther away than noise explains.

    Returns what ``refine`` does. All poses are between the aligned frames.
    """
    matches, noise = matches_of(aligned), noise_of(aligned, options)
    kept = noise.gravity_sd_rad < MIN_GRAVITY_SD_RAD
    limits = bounds.pixels.copy() if kept else np.full(len(aligned.points), bounds.noise_px)
    wide = bounds.pixels.copy()
    least, best = np.inf, np.empty((0, 3, 4))
    for start in _promising(aligned, starts, bounds):
        plain, reach = refined_path(aligned, start, bounds, options)
        if not kept and reach == np.inf:
            # Too few matches to determine a tilt: there is nothing to choose from.
            return record(aligned, plain, bounds.pixels, options, measured=True)
        for path in [plain] if kept else [plain, _narrowed(matches, wide, limits, start, noise)]:
            path, cost = _descended(matches, limits, path, noise)
            if cost < least:
                least, best = cost, path
    if not kept:
        for start in (best[-1], starts[0]):
            state = best[-1].copy()
            cost = search_nearby(matches, wide, limits, start.copy(), noise, state, least)
            if cost < least:
                best, least = _descended(matches, limits, np.array([best[0], state]), noise)
    if options.robust != "none":
        fit = fitted_path(aligned, best[-1], limits, options)
        if len(fit) and truncated_squares(matches, limits, fit[-1].copy(), noise, np.inf) <= least + RESCUE_REACH:
            best = np.concatenate([best, fit])
    return record(aligned, best, limits, options, measured=True)


def conclude_as_printed(
    aligned: AlignedProblem, start: FloatArray, members: BoolArray, bounds: Bounds, options: RefinementOptions
) -> tuple[FloatArray, BoolArray, RefinementStage]:
    """Only the last line of Algorithms 1 and 2: Gauss-Newton in 6 DoF from ``start`` (3, 4).

    It fits the matches of ``members`` (M,) with equal weights, without gravity and without choosing the matches again;
    with fewer than 4 matches the tilt is kept. The reported inliers are the matches within the bound on the noise of
    the resulting pose.

    Returns what ``refine`` does, poses between the aligned frames.
    """
    plain = replace(options, gravity_sd_deg=np.inf, robust="none")
    path = np.empty((1 + MAX_STEPS, 3, 4))
    path[0] = start
    rotation, translation = start[:, :3].copy(), start[:, 3].copy()
    matches, noise = matches_of(aligned), noise_of(aligned, plain)
    steps = polish_path(
        matches, members.copy(), rotation, translation, noise, np.int64(ROBUST_NONE), np.int64(MAX_STEPS), path[1:]
    )
    return record(aligned, path[: 1 + steps].copy(), np.full(len(members), bounds.noise_px), plain)


def _promising(aligned: AlignedProblem, starts: Sequence[FloatArray], bounds: Bounds) -> list[FloatArray]:
    """The first start, and those of the next ones that explain enough compared with it."""
    counts = [int(np.count_nonzero(residuals_px(aligned, start) <= bounds.pixels)) for start in starts[:MAX_STARTS]]
    enough = ALTERNATIVE_SHARE * max(counts)
    return [start for k, (start, count) in enumerate(zip(starts, counts, strict=False)) if k == 0 or count >= enough]


def _narrowed(
    matches: AlignedMatches, wide: FloatArray, limits: FloatArray, start: FloatArray, noise: Noise
) -> FloatArray:
    """The start and the poses (I, 3, 4) at bounds that narrow from ``wide`` (M,) to ``limits`` (M,), px."""
    path = np.empty((1 + len(NARROWINGS), 3, 4))
    path[0] = start
    narrow(matches, wide, limits, path[0].copy(), noise, path[1:])
    return path


def _descended(matches: AlignedMatches, limits: FloatArray, path: FloatArray, noise: Noise) -> tuple[FloatArray, float]:
    """The path (I, 3, 4), continued to a minimum of the sum of truncated squares, and that sum at its end."""
    more, last = np.empty((MAX_DESCENTS, 3, 4)), path[-1].copy()
    states, cost = descend(matches, limits, last, noise, more)
    return np.concatenate([path, more[:states]]), float(cost)
