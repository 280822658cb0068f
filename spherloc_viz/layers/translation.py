"""Translation: the balls of feasible camera positions gather, their overlaps, and their maximum clique."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from math import gcd

import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import camera_centre, yaw_rotation
from spherloc.trace import ConsensusStage, TranslationStage
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.agreement import agreement
from spherloc_viz.layers.frame import Frame, Plan, RunView, ball_boxes, even, growing, level_circles, one_color
from spherloc_viz.layers.primitives import BallRows, Balls, Focus, Graph, Label, Nodes, Points, SceneItem, Segments
from spherloc_viz.layers.ring import GOLDEN

OPACITIES = ((4, 0.3), (np.inf, 0.2))
"""Largest number of surfaces, and their opacity: few balls are seen well, and many do not hide things behind them."""
MAX_SURFACES = 10
"""If there are more balls, the others are drawn as circles."""


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
        smaller half of those of a mask (M,) and of the others. Large balls would contain and hide the whole picture."""
        most = style.MAX_DRAWN_BALLS
        if len(shown) <= most:
            return shown
        halves = [group[: max(1, len(group) // 2)] for group in (shown[inside[shown]], shown[~inside[shown]])]
        take = min(len(halves[0]), max(most // 2, most - len(halves[1])))
        return np.concatenate([even(halves[0], take), even(halves[1], most - take)])

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


SIZES = (3, 10, 30, 100, 300)
"""Numbers of balls that are shown in steps before all are, in the order of ``BallSet.order``."""
CLIQUE_SIZES = (3, 10, 30, 100)
"""Numbers of members of the maximum clique that are shown in steps before all are."""
NAME_ROOM = 2.5
"""Half width of the view around one ball and its name, in radii."""


def plans(view: RunView, stage: TranslationStage) -> list[Plan]:
    """Steps for one ball, more and more balls, two greedy cliques, and the maximum clique."""
    balls, no_balls = BallSet(stage), np.zeros(0, dtype=np.int64)
    nodes = cache(partial(ball_nodes, balls))

    def graph(shown: IntArray | None, marked: IntArray, words: str, color: style.RGB = style.CLIQUE) -> Graph:
        listed = partial(ball_rows, view, balls, shown, marked)
        return replace(graph_at(nodes, shown, marked, color, words), list_balls=listed)

    one = np.array([balls.example])
    out = [
        Plan(
            "balls-pair",
            "One pair, one ball",
            lambda: _pair(view, balls),
            graph=lambda: graph(one, one, "The first node.", style.SAMPLE),
        )
    ]
    for size in growing(len(balls), *SIZES):
        title, draw, words = f"{size} balls and their graph", partial(_some, view, balls, size), f"{size} nodes."
        out.append(Plan(f"balls-{size}", title, draw, graph=partial(graph, balls.order[:size], no_balls, words)))
    words = f"All {len(balls):,} nodes." if len(balls) > 1 else "The only node."
    out.append(
        Plan(
            "balls", "Balls of camera positions", lambda: _all(view, balls), graph=partial(graph, None, no_balls, words)
        )
    )
    for key, title, draw, order in (
        ("clique-greedy-smallest", "A clique from the smallest ball", _from_smallest, lambda: balls.by_radius),
        ("clique-greedy-degree", "A clique from the busiest ball", _from_busiest, lambda: balls.busiest),
    ):
        out.append(Plan(key, title, partial(draw, view, balls), graph=partial(_greedy_graph, balls, graph, order)))
    for size in growing(len(stage.clique), *CLIQUE_SIZES):
        title = f"{size} of the {len(stage.clique):,} balls of the maximum clique"
        draw = partial(_members, view, balls, size)
        words = f"{size} of the {len(stage.clique):,} nodes of the maximum clique."
        out.append(Plan(f"clique-{size}", title, draw, graph=partial(graph, None, balls.members[:size], words)))
    words = f"The maximum clique: {len(stage.clique):,} nodes that all agree, a full block of the matrix."
    out.append(
        Plan(
            "clique",
            "The maximum clique of balls",
            lambda: _clique(view, balls),
            graph=partial(graph, None, stage.clique.astype(np.int64), words),
        )
    )
    return out


def _greedy_graph(balls: BallSet, graph: Callable[..., Graph], order: Callable[[], IntArray]) -> Graph:
    found, most = balls.greedy(order()), len(balls.stage.clique)
    bound = f"≤ ω(G) = {most:,}" if balls.stage.proven else "≤ ω(G)"
    return graph(None, found, f"A clique of {len(found):,} nodes: a lower bound, {len(found):,} {bound}.", style.SAMPLE)


def _turned(view: RunView, balls: BallSet) -> FloatArray:
    """The sphere in the middle of the map, at the estimated yaw."""
    return view.standing(view.aligned_pose(balls.stage.cam_from_map)[:, :3])


def _note(balls: BallSet, shown: IntArray, inside: np.ndarray) -> str:
    """A note on the rules by which balls were left out."""
    drawn = balls.drawn(shown, inside)
    parts = [balls.stage.rule]
    if len(drawn) < len(shown):
        parts.append(
            f"{len(drawn)} of {len(shown):,} balls are drawn with the overlaps between them: an even sample of the "
            "smaller half of the clique, and of the others; of the rest only the centres."
        )
    solid = np.count_nonzero(balls.solid(drawn, inside))
    if solid < len(drawn):
        parts.append(f"{solid} {'has' if solid == 1 else 'have'} a surface, the others their level circle.")
    return " ".join(parts)


def _from_truth(view: RunView, position: FloatArray) -> str:
    """Distance of a position (3,) from the true one, as part of a sentence; empty if that is unknown."""
    if view.truth is None:
        return ""
    return f", {view.length(float(np.linalg.norm(position - camera_centre(view.truth))))} from the truth"


def _pair(view: RunView, balls: BallSet) -> Frame:
    """One ball, and the rays of its pair."""
    stage, ball = balls.stage, np.array([balls.example])
    first, second = (int(number) for number in stage.pairs[ball[0]])
    centre, mask, radius_m = stage.centres_m[ball[0]], view.mask(stage.pairs[ball[0]]), float(stage.radii_m[ball[0]])
    ends = np.stack([view.points[[first, second]], np.tile(centre, (2, 1))], axis=1)
    ids = stage.pairs[ball].astype(np.int64)
    return Frame(
        f"With the yaw known, matches {first} and {second} have rays of known directions, which come nearest to each "
        f"other at {view.place(centre)}{_from_truth(view, centre)}. If both are right, noise can move the camera by "
        f"{view.length(radius_m)} from there at most: a ball that holds every camera position this pair allows.",
        "H t = b,  |t_k − t| ≤ r_k   (Eq. 24-27)",
        _turned(view, balls),
        view.colors(style.UNDECIDED, (mask, style.SAMPLE)),
        mask,
        note=stage.rule,
        items=(
            Balls("balls/one", "balls", centre[None], stage.radii_m[ball], one_color(style.SAMPLE, 1), 0.3, ids=ids),
            Segments("pairs/rays", "pairs", ends, one_color(style.SAMPLE, 2), 2.0),
            _name(centre, radius_m, "ball: all camera positions that this pair allows"),
        ),
        focus=Focus("Balls", np.vstack([ball_boxes(centre[None], NAME_ROOM * stage.radii_m[ball]), ends[:, 0]])),
    )


def _name(centre: FloatArray, radius_m: float, words: str) -> Label:
    """A label above a ball, which does not cover it where it is small on the screen."""
    return Label("balls/name", "balls", centre - np.array([0.0, 1.6 * radius_m, 0.0]), words)


def _some(view: RunView, balls: BallSet, size: int) -> Frame:
    """The first balls."""
    stage, inside = balls.stage, np.zeros(len(balls), dtype=bool)
    mask = balls.mask(balls.order[:size])
    shown = balls.by_radius[mask[balls.by_radius]]
    edges, possible = len(balls.edges_within(mask)), size * (size - 1) // 2
    low, high = (view.length(float(stage.radii_m[ball])) for ball in shown[[0, -1]])
    items = balls.items(view, shown, inside)
    if size == SIZES[0] and edges:
        middle = np.mean(stage.centres_m[balls.edges_within(mask)[0]], axis=0)
        items += (_name(middle, float(stage.radii_m[shown[-1]]), "edge: these two balls overlap"),)
    return Frame(
        f"{size} of {len(balls):,} balls, with radii from {low} to {high}; {edges:,} of their {possible:,} pairs "
        "overlap. An overlap means that one position of the camera can suit both pairs of matches, and makes an edge "
        "of the graph.",
        "‖t_k1 − t_k2‖ ≤ r_k1 + r_k2   (Eq. 38)",
        _turned(view, balls),
        view.colors(style.UNDECIDED, (view.mask(stage.pairs[shown]), style.CLIQUE)),
        view.no_matches(),
        note=f"Smaller balls come first, spread evenly over them. {_note(balls, shown, inside)}",
        items=items,
        focus=balls.focus(shown),
    )


def _all(view: RunView, balls: BallSet) -> Frame:
    stage, inside = balls.stage, np.zeros(len(balls), dtype=bool)
    return Frame(
        f"With the yaw known, each pair says where the camera is, up to a ball; {len(stage.edges):,} pairs of "
        f"balls overlap. Small balls come from near points under a wide angle; balls of inliers share a position.",
        "H t = b,  |t_k − t| ≤ r_k   (Eq. 24-27)",
        _turned(view, balls),
        view.colors(style.UNDECIDED, (view.mask(stage.pairs), style.CLIQUE)),
        view.no_matches(),
        note=_note(balls, balls.by_radius, inside),
        items=balls.items(view, balls.by_radius, inside),
        focus=balls.focus(balls.by_radius),
    )


def _from_smallest(view: RunView, balls: BallSet) -> Frame:
    found = balls.greedy(balls.by_radius)
    return _greedy(view, balls, found, "the smallest ball", "the next larger one")


def _from_busiest(view: RunView, balls: BallSet) -> Frame:
    found = balls.greedy(balls.busiest)
    most = int(balls.degrees[found[0]])
    return _greedy(view, balls, found, f"the ball that overlaps most others, {most:,}", "the next busiest one")


def _greedy(view: RunView, balls: BallSet, found: IntArray, first: str, then: str) -> Frame:
    """The step of a clique that was built greedily."""
    missing = len(balls.stage.clique) - len(found)
    verdict = "which is as large as the maximum" if missing == 0 else f"{missing:,} fewer than the maximum has"
    inside = balls.mask(found)
    return Frame(
        f"From {first}, always taking {then} that overlaps all taken so far, a clique grows to {len(found):,} balls, "
        f"{verdict}. Such a clique is a lower bound for the search, which must look into every larger one.",
        f"{len(found):,} ≤ ω(G) = {len(balls.stage.clique):,}" if balls.stage.proven else f"{len(found):,} ≤ ω(G)",
        _turned(view, balls),
        view.colors(style.UNDECIDED, (view.mask(balls.stage.pairs[found]), style.SAMPLE)),
        view.no_matches(),
        note=_note(balls, balls.by_radius, inside),
        items=balls.items(view, balls.by_radius, inside, style.SAMPLE),
        focus=balls.focus(balls.by_radius[inside[balls.by_radius]]),
    )


def _members(view: RunView, balls: BallSet, size: int) -> Frame:
    """The smallest balls of the maximum clique."""
    stage, chosen = balls.stage, balls.members[:size]
    weights = stage.radii_m[chosen] ** -2.0
    mean = weights @ stage.centres_m[chosen] / weights.sum()
    inside, matches = balls.mask(chosen), view.mask(stage.pairs[chosen])
    return Frame(
        f"The {size} smallest of the {len(stage.clique):,} balls of the maximum clique come from "
        f"{np.count_nonzero(matches)} matches, and all {size * (size - 1) // 2:,} pairs of them overlap. "
        f"Their mean, weighted by precision, puts the camera at {view.place(mean)}{_from_truth(view, mean)}.",
        "C ≈ Σ r_k⁻² C_k / Σ r_k⁻²",
        _turned(view, balls),
        view.colors(style.UNDECIDED, (matches, style.CLIQUE)),
        view.no_matches(),
        note=_note(balls, balls.by_radius, inside),
        items=balls.items(view, balls.by_radius, inside),
        focus=balls.focus(chosen),
    )


def _clique(view: RunView, balls: BallSet) -> Frame:
    stage, start = balls.stage, view.aligned_pose(balls.stage.cam_from_map)
    members = view.mask(stage.pairs[stage.clique])
    largest = "the largest such set" if stage.proven else "the largest set found before the search reached its limit"
    return Frame(
        f"{len(stage.clique):,} of {len(balls):,} balls overlap pairwise, from {np.count_nonzero(members)} matches: "
        f"{largest}. The best of its pairs puts the camera at {view.position(start)}.",
        "‖t_k1 − t_k2‖ ≤ r_k1 + r_k2   (Eq. 38)",
        start,
        view.colors(style.UNDECIDED, (members, style.CLIQUE)),
        view.no_matches(),
        note=_note(balls, balls.by_radius, balls.in_clique),
        located=True,
        sphere_aside=True,
        items=(*balls.items(view, balls.by_radius, balls.in_clique), _clique_name(balls)),
        focus=balls.focus(balls.members),
    )


def _clique_name(balls: BallSet) -> Label:
    """A label above the clique."""
    points = balls.focus(balls.members).points
    place = np.mean(points, axis=0)
    place[1] = np.min(points[:, 1])
    return Label("balls/name", "balls", place, "maximum clique: most balls that all overlap each other")
