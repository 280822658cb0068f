"""Turns (trace, step) into primitives. The page and the recording draw these and nothing else."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

from spherloc.trace import (
    ConsensusStage,
    DecisionStage,
    RansacStage,
    RefinementStage,
    Stage,
    Trace,
    TranslationStage,
    YawStage,
)
from spherloc_viz import style
from spherloc_viz.layers import consensus, decision, ransac, refinement, start, translation, yaw
from spherloc_viz.layers.frame import Frame, RunView
from spherloc_viz.layers.primitives import FloatArray, Picture, Step
from spherloc_viz.layers.scene import base_items, camera
from spherloc_viz.layers.tables import outcome_table

FRAMES: dict[type[Stage], Callable[[RunView, Any], list[Frame]]] = {
    DecisionStage: decision.frames,
    RansacStage: ransac.frames,
    YawStage: yaw.frames,
    TranslationStage: translation.frames,
    ConsensusStage: consensus.frames,
    RefinementStage: refinement.frames,
}
"""The file that draws each kind of stage."""


@lru_cache(maxsize=4)
def _timeline(trace: Trace) -> tuple[RunView, tuple[Frame, ...]]:
    view = RunView(trace)
    frames = start.frames(view)
    for stage in trace.stages:
        frames += FRAMES[type(stage)](view, stage)
    return view, (*frames, refinement.outcome_frame(view))


def steps(trace: Trace) -> tuple[Step, ...]:
    """The stops on the run's timeline, from the matches to the outcome."""
    return tuple(frame.step for frame in _timeline(trace)[1])


def paint(trace: Trace, index: int) -> Picture:
    """What the step at ``index`` looks like. Charts of earlier steps stay."""
    view, frames = _timeline(trace)
    frame = frames[index]
    charts = {chart.name: chart for earlier in frames[: index + 1] for chart in earlier.charts}
    tables = (*frame.tables, outcome_table(trace)) if index == len(frames) - 1 else frame.tables
    return Picture(frame.step, base_items(view, frame) + frame.extra(), tuple(charts.values()), tables)


def with_rival(picture: Picture, trace: Trace, cam_from_map: FloatArray) -> Picture:
    """The picture with another pose (3, 4) beside the run's own."""
    view = _timeline(trace)[0]
    rival = camera("cameras/rival", view.aligned_pose(cam_from_map), 1.7 * view.sphere_m, style.RIVAL, 2.5)
    return replace(picture, scene=(*picture.scene, rival))
