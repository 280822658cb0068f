"""Exact consensus: the bound over yaw, the largest set of matches that agrees, and the poses that were verified."""

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from spherloc.geometry import camera_centre, yaw_of, yaw_rotation
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.trace import ConsensusStage
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers import yaw_bound as bound
from spherloc_viz.layers.balls import graph_at, match_nodes
from spherloc_viz.layers.frame import Frame, Plan, RunView, even, growing, one_color, sphere_box
from spherloc_viz.layers.primitives import Focus, Graph, Nodes, SceneItem, Segments, Table
from spherloc_viz.layers.scene import camera
from spherloc_viz.layers.yaw_bound import best_support, highest_bound

CLIQUE_SIZES = (3, 5, 10, 20, 50, 100)
"""How many members of the largest set are shown before all are."""


def plans(view: RunView, stage: ConsensusStage) -> list[Plan]:
    """The first guess and the bound; then the set and the poses, where the search has found any."""
    charts = {"consensus": partial(bound.chart, view, stage)}
    out = bound.plans(view, stage)
    nodes, whole = cache(partial(match_nodes, view, stage)), len(stage.clique)
    for size in growing(whole, *CLIQUE_SIZES):
        title, draw = f"{size} matches that agree", partial(_members, view, stage, size)
        graph = partial(_graph, view, nodes, stage.clique[:size], f"{size} of {whole} matches that all agree.")
        out.append(Plan(f"consensus-clique-{size}", title, draw, charts, graph))
    if whole:
        title, words = "The largest set that agrees", f"{whole} matches that all agree, a full block of the matrix."
        graph = partial(_graph, view, nodes, stage.clique, words)
        out.append(Plan("consensus-clique", title, lambda: _clique(view, stage), charts, graph))
    shown = min(len(stage.support), 1 + style.MAX_DRAWN_ALTERNATIVES)
    for rank in range(shown if shown > 1 else 0):
        title = "The best pose" if rank == 0 else f"Alternative pose {rank}"
        out.append(Plan(f"consensus-pose-{rank + 1}", title, partial(_pose, view, stage, rank), charts))
    if len(stage.support):
        out.append(Plan("consensus-poses", "The poses that were verified", lambda: _poses(view, stage), charts))
    return out


def _graph(view: RunView, nodes: Callable[[], Nodes], marked: np.ndarray, words: str) -> Graph:
    """The graph at the best pose's yaw, with some matches (numbers in the problem) marked."""
    return graph_at(nodes, None, np.searchsorted(view.trace.problem.aligned.index, marked), style.CLIQUE, words)


def _clique(view: RunView, stage: ConsensusStage) -> Frame:
    size, most = len(stage.clique), highest_bound(stage)
    pairs, note = _pairs(stage.clique)
    return Frame(
        _agreement(view, stage),
        f"{size} ≤ max over θ of ω(G(θ)) ≤ {most}",
        view.standing(yaw_rotation(stage.yaw_rad)),
        view.colors(style.UNDECIDED, (stage.clique, style.CLIQUE)),
        view.nobody(),
        note=note,
        items=(_edges(view, pairs),),
        focus=_focus(view, stage.clique),
    )


def _agreement(view: RunView, stage: ConsensusStage) -> str:
    """What the largest set is, and what follows."""
    size, most, best = len(stage.clique), highest_bound(stage), best_support(stage)
    labels = view.trace.problem.truth_inliers
    right = "" if labels is None else f"{view.right_ones(stage.clique)},"
    if size > best:
        return (
            f"{size} matches{right} agree in pairs at some yaw, {size - best} more than the best pose explains. "
            "But pairs that agree need not share one position, and no pose that was tried explains them all."
        )
    yaw, pairs = np.degrees(stage.yaw_rad), size * (size - 1) // 2
    if not stage.arcs:
        return (
            f"The best pose explains {size} matches{right} at a yaw of {yaw:.2f}°"
            f"{ring.off_truth(view, stage.yaw_rad)}. All camera positions were searched: no pose explains more than "
            f"{most}."
        )
    larger = "No larger set agrees at any yaw" if size >= most else f"A larger set, of up to {most}, is not excluded"
    return (
        f"The {size} matches{right} that the best pose explains agree at its yaw of {yaw:.2f}°"
        f"{ring.off_truth(view, stage.yaw_rad)}: each of their {pairs:,} pairs has an arc there. "
        f"{larger}, and that bounds what a better pose could explain."
    )


def _members(view: RunView, stage: ConsensusStage, size: int) -> Frame:
    """The first members of the largest set."""
    chosen, whole = stage.clique[:size], len(stage.clique)
    pairs, note = _pairs(chosen)
    return Frame(
        f"{size} of the {whole} matches{view.right_ones(chosen)}{',' if view.right_ones(chosen) else ''} agree in all "
        f"{size * (size - 1) // 2:,} pairs at one yaw. The next one must agree with each of these {size}, which a "
        "wrong match seldom does.",
        f"{size} ≤ max over θ of ω(G(θ))",
        view.standing(yaw_rotation(stage.yaw_rad)),
        view.colors(style.UNDECIDED, (chosen, style.CLIQUE)),
        view.nobody(),
        note=note,
        items=(_edges(view, pairs),),
        focus=_focus(view, chosen),
    )


