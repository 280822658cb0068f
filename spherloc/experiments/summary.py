"""Summary of a sequence's results: success rates with their uncertainty, medians, and errors of the whole trajectory.

ATE is computed after an alignment, RPE from each pose to the next, as the tool evo defines them.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from spherloc.datasets.map_scene import Thresholds
from spherloc.experiments.results import DOUBTFUL, FAILED, LOCALIZED, UNREADABLE, QueryResult, SequenceResults
from spherloc.geometry import inverse_pose, pose, rotation_angle
from spherloc.trajectory import NS_PER_S, Trajectory
from spherloc.types import FloatArray

MIN_POSES = 3
"""Least number of positions for an alignment."""


@dataclass(frozen=True)
class TrajectoryError:
    """Root mean squares over the poses that have both an estimate and a truth."""

    poses: int
    """Number of these poses."""
    ate_m: float
    """Absolute trajectory error, m: of the distances between positions, without an alignment."""
    ate_rigid_m: float | None
    """The same after the best rotation and translation; None for fewer than 3 poses or where these do not fix it."""
    ate_similarity_m: float | None
    """The same after the best rotation, translation and scale."""
    rpe_m: float | None
    """Relative pose error, m: of the translation from each pose to the next; None without an order in time."""
    rpe_deg: float | None
    """The same of the rotation, degrees."""


def trajectory_error(truth: FloatArray, estimate: FloatArray, ordered: bool) -> TrajectoryError | None:
    """Errors of ``estimate`` (P, 3, 4) against ``truth`` (P, 3, 4), both map_from_camera; None for no poses.

    ``ordered`` says whether the poses follow each other in time.
    """
    if not len(truth):
        return None
    places, true_places = estimate[:, :, 3], truth[:, :, 3]
    moves = _moves(truth, estimate) if ordered and len(truth) > 1 else None
    return TrajectoryError(
        poses=len(truth),
        ate_m=_root_mean_square(places - true_places),
        ate_rigid_m=_aligned_error(places, true_places, with_scale=False),
        ate_similarity_m=_aligned_error(places, true_places, with_scale=True),
        rpe_m=None if moves is None else _root_mean_square(moves[:, :, 3]),
        rpe_deg=None if moves is None else _root_mean_square_angle(moves),
    )


def align(places: FloatArray, true_places: FloatArray, with_scale: bool) -> tuple[float, FloatArray, FloatArray] | None:
    """Scale, rotation (3, 3) and translation (3,) that bring places (P, 3) closest to the true ones (P, 3).

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. None for
    fewer than 3 places, or if they all lie on a line.
    """
    if len(places) < MIN_POSES:
        return None
    middle, true_middle = places.mean(axis=0), true_places.mean(axis=0)
    moved, true_moved = places - middle, true_places - true_middle
    left, stretch, right = np.linalg.svd(true_moved.T @ moved / len(places))
    if stretch[1] <= 1e-12 * max(stretch[0], 1e-300):
        return None
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = left @ np.diag(signs) @ right
    scale = float(stretch @ signs / np.mean(np.sum(moved**2, axis=1))) if with_scale else 1.0
    return scale, rotation, true_middle - scale * rotation @ middle


def _aligned_error(places: FloatArray, true_places: FloatArray, with_scale: bool) -> float | None:
    found = align(places, true_places, with_scale)
    if found is None:
        return None
    scale, rotation, translation = found
    return _root_mean_square(scale * places @ rotation.T + translation - true_places)


def _moves(truth: FloatArray, estimate: FloatArray) -> FloatArray:
    """Errors (P - 1, 3, 4) of the motion from each pose to the next: inverse of the true times the estimated one."""
    true_moves, moves = _between(truth), _between(estimate)
    rotations = np.swapaxes(true_moves[:, :, :3], 1, 2)
    shift = moves[:, :, 3] - true_moves[:, :, 3]
    return np.concatenate([rotations @ moves[:, :, :3], np.einsum("pij,pj->pi", rotations, shift)[:, :, None]], axis=2)


def _between(poses: FloatArray) -> FloatArray:
    """Motions (P - 1, 3, 4): each pose relative to the one before."""
    rotations = np.swapaxes(poses[:-1, :, :3], 1, 2)
    shift = poses[1:, :, 3] - poses[:-1, :, 3]
    return np.concatenate([rotations @ poses[1:, :, :3], np.einsum("pij,pj->pi", rotations, shift)[:, :, None]], axis=2)


def _root_mean_square(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _root_mean_square_angle(moves: FloatArray) -> float:
    angles = np.array([rotation_angle(move[:, :3]) for move in moves])
    return float(np.degrees(np.sqrt(np.mean(angles**2))))


Z_95 = 1.959963984540054
"""Standard normal quantile of a two-sided interval of 95 %."""


@dataclass(frozen=True)
class SuccessRate:
    """Success rate of the queries at one limit."""

    degrees: float | None
    """Limit of the rotation error; None where poses are judged by registration."""
    metres: float
    """Limit of the position error, or of the registration error."""
    successes: int
    """Number of queries with errors below the limits."""
    judged: int
    """Number of judged queries: failed ones too, but not those without truth or with an unreadable image."""
    rate: float | None
    """Ratio of both, 0 to 1; None if none was judged."""
    low: float | None
    """Lower end of the 95 % Wilson interval of the rate."""
    high: float | None
    """Its upper end."""


@dataclass(frozen=True)
class Summary:
    """A sequence in numbers. Means and medians are None where there are no values."""

    queries: int
    """Number of queries in the scene; the next ones are numbers of queries too."""
    done: int
    """Queries with a result."""
    localized: int
    """Queries with a pose that is believed."""
    doubtful: int
    """Queries with a pose that is not believed."""
    failed: int
    """Usable images without a pose; they count as failures."""
    unreadable: int
    """Images that could not be used; they are skipped, not judged."""
    without_truth: int
    """Usable images whose true pose is unknown; they are skipped where the truth is needed."""
    not_registered: int
    """Poses that could not be registered, in scenes that judge by registration; they are skipped there."""
    success: tuple[SuccessRate, ...]
    """Success rates at the scene's limits of pose errors; empty if no query's truth is known."""
    registration_success: tuple[SuccessRate, ...]
    """Success rates at the scene's limits of registration errors; empty if the scene has none."""
    median_rotation_error_deg: float | None
    """Median rotation error of the localized queries with known truth, degrees."""
    median_translation_error_m: float | None
    """Median position error of the same queries, metres."""
    median_registration_error_m: float | None
    """Median registration error of the registered queries, metres."""
    scored: int
    """Number of queries with labelled correspondences, for the next six; a query without a pose counts as 0 there."""
    mean_precision: float | None
    """Mean precision of the inliers, at 8 px."""
    mean_recall: float | None
    """Mean recall of the inliers, at 8 px."""
    mean_f1: float | None
    """Mean F1 of the inliers, at 8 px."""
    median_precision: float | None
    """Median precision of the inliers, at 8 px, as in the paper's tables."""
    median_recall: float | None
    """Median recall of the inliers, at 8 px, as in the paper's tables."""
    median_f1: float | None
    """Median F1 of the inliers, at 8 px, as in the paper's tables."""
    median_true_outlier_rate: float | None
    """Median outlier rate of the queries with labelled correspondences."""
    median_estimated_outlier_rate: float | None
    """Median of the front end's estimates, over the queries that have one."""
    median_matching_ms: float | None
    """Median over all queries that were matched."""
    median_estimating_ms: float | None
    """Median over all queries that were solved."""
    trajectory: TrajectoryError | None
    """ATE and RPE of all poses, doubtful ones too; None if no pose has a truth."""
    diagnoses: dict[str, int]
    """Numbers of queries by the cause of their diagnosis, most frequent first."""


