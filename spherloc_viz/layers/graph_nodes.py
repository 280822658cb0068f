"""The graph beside the canvas: which balls or matches are its nodes, where they are drawn, and what a step shows."""

from collections.abc import Callable

import numpy as np

from spherloc.geometry import yaw_rotation
from spherloc.trace import ConsensusStage
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.agreement import agreement
from spherloc_viz.layers.ball_set import BallSet
from spherloc_viz.layers.frame import RunView, even
from spherloc_viz.layers.primitives import BallRows, Graph, Nodes

MAX_NODES = 400
"""Largest number of nodes; of more, the clique, or an even sample of it, and an even sample of the others are drawn."""
WHOLE = 30
"""Number of balls, of all and of the clique, with which a step's graph still has every ball of the step."""
INNER, OUTER = 0.08, 0.97
"""Smallest and largest radius of a node's position; the whole drawing has radius 1."""


def ball_nodes(balls: BallSet) -> Nodes:
    """Nodes are balls, and overlapping ones agree."""
    stage, total = balls.stage, len(balls)
    first = np.union1d(balls.order[:WHOLE], balls.members[:WHOLE])
    chosen = _chosen(total, stage.clique.astype(np.int64), balls.by_radius, first)
    place = np.full(total, -1)
    place[chosen] = np.arange(len(chosen))
    ends = place[stage.edges]
    ends = ends[(ends >= 0).all(axis=1)]
    agrees = np.zeros((len(chosen), len(chosen)), dtype=bool)
    agrees[ends[:, 0], ends[:, 1]] = agrees[ends[:, 1], ends[:, 0]] = True
    middle = (
        np.median(stage.centres_m[stage.clique], axis=0) if len(stage.clique) else np.median(stage.centres_m, axis=0)
    )
    offsets = stage.centres_m[chosen] - middle
    return _nodes(
        "ball", chosen, total, offsets, stage.pairs[chosen].astype(np.int64), agrees, stage.clique.astype(np.int64)
    )


def ball_rows(view: RunView, balls: BallSet, shown: IntArray | None, marked: IntArray) -> BallRows:
    """The balls of a step in rows: some by their indices in the stage, or all (None); and the marked ones."""
    stage, there, about = balls.stage, balls.by_radius, balls.mask(marked)
    if shown is not None:
        there = there[balls.mask(shown)[there]]
    about &= balls.mask(there)
    rows = np.concatenate([there[about[there]], there[~about[there]]])
    edges = stage.edges if shown is None else balls.edges_within(balls.mask(shown))
    overlaps = np.bincount(edges.ravel(), minlength=len(balls))[rows]
    radii = tuple(view.length(float(radius_m)) for radius_m in stage.radii_m[rows])
    return BallRows(stage.pairs[rows].astype(np.int64), radii, overlaps, int(np.count_nonzero(about)))


def match_nodes(view: RunView, stage: ConsensusStage) -> Nodes:
    """Nodes are matches, and those agree that have an arc over the stage's yaw."""
    aligned = view.trace.problem.aligned
    places = np.searchsorted(aligned.index, stage.clique)
    chosen = _chosen(len(aligned.index), places, np.arange(len(aligned.index)), np.zeros(0, dtype=np.int64))
    agrees = agreement(aligned, view.bounds.radians, stage.yaw_rad, chosen, chosen)
    seen = aligned.bearings[chosen] @ yaw_rotation(stage.yaw_rad)
    matches = aligned.index[chosen].astype(np.int64)[:, None]
    return _nodes("match", chosen, len(aligned.index), seen, matches, agrees | agrees.T, places)


def _chosen(total: int, clique: IntArray, order: IntArray, first: IntArray) -> IntArray:
    """Nodes to draw, at most ``MAX_NODES``, among them ``first``."""
    if total <= MAX_NODES:
        return order
    rest, room = order[~np.isin(order, first)], MAX_NODES - len(first)
    inside = np.isin(rest, clique)
    members, others = rest[inside], rest[~inside]
    take = min(len(members), max(room // 2, room - len(others)))
    return np.concatenate([first, even(members, take), even(others, room - take)])


def _nodes(
    name: str, chosen: IntArray, total: int, offsets: FloatArray, matches: IntArray, agrees: BoolArray, clique: IntArray
) -> Nodes:
    """The nodes in the order of the matrix. ``offsets`` (K, 3) are their positions in space, from the middle."""
    member = np.isin(chosen, clique)
    with_clique = agrees[:, member].sum(axis=1)
    order = np.lexsort((-agrees.sum(axis=1), -with_clique, ~member))
    return Nodes(
        name,
        chosen[order],
        total,
        _layout(offsets, member)[order],
        matches[order],
        agrees[np.ix_(order, order)],
        int(np.count_nonzero(member)),
    )


def _layout(offsets: FloatArray, member: BoolArray) -> FloatArray:
    """Positions (K, 2) in the drawing: in the directions that nodes have in space, seen from above, but evenly spread.
    The clique fills a disc in the middle, whose area is its share of the nodes; nearer nodes are farther inside."""
    rank = np.empty(len(offsets))
    away = np.linalg.norm(offsets, axis=1)
    rank[np.lexsort((away, ~member))] = np.arange(len(offsets))
    radius = INNER + (OUTER - INNER) * np.sqrt((rank + 0.5) / max(1, len(offsets)))
    angle = np.empty(len(offsets))
    for group in (member, ~member):
        turn = np.arctan2(offsets[group, 2], offsets[group, 0])
        spread = np.empty(len(turn))
        spread[np.argsort(turn, kind="stable")] = 2.0 * np.pi * np.arange(len(turn)) / max(1, len(turn))
        angle[group] = spread
    return radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def graph_at(
    nodes: Callable[[], Nodes], shown: IntArray | None, marked: IntArray, color: style.RGB, words: str
) -> Graph:
    """The graph of a step: the shown nodes, by their indices in the stage (None for all), and the marked ones."""
    known = nodes()
    there = np.ones(len(known.number), dtype=bool) if shown is None else np.isin(known.number, shown)
    count = known.total if shown is None else len(shown)
    return Graph(known, there, count, there & np.isin(known.number, marked), color, words)
