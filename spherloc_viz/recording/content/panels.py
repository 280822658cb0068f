"""What stands beside the scene at every step: arcs near the peak, the graph of overlaps, and residuals."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from spherloc.geometry import yaw_of
from spherloc.trace import Trace, TranslationStage, YawStage
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import even
from spherloc_viz.layers.residuals import Histogram, residuals_of
from spherloc_viz.recording.content.columns import (
    STRIP_2D,
    VECTOR_2D,
    Values,
    numbers,
    packed,
    segments,
    static_chunk,
    vectors,
)
from spherloc_viz.recording.content.components import PARTS, Bars

ARCS, GRAPH, RESIDUALS = "/arcs", "/graph", "/charts/residuals"
MAX_ARCS = 120
"""Arcs that are shown near the peak."""
REACH_DEG = 8.0
"""Arcs up to so far from the estimated yaw are near the peak."""
ASPECT = 0.6
"""Height of the stack of arcs by its width."""
MAX_NODES, MAX_EDGES = 200, 2_000
"""The viewer's own graph is fluent up to these; larger ones are lines and dots, of which no more edges are drawn."""
EDGE: pa.StructType = rr.components.GraphEdgeBatch._ARROW_DATATYPE
GREY = 0.35
"""Opacity of what is not in the clique."""


@dataclass(frozen=True)
class Panels:
    """Which of them a run has."""

    arcs: bool
    graph: bool
    """Whether there is a graph in the viewer's own graph view."""
    large_graph: bool
    """Whether there is a graph drawn as lines and dots."""
    residuals: bool


def panels_of(trace: Trace) -> Panels:
    """Which panels a run has."""
    translation, yaw = trace.stage(TranslationStage), trace.stage(YawStage)
    balls = 0 if translation is None else len(translation.pairs)
    small = translation is not None and balls <= MAX_NODES and len(translation.edges) <= MAX_EDGES
    return Panels(
        arcs=yaw is not None and len(yaw.pairs) > 0,
        graph=small and balls > 0,
        large_graph=not small and balls > 0,
        residuals=trace.cam_from_map is not None,
    )


def panel_chunks(trace: Trace, panels: Panels) -> Iterator[Chunk]:
    """Static chunks of the panels of a run."""
    yaw, translation, residuals = trace.stage(YawStage), trace.stage(TranslationStage), residuals_of(trace)
    if panels.arcs and yaw is not None:
        yield from _arcs(trace, yaw)
    if translation is not None and (panels.graph or panels.large_graph):
        yield from _graph(translation) if panels.graph else _large_graph(translation)
    if residuals is not None:
        yield from _residuals(residuals.histograms[0])


