"""Searches the best consensus without the given gravity, by samples of three correspondences, and decides whether it
contradicts that gravity. Poses are between the aligned frames."""

from dataclasses import dataclass, replace

import numpy as np

from spherloc.bounds import bounds_of
from spherloc.consensus.chance import chance_rate, nfa
from spherloc.gauss_newton import Noise, tilt_of
from spherloc.narrowing import NARROWINGS, narrow
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, matches_of, refine, residuals_px
from spherloc.solvers.p3p import SAMPLE_SIZE, p3p
from spherloc.types import BoolArray, FloatArray, IntArray

MAX_NFA = 1e-3
"""Largest expected number of false alarms (NFA) of a set that is believed."""
MIN_LEAD = 2.0
"""Number of standard deviations, by counting statistics, by which one set must be larger than another."""
TILT_RAD = np.radians(6.0)
"""Gravity errors up to about this are searched for near a pose."""
SAMPLES, BATCH, CONFIDENCE = 6000, 300, 0.99
"""Largest number of samples of a search, samples at once, and the probability, by Eq. 28, at which the search ends."""
MAX_SCORED = 1000
"""Largest number of correspondences by which samples are compared, evenly chosen from all."""


@dataclass(frozen=True, eq=False)
class Contradiction:
    """A pose that contradicts the given gravity."""

    cam_from_map: FloatArray
    """The pose (3, 4)."""
    support: int
    """Number of different matches that agree with it."""
    believed_support: int
    """Number of different matches that agree with the pose that was found with the given gravity."""
    tilt_rad: float
    """Angle between the given gravity and the pose's."""


def without_gravity(aligned: AlignedProblem) -> AlignedProblem:
    """The same correspondences with unknown gravity."""
    return replace(aligned, gravity_bound_rad=0.0, gravity_sd_rad=np.inf)


def search_without_gravity(aligned: AlignedProblem, bound_px: float) -> FloatArray | None:
    """The refined pose (3, 4) with the most inliers among those of random samples of three; None without a pose.

    Every call draws the same samples.
    """
    free, count = without_gravity(aligned), len(aligned.points)
    if count <= SAMPLE_SIZE:
        return None
    bounds = bounds_of(free, bound_px)
    scored = np.unique(np.linspace(0, count - 1, min(count, MAX_SCORED)).astype(np.int64))
    bearings, points, least_cosine = aligned.bearings[scored], aligned.points[scored], np.cos(bounds.radians[scored])
    rng, best, most, drawn, needed = np.random.default_rng(0), None, 0, 0, SAMPLES
    while drawn < min(needed, SAMPLES):
        # Repeated correspondences in a sample give no pose, and cost less than to avoid them.
        sample = rng.integers(count, size=(BATCH, SAMPLE_SIZE))
        drawn += BATCH
        poses, _ = p3p(aligned.bearings[sample], aligned.points[sample])
        if not len(poses):
            continue
        support = _supports(poses, bearings, points, least_cosine)
        if support.max() > most:
            most, best = int(support.max()), poses[int(np.argmax(support))]
            clean = (most / len(scored)) ** SAMPLE_SIZE
            needed = int(np.ceil(np.log1p(-CONFIDENCE) / np.log1p(-clean))) if clean < 1.0 else 0
    if best is None:
        return None
    return refine(free, best, bounds, RefinementOptions(gravity_sd_deg=np.inf))[0]


def _supports(poses: FloatArray, bearings: FloatArray, points: FloatArray, least_cosine: FloatArray) -> IntArray:
    """Number of inliers of each pose (L, 3, 4): correspondences whose bearing (M, 3) and direction to the point have a
    cosine of at least ``least_cosine`` (M,)."""
    rays = poses[:, :, :3] @ points.T + poses[:, :, 3:]
    along = np.einsum("lim,mi->lm", rays, bearings)
    return np.count_nonzero(along >= least_cosine * np.sqrt(np.einsum("lim,lim->lm", rays, rays)), axis=1)


def count_distinct(aligned: AlignedProblem, mask: BoolArray) -> int:
    """Number of the correspondences of ``mask`` (M,); those that share a point or a bearing count once."""
    if not mask.any():
        return 0
    points, bearings = np.unique(aligned.points[mask], axis=0), np.unique(aligned.bearings[mask], axis=0)
    return min(len(points), len(bearings))


def expected_by_chance(count: int, size: int, rate: float, fixed_by: int) -> float:
    """Expected number of sets of that size by chance, where ``fixed_by`` correspondences fix a pose."""
    return nfa(count, size, rate) * rate ** (2 - fixed_by) if size > fixed_by else np.inf


def lead(size: int, other: int) -> float:
    """Number of standard deviations, by counting statistics, by which the first set is larger than the second."""
    return (size - other) / np.sqrt(max(size + other, 1))


def nearby_support(aligned: AlignedProblem, cam_from_map: FloatArray, bound_px: float, noise_px: float) -> int:
    """Number of different matches that agree with a pose near this one (3, 4), the given gravity ignored."""
    wide = np.maximum(bounds_of(aligned, bound_px).pixels, bound_px + TILT_RAD * aligned.pixels_per_radian)
    tight, path = np.full(len(wide), bound_px), np.empty((len(NARROWINGS), 3, 4))
    narrow(matches_of(aligned), wide, tight, cam_from_map.copy(), Noise(noise_px, np.inf), path)
    return count_distinct(aligned, residuals_px(aligned, path[-1]) <= tight)


def contradicts(
    aligned: AlignedProblem, cam_from_map: FloatArray | None, inliers: BoolArray, bound_px: float, noise_px: float
) -> Contradiction | None:
    """The pose that shows gravity to be beyond its bound, if there is one.

    ``cam_from_map`` (3, 4), or None, was found and refined with gravity, and ``inliers`` (M,) agree with it. If it is
    nevertheless tilted beyond the bound, it is itself the contradiction. No search is made if its inliers are more than
    chance explains and no pose nearby explains clearly more without gravity.
    """
    count, size, bound_rad = len(aligned.points), count_distinct(aligned, inliers), aligned.gravity_bound_rad
    exact = chance_rate(aligned.bearings, bounds_of(without_gravity(aligned), bound_px).radians)
    if cam_from_map is not None:
        tight = count_distinct(aligned, residuals_px(aligned, cam_from_map) <= bound_px)
        beyond = 0.0 < bound_rad < tilt_of(cam_from_map)
        if beyond and expected_by_chance(count, tight, exact, SAMPLE_SIZE) <= MAX_NFA:
            return Contradiction(cam_from_map, tight, size, float(tilt_of(cam_from_map)))
        rate = chance_rate(aligned.bearings, np.minimum(bounds_of(aligned, bound_px).radians, np.pi / 2))
        believed = expected_by_chance(count, size, rate, 2) <= MAX_NFA
        if believed and lead(nearby_support(aligned, cam_from_map, bound_px, noise_px), size) < MIN_LEAD:
            return None
    found = search_without_gravity(aligned, bound_px)
    if found is None:
        return None
    support = count_distinct(aligned, residuals_px(aligned, found) <= bound_px)
    tilt_rad = float(tilt_of(found))
    if (
        expected_by_chance(count, support, exact, SAMPLE_SIZE) > MAX_NFA
        or lead(support, size) < MIN_LEAD
        or tilt_rad <= bound_rad
    ):
        return None
    return Contradiction(found, support, size, tilt_rad)
