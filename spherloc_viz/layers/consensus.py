"""Exact consensus: the bound over yaw, the largest set of matches that agrees, verified poses, boxes of positions."""

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from spherloc.geometry import camera_centre, yaw_of, yaw_rotation
from spherloc.metrics import BEYOND, rotation_error_deg, translation_error_m
from spherloc.trace import ConsensusStage, PositionStage
from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.camera_shape import camera
from spherloc_viz.layers.frame import Frame, Plan, RunView, even, growing, one_color, sphere_box
from spherloc_viz.layers.graph_nodes import graph_at, match_nodes
from spherloc_viz.layers.primitives import Chart, Curve, Focus, Graph, Nodes, SceneItem, Segments, Table

PEAKS = 16
"""Largest number of peaks of the bound that have a step."""
REACH = 10
"""A peak is the largest value within this many quarters of a degree on both sides."""


def highest_bound(stage: ConsensusStage) -> int:
    """Largest value of the bound: no pose explains more correspondences."""
    return int(stage.bound.max())


def is_same_everywhere(stage: ConsensusStage) -> bool:
    """Whether the bound is one number: a search over positions proves it for all yaws together."""
    return bool(stage.bound.min() == stage.bound.max())


def best_support(stage: ConsensusStage) -> int:
    """Number of correspondences that the best known pose explains."""
    return int(stage.support.max(initial=stage.seed_support))


def _bound_plans(view: RunView, stage: ConsensusStage) -> list[Plan]:
    """Steps for the first guess, the bound, and its peaks, if it has any, from the highest down."""
    charts = {"consensus": partial(bound_chart, view, stage)}
    out = [
        Plan("consensus-guess", "The first guess", lambda: _guess(view, stage)),
        Plan(
            "consensus-bound",
            "What no pose can beat" if is_same_everywhere(stage) else "What no pose can beat, at each yaw",
            lambda: _bound(view, stage),
            charts,
        ),
    ]
    if is_same_everywhere(stage):
        return out
    peaks = ring.peaks(stage.bound, REACH, PEAKS)
    for rank, place in enumerate(peaks.tolist(), 1):
        yaw = ring.degrees_of(place + 0.5, len(stage.bound))
        title = f"At {yaw:.1f}°: at most {stage.bound[place]}"
        with_candidate = {"consensus": partial(bound_chart, view, stage, candidate_rad=np.radians(yaw))}
        draw = partial(_peak, view, stage, rank, place, len(peaks))
        out.append(Plan(f"consensus-yaw-{rank}", title, draw, with_candidate))
    return out


def _guess(view: RunView, stage: ConsensusStage) -> Frame:
    count, seed = len(view.points), stage.seed_support
    return Frame(
        f"Before anything is proven, poses of sampled pairs are tried, and the best of them explains {seed} of {count} "
        f"matches. A pose that beats it must explain {seed + 1}, so yaws at which fewer agree need no search.",
        f"max over R, t of Σ 1(‖π(R p + t) − u‖ ≤ ε) ≥ {seed}",
        view.standing(np.eye(3)),
        view.colors(style.UNDECIDED),
        view.no_matches(),
    )


def _bound(view: RunView, stage: ConsensusStage) -> Frame:
    most, best, start = highest_bound(stage), best_support(stage), view.standing(np.eye(3))
    open_share = 100.0 * np.count_nonzero(stage.bound > best) / len(stage.bound)
    left = f"{open_share:.3g} % of all yaws could hide a better one" if open_share else "no yaw could hide a better one"
    if stage.arcs:
        why = (
            f"The {stage.arcs:,} arcs tell which pairs of matches agree at a yaw, and matches that one pose explains "
            "all agree in pairs, so the largest such set is a bound"
        )
        formula = f"max over θ of ω(G(θ)) = {most},  ij ∈ G(θ) ⇔ |f_ij(θ)| ≤ τ_ij"
    else:
        why = "All camera positions were searched, at every yaw and every tilt that gravity allows"
        formula = f"max over R, t of Σ 1(‖π(R p + t) − u‖ ≤ ε) ≤ {most}"
    return Frame(
        f"{why}: no pose explains more than {most} of {len(view.points)} matches. "
        f"The first guess explains {stage.seed_support} and the best pose {best}, and {left}.",
        formula,
        start,
        view.colors(style.UNDECIDED),
        view.no_matches(),
        note=_effort(stage),
        items=(
            *_ring(view, stage),
            ring.name("ring/name", view, stage.yaw_rad + np.pi, f"bound: {_heights(stage)}"),
        ),
    )


