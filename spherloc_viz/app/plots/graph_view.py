"""The graph view: the graph of a step, in which selected matches are marked and can be selected."""

import base64
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from spherloc_viz import style
from spherloc_viz.app.glossary import help_html, linked
from spherloc_viz.app.paging import PAGE, chip, page_of
from spherloc_viz.app.plots import shapes
from spherloc_viz.app.plots.ball_list import PAGES, ball_list_html, selected_rows
from spherloc_viz.app.text import WITHHELD, box, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers.frame import even
from spherloc_viz.layers.matches import IN_CLIQUE
from spherloc_viz.layers.primitives import BallRows, Graph

CELL, LOOK = "graph-cell", "graph-look"
CLIQUE_STEP = "clique"
"""Key of the step that shows the maximum clique of balls."""
LIST = "list"
LOOKS = ("drawing", LIST)
"""Looks of the panel where nodes are balls."""
WIDTH_PX, HEIGHT_PX = 400.0, 208.0
MIDDLE_PX, RADIUS_PX = (98.0, 110.0), 93.0
MATRIX_PX = (212.0, 20.0, 186.0)
"""Left, top and size of the matrix, px."""
FONT = ' style="font-size:13px"'
MAX_EDGES = 450
"""Largest number of edges drawn between marked nodes, and of those between others."""
MAX_TOLD = 2
"""Largest number of selected nodes of which each is described."""
MAX_LIT = 12
"""Largest number of selected nodes that are marked in the matrix."""


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of a graph that are drawn, as indices of nodes."""

    marked: NDArray[np.int64]
    """(E, 2) between marked nodes."""
    others: NDArray[np.int64]
    """(F, 2) between nodes of which not both are marked."""
    total: int
    """Number of edges between the nodes that are shown, drawn or not."""


def graph_svg(graph: Graph, edges: Edges, lit: NDArray[np.int64], kept: NDArray[np.int64]) -> str:
    """The drawing. ``lit`` are the selected nodes, ``kept`` (N,) the numbers of the matches on the page."""
    nodes = graph.nodes
    parts = [
        shapes.text(0.0, 12.0, _heading(nodes.name), more=FONT),
        shapes.text(MATRIX_PX[0], 12.0, "matrix, clique first", more=FONT),
        *_edges(graph, edges),
        *_nodes(graph, lit, kept),
        *_matrix(graph, lit),
    ]
    return shapes.svg(WIDTH_PX, HEIGHT_PX, parts, f"Graph of {_many(nodes.name)}: {graph.words}")


def edges_of(graph: Graph) -> Edges:
    """The edges to draw: an even sample if there are too many."""
    edges = graph.nodes.edges
    a, b = edges.T
    both = graph.marked[a] & graph.marked[b]
    marked, others = np.flatnonzero(both), np.flatnonzero(graph.shown[a] & graph.shown[b] & ~both)
    return Edges(edges[even(marked, MAX_EDGES)], edges[even(others, MAX_EDGES)], len(marked) + len(others))


def graph_note(graph: Graph, edges: Edges) -> str:
    """A note on what is left out and what can be pressed."""
    nodes, drawn = graph.nodes, len(edges.marked) + len(edges.others)
    shown = int(np.count_nonzero(graph.shown))
    press = "Press a node or a cell to select its matches."
    if shown == 1:
        return f"One {nodes.name}: no edge yet, and a matrix of one cell. {press}"
    said = []
    if shown < graph.count:
        sample = "evenly from clique and others, half from the clique where it has so many"
        said.append(f"{shown:,} of {graph.count:,} {_many(nodes.name)} are drawn: {sample}.")
    if drawn < edges.total:
        said.append(f"{drawn:,} of the {edges.total:,} edges between them are drawn, evenly.")
    elif edges.total:
        between = " between them" if shown < graph.count else ""
        many = edges.total > 1
        said.append(f"All {edges.total:,} edges{between} are drawn." if many else f"The only edge{between} is drawn.")
    else:
        said.append("No two of them agree yet, so there is no edge.")
    said.append(f"The matrix has a row and a column for each of the {shown:,} nodes.")
    return " ".join([*_listed(graph), *said, press])


def chosen_words(graph: Graph, lit: NDArray[np.int64], kept: NDArray[np.int64]) -> str:
    """Which of the drawn nodes are selected, and what they agree with; empty without one. ``lit`` and ``kept`` are as
    in ``graph_svg``."""
    nodes, others = graph.nodes, int(np.count_nonzero(graph.shown)) - 1
    if not len(lit):
        return ""
    if len(lit) > MAX_TOLD:
        return f"Selected, violet: {len(lit)} {_many(nodes.name)}."
    verb = "overlaps" if nodes.name == "ball" else "agrees with"
    said = []
    for k in lit.tolist():
        numbers = " and ".join(map(str, kept[nodes.matches[k]].tolist()))
        who = f"match {numbers}" if nodes.name == "match" else f"the {nodes.name} of matches {numbers}"
        member = " and is in the clique" if graph.color == style.CLIQUE and graph.marked[k] else ""
        said.append(f"{who} {verb} {np.count_nonzero(nodes.agrees[k] & graph.shown)} of the other {others}{member}")
    return f"Selected, violet: {'; '.join(said)}."


def _listed(graph: Graph) -> list[str]:
    """Where the members of the clique are listed, if nodes of the clique are marked."""
    if graph.color != style.CLIQUE or not graph.marked.any():
        return []
    count = len(np.unique(graph.nodes.matches[graph.marked]))
    first = "The list, a button above, has the balls of the clique first. " if graph.list_balls is not None else ""
    return [f'{first}Marked: nodes of {count:,} matches, which the Matches tab lists ("{IN_CLIQUE}").']


def _many(name: str) -> str:
    return "matches" if name == "match" else f"{name}s"


def _heading(name: str) -> str:
    """What the drawing of the graph shows, no wider than the drawing."""
    return "balls and their overlaps" if name == "ball" else f"{_many(name)} and which agree"


def _places(graph: Graph) -> NDArray[np.float64]:
    """Positions (K, 2) of the nodes in the drawing, px."""
    return np.array(MIDDLE_PX) + RADIUS_PX * graph.nodes.places


def _edges(graph: Graph, drawn: Edges) -> list[str]:
    places = _places(graph)
    looks = (
        (drawn.others, 'stroke="currentColor" stroke-opacity=".16" stroke-width=".6"'),
        (drawn.marked, f'stroke="{style.css(graph.color)}" stroke-opacity=".5" stroke-width=".7"'),
    )
    return [f'<path d="{_lines(places[edges])}" {look}/>' for edges, look in looks if len(edges)]


def _lines(ends: NDArray[np.float64]) -> str:
    """Lines (E, 2, 2) as the data of one path."""
    return "M%.0f %.0fL%.0f %.0f" * len(ends) % tuple(ends.ravel().tolist())


def _nodes(graph: Graph, lit: NDArray[np.int64], kept: NDArray[np.int64]) -> list[str]:
    """A dot for every node that is shown; marked nodes lie above the others, selected ones on top."""
    nodes, places = graph.nodes, _places(graph)
    count = int(np.count_nonzero(graph.shown))
    radius = 5.0 if count <= 12 else 3.6 if count <= 110 else 2.5
    chosen = np.zeros(len(nodes.number), dtype=bool)
    chosen[lit] = True
    numbers = kept[nodes.matches].tolist()
    parts: list[str] = []
    grey = ' fill="currentColor" fill-opacity=".55"'
    color = f' fill="{style.css(graph.color)}"'
    ring = f' fill="{style.css(style.SELECTED)}" stroke="currentColor"'
    groups = (
        (graph.shown & ~graph.marked & ~chosen, grey, radius),
        (graph.marked & ~chosen, color, radius),
        (graph.shown & chosen, ring, radius + 1.5),
    )
    for members, look, size in groups:
        dots = _dots(np.flatnonzero(members).tolist(), places, numbers, size)
        parts.append(f"<g{look}>{''.join(dots)}</g>")
    return parts


def _dots(members: Iterable[int], places: NDArray[np.float64], numbers: list, radius: float) -> list[str]:
    return [
        f'<circle cx="{places[k, 0]:.1f}" cy="{places[k, 1]:.1f}" r="{radius:g}" '
        f'data-touch="select:{",".join(map(str, numbers[k]))}"/>'
        for k in members
    ]


def _matrix(graph: Graph, lit: NDArray[np.int64]) -> list[str]:
    left, top, size = MATRIX_PX
    look = 'fill="none" stroke="currentColor" stroke-opacity=".35"'
    parts = [
        f'<image href="data:image/png;base64,{matrix_png(graph)}" x="{left:g}" y="{top:g}" width="{size:g}" '
        f'height="{size:g}" preserveAspectRatio="none" style="image-rendering:pixelated"/>',
        shapes.rect(left, top, size, size, look),
    ]
    there = np.flatnonzero(graph.shown)
    cell = size / max(1, len(there))
    for k in np.searchsorted(there, lit[:MAX_LIT]).tolist():
        violet = f'fill="{style.css(style.SELECTED)}" fill-opacity=".75"'
        parts.append(shapes.rect(left, top + k * cell, size, min(max(cell, 1.0), 4.0), violet))
        parts.append(shapes.rect(left + k * cell, top, min(max(cell, 1.0), 4.0), size, violet))
    parts.append(shapes.rect(left, top, size, size, f'fill="transparent"{shapes.touch(f"{CELL}:")}'))
    return parts


def matrix_png(graph: Graph) -> str:
    """The matrix of the nodes that are shown, a pixel a cell, as a PNG in base64: pairs that agree are grey, or of the
    marks' colour if they are marked."""
    grey, there = style.UNDECIDED[::-1], np.flatnonzero(graph.shown)
    look = np.array([(*grey, 26), (*grey, 190), (*graph.color[::-1], 255)], np.uint8)
    marked = graph.marked[there].astype(np.uint8)
    agrees = graph.nodes.agrees[np.ix_(there, there)] | np.eye(len(there), dtype=bool)
    done, data = cv2.imencode(".png", look[(1 + np.outer(marked, marked)) * agrees], (cv2.IMWRITE_PNG_COMPRESSION, 1))
    assert done
    return base64.b64encode(data.tobytes()).decode()


