"""What the steps of a run say in numbers, to be asked over many runs: which pose a step shows and how far it is off."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.trace import ConsensusStage, RansacStage, RefinementStage, Trace, TranslationStage
from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers.primitives import Picture, Points

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
    """Such as "yaw-arcs"."""
    agreeing: int
    """Matches that the step shows as agreeing: in the clique, or within the bound."""
    rotation_error_deg: float | None
    """Of the step's pose; None if it has none or the truth is unknown."""
    translation_error_m: float | None
    """Likewise, between the camera positions, metres."""


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
    """(N, 3) colours of all matches in a picture."""
    shown = next((item for item in picture.scene if isinstance(item, Points) and item.name == ALL_MATCHES), None)
    return np.zeros((0, 3), np.uint8) if shown is None else shown.colors


def agreeing(colors: ByteArray) -> np.ndarray:
    """Which of the colours (N, 3) say that a match agrees, (N,)."""
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
