"""The arcs of a run: which of them are looked at, what they are, and how they are drawn on the ring."""

from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush
from math import gcd

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.yaw_arcs import YawConsensus, deepest_yaw
from spherloc.trace import YawStage
from spherloc.types import FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import RunView, even, one_color
from spherloc_viz.layers.primitives import Segments

INNER, OUTER = 1.3, 1.95
"""Radii of the band of arcs, in sphere radii."""
STEP_RAD = np.radians(4.0)
FEWEST_TRACKS = 24
"""The band has room for so many arcs over one yaw, or more if more are drawn there."""


@dataclass(frozen=True, eq=False)
class Arcs:
    """A yaw stage and what several of its frames need, computed when it is first asked for. A arcs."""

    stage: YawStage

    def __len__(self) -> int:
        return len(self.stage.lo_rad)

    @property
    def median_width_rad(self) -> float:
        """Of all arcs; numpy's own median is ten times slower."""
        return float(np.partition(self.stage.hi_rad - self.stage.lo_rad, len(self) // 2)[len(self) // 2])

    @cached_property
    def in_clique(self) -> NDArray[np.bool_]:
        """(A,) arcs that cover the estimated yaw."""
        inside = np.zeros(len(self), dtype=bool)
        inside[self.stage.clique] = True
        return inside

    @cached_property
    def _continues(self) -> NDArray[np.bool_]:
        """(A,) arcs of the same pair as the arc before them; the arcs of a pair follow one another."""
        pairs = np.ascontiguousarray(self.stage.pairs, dtype=np.int32).view(np.int64).ravel()
        same = np.zeros(len(pairs), dtype=bool)
        same[1:] = pairs[1:] == pairs[:-1]
        return same

    @cached_property
    def pair_counts(self) -> tuple[int, int]:
        """How many pairs have one arc, and how many have more."""
        same = self._continues
        pairs = len(same) - int(np.count_nonzero(same))
        several = int(np.count_nonzero(same[1:] & ~same[:-1]))
        return pairs - several, several

    @cached_property
    def example(self) -> IntArray:
        """The arcs of one pair: of those with an arc over the estimated yaw the one whose arc there is the shortest,
        among those with two arcs if there are any."""
        arcs, same = self.stage.clique.astype(np.int64), self._continues
        several = same[arcs] | np.append(same[1:], False)[arcs]
        if several.any():
            arcs = arcs[several]
        first = int(arcs[np.argmin((self.stage.hi_rad - self.stage.lo_rad)[arcs])])
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
        """The yaw that most of some arcs share, and their overlap."""
        found = deepest_yaw(self.stage.lo_rad[arcs], self.stage.hi_rad[arcs])
        assert found is not None
        return found

    def over(self, arcs: IntArray, lo_rad: float, hi_rad: float) -> NDArray[np.bool_]:
        """Which of some arcs touch an interval of yaw within [-pi, pi]."""
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

    def drawn(self, view: RunView, arcs: IntArray, marked: np.ndarray, mark: style.RGB) -> Segments:
        """Arcs on the ring around the middle of the map, the marked ones (mask) in their colour. Arcs that overlap lie
        side by side, so that the band is as broad as they are many."""
        order, arc, points = view.kept("arcs", arcs.tobytes(), lambda: self._band(view, arcs))
        colors = one_color(style.UNDECIDED, len(arc))
        colors[marked[order][arc]] = mark
        ids = self.stage.pairs[arcs[order][arc]].astype(np.int64)
        return Segments("ring/arcs", "yaw ring", points, colors, 2.0, ids=ids)

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
        # Each track is either free or busy.
        track = heappop(free) if free else len(busy)
        heappush(busy, (hi, track))
        tracks[k] = track
    return tracks
