"""Turns (trace, step) into primitives. The page and the recording draw these and nothing else."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from spherloc.trace import (
    ConsensusStage,
    DecisionStage,
    PositionStage,
    RansacStage,
    RefinementStage,
    Stage,
    Trace,
    TranslationStage,
    YawStage,
)
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers import (
    consensus,
    extension,
    outcome,
    ransac,
    refinement,
    start,
    translation,
    withheld,
    yaw,
)
from spherloc_viz.layers.camera_shape import camera
from spherloc_viz.layers.frame import Plan, RunView, focus_of
from spherloc_viz.layers.primitives import Chart, Graph, Picture, Step, StepHeading
from spherloc_viz.layers.query_image import modified
from spherloc_viz.layers.scene import base_items

STAGES: dict[type[Stage], tuple[str, Callable[[RunView, Any], list[Plan]]]] = {
    DecisionStage: ("Choice", ransac.decision_plans),
    RansacStage: ("Samples", ransac.plans),
    YawStage: ("Yaw", yaw.plans),
    TranslationStage: ("Translation", translation.plans),
    ConsensusStage: ("Consensus", consensus.plans),
    PositionStage: ("Positions", consensus.position_plans),
    RefinementStage: ("Refinement", refinement.plans),
}
"""Name of each kind of stage for users, and the function that plans its steps."""
KINDS = tuple(stage.kind for stage in STAGES)
"""Kinds of the stages that are spherloc's own."""
FIRST, LAST = "Matches", "Outcome"
"""Names of the first and the last stage, which every run has."""
MAX_PICTURES = 24
"""Largest number of a run's pictures that are kept."""


@dataclass(frozen=True, eq=False)
class _Timeline:
    view: RunView
    plans: tuple[Plan, ...]
    headings: tuple[StepHeading, ...]
    charts: dict[Callable[[], Chart], Chart | None] = field(default_factory=dict)
    """Charts that were drawn already; they are reused by all later steps."""

    graphs: dict[Callable[[], Graph], Graph | None] = field(default_factory=dict)
    pictures: dict[tuple[int, bool, int], Picture] = field(default_factory=dict)
    """The pictures that were painted last, for those who walk back and forth: by the step, whether what came out was
    told, and when the query image was written."""

    def _until(self, index: int, told: bool) -> list[Plan]:
        """The steps up to one, without those that tell what came out unless that is ``told``."""
        return [plan for plan in self.plans[: index + 1] if told or plan.untold is not None]

    def graph(self, index: int, told: bool) -> Graph | None:
        """The graph as of a step, made once; None where that fails on the numbers of an extension."""
        draw = next((plan.graph for plan in reversed(self._until(index, told)) if plan.graph is not None), None)
        if draw is None:
            return None
        if draw not in self.graphs:
            try:
                self.graphs[draw] = extension.whole_graph(draw())
            except Exception:
                if not extension.is_extension(self.view):
                    raise
                self.graphs[draw] = None
        return self.graphs[draw]

    def charts_at(self, index: int, told: bool) -> tuple[Chart, ...]:
        """The charts as of a step."""
        named: dict[str, Callable[[], Chart]] = {}
        for plan in self._until(index, told):
            named.update(plan.charts)
        return tuple(chart for chart in map(self.chart, named.values()) if chart is not None)

    def chart(self, draw: Callable[[], Chart]) -> Chart | None:
        """The chart that ``draw`` makes, made once; None where that fails on the numbers of an extension."""
        if draw not in self.charts:
            try:
                self.charts[draw] = extension.whole_chart(draw())
            except Exception:
                if not extension.is_extension(self.view):
                    raise
                self.charts[draw] = None
        return self.charts[draw]


class _Kept(threading.local):
    """The timeline that was used last, per thread: each page has a thread that paints one run at a time."""

    timeline: _Timeline | None = None


_kept = _Kept()


def _timeline(trace: Trace) -> _Timeline:
    known = _kept.timeline
    if known is None or known.view.trace is not trace:
        known = _kept.timeline = _planned(RunView(trace))
    return known


def _planned(view: RunView) -> _Timeline:
    parts = [(FIRST, start.plans(view))]
    for stage in view.trace.stages:
        if type(stage) in STAGES:
            name, plans = STAGES[type(stage)]
            parts.append((name, extension.guarded_plans(view, stage, partial(plans, view, stage))))
        else:
            parts.append(extension.named_plans(view, stage, KINDS))
    parts.append((LAST, outcome.plans(view)))
    named = [(name, plan) for name, plans in parts for plan in plans]
    headings = tuple(StepHeading(plan.key, plan.title, name) for name, plan in named)
    return _Timeline(view, tuple(plan for _, plan in named), headings)


def steps(trace: Trace, told: bool = True) -> tuple[StepHeading, ...]:
    """The headings of a run's steps, from the matches to the outcome. Captions are made when a step is painted.

    Unless what came out is to be ``told``, steps that tell it have the names of their stages as titles.
    """
    timeline = _timeline(trace)
    return timeline.headings if told else withheld.untold_headings(timeline.plans, timeline.headings)


def graph_begins(trace: Trace) -> str:
    """The key of the first step that has a graph; empty if none has."""
    return next((plan.key for plan in _timeline(trace).plans if plan.graph is not None), "")


def paint(trace: Trace, index: int, told: bool = True) -> Picture:
    """The picture of the step at ``index``. Charts of earlier steps are kept, and some pictures.

    Unless what came out is to be ``told``, a step that tells it has the picture of the last one before it that does
    not; ``trace`` is then to be without it too (``withheld.untold``).
    """
    timeline, image = _timeline(trace), trace.problem.image
    key = index, told, 0 if image is None else modified(image)
    kept = timeline.pictures
    picture = kept[key] = kept.pop(key, None) or _painted(timeline, index, told)
    if len(kept) > MAX_PICTURES:
        del kept[next(iter(kept))]
    return picture


def _painted(timeline: _Timeline, index: int, told: bool) -> Picture:
    shown = index if told else withheld.last_untold(timeline.plans, index)
    plan, heading = timeline.plans[shown], timeline.headings[shown]
    frame = plan.draw() if told or plan.untold is None else plan.untold()
    step = Step(heading.key, heading.title, frame.caption, frame.equation, frame.note, heading.stage)
    if shown != index:
        step = withheld.untold_step(timeline.headings[index], heading)
    tables = frame.tables if shown == index else ()
    scene = base_items(timeline.view, frame) + frame.items
    charts, graph = partial(timeline.charts_at, shown, told), partial(timeline.graph, shown, told)
    return Picture(step, scene, tables, focus_of(timeline.view, frame), charts, graph)


def with_alternative(picture: Picture, trace: Trace, cam_from_map: FloatArray) -> Picture:
    """The picture with another pose (3, 4) beside the run's own."""
    view = _timeline(trace).view
    alternative = camera(
        "cameras/alternative", view.aligned_pose(cam_from_map), 1.7 * view.sphere_m, style.ALTERNATIVE, 2.5
    )
    return replace(picture, scene=(*picture.scene, alternative))
