"""Explains why a run kept or rejected a correspondence, by its pairs, its residuals and the truth."""

from dataclasses import dataclass

import numpy as np

from spherloc.diagnosis.words import px_text
from spherloc.geometry import yaw_of
from spherloc.metrics import evaluate, extent_of, rotation_error_deg, said_length, translation_error_m
from spherloc.problem import Problem
from spherloc.trace import ConsensusStage, RansacStage, Trace, TranslationStage, YawStage
from spherloc.types import BoolArray, FloatArray, IndexArray, IntArray
from spherloc_viz.layers.agreement import PartnerArcs, partner_arcs, unbounded
from spherloc_viz.layers.residuals import residuals_at, run_bounds, verdicts

NEARLY = 2.0
"""Largest ratio of a residual to its bound that is called just beyond it."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Measurements of one correspondence at the estimated, the true and another pose, by which sentences are chosen."""

    usable: bool
    kept: bool
    right: bool | None
    labelled: bool
    bound_px: float
    estimate: tuple[float, float] | None
    """Residual at the run's pose in px and degrees; None without one."""
    truth: tuple[float, float] | None
    """Residual at the true pose in px and degrees; None if that is unknown."""
    lost: str
    """A sentence on the stage at which the run lost it; empty if it did not."""
    alternative: tuple[FloatArray, float] | None
    """Another pose (3, 4), and the residual there, px."""
    agree_inliers: tuple[int, int] | None
    """Number of its pairs with the run's other inliers that agree at the run's yaw, and number of all these pairs."""


def reason(trace: Trace, poses: Poses) -> tuple[str, str]:
    """A verdict in a few words, and the reason in one or two sentences."""
    if not poses.usable:
        return (
            "Cannot be used",
            "The camera does not see this pixel: its model has no bearing there. So the match counts as an outlier.",
        )
    rightly = {None: "", True: ", rightly", False: ", wrongly"}
    if trace.cam_from_map is None or poses.estimate is None:
        return "Not judged", _joined("The run found no pose to judge it by.", _by_truth(poses))
    if poses.kept:
        verdict = "Kept" + rightly[poses.right]
        off, bound = px_text(poses.estimate[0]), px_text(poses.bound_px)
        first = f"At the estimated pose it is {off} off, within its bound of {bound}."
        return verdict, _joined(first, _why_kept(trace, poses))
    verdict = "Rejected" + rightly[None if poses.right is None else not poses.right]
    return verdict, _joined(_how_far(poses, poses.estimate), _why_rejected(trace, poses), poses.lost)


def _joined(*sentences: str) -> str:
    return " ".join(filter(None, sentences))


def _how_far(poses: Poses, residual: tuple[float, float]) -> str:
    px, degrees = residual
    if np.isinf(px):
        return f"At the estimated pose its point is {degrees:.0f}° from the direction of its pixel."
    times = px / poses.bound_px
    if times < NEARLY:
        return f"At the estimated pose it is {px_text(px)} off, just beyond its bound of {px_text(poses.bound_px)}."
    return f"At the estimated pose it is {px_text(px)} off, {times:,.0f} times its bound of {px_text(poses.bound_px)}."


def _why_kept(trace: Trace, poses: Poses) -> str:
    if poses.right is None:
        return ""
    if poses.right and poses.truth is None:
        return "Its label says that it is right."
    if poses.right and poses.truth is not None:
        beyond = poses.truth[0] > poses.bound_px
        return f"It is a right match, {'but ' if beyond else ''}{_off(poses.truth)} at the true pose."
    if poses.truth is None:
        return "But its label says that it is wrong."
    if poses.truth[0] <= poses.bound_px:
        return f"Its label says that it is wrong, though it is {px_text(poses.truth[0])} off at the true pose."
    if evaluate(trace).success:
        return f"At the true pose it is {_off(poses.truth)}: an outlier that fits by chance."
    off = _off(poses.truth)
    return f"But at the true pose it is {off}: it agrees with a wrong pose, {_away(trace)} from the true one."


