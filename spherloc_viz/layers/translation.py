"""Translation: the balls of feasible camera positions gather, their overlaps, and their maximum clique."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np

from spherloc.geometry import camera_centre, yaw_of
from spherloc.trace import TranslationStage
from spherloc.types import FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.ball_set import BallSet
from spherloc_viz.layers.frame import Frame, Plan, RunView, growing, one_color, sphere_box
from spherloc_viz.layers.graph_nodes import ball_nodes, ball_rows, graph_at
from spherloc_viz.layers.primitives import Balls, Focus, Graph, Label, Segments

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
            f"{len(drawn)} of {len(shown):,} balls are drawn with the overlaps between them, evenly chosen from the "
            "smaller half of the clique and from the others; of the rest only the centres."
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
        focus=Focus("Balls", np.vstack([sphere_box(centre, NAME_ROOM * radius_m), ends[:, 0]])),
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
        note=f"The smaller half of all balls comes first, evenly chosen from it. {_note(balls, shown, inside)}",
        items=items,
        focus=balls.focus(shown, inside),
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
        focus=balls.focus(balls.by_radius, inside),
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
        focus=balls.focus(balls.by_radius, inside),
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
        focus=balls.focus(balls.by_radius, inside),
    )


def _clique(view: RunView, balls: BallSet) -> Frame:
    stage, start = balls.stage, view.aligned_pose(balls.stage.cam_from_map)
    members = view.mask(stage.pairs[stage.clique])
    kept, found = np.count_nonzero(members & view.trace.inlier_mask), np.count_nonzero(members)
    lost = (
        ""
        if kept == found
        else f" Balls that overlap in pairs need not share a point: of the {found} matches, the run keeps {kept}."
    )
    largest = "the largest such set" if stage.proven else "the largest set found before the search reached its limit"
    return Frame(
        f"{len(stage.clique):,} of {len(balls):,} balls overlap pairwise, from {found} matches"
        f"{view.right_ones(np.flatnonzero(members))}: {largest}. The best of its pairs puts the camera at "
        f"{view.position(start)}.",
        "‖t_k1 − t_k2‖ ≤ r_k1 + r_k2   (Eq. 38)",
        start,
        view.colors(style.UNDECIDED, (members, style.CLIQUE)),
        view.no_matches(),
        note=f"{_own_yaw(view, start)} {_note(balls, balls.by_radius, balls.in_clique)}{lost}".strip(),
        located=True,
        sphere_aside=True,
        items=(*balls.items(view, balls.by_radius, balls.in_clique), _clique_name(balls)),
        focus=balls.focus(balls.by_radius, balls.in_clique),
    )


def _own_yaw(view: RunView, cam_from_map: FloatArray) -> str:
    """A sentence on the yaw of the pose (3, 4) of a pair."""
    yaw_rad = float(yaw_of(cam_from_map[:, :3]))
    at = f"{np.degrees(yaw_rad):.2f}°{ring.off_truth(view, yaw_rad)}"
    return f"The pose is of that pair alone, with a yaw of {at}; the refinement fits all inliers."


def _clique_name(balls: BallSet) -> Label:
    """A label above the clique."""
    points = balls.focus(balls.by_radius, balls.in_clique).points
    place = np.mean(points, axis=0)
    place[1] = np.min(points[:, 1])
    return Label("balls/name", "balls", place, "maximum clique: most balls that all overlap each other")
