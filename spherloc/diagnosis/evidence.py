"""Measures the evidence for a diagnosis, and summarizes it in a few numbers that can be compared over many runs.
The decision itself is in ``decide``. Poses are between the aligned frames.
"""

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from spherloc.bounds import Bounds, bounds_of
from spherloc.consensus.chance import chance_rate, nfa
from spherloc.consensus.spread import Spread, spread_in
from spherloc.consensus.two_point_search import search_two_point
from spherloc.diagnosis.causes import Measures
from spherloc.diagnosis.information import pose_sd
from spherloc.estimators.base import estimate
from spherloc.estimators.mc_exact import McExactOptions
from spherloc.gauss_newton import tilt_of
from spherloc.geometry import camera_centre, pose, rotation_angle, yaw_rotation
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M, evaluate
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, gravity_sd_rad, refine, residuals_px
from spherloc.trace import Certificate, ConsensusStage, RefinementStage, Trace
from spherloc.types import BoolArray, FloatArray


def apart(one: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Angle (rad) and distance (m) between two poses (3, 4)."""
    turn = rotation_angle(one[:, :3] @ other[:, :3].T)
    return turn, float(np.linalg.norm(camera_centre(one) - camera_centre(other)))


SAMPLES = 20_000
"""Largest number of samples of a search: with 1.5 % right matches, one of them is clean with 99 % probability. The
search ends earlier when it reaches its confidence."""
MAX_WORK = 20_000_000
"""Largest product of samples and correspondences; with many correspondences the search draws fewer samples."""
CONFIDENCE = 0.9999
MAX_TILT_RAD = np.radians(12.0)
"""Largest gravity error that is searched for."""
MISSED = 0.85
"""A run has missed the best pose if its own has less than this share of the best one's support."""
STRONG = 0.45
"""A second pose with at least this share of the best one's support is not chance: structure repeats itself."""
WIDER = 4.0
"""Largest factor of the noise bound that is tried if the bound may be too small."""
MAX_CERTIFIED = 500
"""Largest number of correspondences for which a run without a certificate gets one."""
EFFORT = 0.3
"""Effort of that exact search: enough where one pose stands out, and quickly spent where many poses are alike."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose and its reprojection errors."""

    cam_from_map: FloatArray
    """Pose (3, 4)."""
    errors_px: FloatArray
    """(M,) reprojection errors."""

    def support(self, bound_px: float) -> int:
        """Number of correspondences within a bound."""
        return int(np.count_nonzero(self.errors_px <= bound_px))

    @property
    def tilt_rad(self) -> float:
        """Angle between the given gravity and the pose's."""
        return float(tilt_of(self.cam_from_map))


def fit_of(aligned: AlignedProblem, cam_from_map: FloatArray) -> Fit:
    """A pose (3, 4) with its errors."""
    return Fit(cam_from_map, residuals_px(aligned, cam_from_map))


def search(aligned: AlignedProblem, bound_px: float, options: RefinementOptions) -> FloatArray | None:
    """The pose (3, 4) that a long 2P-RANSAC finds, refined; None if no sample has a pose."""
    bounds = bounds_of(aligned, bound_px)
    samples = min(SAMPLES, MAX_WORK // len(aligned.points))
    found = search_two_point(aligned, bounds.pixels, 0, samples, CONFIDENCE, local_optimization=True)
    if not found.found:
        return None
    best = int(np.argmax(found.support))
    start = pose(yaw_rotation(found.yaws_rad[best]), found.translations[best])
    return refine(aligned, start, bounds, options)[0]


def subset(aligned: AlignedProblem, mask: BoolArray) -> AlignedProblem:
    """The correspondences of ``mask`` (M,) alone."""
    names = ("index", "bearings", "points", "pixel_from_bearing", "radians_per_pixel")
    return replace(aligned, **{name: np.ascontiguousarray(getattr(aligned, name)[mask]) for name in names})


def alternative(aligned: AlignedProblem, best: Fit, bound_px: float, options: RefinementOptions) -> Fit | None:
    """The pose that explains most of the correspondences that are far from ``best``, with its support among all."""
    rest = best.errors_px > 3.0 * bound_px
    if np.count_nonzero(rest) < 2:
        return None
    found = search(subset(aligned, rest), bound_px, options)
    return None if found is None else fit_of(aligned, found)


def certify(trace: Trace) -> Certificate | None:
    """The run's certificate, or that of an exact search of its problem; None if that has too many correspondences."""
    if trace.certificate is not None or len(trace.problem) > MAX_CERTIFIED:
        return trace.certificate
    given = {item.name: getattr(trace.options, item.name) for item in fields(RefinementOptions)}
    options = McExactOptions(bound_px=trace.options.bound_px, effort=EFFORT, **given)
    return estimate(trace.problem, "mc-exact", options).certificate


def free_fit(aligned: AlignedProblem, starts: list[FloatArray], bound_px: float) -> Fit | None:
    """The pose with the most support within ``WIDER`` times the bound where the given gravity is ignored.

    From the aligned poses ``starts``, each (3, 4), and from a search that allows for a wrong gravity and tightens its
    bound step by step.
    """
    free = replace(aligned, gravity_bound_rad=0.0, gravity_sd_rad=np.inf)
    wide, options = WIDER * bound_px, RefinementOptions(gravity_sd_deg=np.inf)
    steps = wide + float(np.median(aligned.pixels_per_radian)) * MAX_TILT_RAD * 0.5 ** np.arange(5)
    loose = search(replace(aligned, gravity_bound_rad=MAX_TILT_RAD), wide, options)
    fits = []
    for start, levels in [(start, ()) for start in starts] + ([] if loose is None else [(loose, steps)]):
        for level in (*levels, wide):
            start = refine(free, start, bounds_of(free, float(level)), options)[0]
        fits.append(fit_of(aligned, start))
    return max(fits, key=lambda fit: fit.support(wide), default=None)


NARROWER, MAX_NARROWER = 4.0, 6
"""Ratio of one bound to the next lower one that is tried, and the largest number of those ..."""
NOISE_SDS = 3.0
"""... down to this many standard deviations of the noise: a lower one would take right matches out."""


class Narrow(NamedTuple):
    """A pose within a lower noise bound than the run's."""

    bound_px: float
    """The lower bound."""
    fit: Fit
    """The pose with the most support within it."""
    nfa: float
    """Expected number of sets as large within the lower bound by chance."""


def narrow_fit(trace: Trace) -> Narrow | None:
    """Of poses found within lower noise bounds than the run's, the one that chance explains least; None if the run's
    bound is not clearly above the noise."""
    aligned, options = trace.problem.aligned, trace.options
    lower_px = float(options.bound_px) / NARROWER ** np.arange(1, MAX_NARROWER + 1)
    found = []
    for bound_px in lower_px[lower_px >= NOISE_SDS * options.noise_px].tolist():
        if (cam_from_map := search(aligned, bound_px, options)) is not None:
            fit = fit_of(aligned, cam_from_map)
            rate = chance_rate(aligned.bearings, bounds_of(aligned, bound_px).radians)
            found.append(Narrow(bound_px, fit, nfa(len(aligned.points), fit.support(bound_px), rate)))
    return min(found, key=lambda narrow: narrow.nfa, default=None)


LOOSE_ENDS = 2
"""Number of matches that are left out when it is judged how well the inliers fix a pose: they may agree by chance."""
FEW = 8
"""Sets smaller than this are judged with all their members, since each is needed."""
MIN_SDS = 2.0
"""Number of standard deviations of a believed pose that must lie within the errors of a success."""
BELIEVED_SDS = 4.0
"""Number of standard deviations of gravity that a refinement allows for at most."""
DIFFERENT_RAD = np.radians(3.0)
DIFFERENT_M = 0.3
"""Poses are clearly different if they are farther apart than one of these: three times the errors of a success."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """The measurements that do not need the truth."""

    aligned: AlignedProblem
    """The usable correspondences."""
    bound_px: float
    """The run's noise bound."""
    believed_rad: float
    """Error of gravity that the run allows for: the gravity bound, or less if the refinement trusts gravity more."""
    chance_rate: float
    """Probability that a wrong pose with the given gravity explains one correspondence, within its bound too."""
    free_chance_rate: float
    """The same for a pose with its own gravity, within the noise bound alone."""
    run: Fit | None
    """The run's own pose."""
    best: Fit | None
    """The pose with the most support: the run's own, or one of a longer search if that has more."""
    alternative: Fit | None
    """The pose with the most support that is clearly different from ``best``."""
    free: Fit | None
    """The pose with the most support within a wider bound, the given gravity ignored."""
    free_tilt_sd_rad: float
    """Standard deviation of its tilt."""
    tilted: Fit | None
    """The one of ``best`` and ``free`` with more support, from which the tilt of gravity is taken."""
    tilted_sd_rad: float
    """Standard deviation of its tilt, the given gravity ignored."""
    rotation_sd_rad: float
    """Standard deviation of the best pose's rotation without the matches on which it depends most."""
    position_sd_m: float
    """The same for its position."""
    reported_sd: tuple[float, float] | None
    """The same two of the run's own pose, by which its outcome is judged; None without a pose."""
    verified_without_point: int
    """See ``Problem``."""
    spread: Spread | None
    """Where the matches that agree with the run's pose lie in a panorama; None if there are hardly any, and
    for another camera."""

    def nfa(self, size: int, wider: float = 1.0, fixed_by: int = 2) -> float:
        """Expected number of false alarms (NFA) of that size within ``wider`` times the bound.

        ``fixed_by`` correspondences fix a pose: 2, or 3 where gravity is free. Where gravity is uncertain, there are no
        more sets for poses with the given gravity than for poses with any gravity.
        """
        free = min(1.0, self.free_chance_rate * wider**2)
        any_gravity = nfa(len(self.aligned.points), size, free) / free if size > 3 else np.inf
        if fixed_by == 3:
            return any_gravity
        given = nfa(len(self.aligned.points), size, min(1.0, self.chance_rate * wider**2))
        return min(given, any_gravity) if self.aligned.gravity_bound_rad > 0.0 else given

    def alternatives_own(self) -> int:
        """Number of correspondences that the alternative explains and the best pose does not."""
        if self.alternative is None or self.best is None:
            return 0
        return int(
            np.count_nonzero((self.alternative.errors_px <= self.bound_px) & (self.best.errors_px > self.bound_px))
        )

    def found(self, factor: float) -> float:
        """Support of the free pose within ``factor`` times the bound, minus the number expected by chance."""
        if self.free is None:
            return 0.0
        return self.free.support(factor * self.bound_px) - len(self.aligned.points) * self.free_chance_rate * factor**2


@dataclass(frozen=True, eq=False)
class Truth:
    """The measurements that need the true pose and labels."""

    success: bool
    """Whether the run's pose is right."""
    right: BoolArray
    """(M,) matches that are right."""
    exact: Fit
    """The true pose; its tilt is the angle between the given and the true gravity."""
    fit: Fit
    """The true pose, or the fit to the right matches near it if that explains more."""
    position_sd_m: float
    """Standard deviation of a position from all right matches."""
    rotation_sd_rad: float
    """The same for a rotation."""
    within: float
    """Number of noise bounds within which matches count as right; 1 if labels say which are right."""
    by_chance: float
    """Expected number of matches that are in ``right`` by chance; 0 if labels say which are right."""


def gather(trace: Trace) -> Evidence:
    """Run the experiments on the problem of a run."""
    aligned, options = trace.problem.aligned, trace.options
    bound_px = float(options.bound_px)
    bounds = bounds_of(aligned, bound_px)
    run = None if trace.cam_from_map is None else fit_of(aligned, aligned.align_pose(trace.cam_from_map))
    fits = ([] if run is None else [run]) + _other_fits(trace, bounds)
    best = max(fits, key=lambda fit: fit.support(bound_px), default=None)
    second, sd = None, (np.inf, np.inf)
    if best is not None:
        others = [*fits, alternative(aligned, best, bound_px, options)]
        others = [fit for fit in others if fit is not None and different(fit.cam_from_map, best.cam_from_map)]
        second = max(others, key=lambda fit: fit.support(bound_px), default=None)
        sd = sd_of(aligned, best.cam_from_map, best.errors_px <= bound_px, options)
    free = free_fit(aligned, [fit.cam_from_map for fit in fits[:2]], bound_px)
    tilted = max((fit for fit in (free, best) if fit), key=lambda fit: fit.support(bound_px), default=None)
    known = replace(aligned, gravity_bound_rad=0.0)
    return Evidence(
        aligned=aligned,
        bound_px=bound_px,
        believed_rad=min(aligned.gravity_bound_rad, BELIEVED_SDS * gravity_sd_rad(aligned, options)),
        chance_rate=chance_rate(aligned.bearings, bounds.radians),
        free_chance_rate=chance_rate(aligned.bearings, bounds_of(known, bound_px).radians),
        run=run,
        best=best,
        alternative=second,
        free=free,
        free_tilt_sd_rad=np.inf if free is None else _free_tilt_sd(aligned, free, WIDER * bound_px),
        tilted=tilted,
        tilted_sd_rad=np.inf
        if tilted is None
        else _free_tilt_sd(aligned, tilted, (WIDER if tilted is free else 1.0) * bound_px),
        rotation_sd_rad=sd[0],
        position_sd_m=sd[1],
        reported_sd=None if run is None else sd_of(aligned, run.cam_from_map, agreeing(trace, run.errors_px), options),
        verified_without_point=trace.problem.verified_without_point,
        spread=None if run is None else spread_in(trace.problem, agreeing(trace, run.errors_px)),
    )


def _other_fits(trace: Trace, bounds: Bounds) -> list[Fit]:
    """Poses from a longer search, and those that the run itself found beside its pose.

    Within a wide gravity bound a fit of few right matches may be led away by wrong ones: a pose with the given gravity,
    which can be better than its bound, is looked for too.
    """
    aligned, options = trace.problem.aligned, trace.options
    given = [replace(aligned, gravity_bound_rad=0.0)] if aligned.gravity_bound_rad else []
    found = [search(one, bounds.noise_px, options) for one in [aligned, *given]]
    stage = trace.stage(ConsensusStage)
    verified = [] if stage is None else [aligned.align_pose(pose) for pose in stage.cam_from_map]
    poses = [refine(aligned, pose, bounds, options)[0] for pose in verified]
    return [fit_of(aligned, pose) for pose in [*found, *poses] if pose is not None]


def different(one: FloatArray, other: FloatArray) -> bool:
    """Whether two poses (3, 4) are clearly different."""
    turn, distance = apart(one, other)
    return turn > DIFFERENT_RAD or distance > DIFFERENT_M


def sd_of(
    aligned: AlignedProblem, cam_from_map: FloatArray, mask: BoolArray, options: RefinementOptions
) -> tuple[float, float]:
    """Standard deviations of rotation (rad) and position (m) of an aligned pose (3, 4) that the matches of ``mask``
    (M,) fix, without those on which it depends most; inf if they are too few."""
    size = int(np.count_nonzero(mask))
    if size < 2:
        return np.inf, np.inf
    drop = LOOSE_ENDS if size >= FEW else 0
    return pose_sd(aligned, cam_from_map, mask, options.noise_px, gravity_sd_rad(aligned, options), drop)[:2]


def undetermined(rotation_sd_rad: float, position_sd_m: float) -> bool:
    """Whether one standard deviation is already more than the error of a success."""
    return rotation_sd_rad > np.radians(SUCCESS_DEG) or position_sd_m > SUCCESS_M


def agreeing(trace: Trace, errors_px: FloatArray) -> BoolArray:
    """Which matches agree with the run's pose by their residuals (M,): within the bound on the noise or, where gravity
    is kept, within one that allows for its error."""
    stage, bound_px = trace.stage(RefinementStage), float(trace.options.bound_px)
    kept = stage is not None and stage.dof == 4
    return errors_px <= (bounds_of(trace.problem.aligned, bound_px).pixels if kept else bound_px)


def _free_tilt_sd(aligned: AlignedProblem, fit: Fit, bound_px: float) -> float:
    mask = fit.errors_px <= bound_px
    if np.count_nonzero(mask) < 4:
        return np.inf
    noise_px = float(np.sqrt(np.mean(np.square(fit.errors_px[mask])) / 2.0))
    return pose_sd(aligned, fit.cam_from_map, mask, max(noise_px, 1e-3), np.inf, 0)[2]


def gather_truth(trace: Trace, bound_px: float) -> Truth | None:
    """Measure with the true pose and the labels; None if neither is known."""
    problem, aligned, options = trace.problem, trace.problem.aligned, trace.options
    labels = None if problem.truth_inliers is None else problem.truth_inliers[aligned.index]
    if problem.truth_cam_from_map is not None:
        true = aligned.align_pose(problem.truth_cam_from_map)
    elif labels is not None and np.count_nonzero(labels) >= 2:
        found = free_fit(subset(aligned, labels), [], bound_px)
        true = None if found is None else found.cam_from_map
    else:
        true = None
    if true is None:
        return None
    free = replace(aligned, gravity_bound_rad=0.0, gravity_sd_rad=np.inf)
    wide = bounds_of(free, WIDER * bound_px)
    near = fit_of(aligned, refine(free, true, wide, replace(options, gravity_sd_deg=np.inf))[0])
    exact = fit_of(aligned, true)
    better = not different(near.cam_from_map, true) and near.support(bound_px) > exact.support(bound_px)
    fit = near if better else exact
    within = WIDER if labels is None else 1.0
    right = fit.errors_px <= within * bound_px if labels is None else labels
    rate = chance_rate(aligned.bearings, bounds_of(free, bound_px).radians)
    by_chance = len(aligned.points) * min(1.0, rate * within**2) if labels is None else 0.0
    rotation_sd, position_sd = np.inf, np.inf
    if np.count_nonzero(right) >= 2:
        gravity_sd = gravity_sd_rad(aligned, options)
        rotation_sd, position_sd, _ = pose_sd(aligned, true, right, options.noise_px, gravity_sd, 0)
    success = evaluate(trace).success
    if success is None:
        success = trace.cam_from_map is not None and not different(aligned.align_pose(trace.cam_from_map), true)
    return Truth(success, right, exact, fit, position_sd, rotation_sd, within, by_chance)


BANDS, SECTORS = 6, 8
"""Cells of equal area on the unit sphere: bands of equal height by sectors of equal angle."""


def measures_of(e: Evidence, certificate: Certificate | None) -> Measures:
    """The numbers of a run whose evidence was gathered; None for those that it does not have."""
    median = high = coverage = None
    best = 0 if e.best is None else e.best.support(e.bound_px)
    if e.run is not None:
        inliers = e.run.errors_px <= e.bound_px
        if inliers.any():
            median, high = (float(q) / e.bound_px for q in np.quantile(e.run.errors_px[inliers], (0.5, 0.9)))
            coverage = _coverage(e.aligned, inliers)
    other = None if e.alternative is None else e.alternative.support(e.bound_px)
    return Measures(
        residual_median=median,
        residual_p90=high,
        alternative_support=None if other is None or not best else other / best,
        certificate_gap=None
        if certificate is None or certificate.upper_bound <= 0
        else certificate.gap / certificate.upper_bound,
        tilt_deg=None if e.free is None else float(np.degrees(e.free.tilt_rad)),
        coverage=coverage,
        rotation_sd_deg=_finite(np.degrees(e.rotation_sd_rad)),
        position_sd_m=_finite(e.position_sd_m),
    )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _coverage(aligned: AlignedProblem, inliers: BoolArray) -> float:
    """Share of the cells with bearings that have inliers (M,) too."""
    x, y, z = aligned.bearings.T
    band = np.clip((0.5 * (1.0 + y) * BANDS).astype(int), 0, BANDS - 1)
    sector = np.clip((0.5 * (1.0 + np.arctan2(x, z) / np.pi) * SECTORS).astype(int), 0, SECTORS - 1)
    cells = SECTORS * band + sector
    return len(np.unique(cells[inliers])) / len(np.unique(cells))
