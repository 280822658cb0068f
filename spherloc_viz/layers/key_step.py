"""The results of a step in numbers, and the key step, at which a run was decided or went wrong."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spherloc.diagnosis import Cause, Diagnosis
from spherloc.geometry import yaw_of
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M, evaluate, rotation_error_deg, translation_error_m
from spherloc.trace import ConsensusStage, RansacStage, RefinementStage, Trace, TranslationStage, YawStage
from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers import steps
from spherloc_viz.layers.primitives import Picture, Points

BY_CAUSE: dict[Cause, tuple[str, ...]] = {
    Cause.GRAVITY_OFF: ("gravity",),
    Cause.BOUND_TOO_SMALL: ("refinement-outliers",),
    Cause.BOUND_TOO_LARGE: ("refinement-outliers",),
    Cause.DEGENERATE: ("refinement-error",),
    Cause.AMBIGUOUS: ("consensus-poses",),
    Cause.FALSE_CONSENSUS: ("consensus-poses",),
    Cause.ITERATIONS_RAN_OUT: ("samples-drawn",),
}
"""Steps that show a cause, by cause; the first one that a run has is its key step, whatever its stages found."""
YAW_SLACK_DEG = 3.0
"""Largest error of a yaw that counts as right: arcs are some degrees wide, and refinement corrects that much."""
POSITION_SLACK_M = 0.5
"""Largest error of a position before refinement that counts as right."""


def key_step(trace: Trace, diagnosis: Diagnosis) -> int:
    """The index in ``layers.steps(trace)`` of the step at which the run was decided or, if it failed, went wrong.

    If the given gravity is wrong, it is the step "gravity", before any computation. Else, where the truth is known,
    it is the first stage whose result is wrong; where it is not, the step that shows the cause. A run that looks right
    was decided where its consensus was found, and a run without such a step at its outcome.
    """
    index = {heading.key: number for number, heading in enumerate(steps(trace))}
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
    # If only the last digits of the pose are wrong, the cause says what was missing.
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


AGREEING = (style.INLIER, style.CLIQUE)
"""Colours of matches that agree."""
ALL_MATCHES = "map/points"
"""The dots that show all matches."""


@dataclass(frozen=True)
class StepNumbers:
    """One step of a run."""

    step: int
    """Index in ``layers.steps``."""
    stage: str
    """Named stage, such as "Yaw"."""
    key: str
    """Key of the step, such as "yaw-arcs"."""
    agreeing: int
    """Number of matches that the step shows as agreeing: in the clique, or within the bound."""
    rotation_error_deg: float | None
    """Rotation error of the step's pose; None if it has no pose or the truth is unknown."""
    translation_error_m: float | None
    """Distance of the step's camera position from the true one, metres; None likewise."""


def step_numbers(trace: Trace, pictures: Mapping[int, Picture]) -> tuple[StepNumbers, ...]:
    """The numbers of painted steps, by their index."""
    truth, found = trace.problem.truth_cam_from_map, []
    for index, picture in pictures.items():
        pose = step_pose(trace, picture.step.key)
        off: tuple[float | None, float | None] = (None, None)
        if pose is not None and truth is not None:
            off = rotation_error_deg(truth, pose), translation_error_m(truth, pose)
        found.append(StepNumbers(index, picture.step.stage, picture.step.key, _agreeing(picture), *off))
    return tuple(found)


def _agreeing(picture: Picture) -> int:
    return int(np.count_nonzero(agreeing(match_colors(picture))))


def match_colors(picture: Picture) -> ByteArray:
    """Colours (N, 3) of all matches in a picture."""
    shown = next((item for item in picture.scene if isinstance(item, Points) and item.name == ALL_MATCHES), None)
    return np.zeros((0, 3), np.uint8) if shown is None else shown.colors


def agreeing(colors: ByteArray) -> np.ndarray:
    """Mask (N,) of the colours (N, 3) that mean that a match agrees."""
    red, green, blue = colors.T
    marked = np.zeros(len(colors), dtype=bool)
    for r, g, b in AGREEING:
        marked |= (red == r) & (green == g) & (blue == b)
    return marked


def step_pose(trace: Trace, key: str) -> FloatArray | None:
    """The pose (3, 4) that a step shows, in the problem's frames; None if it shows none."""
    kind, number = _parted(key)
    if kind == "outcome":
        return trace.cam_from_map
    ransac, refinement = trace.stage(RansacStage), trace.stage(RefinementStage)
    consensus, translation = trace.stage(ConsensusStage), trace.stage(TranslationStage)
    if ransac is not None and kind in ("sample", "samples-drawn"):
        return _at(ransac.cam_from_map, None if number is None else number - 1)
    if translation is not None and key == "clique":
        return translation.cam_from_map
    if consensus is not None and kind in ("consensus-pose", "consensus-poses"):
        return _at(consensus.cam_from_map, 0 if number is None else number - 1)
    if refinement is not None and kind.startswith("refinement"):
        return _at(refinement.cam_from_map, number)
    return None


def _parted(key: str) -> tuple[str, int | None]:
    """A key without its number, and the number: of "sample-3-pose" it is "sample" and 3."""
    match = re.fullmatch(r"(.+?)-(\d+)(?:-pose)?", key)
    return (key, None) if match is None else (match[1], int(match[2]))


def _at(poses: FloatArray, index: int | None) -> FloatArray | None:
    """One of some poses (K, 3, 4), the last one for None."""
    return poses[-1 if index is None else index] if len(poses) else None