def wilson(successes: int, judged: int) -> tuple[float, float]:
    """The 95 % interval of a rate by Wilson's score (1927): accurate also near 0 and 1 and for few queries."""
    rate, z2 = successes / judged, Z_95**2 / judged
    centre = (rate + z2 / 2) / (1 + z2)
    half = math.sqrt(rate * (1 - rate) * z2 + z2**2 / 4) / (1 + z2)
    return max(0.0, centre - half), min(1.0, centre + half)


def summarize(results: SequenceResults) -> Summary:
    """The summary of the results so far."""
    rows, setting = results.rows, results.configuration
    usable = [row for row in rows if row.status != UNREADABLE]
    with_truth = [row for row in usable if row.truth_cam_from_map is not None]
    scored = [row for row in rows if row.f1 is not None]
    limits_m = setting.registration_thresholds_m
    registered = [row for row in usable if row.status == FAILED or row.registration_error_m is not None]
    causes = [row.diagnosis for row in rows if row.diagnosis is not None]
    return Summary(
        queries=setting.queries,
        done=len(rows),
        localized=sum(row.status == LOCALIZED for row in rows),
        doubtful=sum(row.status == DOUBTFUL for row in rows),
        failed=sum(row.status == FAILED for row in rows),
        unreadable=len(rows) - len(usable),
        without_truth=len(usable) - len(with_truth),
        not_registered=0 if limits_m is None else len(usable) - len(registered),
        success=success_rates(rows, setting.thresholds),
        registration_success=tuple(_rate(registered, None, metres) for metres in limits_m or ()),
        median_rotation_error_deg=_median(row.rotation_error_deg for row in rows),
        median_translation_error_m=_median(row.translation_error_m for row in rows),
        median_registration_error_m=_median(row.registration_error_m for row in rows),
        scored=len(scored),
        mean_precision=_mean(row.precision for row in scored),
        mean_recall=_mean(row.recall for row in scored),
        mean_f1=_mean(row.f1 for row in scored),
        median_precision=_median(row.precision for row in scored),
        median_recall=_median(row.recall for row in scored),
        median_f1=_median(row.f1 for row in scored),
        median_true_outlier_rate=_median(row.true_outlier_rate for row in rows),
        median_estimated_outlier_rate=_median(row.estimated_outlier_rate for row in rows),
        median_matching_ms=_median(row.matching_ms for row in rows if row.matches is not None),
        median_estimating_ms=_median(row.estimating_ms for row in rows),
        trajectory=_trajectory_error(results),
        diagnoses={cause: causes.count(cause) for cause in sorted(set(causes), key=lambda c: (-causes.count(c), c))},
    )


