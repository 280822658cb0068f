"""Runs a case and compares what happens with what is told."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M, evaluate
from spherloc.refine import residuals_px
from spherloc.trace import RansacStage, Trace
from spherloc_viz.gallery.case import Beside, GalleryCase, Play


@dataclass(frozen=True, eq=False)
class Played:
    """A case that was run."""

    case: GalleryCase
    """What is told."""
    trace: Trace
    """Its run."""
    diagnosis: Diagnosis
    """With the truth."""
    beside: tuple[tuple[Beside, Trace], ...]
    """The runs to compare with."""


def play(case: GalleryCase) -> Played:
    """Run a case and all that is beside it."""
    trace = case.run()
    return Played(case, trace, diagnose(trace), tuple((item, item.run()) for item in case.beside))


def faults(played: Played) -> Iterator[str]:
    """What happened otherwise than it is told, in sentences; nothing if the story is true."""
    case, trace = played.case, played.trace
    if played.diagnosis.cause != case.cause:
        yield f"{case.key}: the diagnosis is {played.diagnosis.cause}, and not {case.cause}."
    if sorted(happened := failures(trace)) != sorted(case.fails):
        yield f"{case.key}: what fails is {', '.join(happened) or 'nothing'}, and not {', '.join(case.fails)}."
    yield from _wrong_facts(case.key, case, trace)
    for item, other in played.beside:
        where = f"{case.key}, beside {item.name}"
        if bool(evaluate(other).success) != item.succeeds:
            yield f"{where}: it {'fails' if item.succeeds else 'succeeds'}, against what is told."
        yield from _wrong_facts(where, item, other)


def failures(trace: Trace) -> list[str]:
    """How a run with a known true pose fails; empty if it does not."""
    metrics = evaluate(trace)
    if metrics.rotation_error_deg is None or metrics.translation_error_m is None:
        return ["no pose"]
    found = {"position": metrics.translation_error_m >= SUCCESS_M, "rotation": metrics.rotation_error_deg >= SUCCESS_DEG}
    return [name for name, so in found.items() if so]


def _wrong_facts(where: str, told: Play, trace: Trace) -> Iterator[str]:
    for name, value in told.facts.items():
        if name not in MEASURES:
            yield f"{where}: there is no fact called {name}; there are {', '.join(MEASURES)}."
        elif not agrees(value, measured := MEASURES[name](trace)):
            yield f"{where}: {name} is {measured:.6g}, and not {value}."


def agrees(told: float, measured: float) -> bool:
    """Whether a number was measured as it is told: whole ones exactly, others up to one in their last digit."""
    if isinstance(told, int):
        return told == measured
    decimals = len(repr(told).partition(".")[2])
    return bool(abs(told - measured) <= 10.0**-decimals)


def _count(mask: np.ndarray | None) -> int:
    return 0 if mask is None else int(np.count_nonzero(mask))


def _agree_with_truth(trace: Trace) -> int:
    aligned, truth = trace.problem.aligned, trace.problem.truth_cam_from_map
    return 0 if truth is None else _count(residuals_px(aligned, aligned.align_pose(truth)) <= trace.options.bound_px)


def _right_inliers(trace: Trace) -> int:
    labels = trace.problem.truth_inliers
    return 0 if labels is None else _count(trace.inlier_mask & labels)


def _tilt_deg(trace: Trace) -> float:
    truth, problem = trace.problem.truth_cam_from_map, trace.problem
    if truth is None:
        return np.nan
    cosine = problem.gravity_camera @ (truth[:, :3] @ problem.gravity_map)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _samples(trace: Trace) -> int:
    stage = trace.stage(RansacStage)
    return 0 if stage is None else stage.iterations


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


MEASURES: Mapping[str, Callable[[Trace], float]] = {
    "matches": lambda trace: len(trace.problem),
    "right": lambda trace: _count(trace.problem.truth_inliers),
    "inliers": lambda trace: _count(trace.inlier_mask),
    "right_inliers": _right_inliers,
    "agree_with_truth": _agree_with_truth,
    "off_m": lambda trace: _or_nan(evaluate(trace).translation_error_m),
    "off_deg": lambda trace: _or_nan(evaluate(trace).rotation_error_deg),
    "samples": _samples,
    "gravity_off_deg": _tilt_deg,
    "at_most": lambda trace: -1 if trace.certificate is None else trace.certificate.upper_bound,
    "chance_sets": lambda trace: np.nan if trace.certificate is None else trace.certificate.chance_sets,
}
"""What a fact can be about: counts of matches, errors of the pose against the truth, and what is proven."""