def _why_rejected(trace: Trace, poses: Poses) -> str:
    if poses.right:
        return _why_lost(trace, poses)
    alternative = _by_alternative(trace, poses)
    if poses.right is False:
        return _joined(_by_truth(poses), alternative)
    return alternative or _by_pairs(poses)


def _why_lost(trace: Trace, poses: Poses) -> str:
    """Why a right match was rejected."""
    if poses.truth is None:
        return "Yet its label says that it is right."
    off = _off(poses.truth)
    if poses.truth[0] > poses.bound_px:
        return f"Its label says that it is right, but it is {off} at the true pose too: the bound is too tight for it."
    if evaluate(trace).success:
        return f"At the true pose it is {off}: the small error of the pose moves it beyond the bound."
    return f"It agrees with the true pose, {off} there, but the run ended {_away(trace)} from it."


def _by_truth(poses: Poses) -> str:
    if poses.truth is None:
        return {None: "", True: "Its label says that it is right.", False: "Its label says that it is wrong."}[
            poses.right
        ]
    if poses.right:
        return f"At the true pose it is {_off(poses.truth)}: a right match."
    return f"At the true pose it is {_off(poses.truth)}: a wrong match."


def _by_alternative(trace: Trace, poses: Poses) -> str:
    if poses.alternative is None or not poses.alternative[1] <= poses.bound_px or trace.cam_from_map is None:
        return ""
    away = _between(trace.cam_from_map, poses.alternative[0], trace.problem)
    return f"It agrees with another pose, {away} from the estimated one."


def _by_pairs(poses: Poses) -> str:
    if poses.agree_inliers is None or poses.agree_inliers[1] == 0:
        return ""
    agree, count = poses.agree_inliers
    some = f"{agree} agree" if agree > 1 else "1 agrees" if agree else "none agrees"
    return f"Of its pairs with the {count} inliers {some} at the estimated yaw."


def _off(residual: tuple[float, float]) -> str:
    px, degrees = residual
    return f"{degrees:.0f}° off" if np.isinf(px) else f"{px_text(px)} off"


def _away(trace: Trace) -> str:
    truth, estimate = trace.problem.truth_cam_from_map, trace.cam_from_map
    return "" if truth is None or estimate is None else _between(truth, estimate, trace.problem)


def _between(one: FloatArray, other: FloatArray, problem: Problem) -> str:
    away_m = translation_error_m(one, other)
    away = said_length(away_m, extent_of(problem.points), f"{away_m:.2f} {problem.unit}")
    return f"{away} and {rotation_error_deg(one, other):.1f}°"


WORST = 3
"""Number of pairs that are named, of those whose arcs exclude the true yaw."""
ROUNDING_RAD = 1e-12


@dataclass(frozen=True)
class Residual:
    """Residual of a correspondence at one pose."""

    px: float
    """Reprojection error to first order, px; inf if the point is more than 90 degrees from the bearing."""
    deg: float
    """Angle between the bearing and the ray to the point, degrees."""


@dataclass(frozen=True)
class Pairs:
    """Agreement of the pairs of a correspondence with all others at one yaw."""

    yaw_deg: float
    """The yaw between the aligned frames, degrees."""
    agree: int
    """Number of pairs with an arc over it, and of those that do not restrict yaw."""
    agree_inliers: int
    """Number of pairs with the run's other inliers that agree."""
    excluded: int
    """Number of pairs whose arcs do not contain the yaw."""
    impossible: int
    """Number of pairs that agree at no yaw."""
    worst: tuple[tuple[int, float], ...]
    """The excluded pairs whose arcs are farthest from the yaw: the other match and the distance, degrees."""


