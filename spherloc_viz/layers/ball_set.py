"""The balls of camera positions that steps show: their order, their overlaps, and which of them are drawn."""

from dataclasses import dataclass
from functools import cached_property
from math import gcd

import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import camera_centre
from spherloc.trace import TranslationStage
from spherloc.types import FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.frame import RunView, ball_boxes, even, level_circles, one_color, sphere_box
from spherloc_viz.layers.primitives import Balls, Focus, Points, SceneItem, Segments
from spherloc_viz.layers.ring import GOLDEN

OPACITIES = ((4, 0.3), (np.inf, 0.2))
"""Largest number of surfaces, and their opacity: few balls are seen well, and many do not hide things behind them."""
MAX_SURFACES = 10
"""If there are more balls, the others are drawn as circles."""
ROOM = 1.3
"""Reach around a ball of a clique that is on the screen, by its radius: what is around the clique is seen as well."""
LARGE = 3.0
"""A ball that is larger than this many times the median of a few hides them."""


@dataclass(frozen=True, eq=False)
class BallSet:
    """A translation stage and what several of its frames need, computed when it is first asked for. M balls."""

    stage: TranslationStage

    def __len__(self) -> int:
        return len(self.stage.radii_m)

    @cached_property
    def by_radius(self) -> IntArray:
        """(M,) indices of the balls, the smallest first."""
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
        """The ball that serves as an example."""
        return int(self.order[0])

    def focus(self, shown: IntArray, inside: NDArray[np.bool_]) -> Focus:
        """What `items` draws: the surfaces of a clique, a mask (M,), or the denser half of balls that are none, from
        the side from which most of the maximum clique is seen."""
        return Focus("Balls", self._box(shown, inside), self._clique_box)

    @cached_property
    def _clique_box(self) -> FloatArray:
        return self._box(self.by_radius, self.in_clique)

    def _box(self, shown: IntArray, inside: NDArray[np.bool_]) -> FloatArray:
        drawn = self.drawn(shown, inside)
        if not inside[drawn].any():
            return ball_boxes(self.stage.centres_m[drawn], self.stage.radii_m[drawn])
        # Balls of a clique are all at one place, and its large ones, drawn as circles, reach far around it.
        chosen = self.solid(drawn, inside) & inside
        boxes = zip(self.stage.centres_m[chosen], self.stage.radii_m[chosen], strict=True)
        return np.vstack([sphere_box(centre, ROOM * radius_m) for centre, radius_m in boxes])

    @cached_property
    def in_clique(self) -> NDArray[np.bool_]:
        """Mask (M,) of the balls of the maximum clique."""
        return self.mask(self.stage.clique)

    @cached_property
    def members(self) -> IntArray:
        """(S,) balls of the maximum clique, the smallest first."""
        return self.by_radius[self.in_clique[self.by_radius]]

    @cached_property
    def degrees(self) -> IntArray:
        """(M,) number of other balls that each ball overlaps."""
        return np.bincount(self.stage.edges.ravel(), minlength=len(self))

    @cached_property
    def busiest(self) -> IntArray:
        """(M,) indices of the balls, those that overlap most others first."""
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
        """(M + 1,) index of each ball's first edge to a later ball: edges are sorted."""
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
        # Integers as bit sets: one operation per ball, however many there are.
        fitting, taken = (1 << count) - 1, []
        while fitting:
            ball = (fitting & -fitting).bit_length() - 1
            taken.append(ball)
            fitting &= int.from_bytes(rows[ball].tobytes(), "little")
        return order[taken]

    def drawn(self, shown: IntArray, inside: NDArray[np.bool_]) -> IntArray:
        """The balls to draw, of some balls with the smallest first: if there are too many, an even sample of the
        smaller ones of a mask (M,) and of the others. Large balls would contain and hide the whole picture."""
        most = style.MAX_DRAWN_BALLS
        if len(shown) <= most:
            return shown
        chosen, others = shown[inside[shown]], shown[~inside[shown]]
        halves = chosen[: self._smaller(chosen)], others[: max(1, len(others) // 2)]
        take = min(len(halves[0]), max(most // 2, most - len(halves[1])))
        return np.concatenate([even(halves[0], take), even(halves[1], most - take)])

    def _smaller(self, balls: IntArray) -> int:
        """How many of some balls, the smallest first, are the smaller ones: half of many, and all of a few that do not
        stand out by their size."""
        if len(balls) == 0:
            return 0
        radii = self.stage.radii_m[balls]
        return max(len(balls) // 2, min(MAX_SURFACES, int(np.count_nonzero(radii <= LARGE * np.median(radii)))))

    def solid(self, drawn: IntArray, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask (M,) of the balls with a surface: some of the smaller half of the drawn ones of a mask (M,), or of all
        if none of them is. A large surface would contain the others."""
        members = drawn[inside[drawn]] if inside[drawn].any() else drawn
        return self.mask(even(members[: max(MAX_SURFACES, len(members) // 2)], MAX_SURFACES))

    def items(
        self, view: RunView, shown: IntArray, inside: NDArray[np.bool_], color: style.RGB = style.CLIQUE
    ) -> tuple[SceneItem, ...]:
        """Some balls, the smallest first, their centres and their overlaps; those of a mask (M,) in their colour.

        Many translucent surfaces hide each other and take seconds without a graphics card, so that most balls are
        drawn as their level circle.
        """
        stage, drawn = self.stage, self.drawn(shown, inside)
        items: list[SceneItem] = [self._edges(drawn, inside, color)]
        looked_at = drawn[inside[drawn]] if inside[drawn].any() else drawn
        # With more, the centres would hide the few small balls that a step is about.
        dot_m = min(0.02 * view.sphere_m, 0.1 * float(np.median(stage.radii_m[looked_at])))
        solid = self.solid(drawn, inside)
        faint = next(opacity for most, opacity in OPACITIES if np.count_nonzero(solid) <= most)
        groups = (("balls/others", ~inside, style.UNDECIDED, faint), ("balls/clique", inside, color, 1.6 * faint))
        for name, members, shade, opacity in groups:
            chosen, centres = members & solid, shown[members[shown]]
            if chosen.any():
                places, radii = stage.centres_m[chosen], stage.radii_m[chosen]
                ids = stage.pairs[chosen].astype(np.int64)
                items.append(Balls(name, "balls", places, radii, one_color(shade, len(ids)), opacity, ids=ids))
            outlined = drawn[(members & ~solid)[drawn]]
            if len(outlined):
                lines = level_circles(stage.centres_m[outlined], stage.radii_m[outlined])
                ids = np.repeat(stage.pairs[outlined].astype(np.int64), len(lines) // len(outlined), axis=0)
                items.append(Segments(f"{name}-circles", "balls", lines, one_color(shade, len(lines)), 1.0, ids=ids))
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