def _heights(stage: ConsensusStage) -> str:
    """What the heights of the bars are."""
    if is_same_everywhere(stage):
        return f"at most {highest_bound(stage)} matches at any yaw"
    return "most matches at each yaw"


def _effort(stage: ConsensusStage) -> str:
    end = (
        "every yaw that could hide a better pose was searched to its end."
        if stage.finished
        else "the budget ran out before every yaw was searched, so that the bound is larger than it might be."
    )
    what = "operations on sets of matches" if stage.arcs else "tests of a match"
    return f"The effort of the search, {stage.effort:,} {what}: {end}"


def _peak(view: RunView, stage: ConsensusStage, rank: int, place: int, peaks: int) -> Frame:
    """One of the highest peaks of the bound."""
    here, best = int(stage.bound[place]), best_support(stage)
    yaw = np.radians(ring.degrees_of(place + 0.5, len(stage.bound)))
    turned = view.standing(yaw_rotation(yaw))
    if here > best:
        verdict = f"That is {here - best} more than the best pose explains, so a better one is not excluded here."
    elif here == best:
        verdict = f"The best pose explains as many, {best}, so nothing here can beat it."
    else:
        verdict = f"That is {best - here} fewer than the best pose explains, so nothing here can beat it."
    rest = f" The {peaks} highest peaks of the bound are shown." if rank == 1 else ""
    return Frame(
        f"Peak {rank} of the bound: with a yaw near {np.degrees(yaw):.1f}°{ring.off_truth(view, yaw)}, no pose "
        f"explains more than {here} of {len(view.points)} matches. {verdict}",
        f"ω(G(θ)) ≤ {here} {'>' if here > best else '≤'} {best}",
        turned,
        view.colors(style.UNDECIDED),
        view.no_matches(),
        note=f"Yaws are searched by falling bound until none could hide a better pose.{rest}",
        items=(
            *_ring(view, stage, place),
            ring.spoke("ring/candidate", view, view.middle, yaw, style.SAMPLE),
        ),
    )


def bound_chart(view: RunView, stage: ConsensusStage, candidate_rad: float | None = None) -> Chart:
    """Chart of the bound over yaw, with the support of the first guess and of the best pose, and with the true, the
    estimated and a candidate yaw."""
    peak, ends = float(max(highest_bound(stage), 1)), np.array([-180.0, 180.0])
    curves = [
        ring.step_curve("bound", stage.bound),
        Curve("first guess", ends, np.full(2, float(stage.seed_support)), style.SAMPLE, "level"),
        Curve("best pose", ends, np.full(2, float(best_support(stage))), style.INLIER, "level"),
        *ring.markers(view, peak, _yaw(stage)),
    ]
    if candidate_rad is not None:
        curves.append(ring.marker("candidate", candidate_rad, peak, style.SAMPLE))
    return Chart("consensus", "No pose with this yaw explains more than", "yaw (°)", "matches", tuple(curves))


def _yaw(stage: ConsensusStage) -> float | None:
    """Yaw of the best pose, if there is one."""
    return stage.yaw_rad if len(stage.support) else None