@dataclass(frozen=True)
class Explanation:
    """The explanation of one correspondence in one run."""

    number: int
    """Its index in the problem."""
    usable: bool
    """Whether its pixel has a bearing."""
    kept: bool
    """Whether the run calls it an inlier."""
    right: bool | None
    """Whether it truly is an inlier; None if the truth is unknown."""
    labelled: bool
    """Whether that is known from a label, and not only from its residual at the true pose."""
    bound_px: float
    """Bound on its residual at the run's pose; NaN if it is not usable."""
    noise_only: bool
    """Whether ``bound_px`` is for noise alone, as where the run estimated the tilt, and not for gravity's error too."""
    bound_deg: float
    """Bound on the angular error of its bearing, by noise and gravity's error; NaN if it is not usable."""
    gravity_deg: float
    """The part of gravity's error in it."""
    estimate: Residual | None
    """Residual at the run's pose; None without a pose or a bearing."""
    truth: Residual | None
    """Residual at the true pose; None if that is unknown."""
    others: int
    """Number of its pairs: of other usable correspondences."""
    silent: int
    """Number of its pairs that do not restrict yaw, since their bearings or points are too close."""
    inliers: int
    """Number of other inliers of the run."""
    at_estimate: Pairs | None
    """Its pairs at the run's yaw."""
    at_truth: Pairs | None
    """Its pairs at the true yaw."""
    stages: tuple[str, ...]
    """Its part in the stages of the run, in words."""
    verdict: str
    """Whether it was kept or rejected, and whether rightly, in a few words."""
    reason: str
    """The reason in one or two sentences."""


def explain(trace: Trace, number: int, alternative_cam_from_map: FloatArray | None = None) -> Explanation:
    """Explain why the run kept or rejected the correspondence of that index in the problem.

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
        lost=_lost_at(trace, number),
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
        noise_only=poses.bound_px <= bounds.noise_px,
        bound_deg=float(np.degrees(bounds.radians[place])) if usable else np.nan,
        gravity_deg=float(np.degrees(problem.gravity_bound_rad)),
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
    """Agreement, at the yaw of a pose (3, 4), of the pairs with ``others`` (K,), indices of usable correspondences."""
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
    """The other known pose (3, 4) that explains the correspondence best, and its residual, px."""
    stage = trace.stage(ConsensusStage)
    poses = ([] if given is None else [given]) + ([] if stage is None else list(stage.cam_from_map[1:]))
    errors = [float(residuals_at(trace.problem, pose).px[number]) for pose in poses]
    if not errors or not np.isfinite(errors).any():
        return None
    best = int(np.nanargmin(errors))
    return poses[best], errors[best]


def part_in_stages(trace: Trace, number: int) -> tuple[str, ...]:
    """The part of the correspondence in each stage of the run, in a few words each."""
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


def _lost_at(trace: Trace, number: int) -> str:
    """The first stage in which the correspondence had no part or, if it had one in all, that it was lost after them: a
    sentence, empty if no stage tells."""
    passed = ""
    for stage in trace.stages:
        if isinstance(stage, YawStage) and not _members(stage.pairs, stage.clique, number):
            return "It was lost at the yaw arcs: none of its arcs is in the maximum clique."
        if isinstance(stage, TranslationStage) and not _members(stage.pairs, stage.clique, number):
            return "It was lost at the translation balls: none of its balls is in the maximum clique."
        if isinstance(stage, ConsensusStage) and number not in stage.clique:
            return "It is not in the largest set that agrees."
        if isinstance(stage, RansacStage) and not stage.inlier_masks[:, number].any():
            return "None of RANSAC's best poses so far explained it."
        passed = _PASSED.get(type(stage), passed)
    return f"{passed}, but the refined pose does not explain it." if passed else ""


_PASSED = {
    TranslationStage: "It was not lost before the refinement: balls of it are in the maximum clique",
    ConsensusStage: "It was not lost before the refinement: it is in the largest set that agrees",
    RansacStage: "One of RANSAC's best poses so far explained it",
}
"""What is said of a correspondence that had a part in a stage of this type, the last one counting."""


def _members(pairs: IndexArray, clique: IndexArray, number: int) -> int:
    """Number of a clique's pairs that contain the correspondence."""
    return int(np.count_nonzero((pairs[clique] == number).any(axis=1)))


def _part_in_samples(stage: RansacStage, number: int) -> str:
    count = len(stage.improved_at)
    sampled = int(np.count_nonzero((stage.samples == number).any(axis=1) & ~stage.locally_optimized))
    explained = int(np.count_nonzero(stage.inlier_masks[:, number]))
    drawn = f"in {sampled} of the samples behind them" if sampled else "in none of their samples"
    return f"explained by {explained} of the {count} best poses so far of RANSAC, {drawn}"
