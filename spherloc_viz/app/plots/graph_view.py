"""The graph view: the graph that a step speaks of, linked with all that is selected."""

from collections.abc import Callable
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from spherloc_viz.app.glossary import help_html, linked
from spherloc_viz.app.plots.graph_drawing import CELL, cell_nodes, edges_of, graph_note, graph_svg
from spherloc_viz.app.text import box
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.layers.primitives import Graph

Select = Callable[[tuple[int, ...]], None]
NONE_YET = "Here the graph will grow, from the step at which there is one."
NEVER = (
    "This estimator looks for no clique: RANSAC draws samples, and all matches vote on each. Choose mc to see the "
    "graph of balls, or mc-exact for the graph of matches."
)


class GraphView:
    """Pressing a node, or a cell of the matrix, selects its matches."""

    def __init__(self, gui: viser.GuiApi, touches: Touches, select: Select) -> None:
        """``select`` is called with matches by their numbers in the problem."""
        self._select = select
        self._html = gui.add_html("")
        self._drawn: tuple[Graph | None, str, tuple[int, ...], bytes] | None = None
        self._graph: Graph | None = None
        touches.on(CELL, self._press)

    def draw(self, graph: Graph | None, begins: str, selected: tuple[int, ...], kept: NDArray[np.int64]) -> None:
        """Show what there is of the graph by now; before it ``begins``, at the step of that key, how to get there.

        ``selected`` are numbers in the problem, ``kept`` (N,) those by which matches are known on the page. Sends
        nothing if nothing changed.
        """
        drawn = (graph, begins, selected, kept.tobytes())
        if self._drawn is not None and self._drawn[0] is graph and self._drawn[1:] == drawn[1:]:
            return
        self._drawn, self._graph = drawn, graph
        content = _waiting_html(begins) if graph is None else graph_html(graph, selected, kept)
        if content != self._html.content:
            self._html.content = content

    def _press(self, touch: Touch) -> None:
        graph = self._graph
        if graph is None:
            return
        nodes = cell_nodes(graph, touch.x, touch.y)
        self._select(tuple(np.unique(graph.nodes.matches[nodes]).tolist()))


def graph_html(graph: Graph, selected: tuple[int, ...], kept: NDArray[np.int64]) -> str:
    """Both drawings with what they show in words."""
    lit, edges = graph.nodes.lit(selected), edges_of(graph)
    title = f'<div style="font-weight:600;padding-bottom:.3em">Graph and matrix{help_html("graph")}</div>'
    words = f'<div style="padding-top:.4em">{linked(graph.words)}</div>'
    note = f'<div style="font-size:12px;opacity:.75;padding-top:.3em">{escape(graph_note(graph, edges))}</div>'
    return box(title + graph_svg(graph, edges, lit[graph.shown[lit]], kept) + words + note)


def _waiting_html(begins: str) -> str:
    if not begins:
        return box(escape(NEVER))
    go = f'<span class="term" role="button" tabindex="0" data-touch="step:{escape(begins)}">Go to that step</span>'
    return box(f"{escape(NONE_YET)} {go}.")
