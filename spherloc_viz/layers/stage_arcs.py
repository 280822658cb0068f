"""The arcs of a yaw stage: those that serve as examples, those that are drawn, and where they lie on the ring."""

from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush
from math import gcd

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.yaw_arcs import YawConsensus, deepest_yaw
from spherloc.trace import YawStage
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import RunView, even, one_color
from spherloc_viz.layers.primitives import Segments

INNER, OUTER = 1.3, 1.95
"""Radii of the band of arcs, in sphere radii."""
STEP_RAD = np.radians(4.0)
FEWEST_TRACKS = 24
"""Least number of tracks of the band; it has more if more arcs are drawn over one yaw."""
EXAMPLE_RAD = np.radians(15.0)
"""Preferred width of the arc that serves as an example."""


@dataclass(frozen=True, eq=False)
class StageArcs:
    """A yaw stage and what several of its frames need, computed when it is first asked for. A arcs."""

    stage: YawStage
    inliers: BoolArray
    """Mask (N,) of the run's inliers; all false if they are withheld."""

    def __len__(self) -> int:
        return len(self.stage.lo_rad)

    @property
    def median_width_rad(self) -> float:
        """Median width of all arcs; ``np.median`` is slower."""
        return float(np.partition(self.stage.hi_rad - self.stage.lo_rad, len(self) // 2)[len(self) // 2])

    @cached_property
    def in_clique(self) -> NDArray[np.bool_]:
        """Mask (A,) of the arcs that cover the estimated yaw."""
        inside = np.zeros(len(self), dtype=bool)
        inside[self.stage.clique] = True
        return inside

    @cached_property
    def _continues(self) -> NDArray[np.bool_]:
        """Mask (A,) of the arcs of the same pair as the arc before; the arcs of a pair follow one another."""
        pairs = np.ascontiguousarray(self.stage.pairs, dtype=np.int32).view(np.int64).ravel()
        same = np.zeros(len(pairs), dtype=bool)
        same[1:] = pairs[1:] == pairs[:-1]
        return same

    @cached_property
    def pair_counts(self) -> tuple[int, int]:
        """Number of pairs with one arc, and number of pairs with more."""
        same = self._continues
        pairs = len(same) - int(np.count_nonzero(same))
        several = int(np.count_nonzero(same[1:] & ~same[:-1]))
        return pairs - several, several

    def middle_deg(self, chosen: IntArray) -> float:
        """The yaw, degrees, around which a step that shows the arcs ``chosen`` is about: that which most of them cover,
        or of one pair the middle of its arc over the estimated yaw."""
        if np.array_equal(chosen, self.example):
            k = self.example_in_clique
            return float(np.degrees(0.5 * (self.stage.lo_rad[k] + self.stage.hi_rad[k])))
        return float(np.degrees(self.overlap_of(chosen).yaw_rad))

    @property
    def two_at_most(self) -> bool:
        """Whether no pair has a third arc: a root has two where a point passes behind the camera between them."""
        return not bool(np.any(self._continues[1:] & self._continues[:-1]))

    @property
    def example_in_clique(self) -> int:
        """The arc of the example over the estimated yaw."""
        return int(self.example[np.argmax(self.in_clique[self.example])])

    @cached_property
    def example(self) -> IntArray:
        """The arcs of one pair with an arc over the estimated yaw, or of any pair if that is withheld: of such pairs,
        of two inliers and with two arcs if there are any, the one whose arc there is closest to ``EXAMPLE_RAD`` in
        width."""
        arcs, same = self.stage.clique.astype(np.int64), self._continues
        if not len(arcs):
            arcs = np.arange(len(self))
        right = self.inliers[self.stage.pairs[arcs]].all(axis=1)
        if right.any():
            arcs = arcs[right]
        several = same[arcs] | np.append(same[1:], False)[arcs]
        if several.any():
            arcs = arcs[several]
        first = int(arcs[np.argmin(np.abs((self.stage.hi_rad - self.stage.lo_rad)[arcs] - EXAMPLE_RAD))])
        end = first + 1
        while same[first]:
            first -= 1
        while end < len(same) and same[end]:
            end += 1
        return np.arange(first, end)

    def spread(self, count: int) -> IntArray:
        """The first ``count`` arcs in an order in which every beginning is spread evenly over all pairs."""
        total = len(self)
        stride = max(1, round(ring.GOLDEN * total))
        while gcd(stride, total) > 1:
            stride += 1
        return np.arange(min(count, total), dtype=np.int64) * stride % total

    def overlap_of(self, arcs: IntArray) -> YawConsensus:
        """The yaw that most of some arcs cover, and the number of these arcs."""
        found = deepest_yaw(self.stage.lo_rad[arcs], self.stage.hi_rad[arcs])
        assert found is not None
        return found

    def over(self, arcs: IntArray, lo_rad: float, hi_rad: float) -> NDArray[np.bool_]:
        """Mask of some arcs that touch an interval of yaw within [-pi, pi]."""
        lo, hi = self.stage.lo_rad[arcs], self.stage.hi_rad[arcs]
        return ((lo <= hi_rad) & (hi >= lo_rad)) | (hi >= lo_rad + 2 * np.pi)

    def with_clique(self) -> IntArray:
        """Arcs to draw: an even sample of the clique's and of the others, half and half if there are too many."""
        members, room = self.stage.clique.astype(np.int64), style.MAX_DRAWN_ARCS
        take = min(len(members), max(room // 2, room - (len(self) - len(members))))
        others = self.spread(8 * room)
        others = others[~self.in_clique[others]]
        if len(others) < room - take:
            others = np.flatnonzero(~self.in_clique)
        return np.concatenate([even(members, take), others[: room - take]])

    def drawn(self, view: RunView, arcs: IntArray, marked: np.ndarray, mark: style.RGB, width_px: float) -> Segments:
        """Arcs on the ring around the middle of the map, the marked ones (mask) in their colour. Arcs that overlap lie
        side by side, so that the band is as broad as they are many."""
        order, arc, points = view.kept("arcs", arcs.tobytes(), lambda: self._band(view, arcs))
        colors = one_color(style.UNDECIDED, len(arc))
        colors[marked[order][arc]] = mark
        ids = self.stage.pairs[arcs[order][arc]].astype(np.int64)
        return Segments("ring/arcs", "yaw ring", points, colors, width_px, ids=ids)

    def _band(self, view: RunView, arcs: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Some arcs as S straight lines (S, 2, 3), which arc each line is of (S,), and the order of these arcs."""
        order = np.argsort(self.stage.lo_rad[arcs], kind="stable")
        arcs = arcs[order]
        lo, hi = self.stage.lo_rad[arcs], self.stage.hi_rad[arcs]
        tracks = _tracks(lo, hi)
        radii = INNER + (OUTER - INNER) * (tracks + 0.5) / max(FEWEST_TRACKS, int(tracks.max(initial=0)) + 1)
        steps = np.maximum(1, np.ceil((hi - lo) / STEP_RAD)).astype(np.int64)
        arc = np.repeat(np.arange(len(arcs)), steps)
        part = np.arange(len(arc)) - np.repeat(np.cumsum(steps) - steps, steps)
        ends = lo[arc, None] + ((hi - lo) / steps)[arc, None] * (part[:, None] + np.array([0.0, 1.0]))
        directions = ring.directions(ends.ravel()).reshape(-1, 2, 3)
        return order, arc, view.middle + view.sphere_m * radii[arc, None, None] * directions


def _tracks(lo_rad: FloatArray, hi_rad: FloatArray) -> IntArray:
    """The innermost track (A,) that is free for each of the arcs, which begin one after another."""
    free: list[int] = []
    busy: list[tuple[float, int]] = []
    tracks = np.empty(len(lo_rad), dtype=np.int64)
    for k, (lo, hi) in enumerate(zip(lo_rad.tolist(), hi_rad.tolist(), strict=True)):
        while busy and busy[0][0] < lo:
            heappush(free, heappop(busy)[1])
        # Each track is either free or occupied.
        track = heappop(free) if free else len(busy)
        heappush(busy, (hi, track))
        tracks[k] = track
    return tracks
