"""The balls of a run: in which order they come, which of them are drawn, and how."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import gcd

import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import camera_centre, yaw_rotation
from spherloc.trace import ConsensusStage, TranslationStage
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.agreement import agreement
from spherloc_viz.layers.frame import RunView, ball_boxes, even, one_color
from spherloc_viz.layers.primitives import Balls, Focus, Graph, Nodes, Points, SceneItem, Segments
from spherloc_viz.layers.ring import GOLDEN

OPACITIES = ((4, 0.3), (12, 0.22), (35, 0.14), (np.inf, 0.1))
"""Up to how many balls have which opacity: few are seen well, and many do not hide what is behind them."""


@dataclass(frozen=True, eq=False)
class BallSet:
    """A translation stage and what several of its frames need, computed when it is first asked for. M balls."""

    stage: TranslationStage

    def __len__(self) -> int:
        return len(self.stage.radii_m)

    @cached_property
    def by_radius(self) -> IntArray:
        """(M,) the smallest first."""
        return np.argsort(self.stage.radii_m, kind="stable")

    @cached_property
    def order(self) -> IntArray:
        """(M,) in which order the balls come: two of the maximum clique, the rest of the smaller half so that every
        beginning is spread evenly over it, and then the others, the smallest first.

        The very smallest would not be telling: they may be of wrong pairs, far from each other.
        """
        half = max(1, len(self) // 2)
        stride = max(1, round(GOLDEN * half))
        while gcd(stride, half) > 1:
            stride += 1
        spread = np.concatenate([self.by_radius[(half // 2 + np.arange(half) * stride) % half], self.by_radius[half:]])
        first = spread[self.in_clique[spread]][:2]
        return np.concatenate([first, spread[~np.isin(spread, first)]])

    @property
    def example(self) -> int:
        """A ball to explain balls by."""
        return int(self.order[0])

    def focus(self, shown: IntArray) -> Focus:
        """These balls, the smallest first, as far as they are drawn, or the denser half of many, from the side from
        which most of the clique is seen."""
        drawn = self.drawn(shown, self.mask(shown))
        return Focus("Balls", ball_boxes(self.stage.centres_m[drawn], self.stage.radii_m[drawn]), self._clique_box)

    @cached_property
    def _clique_box(self) -> FloatArray:
        members = self.members if len(self.members) else self.by_radius
        drawn = self.drawn(members, self.mask(members))
        return ball_boxes(self.stage.centres_m[drawn], self.stage.radii_m[drawn])

    @cached_property
    def in_clique(self) -> NDArray[np.bool_]:
        """(M,) balls of the maximum clique."""
        return self.mask(self.stage.clique)

    @cached_property
    def members(self) -> IntArray:
        """(S,) balls of the maximum clique, the smallest first."""
        return self.by_radius[self.in_clique[self.by_radius]]

    @cached_property
    def degrees(self) -> IntArray:
        """(M,) how many others each ball overlaps."""
        return np.bincount(self.stage.edges.ravel(), minlength=len(self))

    @cached_property
    def busiest(self) -> IntArray:
        """(M,) those that overlap most others first."""
        return np.argsort(-self.degrees, kind="stable")

    def mask(self, balls: np.ndarray) -> NDArray[np.bool_]:
        """Mask (M,) of some balls."""
        inside = np.zeros(len(self), dtype=bool)
        inside[balls] = True
        return inside

    def edges_within(self, inside: NDArray[np.bool_]) -> np.ndarray:
        """Overlaps (E, 2) between balls of a mask (M,)."""
        # There may be 100,000 edges, so only those of these balls are looked at.
        members = np.flatnonzero(inside)
        counts = self._starts[members + 1] - self._starts[members]
        rows = np.arange(int(counts.sum())) + np.repeat(self._starts[members] - np.cumsum(counts) + counts, counts)
        edges = self.stage.edges.take(rows, axis=0)
        return edges[inside[edges[:, 1]]]

    @cached_property
    def _starts(self) -> IntArray:
        """(M + 1,) where each ball's edges to later ones begin: edges are sorted."""
        return np.searchsorted(self.stage.edges[:, 0], np.arange(len(self) + 1))

    def greedy(self, order: IntArray) -> IntArray:
        """A clique: each ball in the given order that overlaps all that were taken before it."""
        count = len(order)
        rank = np.empty(count, dtype=np.int64)
        rank[order] = np.arange(count)
        ends = rank[self.stage.edges]
        overlap = np.zeros((count, count), dtype=bool)
        overlap.ravel()[count * ends[:, 0] + ends[:, 1]] = True
        rows = np.packbits(overlap | overlap.T, axis=1, bitorder="little")
        # Whole numbers as sets of bits: one operation a ball, however many there are.
        fitting, taken = (1 << count) - 1, []
        while fitting:
            ball = (fitting & -fitting).bit_length() - 1
            taken.append(ball)
            fitting &= int.from_bytes(rows[ball].tobytes(), "little")
        return order[taken]

    def drawn(self, shown: IntArray, inside: NDArray[np.bool_]) -> IntArray:
        """Which of some balls, the smallest first, to draw: of those of a mask (M,) and of the others an even sample
        of the smaller half, if there are too many. Large balls hold the whole picture in them and hide it."""
        most = style.MAX_DRAWN_BALLS
        if len(shown) <= most:
            return shown
        halves = [group[: max(1, len(group) // 2)] for group in (shown[inside[shown]], shown[~inside[shown]])]
        take = min(len(halves[0]), max(most // 2, most - len(halves[1])))
        return np.concatenate([even(halves[0], take), even(halves[1], most - take)])

    def items(
        self, view: RunView, shown: IntArray, inside: NDArray[np.bool_], color: style.RGB = style.CLIQUE
    ) -> tuple[SceneItem, ...]:
        """Some balls, the smallest first, their centres and their overlaps; those of a mask (M,) in their colour."""
        stage, drawn = self.stage, self.drawn(shown, inside)
        items: list[SceneItem] = [self._edges(drawn, inside, color)]
        dot_m = min(0.02 * view.sphere_m, 0.1 * float(np.median(stage.radii_m)))
        faint = next(opacity for most, opacity in OPACITIES if len(drawn) <= most)
        groups = (("balls/others", ~inside, style.UNDECIDED, faint), ("balls/clique", inside, color, 1.6 * faint))
        for name, members, shade, opacity in groups:
            chosen, centres = drawn[members[drawn]], shown[members[shown]]
            if len(chosen):
                places, radii = stage.centres_m[chosen], stage.radii_m[chosen]
                ids = stage.pairs[chosen].astype(np.int64)
                items.append(Balls(name, "balls", places, radii, one_color(shade, len(chosen)), opacity, ids=ids))
            if len(centres):
                dots = one_color(shade, len(centres))
                items.append(Points(f"{name}-centres", "balls", stage.centres_m[centres], dots, dot_m))
        if view.truth is not None:
            truth = camera_centre(view.truth)[None]
            items.append(Points("balls/truth", "balls", truth, one_color(style.TRUTH, 1), 2.0 * dot_m))
        return tuple(items)

    def _edges(self, drawn: IntArray, inside: NDArray[np.bool_], color: style.RGB) -> Segments:
        """Overlaps between the drawn balls."""
        edges = self.edges_within(self.mask(drawn))
        colors = one_color(style.UNDECIDED, len(edges))
        colors[inside[edges[:, 0]] & inside[edges[:, 1]]] = color
        return Segments("balls/edges", "balls", self.stage.centres_m[edges], colors, 1.5)


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