def _ring(view: RunView, stage: ConsensusStage, place: int | None = None) -> tuple[SceneItem, ...]:
    """The bound around the sphere, and the best pose's support as a circle: at yaws where the bound is outside of it
    there may be a better pose.

    The bound is in the colour of a sample at ``place``; without one, in that of the clique where it is largest, unless
    it is the same everywhere.
    """
    centre, heights, most = view.middle, ring.by_degree(stage.bound), max(1, highest_bound(stage))
    feet, tops = ring.circle(view, centre, np.zeros(())), ring.circle(view, centre, heights / most)
    colors = one_color(style.UNDECIDED, len(feet))
    if place is None:
        colors[(heights == most) & (not is_same_everywhere(stage))] = style.CLIQUE
    else:
        colors[place * len(feet) // len(stage.bound)] = style.SAMPLE
    support = ring.circle(view, centre, np.array(best_support(stage) / most))
    return (
        ring.bars("ring/bars", feet, tops, colors),
        ring.outline("ring/bound", tops, style.SPHERE),
        ring.outline("ring/support", support, style.INLIER),
        *ring.spokes(view, centre, _yaw(stage)),
    )


CLIQUE_SIZES = (3, 5, 10, 20, 50, 100)
"""Numbers of members of the largest set that are shown in steps before all are."""


def plans(view: RunView, stage: ConsensusStage) -> list[Plan]:
    """The first guess and the bound; then the set and the poses, where the search has found any."""
    charts = {"consensus": partial(bound_chart, view, stage)}
    out = _bound_plans(view, stage)
    nodes, whole = cache(partial(match_nodes, view, stage)), len(stage.clique)
    for size in growing(whole, *CLIQUE_SIZES):
        title, draw = f"{size} matches that agree", partial(_members, view, stage, size)
        graph = partial(_graph, view, nodes, stage.clique[:size], f"{size} of {whole} matches that all agree.")
        out.append(Plan(f"consensus-clique-{size}", title, draw, charts, graph))
    if whole:
        title, words = "The largest set that agrees", f"{whole} matches that all agree, a full block of the matrix"
        words += ": the inliers before refinement." if whole == best_support(stage) else "."
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
    """The graph at the best pose's yaw, with some matches (indices in the problem) marked."""
    return graph_at(nodes, None, np.searchsorted(view.trace.problem.aligned.index, marked), style.CLIQUE, words)


def _clique(view: RunView, stage: ConsensusStage) -> Frame:
    size, most = len(stage.clique), highest_bound(stage)
    pairs, note = _pairs(stage.clique)
    inliers = int(np.count_nonzero(view.trace.inlier_mask))
    if inliers not in (0, size):
        note += f" The refinement may tilt the camera too, and ends with {inliers} inliers."
    return Frame(
        _agreement(view, stage),
        f"{size} ≤ max over θ of ω(G(θ)) ≤ {most}",
        view.standing(yaw_rotation(stage.yaw_rad)),
        view.colors(style.UNDECIDED, (stage.clique, style.CLIQUE)),
        view.no_matches(),
        note=note,
        items=(_edges(view, pairs),),
        focus=_focus(view, stage.clique),
    )


def _agreement(view: RunView, stage: ConsensusStage) -> str:
    """The step of the largest set and its consequence for the bound."""
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
        view.no_matches(),
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
        f"{len(drawn):,} of {len(pairs):,} pairs, evenly chosen, are drawn as lines on the map.",
    )


def _focus(view: RunView, matches: np.ndarray) -> Focus:
    """The map points of some matches, and the sphere."""
    sphere = sphere_box(view.middle, view.sphere_m)
    return Focus("Overview", np.vstack([view.points[matches], sphere]))


def _edges(view: RunView, pairs: np.ndarray) -> Segments:
    colors = one_color(style.CLIQUE, len(pairs))
    return Segments("pairs/clique", "pairs", view.points[pairs], colors, 1.0, ids=pairs)


def _pose(view: RunView, stage: ConsensusStage, rank: int) -> Frame:
    """The step of one of the verified poses, with the matches that it explains."""
    state, support = view.aligned_pose(stage.cam_from_map[rank]), int(stage.support[rank])
    explained = np.zeros(len(view.points), dtype=bool)
    aligned = view.trace.problem.aligned
    explained[aligned.index] = view.residuals_px(state)[aligned.index] <= view.bounds.noise_px
    off = "" if view.truth is None else f", {_off(view, state)} from the true one"
    if rank == 0:
        then = "No other pose that was tried explains more, so it is what refinement starts from."
    else:
        best = view.aligned_pose(stage.cam_from_map[0])
        away, turned = translation_error_m(best, state), rotation_error_deg(best, state)
        both = np.count_nonzero(explained & view.mask(stage.clique))
        apart = f"{view.fixed_length(away, 2)} and {turned:.1f}° away"
        then = f"It is {apart} from the best pose, and shares {both} matches with the set."
    return Frame(
        f"The pose at {view.position(state)}{off} explains {support} of {len(view.points)} matches. {then}",
        f"Σ 1(‖π(R p + t) − u‖ ≤ ε) = {support}",
        state,
        view.colors(style.UNDECIDED, (explained, style.INLIER)),
        explained,
        located=True,
    )


def _off(view: RunView, state: FloatArray) -> str:
    """How far an aligned pose is from the true one, which is known."""
    assert view.truth is not None
    return view.fixed_length(translation_error_m(view.truth, state), 3)


