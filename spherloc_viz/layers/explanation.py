"""Why a run kept or rejected a correspondence, from what its pairs, its residuals and the truth say."""

from dataclasses import dataclass

import numpy as np

from spherloc.geometry import yaw_of
from spherloc.trace import ConsensusStage, RansacStage, Trace, TranslationStage, YawStage
from spherloc.types import BoolArray, FloatArray, IndexArray, IntArray
from spherloc_viz.layers.agreement import PartnerArcs, partner_arcs, unbounded
from spherloc_viz.layers.reasons import Poses, reason
from spherloc_viz.layers.verdicts import residuals_at, run_bounds, verdicts

WORST = 3
"""Pairs that are named of those whose arcs exclude the true yaw."""
ROUNDING_RAD = 1e-12


@dataclass(frozen=True)
class Residual:
    """How far a correspondence is off at one pose."""

    px: float
    """Reprojection error to first order; inf more than 90 degrees from the bearing."""
    deg: float
    """Angle between the bearing and the ray to the point."""


@dataclass(frozen=True)
class Pairs:
    """How the pairs of a correspondence with all others stand to one yaw."""

    yaw_deg: float
    """The yaw, of the gravity-aligned frames."""
    agree: int
    """Pairs with an arc over it, and those that say nothing."""
    agree_inliers: int
    """Of the pairs with the run's other inliers, those that agree."""
    excluded: int
    """Pairs whose arcs lie elsewhere."""
    impossible: int
    """Pairs that agree at no yaw at all."""
    worst: tuple[tuple[int, float], ...]
    """Of the excluded ones those that are farthest off: the other match and by how many degrees."""


@dataclass(frozen=True)
class Explanation:
    """One correspondence in one run."""

    number: int
    """Its index in the problem."""
    usable: bool
    """Whether its pixel has a bearing."""
    kept: bool
    """Whether the run calls it an inlier."""
    right: bool | None
    """Whether it truly is one; None if the truth is unknown."""
    labelled: bool
    """Whether a label says so, and not only its residual at the true pose."""
    bound_px: float
    """Bound on its residual at the run's pose; NaN if it is not usable."""
    bound_deg: float
    """Bound on the angular error of its bearing; NaN if it is not usable."""
    estimate: Residual | None
    """At the run's pose; None without a pose or a bearing."""
    truth: Residual | None
    """At the true pose; None if that is unknown."""
    others: int
    """Usable correspondences that it makes a pair with."""
    silent: int
    """Pairs that say nothing about yaw, since their bearings or points are too close."""
    inliers: int
    """Other inliers of the run."""
    at_estimate: Pairs | None
    """Its pairs at the run's yaw."""
    at_truth: Pairs | None
    """Its pairs at the true yaw."""
    stages: tuple[str, ...]
    """What part it had in the stages of the run, in words."""
    verdict: str
    """Kept or rejected, and whether rightly, in a few words."""
    reason: str
    """Why, in one or two sentences."""


def explain(trace: Trace, number: int, alternative_cam_from_map: FloatArray | None = None) -> Explanation:
    """Why the run kept or rejected the correspondence of that index in the problem.

    ``alternative_cam_from_map`` (3, 4) is another pose to hold it against, as a diagnosis may know one; the poses that
    an exact search verified are looked at too. Raises ``IndexError`` if the problem has no such correspondence.
    """
    problem, known = trace.problem, verdicts(trace)
    if not 0 <= number < len(problem):
        raise IndexError(f"there is no correspondence {number} among {len(problem)}")
    usable = bool(problem.usable[number])
    bounds, aligned = run_bounds(trace), problem.aligned
    place = int(np.searchsorted(aligned.index, number)) if usable else -1
    others = np.delete(np.arange(len(aligned.index)), place) if usable else np.empty(0, np.int64)
    arcs = partner_arcs(aligned, bounds.radians, place, others)
    silent = unbounded(aligned, bounds.radians, np.array([place]), others)[0]
    inliers = trace.inlier_mask[aligned.index[others]]
    at_estimate, at_truth = (
        None if pose is None or not usable else _pairs(trace, others, arcs, silent, inliers, pose)
        for pose in (trace.cam_from_map, problem.truth_cam_from_map)
    )
    estimate, truth = (
        Residual(float(all_.px[number]), float(np.degrees(all_.rad[number]))) if all_ is not None and usable else None
        for all_ in (known.estimate, known.truth)
    )
    right = None if known.right is None else bool(known.right[number])
    poses = Poses(
        usable=usable,
        kept=bool(known.kept[number]),
        right=right,
        labelled=problem.truth_inliers is not None,
        bound_px=float(known.limit_px[number]),
        estimate=None if estimate is None else (estimate.px, estimate.deg),
        truth=None if truth is None else (truth.px, truth.deg),
        alternative=_alternative(trace, number, alternative_cam_from_map),
        agree_inliers=None if at_estimate is None else (at_estimate.agree_inliers, int(inliers.sum())),
    )
    verdict, why = reason(trace, poses)
    return Explanation(
        number=number,
        usable=usable,
        kept=poses.kept,
        right=right,
        labelled=poses.labelled,
        bound_px=poses.bound_px,
        bound_deg=float(np.degrees(bounds.radians[place])) if usable else np.nan,
        estimate=estimate,
        truth=truth,
        others=len(others),
        silent=int(np.count_nonzero(silent)),
        inliers=int(np.count_nonzero(inliers)),
        at_estimate=at_estimate,
        at_truth=at_truth,
        stages=part_in_stages(trace, number),
        verdict=verdict,
        reason=why,
    )


