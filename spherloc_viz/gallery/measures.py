"""Numbers of a run that the stories of the gallery and the lessons quote."""

from collections.abc import Callable, Mapping
from math import comb

import numpy as np

from spherloc.geometry import yaw_of
from spherloc.metrics import evaluate, ransac_success_probability
from spherloc.refine import residuals_px
from spherloc.trace import ConsensusStage, RansacStage, StageT, Trace, YawStage
from spherloc.types import BoolArray, FloatArray


def _count(mask: BoolArray) -> int:
    return int(np.count_nonzero(mask))


def _right(trace: Trace) -> BoolArray:
    """(N,) labels; of the gallery's problems they are known."""
    labels = trace.problem.truth_inliers
    return np.zeros(len(trace.problem), dtype=bool) if labels is None else labels


def _true_errors_px(trace: Trace) -> FloatArray:
    """(N,) reprojection errors at the true pose; inf where the camera cannot see the pixel."""
    problem, truth = trace.problem, trace.problem.truth_cam_from_map
    errors = np.full(len(problem), np.inf)
    if truth is not None:
        errors[problem.aligned.index] = residuals_px(problem.aligned, problem.aligned.align_pose(truth))
    return errors


def _agree_with_truth(trace: Trace, wider: float = 1.0) -> int:
    return _count(_true_errors_px(trace) <= wider * trace.options.bound_px)


def _median_error_px(trace: Trace, rim: bool) -> float:
    """Of the right matches in the outer or the inner half of the view, at the true pose."""
    right, errors = _right(trace), _true_errors_px(trace)
    if not right.any():
        return np.nan
    forward = trace.problem.bearings[:, 2]
    outer = forward < np.median(forward[right])
    return float(np.median(errors[right & (outer if rim else ~outer)]))


def _gravity_off_deg(trace: Trace) -> float:
    error_rad = trace.problem.gravity_error_rad
    return np.nan if error_rad is None else float(np.degrees(error_rad))


def _from_axis_deg(trace: Trace) -> float:
    """Largest angle between gravity and the bearing of a right match."""
    cosines = trace.problem.bearings[_right(trace)] @ trace.problem.gravity_camera
    return float(np.degrees(np.arccos(np.clip(cosines.min(initial=1.0), -1.0, 1.0))))


def stage_of(trace: Trace, kind: type[StageT]) -> StageT:
    """The stage of a run that a number is of; raises ``ValueError`` if it has none."""
    stage = trace.stage(kind)
    if stage is None:
        raise ValueError(f"the run of {trace.estimator} has no {kind.__name__}")
    return stage


def _samples(trace: Trace) -> RansacStage:
    return stage_of(trace, RansacStage)


def _samples_per_right_one(trace: Trace) -> float:
    """How many samples it takes on average until one has right matches only."""
    size = _samples(trace).samples.shape[1]
    return comb(len(trace.problem), size) / comb(_count(_right(trace)), size)


def _hit_percent(trace: Trace) -> float:
    """Eq. 28, with a sample of different matches."""
    rate = 1.0 / _samples_per_right_one(trace)
    return 100.0 * ransac_success_probability(rate, 1, _samples(trace).iterations)


def _yaw(trace: Trace) -> YawStage:
    return stage_of(trace, YawStage)


def _right_pairs_chosen(trace: Trace) -> int:
    """Pairs of two right matches in the rotation clique."""
    stage = _yaw(trace)
    return _count(np.all(_right(trace)[stage.pairs[stage.clique]], axis=1))


def _pairs_at_truth(trace: Trace) -> int:
    """Arcs that cover the true yaw."""
    stage, truth = _yaw(trace), trace.problem.truth_cam_from_map
    if truth is None:
        return 0
    yaw = yaw_of(trace.problem.aligned.align_pose(truth)[:, :3])
    turns = np.stack([yaw + turn * 2.0 * np.pi for turn in (-1.0, 0.0, 1.0)])[:, None]
    return _count(np.any((stage.lo_rad <= turns) & (turns <= stage.hi_rad), axis=0))


def _least_bound(trace: Trace) -> int:
    """What some pose may explain at the yaw where that is least."""
    return int(stage_of(trace, ConsensusStage).bound.min())


def _known(value: float | None) -> float:
    return np.nan if value is None else value


MEASURES: Mapping[str, Callable[[Trace], float]] = {
    "matches": lambda trace: len(trace.problem),
    "right": lambda trace: _count(_right(trace)),
    "inliers": lambda trace: _count(trace.inlier_mask),
    "right_inliers": lambda trace: _count(trace.inlier_mask & _right(trace)),
    "wrong_inliers": lambda trace: _count(trace.inlier_mask & ~_right(trace)),
    "agree_with_truth": _agree_with_truth,
    "agree_within_twice": lambda trace: _agree_with_truth(trace, 2.0),
    "rim_px": lambda trace: _median_error_px(trace, rim=True),
    "middle_px": lambda trace: _median_error_px(trace, rim=False),
    "off_m": lambda trace: _known(evaluate(trace).translation_error_m),
    "off_deg": lambda trace: _known(evaluate(trace).rotation_error_deg),
    "gravity_off_deg": _gravity_off_deg,
    "from_axis_deg": _from_axis_deg,
    "samples": lambda trace: _samples(trace).iterations,
    "sample_size": lambda trace: _samples(trace).samples.shape[1],
    "samples_per_right_one": _samples_per_right_one,
    "hit_percent": _hit_percent,
    "pairs": lambda trace: comb(len(trace.problem), 2),
    "right_pairs": lambda trace: comb(_count(_right(trace)), 2),
    "pairs_at_yaw": lambda trace: len(_yaw(trace).clique),
    "right_pairs_at_yaw": _right_pairs_chosen,
    "pairs_at_true_yaw": _pairs_at_truth,
    "least_bound": _least_bound,
    "at_most": lambda trace: _known(None if trace.certificate is None else trace.certificate.upper_bound),
    "nfa": lambda trace: _known(None if trace.certificate is None else trace.certificate.nfa),
}
"""By name: counts of matches, pairs and samples, errors against the truth, and what is proven."""
