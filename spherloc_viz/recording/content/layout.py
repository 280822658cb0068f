"""How a recording opens: the blueprint that is put into the recording's own file."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import rerun.blueprint as rrb
import rerun_bindings
from rerun import RecordingStream
from rerun.blueprint import archetypes

from spherloc_viz.layers.primitives import Chart, Picture
from spherloc_viz.recording.content.drawing import chart_path, table_path
from spherloc_viz.recording.content.panels import ARCS, GRAPH, RESIDUALS, Panels
from spherloc_viz.recording.content.properties import APPLICATION_ID, REVIEW_ENTITY
from spherloc_viz.recording.content.rrd_file import RrdFile, split
from spherloc_viz.recording.content.text import legible

EYE = (1.15, -1.2, -1.55)
"""Where one looks from, in the frame in which the scene has radius 1: from the same side as the page's overview."""
LAYOUT_ROOM = 1 << 20
"""Bytes, many more than a layout takes."""
MOST_LAYOUTS = 64
"""Layouts that are kept; runs of one estimator share one or a few."""


@dataclass(frozen=True)
class Shown:
    """What a layout has views for. Hashable, so that runs can share layouts."""

    charts: tuple[tuple[str, str, bool], ...]
    """Name and heading of every chart, and whether its legend stands on the left, where nothing high is behind it."""
    tables: tuple[str, ...]
    """Tables that a run shows before its last step; those of the last one are part of the outcome."""
    panels: Panels


def shown_in(pictures: Sequence[Picture], panels: Panels) -> Shown:
    """What a run shows at any step, in the order of its first appearance."""
    charts: dict[str, Chart] = {}
    for picture in pictures:
        for chart in picture.charts:
            charts.setdefault(chart.name, chart)
    named = tuple(
        (name, legible(f"{chart.title}: {chart.y_label} over {chart.x_label}"), _low_on_the_left(chart))
        for name, chart in charts.items()
    )
    tables = tuple(dict.fromkeys(table.name for picture in pictures[:-1] for table in picture.tables))
    return Shown(named, tables, panels)


def _low_on_the_left(chart: Chart) -> bool:
    curves = [curve for curve in chart.curves if curve.kind != "marker" and len(curve.x)]
    if not curves:
        return True
    x, y = (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("x", "y"))
    left = x < 0.5 * (x.min() + x.max())
    return float(y[left].max(initial=0.0)) <= float(y[~left].max(initial=0.0))


def blueprint(shown: Shown) -> rrb.Blueprint:
    """The scene above the image, arcs and graph on the left; what the step says, charts and verdict on the right.

    The layout pauses on the timeline of steps; at which step is up to who opens the recording, since a blueprint has
    no word for it. A viewer in a page is told by its address.
    """
    plots = [
        rrb.BarChartView(
            origin=chart_path(name), name=label, plot_legend=rrb.PlotLegend("LeftTop" if left else "RightTop")
        )
        for name, label, left in shown.charts
    ]
    if shown.panels.residuals:
        # Second, since the chart of refinement is empty at most steps.
        # There are bars everywhere, so the heading says what a legend would hide.
        name, legend = "Residuals over log10 of px: right green, wrong red", rrb.PlotLegend(visible=False)
        plots.insert(1, rrb.BarChartView(origin=RESIDUALS, name=name, plot_legend=legend))
    texts = [
        rrb.TextDocumentView(origin="/outcome", name="Verdict"),
        rrb.TextDocumentView(origin=REVIEW_ENTITY, name="Review"),
        *(rrb.TextDocumentView(origin=table_path(name), name=name) for name in shown.tables),
    ]
    words = rrb.TextDocumentView(origin="/step", name="Step")
    side = [words, *plots[:1], *([rrb.Tabs(*plots[1:])] if plots[1:] else []), rrb.Tabs(*texts)]
    left = rrb.Vertical(_scene(), rrb.Horizontal(*_flat_views(shown.panels)), row_shares=[2.2, 1])
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*side, row_shares=[1.3, *[1] * (len(side) - 2), 1.5]), column_shares=[3, 2]),
        # Without its timeline: rerun chooses the only one, and says that a named one is missing while it still loads.
        rrb.TimePanel(state="collapsed", play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scene() -> rrb.Spatial3DView:
    eye = rrb.EyeControls3D(position=EYE, look_target=(0.0, 0.0, 0.0), eye_up=(0.0, -1.0, 0.0))
    grid = archetypes.LineGrid3D(visible=False)
    return rrb.Spatial3DView(origin="/", contents="/scene/**", name="Scene", eye_controls=eye, line_grid=grid)


def _flat_views(panels: Panels) -> list[rrb.View]:
    views: list[rrb.View] = [rrb.Spatial2DView(origin="/query", name="Query image")]
    if panels.arcs:
        views.append(rrb.Spatial2DView(origin=ARCS, name="Yaw arcs near the estimate (degrees)"))
    name = "Overlaps of balls"
    if panels.graph:
        # The balls have places of their own, and forces would only move them about.
        views.append(
            rrb.GraphView(
                origin=GRAPH,
                name=name,
                force_link=archetypes.ForceLink(enabled=False),
                force_many_body=archetypes.ForceManyBody(enabled=False),
                force_position=archetypes.ForcePosition(enabled=True),
                force_collision_radius=archetypes.ForceCollisionRadius(enabled=False),
                force_center=archetypes.ForceCenter(enabled=False),
            )
        )
    elif panels.large_graph:
        views.append(rrb.Spatial2DView(origin=GRAPH, name=name))
    return views


@lru_cache(maxsize=MOST_LAYOUTS)
def layout_file(shown: Shown) -> RrdFile:
    """The blueprint as the parts of an ``.rbl`` file.

    Kept, since rerun leaves two threads behind for every blueprint that it saves.
    Raises ``OSError`` if it cannot be saved, ``ValueError`` if rerun saves it in an unknown form.
    """
    with tempfile.TemporaryDirectory(prefix="spherloc-") as folder:
        path = Path(folder) / "layout.rbl"
        # On a full disk, saving a blueprint would wait for ever: find that out first.
        path.write_bytes(bytes(LAYOUT_ROOM))
        path.unlink()
        _save(blueprint(shown), path)
        return split(path.read_bytes())


def _save(layout: rrb.Blueprint, path: Path) -> None:
    """Write a blueprint to a file that is complete when this returns.

    ``Blueprint.save`` leaves the end of the file to the deletion of its stream, which a profiler or debugger that
    holds the frame of this thread delays. So the stream is ours here, and disconnected.
    """
    native = rerun_bindings.new_blueprint(
        application_id=APPLICATION_ID, make_default=False, make_thread_default=False, default_enabled=True
    )
    stream = RecordingStream._from_native(native)
    try:
        stream.set_time("blueprint", sequence=0)
        layout._log_to_stream(stream)
        rerun_bindings.save_blueprint(str(path), native)
    finally:
        stream.disconnect()
