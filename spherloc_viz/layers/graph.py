"""The graph whose maximum clique is looked for: where its nodes stand, which agree, and what a step shows of it.

A run has one layout: nodes do not move from step to step.
"""

from collections.abc import Callable

import numpy as np

from spherloc.geometry import yaw_rotation
from spherloc.trace import ConsensusStage, TranslationStage
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.agreement import agreement
from spherloc_viz.layers.frame import RunView, even
from spherloc_viz.layers.primitives import Graph, Nodes

MOST_NODES = 400
"""More are thinned: to the clique, or an even sample of it, and an even sample of the others."""
INNER, OUTER = 0.08, 0.97
"""Radii within which nodes stand; the whole drawing has radius 1."""


def ball_nodes(stage: TranslationStage) -> Nodes:
    """Nodes are balls, and overlapping ones agree."""
    total = len(stage.radii_m)
    chosen = _chosen(total, stage.clique.astype(np.int64), np.argsort(stage.radii_m, kind="stable"))
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


def match_nodes(view: RunView, stage: ConsensusStage) -> Nodes:
    """Nodes are matches, and those agree that have an arc over the stage's yaw."""
    aligned = view.trace.problem.aligned
    places = np.searchsorted(aligned.index, stage.clique)
    chosen = _chosen(len(aligned.index), places, np.arange(len(aligned.index)))
    agrees = agreement(aligned, view.bounds.radians, stage.yaw_rad, chosen, chosen)
    seen = aligned.bearings[chosen] @ yaw_rotation(stage.yaw_rad)
    matches = aligned.index[chosen].astype(np.int64)[:, None]
    return _nodes("match", chosen, len(aligned.index), seen, matches, agrees | agrees.T, places)


def _chosen(total: int, clique: IntArray, order: IntArray) -> IntArray:
    """Nodes to draw, at most ``MOST_NODES``."""
    if total <= MOST_NODES:
        return order
    inside = np.zeros(total, dtype=bool)
    inside[clique] = True
    members, others = order[inside[order]], order[~inside[order]]
    take = min(len(members), max(MOST_NODES // 2, MOST_NODES - len(others)))
    return np.concatenate([even(members, take), even(others, MOST_NODES - take)])


def _nodes(
    name: str, chosen: IntArray, total: int, offsets: FloatArray, matches: IntArray, agrees: BoolArray, clique: IntArray
) -> Nodes:
    """In the order of the matrix. ``offsets`` (K, 3) are where the nodes are, from the middle."""
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
    """(K, 2) places: directions as in space, seen from above, and as even as directions can be; the members of the
    clique in a disc of their own, as large as they are many, and within it and around it the nearer the farther in."""
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
    """What a step shows: some nodes, by their numbers in the stage (None for all), and those that it marks."""
    known = nodes()
    there = np.ones(len(known.number), dtype=bool) if shown is None else np.isin(known.number, shown)
    return Graph(known, there, there & np.isin(known.number, marked), color, words)
