"""At which step a run was decided, or went wrong: where to open it."""

import numpy as np

from spherloc.diagnosis import Cause, Diagnosis
from spherloc.geometry import yaw_of
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M, evaluate, rotation_error_deg, translation_error_m
from spherloc.trace import ConsensusStage, RansacStage, RefinementStage, Trace, TranslationStage, YawStage
from spherloc.types import FloatArray
from spherloc_viz.layers import steps

BY_CAUSE: dict[Cause, tuple[str, ...]] = {
    Cause.GRAVITY_OFF: ("gravity",),
    Cause.BOUND_TOO_SMALL: ("refinement-outliers",),
    Cause.DEGENERATE: ("refinement-error",),
    Cause.AMBIGUOUS: ("consensus-poses",),
    Cause.FALSE_CONSENSUS: ("consensus-poses",),
    Cause.ITERATIONS_RAN_OUT: ("samples-drawn",),
}
"""Steps that show a cause, of which the first that a run has is taken, whatever its stages found."""
YAW_SLACK_DEG = 3.0
"""A yaw that is off by more than this is wrong: arcs are some degrees wide, and refinement mends as much."""
POSITION_SLACK_M = 0.5
"""A position before refinement that is off by more than this is wrong."""


def key_step(trace: Trace, diagnosis: Diagnosis) -> int:
    """The index in ``layers.steps(trace)`` of the step at which the run was decided or, if it failed, went wrong.

    A gravity that is off spoils a run before anything is computed. Else, where the truth is known, it is the first
    stage whose result is wrong; where it is not, the step that shows the cause. A run that looks right was decided
    where its consensus was found, and one without any such step by its outcome.
    """
    index = {stop.key: number for number, stop in enumerate(steps(trace))}
    wanted = [*_wrong(trace, diagnosis), *_decided(trace, index), "outcome"]
    return next(index[key] for key in wanted if key in index)


def _wrong(trace: Trace, diagnosis: Diagnosis) -> list[str]:
    """Steps at which the run went wrong, the best first; none if it looks right."""
    success = evaluate(trace).success
    if success or (success is None and not diagnosis.doubtful):
        return []
    if diagnosis.cause is Cause.GRAVITY_OFF:
        return ["gravity"]
    found = _first_wrong(trace)
    by_cause = BY_CAUSE.get(diagnosis.cause, ())
    # Where all but the last digits are right, the cause says what was missing.
    return [*by_cause, found] if found == "refinement" else [found, *by_cause] if found else [*by_cause]


def _first_wrong(trace: Trace) -> str:
    """The key of the first stage's last step whose result is not the truth; empty if there is none or no truth."""
    truth = trace.problem.truth_cam_from_map
    if truth is None:
        return ""
    for stage in trace.stages:
        if isinstance(stage, YawStage) and _yaw_off_deg(trace, truth, stage.yaw_rad) > YAW_SLACK_DEG:
            return "yaw-clique"
        if isinstance(stage, TranslationStage) and _off(truth, stage.cam_from_map, POSITION_SLACK_M, YAW_SLACK_DEG):
            return "clique"
        if isinstance(stage, ConsensusStage) and not (
            len(stage.support) and not _off(truth, stage.cam_from_map[0], POSITION_SLACK_M, YAW_SLACK_DEG)
        ):
            return "consensus-poses"
        if isinstance(stage, RansacStage) and not (
            len(stage.improved_at) and not _off(truth, stage.cam_from_map[-1], POSITION_SLACK_M, YAW_SLACK_DEG)
        ):
            return "samples-drawn"
        if isinstance(stage, RefinementStage) and _off(truth, stage.cam_from_map[-1], SUCCESS_M, SUCCESS_DEG):
            return "refinement"
    return ""


def _yaw_off_deg(trace: Trace, truth: FloatArray, yaw_rad: float) -> float:
    off = yaw_rad - yaw_of(trace.problem.aligned.align_pose(truth)[:, :3])
    return float(abs(np.degrees(np.arctan2(np.sin(off), np.cos(off)))))


def _off(truth: FloatArray, found: FloatArray, metres: float, degrees: float) -> bool:
    return translation_error_m(truth, found) > metres or rotation_error_deg(truth, found) > degrees


def _decided(trace: Trace, index: dict[str, int]) -> list[str]:
    """Steps at which a run found its consensus."""
    samples = [key for key in index if key.startswith("sample-") and not key.endswith("-pose")]
    last = ["clique", "consensus-pose-1", "consensus-poses", *samples[-1:]]
    return last if trace.cam_from_map is not None else ["yaw-clique", "consensus-bound"]