def cell_nodes(graph: Graph, x: float, y: float) -> NDArray[np.int64]:
    """The nodes of the cell at a point of the matrix, given as shares of its width and height."""
    there = np.flatnonzero(graph.shown)
    return np.unique(there[[min(int(share * len(there)), len(there) - 1) for share in (x, y)]])


Select = Callable[[tuple[int, ...]], None]
NONE_YET = "Here the graph will grow, from the step at which there is one."
NEVER = (
    "This estimator looks for no clique: RANSAC draws samples, and all matches vote on each. Choose mc to see the "
    "graph of balls, or mc-exact for the graph of matches."
)


class GraphView:
    """The panel with graph and matrix, or in their place a list of the balls. Pressing a node, a cell of the matrix or
    a row selects its matches."""

    def __init__(self, gui: viser.GuiApi, touches: Touches, changed: Callable[[object], None], select: Select) -> None:
        """``changed`` has the page drawn anew; ``select`` is called with matches by their numbers in the problem."""
        self._changed, self._select = changed, select
        self._html = gui.add_html("")
        self._drawn: tuple | None = None
        self._graph: Graph | None = None
        self.look = LOOKS[0]
        """Which of the looks is shown where nodes are balls."""
        self._page, self._followed = 0, ()
        touches.on(CELL, self._press)
        touches.on(LOOK, self._choose)
        touches.on(PAGES, self._turn)

    def draw(
        self,
        graph: Graph | None,
        begins: str,
        selected: tuple[int, ...],
        kept: NDArray[np.int64],
        hidden: bool = False,
    ) -> None:
        """Show the graph as far as it is known at this step; before the step with the key ``begins``, a link to that
        step or, if what came out is ``hidden``, that the graph would tell it.

        ``selected`` are indices in the problem, ``kept`` (N,) the numbers of the matches on the page. Sends nothing if
        nothing changed.
        """
        drawn = (graph, begins, selected, kept.tobytes(), self.look, hidden, self._page)
        if self._drawn is not None and self._drawn[0] is graph and self._drawn[1:] == drawn[1:]:
            return
        self._graph = graph
        if graph is None and hidden and begins:
            content = status_html(WITHHELD)
        elif graph is None:
            content = _waiting_html(begins)
        elif graph.list_balls is not None and self.look == LIST:
            content = self._list_html(graph, graph.list_balls(), selected, kept, hidden)
        else:
            content = graph_html(graph, selected, kept, hidden)
        self._drawn = (*drawn[:-1], self._page)
        update_widget(self._html, content=content)

    def _list_html(
        self, graph: Graph, rows: BallRows, selected: tuple[int, ...], kept: NDArray[np.int64], hidden: bool
    ) -> str:
        """The list; if a ball was just selected elsewhere, it turns to its page."""
        lit = selected_rows(rows, selected)
        self._page = min(self._page, (len(rows.radii) - 1) // PAGE)
        if selected != self._followed:
            self._followed = selected
            self._page = page_of(lit, self._page)
        whole = graph.color == style.CLIQUE and np.count_nonzero(graph.marked) == graph.nodes.clique
        marks = "in the clique" if whole else "marked"
        words = f'<div style="padding-bottom:.2em">{linked(graph.words)}{_clique_html(graph, hidden)}</div>'
        return box(_title(graph, LIST) + words + ball_list_html(rows, self._page, lit, kept, graph.color, marks))

    def _choose(self, touch: Touch) -> None:
        if touch.argument in LOOKS:
            self.look = touch.argument
            self._changed(None)

    def _turn(self, touch: Touch) -> None:
        if touch.argument.isdecimal():
            self._page = min(int(touch.argument), 10**6)
            self._changed(None)

    def _press(self, touch: Touch) -> None:
        graph = self._graph
        if graph is None:
            return
        nodes = cell_nodes(graph, touch.x, touch.y)
        self._select(tuple(np.unique(graph.nodes.matches[nodes]).tolist()))


def graph_html(graph: Graph, selected: tuple[int, ...], kept: NDArray[np.int64], hidden: bool = False) -> str:
    """Both drawings, with a description of what they show."""
    lit, edges = graph.nodes.lit(selected), edges_of(graph)
    lit = lit[graph.shown[lit]]
    chosen = chosen_words(graph, lit, kept)
    about = linked(graph.words) + _clique_html(graph, hidden)
    words = "".join(f'<div style="padding-top:.4em">{said}</div>' for said in (about, escape(chosen)) if said)
    note = f'<div style="font-size:12px;opacity:.75;padding-top:.3em">{escape(graph_note(graph, edges))}</div>'
    return box(_title(graph, LOOKS[0]) + graph_svg(graph, edges, lit, kept) + words + note)


def _title(graph: Graph, look: str) -> str:
    """The heading; where nodes are balls, with buttons for the looks."""
    chips = ""
    if graph.list_balls is not None:
        names = ("drawing", f"list of {graph.count:,}")
        chips = "".join(chip(name, f"{LOOK}:{one}", one == look) for one, name in zip(LOOKS, names, strict=True))
    title = f'<span style="font-weight:600;margin-right:auto">Graph and matrix{help_html("graph")}</span>'
    return f'<div style="display:flex;flex-wrap:wrap;align-items:baseline">{title}{chips}</div>'


def _clique_html(graph: Graph, hidden: bool) -> str:
    """A link to the step of the clique of balls, where another one is shown; none while what came out is ``hidden``."""
    if hidden or graph.list_balls is None or graph.color == style.CLIQUE:
        return ""
    return f' <span class="term" role="button" tabindex="0" data-touch="step:{CLIQUE_STEP}">Go to the clique</span>.'


def _waiting_html(begins: str) -> str:
    if not begins:
        return box(escape(NEVER))
    go = f'<span class="term" role="button" tabindex="0" data-touch="step:{escape(begins)}">Go to that step</span>'
    return box(f"{escape(NONE_YET)} {go}.")