def _trajectory_error(results: SequenceResults) -> TrajectoryError | None:
    rows = [row for row in results.rows if row.cam_from_map is not None and row.truth_cam_from_map is not None]
    truth, estimate = (
        np.array([inverse_pose(getattr(row, name)) for row in rows]).reshape(-1, 3, 4)
        for name in ("truth_cam_from_map", "cam_from_map")
    )
    return trajectory_error(truth, estimate, timed(results.rows))


def success_rates(rows: Sequence[QueryResult], thresholds: Thresholds) -> tuple[SuccessRate, ...]:
    """Success rates of the queries with known truth at each of the limits (degrees, metres); empty without any
    truth."""
    judged = [row for row in rows if row.status != UNREADABLE and row.truth_cam_from_map is not None]
    return tuple(_rate(judged, *limits) for limits in thresholds) if judged else ()


def _rate(judged: Sequence[QueryResult], degrees: float | None, metres: float) -> SuccessRate:
    successes = sum(_within(row, degrees, metres) for row in judged)
    if not judged:
        return SuccessRate(degrees, metres, 0, 0, None, None, None)
    return SuccessRate(
        degrees, metres, successes, len(judged), successes / len(judged), *wilson(successes, len(judged))
    )


def _within(row: QueryResult, degrees: float | None, metres: float) -> bool:
    """Whether the errors are below the limits, as in Sec. VI; false for a query without a pose."""
    if degrees is None:
        return row.registration_error_m is not None and row.registration_error_m < metres
    if row.rotation_error_deg is None or row.translation_error_m is None:
        return False
    return row.rotation_error_deg < degrees and row.translation_error_m < metres


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _median(values: Iterable[float | None]) -> float | None:
    known = _known(values)
    return float(np.median(known)) if known else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = _known(values)
    return float(np.mean(known)) if known else None


LATEST_S = 4e9
"""Latest time, beyond the year 2090: a larger number is not a time in seconds."""


def estimated_trajectory(results: SequenceResults) -> Trajectory:
    """Estimated poses ``map_from_camera`` of the localized queries."""
    return _trajectory(results, "cam_from_map")


def vehicle_trajectory(results: SequenceResults, vehicle_from_camera: FloatArray) -> Trajectory:
    """Poses ``map_from_vehicle`` of the queries with a pose, by the camera's place on the vehicle (3, 4)."""
    cameras = estimated_trajectory(results)
    camera_from_vehicle = inverse_pose(vehicle_from_camera)
    poses = [
        pose(one[:, :3] @ camera_from_vehicle[:, :3], one[:, :3] @ camera_from_vehicle[:, 3] + one[:, 3])
        for one in cameras.map_from_body
    ]
    return Trajectory(cameras.timestamps_ns, np.array(poses).reshape(-1, 3, 4))


def true_trajectory(results: SequenceResults) -> Trajectory:
    """True poses ``map_from_camera`` of the queries whose truth is known."""
    return _trajectory(results, "truth_cam_from_map")


def timed(rows: Sequence[QueryResult]) -> bool:
    """Whether every query has a time and the times grow; else a query's time is its index in the sequence."""
    times = [row.timestamp_s for row in rows]
    if any(time is None or not abs(time) < LATEST_S for time in times):
        return False
    return bool((np.diff([_nanoseconds(row, True) for row in rows]) > 0).all())


def _trajectory(results: SequenceResults, field: str) -> Trajectory:
    by_time = timed(results.rows)
    rows = [row for row in results.rows if getattr(row, field) is not None]
    times = np.array([_nanoseconds(row, by_time) for row in rows], dtype=np.int64)
    inverse = [inverse_pose(getattr(row, field)) for row in rows]
    return Trajectory(times, np.array(inverse).reshape(-1, 3, 4))


def _nanoseconds(row: QueryResult, by_time: bool) -> int:
    seconds = row.timestamp_s if by_time and row.timestamp_s is not None else row.index
    return round(Decimal(repr(seconds)) * NS_PER_S)  # exact for the decimals of the shortest repr
