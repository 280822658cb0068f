"""Measures what the diagnosis decides by; decides nothing. Poses are between the aligned frames."""

from dataclasses import dataclass, replace

import numpy as np

from spherloc.bounds import Bounds, bounds_of
from spherloc.consensus.chance import chance_rate, nfa
from spherloc.diagnosis.experiments import WIDER, Fit, alternative, fit_of, free_fit, search, subset
from spherloc.diagnosis.measures import apart, pose_sd
from spherloc.metrics import evaluate
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, refine
from spherloc.trace import ConsensusStage, Trace
from spherloc.types import BoolArray, FloatArray

LOOSE_ENDS = 2
"""Matches that may agree by chance with one of the poses that all others leave open."""
FEW = 8
"""Sets smaller than this are judged with all their members: each is needed."""
BELIEVED_SDS = 4.0
"""A refinement that is told gravity's standard deviation follows the matches no farther than so many of it."""
DIFFERENT_RAD = np.radians(3.0)
DIFFERENT_M = 0.3
"""Poses farther apart than either are clearly different: three times what counts as a success."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What can be measured without the truth."""

    aligned: AlignedProblem
    """The usable correspondences."""
    bound_px: float
    """The run's noise bound."""
    believed_rad: float
    """How far gravity may be off by what the run was told: its bound, or less if the refinement believes it more."""
    chance_rate: float
    """Probability that a wrong pose explains one correspondence."""
    run: Fit | None
    """The run's own pose."""
    best: Fit | None
    """The pose with the most support: the run's own, or one of a longer search if that has more."""
    alternative: Fit | None
    """The pose with the most support that is clearly different from ``best``."""
    free: Fit | None
    """The pose with the most support within a wider bound and without belief in gravity."""
    free_tilt_sd_rad: float
    """Standard deviation of its tilt."""
    rotation_sd_rad: float
    """Standard deviation of the best pose's rotation, though the matches that it hangs on most be wrong."""
    position_sd_m: float
    """The same of its position."""

    def nfa(self, size: int, wider: float = 1.0, fixed_by: int = 2) -> float:
        """Expected number of false alarms (NFA) of that size within ``wider`` times the bound.

        ``fixed_by`` correspondences fix a pose: 2, or 3 where gravity is free.
        """
        rate = min(1.0, self.chance_rate * wider**2)
        return nfa(len(self.aligned.points), size, rate) * rate ** (2 - fixed_by)

    def alternatives_own(self) -> int:
        """Correspondences that the alternative explains and the best pose does not."""
        if self.alternative is None or self.best is None:
            return 0
        return int(
            np.count_nonzero((self.alternative.errors_px <= self.bound_px) & (self.best.errors_px > self.bound_px))
        )

    def found(self, factor: float) -> float:
        """Support of the free pose within ``factor`` times the bound, less what is there by chance."""
        if self.free is None:
            return 0.0
        return self.free.support(factor * self.bound_px) - len(self.aligned.points) * self.chance_rate * factor**2


@dataclass(frozen=True, eq=False)
class Truth:
    """What the true pose and labels add."""

    success: bool
    """Whether the run's pose is right."""
    right: BoolArray
    """(M,) matches that are right."""
    fit: Fit
    """The true pose, or the fit to the right matches near it if that explains more."""
    tilt_rad: float
    """Angle between the given and the true gravity."""
    position_sd_m: float
    """Standard deviation of a position from all right matches."""
    rotation_sd_rad: float
    """The same of a rotation."""


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
        sd = _sd(aligned, best, bound_px, options)
    free = free_fit(aligned, [fit.cam_from_map for fit in fits[:2]], bound_px)
    return Evidence(
        aligned=aligned,
        bound_px=bound_px,
        believed_rad=min(aligned.gravity_bound_rad, BELIEVED_SDS * _gravity_sd(aligned, options)),
        chance_rate=chance_rate(aligned.bearings, bounds.radians),
        run=run,
        best=best,
        alternative=second,
        free=free,
        free_tilt_sd_rad=np.inf if free is None else _free_tilt_sd(aligned, free, bound_px),
        rotation_sd_rad=sd[0],
        position_sd_m=sd[1],
    )


def _other_fits(trace: Trace, bounds: Bounds) -> list[Fit]:
    """What a longer search finds, and what the run itself found beside its pose."""
    aligned, options = trace.problem.aligned, trace.options
    found = search(aligned, bounds.noise_px, options)
    stage = trace.stage(ConsensusStage)
    verified = [] if stage is None else [aligned.align_pose(pose) for pose in stage.cam_from_map]
    poses = [refine(aligned, pose, bounds, options)[0] for pose in verified]
    return [fit_of(aligned, pose) for pose in ([] if found is None else [found]) + poses]


def different(one: FloatArray, other: FloatArray) -> bool:
    """Whether two poses (3, 4) are clearly different."""
    turn, distance = apart(one, other)
    return turn > DIFFERENT_RAD or distance > DIFFERENT_M


def _gravity_sd(aligned: AlignedProblem, options: RefinementOptions) -> float:
    return aligned.gravity_sd_rad if options.gravity_sd_deg is None else float(np.radians(options.gravity_sd_deg))


def _sd(aligned: AlignedProblem, best: Fit, bound_px: float, options: RefinementOptions) -> tuple[float, float]:
    """Standard deviations of rotation (rad) and position (m)."""
    mask = best.errors_px <= bound_px
    size = int(np.count_nonzero(mask))
    if size < 2:
        return np.inf, np.inf
    drop = LOOSE_ENDS if size >= FEW else 0
    return pose_sd(aligned, best.cam_from_map, mask, options.noise_px, _gravity_sd(aligned, options), drop)[:2]


def _free_tilt_sd(aligned: AlignedProblem, free: Fit, bound_px: float) -> float:
    mask = free.errors_px <= WIDER * bound_px
    if np.count_nonzero(mask) < 4:
        return np.inf
    noise_px = float(np.sqrt(np.mean(np.square(free.errors_px[mask])) / 2.0))
    return pose_sd(aligned, free.cam_from_map, mask, max(noise_px, 1e-3), np.inf, 0)[2]


def gather_truth(trace: Trace, bound_px: float) -> Truth | None:
    """Look at the true pose and the labels; None if neither is known."""
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
    fit = fit_of(aligned, true)
    if not different(near.cam_from_map, true) and near.support(bound_px) > fit.support(bound_px):
        fit = near
    right = fit.errors_px <= WIDER * bound_px if labels is None else labels
    rotation_sd, position_sd = np.inf, np.inf
    if np.count_nonzero(right) >= 2:
        gravity_sd = _gravity_sd(aligned, options)
        rotation_sd, position_sd, _ = pose_sd(aligned, true, right, options.noise_px, gravity_sd, 0)
    success = evaluate(trace).success
    if success is None:
        success = trace.cam_from_map is not None and not different(aligned.align_pose(trace.cam_from_map), true)
    return Truth(success, right, fit, fit_of(aligned, true).tilt_rad, position_sd, rotation_sd)
