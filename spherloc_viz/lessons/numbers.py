"""The numbers of a run that a lesson's prose can name."""

from collections.abc import Callable, Mapping
from math import ceil, comb, isfinite, log, log1p

import numpy as np

from spherloc.bounds import bounds_of
from spherloc.geometry import yaw_of
from spherloc.metrics import evaluate
from spherloc.trace import RansacStage, RefinementStage, Trace, TranslationStage, YawStage
from spherloc_viz.gallery.case import MEASURES, stage_of

CONFIDENCE = 0.999
"""For which the samples that are needed are told."""
LARGE = 10_000.0
SMALL = 1e-3
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NO_BREAK = "\N{NO-BREAK SPACE}"
"""Keeps a number on one line."""

Number = float | str


def _samples_needed(trace: Trace, size: int) -> float:
    """Samples by Eq. 28 until one of ``size`` right matches is drawn with a probability of ``CONFIDENCE``."""
    right = 0 if trace.problem.truth_inliers is None else int(np.count_nonzero(trace.problem.truth_inliers))
    rate = right / len(trace.problem)
    if rate in (0.0, 1.0):
        return np.inf if rate == 0.0 else 1.0
    return ceil(log(1.0 - CONFIDENCE) / log1p(-(rate**size)))


def _yaw_deg(trace: Trace, cam_from_map: np.ndarray | None) -> float:
    if cam_from_map is None:
        return np.nan
    return float(np.degrees(yaw_of(trace.problem.aligned.align_pose(cam_from_map)[:, :3])))


def _refinement(trace: Trace) -> RefinementStage:
    return stage_of(trace, RefinementStage)


def _position_sd_cm(trace: Trace) -> float:
    return 100.0 * float(np.sqrt(np.trace(_refinement(trace).covariance[3:, 3:])))


def _yaw_stage(trace: Trace) -> YawStage:
    return stage_of(trace, YawStage)


def _translation(trace: Trace) -> TranslationStage:
    return stage_of(trace, TranslationStage)


def _pixel_deg(trace: Trace) -> np.ndarray:
    """(N,) what one pixel is at each match as an angle, deg."""
    return np.degrees(bounds_of(trace.problem.aligned, 1.0).radians)


MORE: Mapping[str, Callable[[Trace], float]] = {
    "wrong": lambda trace: MEASURES["matches"](trace) - MEASURES["right"](trace),
    "wrong_percent": lambda trace: 100.0 * (1.0 - MEASURES["right"](trace) / len(trace.problem)),
    "off_cm": lambda trace: 100.0 * MEASURES["off_m"](trace),
    "success": lambda trace: np.nan if (good := evaluate(trace).success) is None else float(good),
    "time_ms": lambda trace: trace.timings_ms["total"],
    "samples_needed": lambda trace: _samples_needed(trace, 2),
    "samples_needed_3": lambda trace: _samples_needed(trace, 3),
    "samples_needed_6": lambda trace: _samples_needed(trace, 6),
    "pairs_of_right": lambda trace: comb(int(MEASURES["right"](trace)), 2),
    "improvements": lambda trace: len(stage_of(trace, RansacStage).improved_at),
    "arcs": lambda trace: len(_yaw_stage(trace).pairs),
    "yaw_deg": lambda trace: _yaw_deg(trace, trace.cam_from_map),
    "true_yaw_deg": lambda trace: _yaw_deg(trace, trace.problem.truth_cam_from_map),
    "arc_width_deg": lambda trace: float(np.degrees(np.median(_yaw_stage(trace).hi_rad - _yaw_stage(trace).lo_rad))),
    "candidates": lambda trace: _translation(trace).candidates,
    "balls": lambda trace: len(_translation(trace).pairs),
    "edges": lambda trace: len(_translation(trace).edges),
    "clique": lambda trace: len(_translation(trace).clique),
    "radius_m": lambda trace: float(np.median(_translation(trace).radii_m)),
    "lower": lambda trace: np.nan if trace.certificate is None else trace.certificate.lower_bound,
    "gap": lambda trace: np.nan if trace.certificate is None else trace.certificate.gap,
    "rounds": lambda trace: len(_refinement(trace).cam_from_map) - 1,
    "dof": lambda trace: _refinement(trace).dof,
    "cost_first_px2": lambda trace: float(_refinement(trace).cost_px2[0]),
    "cost_last_px2": lambda trace: float(_refinement(trace).cost_px2[-1]),
    "tilt_deg": lambda trace: float(np.degrees(_refinement(trace).tilt_rad)),
    "expected_cm": _position_sd_cm,
    "pixel_least_deg": lambda trace: float(_pixel_deg(trace).min()),
    "pixel_most_deg": lambda trace: float(_pixel_deg(trace).max()),
    "bound_px": lambda trace: float(trace.options.bound_px),
}
NAMES = frozenset(MEASURES) | frozenset(MORE) | {"estimator", "verdict"}
"""What prose can name."""


def numbers_of(trace: Trace) -> dict[str, Number]:
    """All numbers that a run has, by name."""
    found: dict[str, Number] = {"estimator": trace.estimator, "verdict": _verdict(trace)}
    for name, measure in (*MEASURES.items(), *MORE.items()):
        try:
            value = float(measure(trace))
        except (ValueError, ZeroDivisionError):
            continue
        if value == value:
            found[name] = value
    return found


def _verdict(trace: Trace) -> str:
    if trace.cam_from_map is None:
        return "a run without a pose"
    return {True: "a success", False: "a failure", None: "a pose, the truth is unknown"}[evaluate(trace).success]


def number_text(value: Number) -> str:
    """A number as prose has it."""
    if isinstance(value, str):
        return value
    if not isfinite(value):
        return "infinitely many"
    if value != 0 and not SMALL <= abs(value) < 1e12:
        digits, _, power = f"{value:.1e}".partition("e")
        return f"{digits}{NO_BREAK}×{NO_BREAK}10{str(int(power)).translate(RAISED)}"
    if value == round(value) or abs(value) >= LARGE:
        return f"{value:,.0f}"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