def _pairs(
    trace: Trace, others: IntArray, arcs: PartnerArcs, silent: BoolArray, inliers: BoolArray, cam_from_map: FloatArray
) -> Pairs:
    """How the pairs with ``others`` (K,), places among the usable ones, stand to the yaw of a pose (3, 4)."""
    aligned = trace.problem.aligned
    yaw = yaw_of(aligned.align_pose(cam_from_map)[:, :3])
    missed = np.where(silent, 0.0, arcs.missed_rad(yaw))
    agree, elsewhere = missed <= ROUNDING_RAD, np.flatnonzero(np.isfinite(missed) & (missed > ROUNDING_RAD))
    worst = elsewhere[np.argsort(-missed[elsewhere], kind="stable")][:WORST]
    return Pairs(
        yaw_deg=float(np.degrees(yaw)),
        agree=int(np.count_nonzero(agree)),
        agree_inliers=int(np.count_nonzero(agree & inliers)),
        excluded=len(elsewhere),
        impossible=int(np.count_nonzero(np.isinf(missed))),
        worst=tuple((int(aligned.index[others[k]]), float(np.degrees(missed[k]))) for k in worst),
    )


def _alternative(trace: Trace, number: int, given: FloatArray | None) -> tuple[FloatArray, float] | None:
    """Of the other poses that are known, the one (3, 4) that explains the correspondence best, and its residual, px."""
    stage = trace.stage(ConsensusStage)
    poses = ([] if given is None else [given]) + ([] if stage is None else list(stage.cam_from_map[1:]))
    errors = [float(residuals_at(trace.problem, pose).px[number]) for pose in poses]
    if not errors or not np.isfinite(errors).any():
        return None
    best = int(np.nanargmin(errors))
    return poses[best], errors[best]


def part_in_stages(trace: Trace, number: int) -> tuple[str, ...]:
    """What part the correspondence had in the stages of the run, a few words each."""
    parts = []
    for stage in trace.stages:
        if isinstance(stage, RansacStage):
            parts.append(_part_in_samples(stage, number))
        elif isinstance(stage, YawStage):
            arcs, size = _members(stage.pairs, stage.clique, number), len(stage.clique)
            parts.append(f"in {arcs:,} of the {size:,} arcs of the yaw clique")
        elif isinstance(stage, TranslationStage):
            balls, size = _members(stage.pairs, stage.clique, number), len(stage.clique)
            parts.append(f"in {balls:,} of the {size:,} balls of the translation clique")
        elif isinstance(stage, ConsensusStage):
            inside = "in" if number in stage.clique else "not in"
            parts.append(f"{inside} the largest set that agrees, of {len(stage.clique)}")
    return tuple(parts)


def _members(pairs: IndexArray, clique: IndexArray, number: int) -> int:
    """How many of a clique's pairs hold the correspondence."""
    return int(np.count_nonzero((pairs[clique] == number).any(axis=1)))


def _part_in_samples(stage: RansacStage, number: int) -> str:
    count = len(stage.improved_at)
    sampled = int(np.count_nonzero((stage.samples == number).any(axis=1) & ~stage.locally_optimized))
    explained = int(np.count_nonzero(stage.inlier_masks[:, number]))
    drawn = f"in {sampled} of the samples behind them" if sampled else "in none of their samples"
    return f"explained by {explained} of the {count} best poses so far of RANSAC, {drawn}"