def _arcs(trace: Trace, stage: YawStage) -> Iterator[Chunk]:
    """Arcs as bars over degrees of yaw, from the widest below to the narrowest above, and the yaws to compare."""
    estimate, reach = float(np.degrees(stage.yaw_rad)), np.radians(REACH_DEG)
    half_widths = 0.5 * (stage.hi_rad - stage.lo_rad)
    away = stage.lo_rad + half_widths - stage.yaw_rad
    away -= 2.0 * np.pi * np.round(away / (2.0 * np.pi))
    in_clique = np.zeros(len(away), dtype=bool)
    in_clique[stage.clique] = True
    near = np.flatnonzero(np.abs(away) - half_widths <= reach)
    inside, outside = near[in_clique[near]], near[~in_clique[near]]
    take = min(len(inside), max(MAX_ARCS // 2, MAX_ARCS - len(outside)))
    chosen = np.concatenate([even(inside, take), even(outside, MAX_ARCS - take)])
    chosen = chosen[np.lexsort((-half_widths[chosen], in_clique[chosen]))]
    ends = away[chosen, None] + half_widths[chosen, None] * np.array([-1.0, 1.0])
    ends = estimate + np.degrees(np.clip(ends, -reach, reach))
    height = 2.0 * REACH_DEG * ASPECT
    rows = height * (np.arange(len(chosen)) + 0.5) / max(1, len(chosen))
    points = np.stack([ends, np.repeat(rows[:, None], 2, axis=1)], axis=2)
    colors = np.where(
        in_clique[chosen], packed(np.array([style.CLIQUE])), packed(np.array([style.UNDECIDED]), 2.0 * GREY)
    )
    yield static_chunk(f"{ARCS}/arcs", _lines(points, colors.astype(np.uint32), 1.5))
    yield _yaws(trace, estimate, height)


def _yaws(trace: Trace, estimate: float, height: float) -> Chunk:
    """Upright lines over the stack of arcs with a word each: the estimated yaw and, if it is near, the true one."""
    # Above the arcs, although the viewer hangs a word below its place.
    marks = [("estimate", estimate, -0.22 * height, style.ESTIMATE)]
    truth = trace.problem.truth_cam_from_map
    if truth is not None:
        true_deg = float(np.degrees(yaw_of(trace.problem.aligned.align_pose(truth)[:, :3])))
        at = estimate + (true_deg - estimate + 180.0) % 360.0 - 180.0
        if abs(at - estimate) <= REACH_DEG:
            marks.append(("truth", at, 1.04 * height, style.TRUTH))
    colors = packed(np.array([color for *_, color in marks]))
    lines = np.array([[[at, 0.0], [at, height]] for _, at, _, _ in marks])
    words = pa.array([f"{name} {(at + 180.0) % 360.0 - 180.0:.2f}°" for name, at, *_ in marks])
    places = vectors(np.array([[at, end] for _, at, end, _ in marks]), VECTOR_2D)
    return static_chunk(
        f"{ARCS}/yaws",
        [
            *_lines(lines, colors, 2.0),
            Values(rr.Points2D.descriptor_positions(), places, [len(marks)]),
            Values(rr.Points2D.descriptor_labels(), words, [len(marks)]),
            Values(rr.Points2D.descriptor_colors(), pa.array(colors), [len(marks)]),
            Values(rr.Points2D.descriptor_radii(), numbers([0.0]), [1]),
        ],
    )


def _lines(points: FloatArray, colors: NDArray[np.uint32], width_px: float) -> list[Values]:
    """The components of lines (K, 2, 2) with a colour each."""
    return [
        Values(rr.LineStrips2D.descriptor_strips(), segments(points, STRIP_2D), [len(points)]),
        Values(rr.LineStrips2D.descriptor_colors(), pa.array(colors), [len(colors)]),
        Values(rr.LineStrips2D.descriptor_radii(), numbers([-width_px / 2]), [1]),
    ]


def _placed(stage: TranslationStage) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Places (M, 2) of the balls, the clique on one circle and the others on another, and a mask (M,) of the clique."""
    inside = np.zeros(len(stage.pairs), dtype=bool)
    inside[stage.clique] = True
    places, start = np.empty((len(inside), 2)), 0.0
    for members in (np.flatnonzero(inside), np.flatnonzero(~inside)):
        radius = 1.6 * len(members) + 10.0
        angles = 2.0 * np.pi * np.arange(len(members)) / max(1, len(members))
        places[members] = np.column_stack([np.cos(angles), np.sin(angles)]) * radius + (start + radius, 0.0)
        start += 2.0 * radius + 40.0
    return places, inside


def _edge_colors(edges: NDArray[np.integer], inside: NDArray[np.bool_]) -> NDArray[np.uint32]:
    both = inside[edges[:, 0]] & inside[edges[:, 1]]
    shades = packed(np.array([style.CLIQUE]), 0.5), packed(np.array([style.UNDECIDED]), GREY)
    return np.where(both, *shades).astype(np.uint32)


def _node_colors(inside: NDArray[np.bool_]) -> NDArray[np.uint32]:
    return packed(np.where(inside[:, None], np.array(style.CLIQUE), np.array(style.UNDECIDED)))


def _graph(stage: TranslationStage) -> Iterator[Chunk]:
    """Balls and their overlaps as the viewer's own graph."""
    places, inside = _placed(stage)
    names = pa.array([f"{a}-{b}" for a, b in stage.pairs.tolist()])
    names = names if len(names.unique()) == len(names) else pa.array([str(k) for k in range(len(names))])
    count, kind = len(inside), EDGE
    edges = pa.StructArray.from_arrays([names.take(pa.array(stage.edges[:, k])) for k in (0, 1)], fields=list(kind))
    nodes = rr.GraphNodes
    columns = [
        Values(nodes.descriptor_node_ids(), names, [count]),
        Values(nodes.descriptor_positions(), vectors(places, VECTOR_2D), [count]),
        Values(nodes.descriptor_colors(), pa.array(_node_colors(inside)), [count]),
        Values(nodes.descriptor_radii(), numbers(np.full(count, 4.0)), [count]),
        Values(nodes.descriptor_show_labels(), pa.array([False]), [1]),
    ]
    if len(edges):
        columns.append(Values(rr.GraphEdges.descriptor_edges(), edges, [len(edges)]))
    yield static_chunk(GRAPH, columns)


def _large_graph(stage: TranslationStage) -> Iterator[Chunk]:
    """Balls as dots and an even sample of their overlaps as lines."""
    places, inside = _placed(stage)
    edges = stage.edges[even(np.arange(len(stage.edges)), MAX_EDGES)]
    if len(edges):
        yield static_chunk(f"{GRAPH}/overlaps", _lines(places[edges], _edge_colors(edges, inside), 1.0))
    yield static_chunk(
        f"{GRAPH}/balls",
        [
            Values(rr.Points2D.descriptor_positions(), vectors(places, VECTOR_2D), [len(places)]),
            Values(rr.Points2D.descriptor_colors(), pa.array(_node_colors(inside)), [len(places)]),
            Values(rr.Points2D.descriptor_radii(), numbers([-3.0]), [1]),
        ],
    )


def _residuals(histogram: Histogram) -> Iterator[Chunk]:
    """Right and wrong matches by how far they are off, side by side over the logarithm of pixels; and the bound."""
    places = np.log10(histogram.edges)
    width = float(places[1] - places[0])
    left = np.concatenate([[places[0] - width], places])
    half = np.full(len(left), 0.5 * width)
    bound = float(np.log10(histogram.bound[1]))
    most = float(max(histogram.right.max(), histogram.wrong.max(), 1))
    parts = {
        "right": Bars(left, histogram.right.astype(np.float64), half, style.INLIER),
        "wrong": Bars(left + half, histogram.wrong.astype(np.float64), half, style.OUTLIER),
        "bound": Bars(np.array([bound]), np.array([most]), np.array([0.02]), style.SCALE),
    }
    for name, bars in parts.items():
        yield static_chunk(f"{RESIDUALS}/{name}", [values for part in PARTS[Bars] for values in part.encode([bars])])