def _poses(view: RunView, stage: ConsensusStage) -> Frame:
    states = [view.aligned_pose(state) for state in stage.cam_from_map[: 1 + style.MAX_DRAWN_ALTERNATIVES]]
    alternatives, count, most = states[1:], len(stage.support), highest_bound(stage)
    if alternatives:
        away, turned = translation_error_m(states[0], states[1]), rotation_error_deg(states[0], states[1])
        apart = f"{view.fixed_length(away, 2)} and {turned:.1f}° away"
        other = f"The best other pose, {apart}, explains {stage.support[1]}"
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
    rows, unit = [], view.trace.problem.unit
    for rank, (state, support) in enumerate(zip(states, stage.support, strict=False), 1):
        centre = camera_centre(view.trace.problem.aligned.unalign_pose(state))
        away = view.is_away(camera_centre(state))
        place = BEYOND if away else " ".join(f"{value:.2f}" for value in centre)
        off = () if view.truth is None else (_off(view, state),)
        rows.append((str(rank), str(support), f"{np.degrees(yaw_of(state[:, :3])):.2f}°", place, *off))
    columns = ("", "explains", "yaw", f"camera ({unit})", *(() if view.truth is None else ("off the truth",)))
    return Table("verified poses", columns, tuple(rows))


BOX_EDGES = np.array([(a, a | 1 << axis) for axis in range(3) for a in range(8) if not a >> axis & 1])
"""(12, 2) corners that the edges of a box join; bit k of a corner's number says at which end of axis k it is."""


def position_plans(view: RunView, stage: PositionStage) -> list[Plan]:
    """One step per level, from the box around the map to the boxes around the camera."""
    out = []
    for rank, level in enumerate(np.unique(stage.level).tolist(), 1):
        left = int(stage.left[stage.level == level][0])
        title = f"{left:,} boxes could hold a better camera" if left != 1 else "One box could hold a better camera"
        out.append(Plan(f"positions-{rank}", title, partial(_level, view, stage, level)))
    return out


def _level(view: RunView, stage: PositionStage, level: int) -> Frame:
    mine = stage.level == level
    boxes, bound, left = stage.boxes_m[mine].astype(float), stage.bound[mine], int(stage.left[mine][0])
    most, count = int(bound.max()), len(view.points)
    size = np.sort(boxes[0, 1] - boxes[0, 0])
    pose = _best_pose(view)
    inside = "" if pose is None else _camera_inside(boxes, camera_centre(pose))
    last = level == stage.level[-1]
    end = (
        f" Smaller boxes are divided in yaw as well: in the end no pose explains more than {stage.upper_bound}."
        if last
        else " Each is halved, and halves that cannot explain more than the best pose are dropped."
    )
    drawn = f" The {len(boxes)} of them that could explain most are drawn." if len(boxes) < left else ""
    boxes_text = "box is" if left == 1 else "boxes are"
    edges = _box_edges(boxes, _shades(bound, stage.support))
    return Frame(
        f"{left:,} {boxes_text} left, {view.length(size[0])} to {view.length(size[2])} long, in which a camera might "
        f"explain more than the {stage.support} matches of the best pose; one of them up to {most} of {count}.{end}",
        f"max over C ∈ box, θ of Σ 1(|el(p − C) − el(v)| ≤ β + ε) · 1(θ ∈ interval) = {most} > {stage.support}",
        view.standing(np.eye(3)) if pose is None else pose,
        view.colors(style.UNDECIDED),
        view.no_matches(),
        note=f"Colour: from grey, one match more than the best pose, to gold, {most}.{inside}{drawn}",
        located=pose is not None,
        items=(edges,),
        focus=Focus("Overview", edges.points.reshape(-1, 3)),
    )


def _best_pose(view: RunView) -> FloatArray | None:
    """The best pose (3, 4) of the search, between the aligned frames."""
    stage = view.trace.stage(ConsensusStage)
    return None if stage is None or not len(stage.cam_from_map) else view.aligned_pose(stage.cam_from_map[0])


def _camera_inside(boxes: FloatArray, centre: FloatArray) -> str:
    inside = ((boxes[:, 0] <= centre) & (centre <= boxes[:, 1])).all(axis=1).any()
    return " The best pose's camera is in one of them." if inside else ""


def _shades(bound: np.ndarray, support: int) -> ByteArray:
    """Colours (B, 3) of boxes: grey for the least bound that exceeds the best support, gold for the largest bound."""
    share = (bound - support) / max(1, int(bound.max()) - support)
    return style.blended(style.UNDECIDED, style.CLIQUE, share)


def _box_edges(boxes: FloatArray, colors: ByteArray) -> Segments:
    ends = np.array([[corner >> axis & 1 for axis in range(3)] for corner in range(8)])
    corners = np.stack([boxes[:, ends[:, axis], axis] for axis in range(3)], axis=2)
    return Segments(
        "boxes/positions", "boxes", corners[:, BOX_EDGES].reshape(-1, 2, 3), np.repeat(colors, 12, axis=0), 1.0
    )