def _pairs(clique: np.ndarray) -> tuple[np.ndarray, str]:
    """Pairs (P, 2) of a set to draw, and the rule by which others are left out."""
    pairs = clique[np.column_stack(np.triu_indices(len(clique), 1))].astype(np.int64)
    drawn = pairs[even(np.arange(len(pairs)), style.MAX_DRAWN_PAIRS)]
    if len(drawn) == len(pairs):
        return drawn, f"All {len(pairs):,} pairs are drawn, as lines on the map."
    return (
        drawn,
        f"An even sample of {len(drawn):,} of {len(pairs):,} pairs is drawn, as lines on the map.",
    )


def _focus(view: RunView, matches: np.ndarray) -> Focus:
    """The map points of some matches, and the sphere."""
    sphere = sphere_box(view.middle, view.sphere_m)
    return Focus("Overview", np.vstack([view.points[matches], sphere]))


def _edges(view: RunView, pairs: np.ndarray) -> Segments:
    colors = one_color(style.CLIQUE, len(pairs))
    return Segments("pairs/clique", "pairs", view.points[pairs], colors, 1.0, ids=pairs)


def _pose(view: RunView, stage: ConsensusStage, rank: int) -> Frame:
    """One of the verified poses, with what it explains."""
    state, support = view.aligned_pose(stage.cam_from_map[rank]), int(stage.support[rank])
    explained = np.zeros(len(view.points), dtype=bool)
    aligned = view.trace.problem.aligned
    explained[aligned.index] = view.residuals_px(state)[aligned.index] <= view.bounds.noise_px
    off = "" if view.truth is None else f", {translation_error_m(view.truth, state):.3f} m from the true one"
    if rank == 0:
        then = "No other pose that was tried explains more, so it is what refinement starts from."
    else:
        best = view.aligned_pose(stage.cam_from_map[0])
        away, turned = translation_error_m(best, state), rotation_error_deg(best, state)
        both = np.count_nonzero(explained & view.mask(stage.clique))
        then = f"It is {away:.2f} m and {turned:.1f}° away from the best pose, and shares {both} matches with the set."
    return Frame(
        f"The pose at {view.position(state)}{off} explains {support} of {len(view.points)} matches. {then}",
        f"Σ 1(‖π(R p + t) − u‖ ≤ ε) = {support}",
        state,
        view.colors(style.UNDECIDED, (explained, style.INLIER)),
        explained,
        located=True,
    )


def _poses(view: RunView, stage: ConsensusStage) -> Frame:
    states = [view.aligned_pose(state) for state in stage.cam_from_map[: 1 + style.MAX_DRAWN_ALTERNATIVES]]
    alternatives, count, most = states[1:], len(stage.support), highest_bound(stage)
    if alternatives:
        away, turned = translation_error_m(states[0], states[1]), rotation_error_deg(states[0], states[1])
        other = f"The best other pose, {away:.2f} m and {turned:.1f}° away, explains {stage.support[1]}"
    else:
        other = "No clearly different pose was found beside it"
    note = (
        f"The best and {len(alternatives)} of {count - 1:,} other poses are shown."
        if count > len(alternatives) + 1
        else ""
    )
    return Frame(
        f"The best pose explains {stage.support[0]} of {len(view.points)} matches from {view.position(states[0])}. "
        f"{other}; no pose explains more than {most}.",
        f"{best_support(stage)} ≤ max over R, t of Σ 1(‖π(R p + t) − u‖ ≤ ε) ≤ {most}",
        states[0],
        view.colors(style.UNDECIDED, (stage.clique, style.CLIQUE)),
        view.mask(stage.clique),
        note=note,
        located=True,
        items=_ghosts(view, alternatives),
        tables=(_table(view, stage, states),),
    )


def _ghosts(view: RunView, alternatives: list[FloatArray]) -> tuple[SceneItem, ...]:
    if not alternatives:
        return ()
    ghosts = [
        camera("cameras/alternatives", state, 1.5 * view.sphere_m, style.ALTERNATIVE, 2.0) for state in alternatives
    ]
    ends = np.concatenate([ghost.points for ghost in ghosts])
    return (Segments("cameras/alternatives", "cameras", ends, one_color(style.ALTERNATIVE, len(ends)), 2.0),)


def _table(view: RunView, stage: ConsensusStage, states: list[FloatArray]) -> Table:
    rows = []
    for rank, (state, support) in enumerate(zip(states, stage.support, strict=False), 1):
        centre = camera_centre(view.trace.problem.aligned.unalign_pose(state))
        place = " ".join(f"{value:.2f}" for value in centre)
        off = () if view.truth is None else (f"{translation_error_m(view.truth, state):.3f} m",)
        rows.append((str(rank), str(support), f"{np.degrees(yaw_of(state[:, :3])):.2f}°", place, *off))
    columns = ("", "explains", "yaw", "camera (m)", *(() if view.truth is None else ("off the truth",)))
    return Table("verified poses", columns, tuple(rows))
