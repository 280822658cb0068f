"""Errors and scores of Sec. VI."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from spherloc.geometry import camera_centre, rotation_angle
from spherloc.trace import Trace
from spherloc.types import BoolArray, FloatArray

SUCCESS_DEG = 1.0
SUCCESS_M = 0.1


@dataclass(frozen=True)
class Metrics:
    """Scores of one run; None where the truth they need is unknown."""

    rotation_error_deg: float | None
    """Angle between true and estimated rotation, degrees."""
    translation_error_m: float | None
    """Distance between the true and the estimated camera position, metres."""
    t_error_m: float | None
    """|t_true - t| of ``cam_from_map``, metres: Sec. VI to the letter; grows with the distance to the map's origin."""
    success: bool | None
    """Both errors below 1 degree and 0.1 m; a run without a pose has failed."""
    precision: float | None
    """Share of the reported inliers that are true inliers."""
    recall: float | None
    """Share of the true inliers that were reported."""
    f1: float | None
    """Harmonic mean of precision and recall."""


def rotation_error_deg(truth: FloatArray, estimate: FloatArray) -> float:
    """Angle (degrees) of R_true^T R of two poses (3, 4): the paper's arccos form, computed by atan2."""
    return float(np.degrees(rotation_angle(truth[:, :3].T @ estimate[:, :3])))


def translation_error_m(truth: FloatArray, estimate: FloatArray) -> float:
    """Distance (metres) between the camera positions -R^T t of two poses (3, 4).

    Sec. VI uses |t_true - t|. That mixes the rotation error with the distance to the map's origin, which is arbitrary:
    a camera placed to 2 mm but turned by 0.75 degrees, 3 m from the origin, would be 4 cm off.
    """
    return float(np.linalg.norm(camera_centre(truth) - camera_centre(estimate)))


BEYOND = "more than 1,000 times the extent of the map"
"""What is said instead of a length of which so much is true: no camera that sees the map is so far away."""
AWAY = f"a place {BEYOND} away, which cannot be"
"""What is said instead of the coordinates of a camera that is so far away."""
_TIMES = 1000.0


def extent_of(points: FloatArray) -> float:
    """The extent, metres or units of the map, of map points (N, 3): the diagonal of the box that holds nine tenths of
    them along each axis, as a few may be far away. 0 without points."""
    return float(np.linalg.norm(np.subtract(*np.percentile(points, (95.0, 5.0), axis=0)))) if len(points) else 0.0


def is_beyond(length_m: float, extent_m: float) -> bool:
    """Whether a length is absurd in a map of that extent (``extent_of``): a pose that few matches give can be
    anywhere. Never where the extent is 0, as that of one point."""
    return length_m > _TIMES * extent_m > 0.0


def is_away(position: FloatArray, points: FloatArray) -> bool:
    """Whether a position (3,) is absurdly far from the middle of map points (N, 3)."""
    if not len(points):
        return False
    return is_beyond(float(np.linalg.norm(position - np.median(points, axis=0))), extent_of(points))


def said_length(length_m: float, extent_m: float, text: str) -> str:
    """The ``text`` of a length; ``BEYOND`` instead if it is absurd in a map of that extent."""
    return BEYOND if is_beyond(length_m, extent_m) else text


def precision_recall_f1(truth: BoolArray, reported: BoolArray) -> tuple[float, float, float]:
    """Scores of a reported inlier mask (N,) against the true one (N,); 0 where a denominator is 0."""
    hits = float(np.count_nonzero(truth & reported))
    precision = hits / max(1, int(np.count_nonzero(reported)))
    recall = hits / max(1, int(np.count_nonzero(truth)))
    return precision, recall, 2 * precision * recall / (precision + recall) if hits else 0.0


def ransac_success_probability(inlier_rate: float, sample_size: int, iterations: int) -> float:
    """Eq. 28: P = 1 - (1 - w^n)^k, without cancellation for small w^n."""
    if inlier_rate >= 1.0:
        return 1.0 if iterations > 0 else 0.0
    return float(-np.expm1(iterations * np.log1p(-(inlier_rate**sample_size))))


def evaluate(trace: Trace) -> Metrics:
    """Score a run with the true pose and labels, as far as they are known; once for a trace."""
    known = _EVALUATED.get(trace)
    if known is None:
        known = _EVALUATED[trace] = _evaluate(trace)
    return known


_EVALUATED: WeakKeyDictionary[Trace, Metrics] = WeakKeyDictionary()


def _evaluate(trace: Trace) -> Metrics:
    problem, estimate = trace.problem, trace.cam_from_map
    rotation = translation = t_error = success = None
    if problem.truth_cam_from_map is not None:
        success = False
        if estimate is not None:
            rotation = rotation_error_deg(problem.truth_cam_from_map, estimate)
            translation = translation_error_m(problem.truth_cam_from_map, estimate)
            t_error = float(np.linalg.norm(problem.truth_cam_from_map[:, 3] - estimate[:, 3]))
            success = rotation < SUCCESS_DEG and translation < SUCCESS_M
    scores: tuple[float | None, ...] = (None, None, None)
    if problem.truth_inliers is not None:
        scores = precision_recall_f1(problem.truth_inliers, trace.inlier_mask)
    return Metrics(rotation, translation, t_error, success, *scores)
