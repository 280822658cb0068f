"""Exact consensus: the bound over yaw, the largest set of matches that agrees, and the poses that were verified."""

from itertools import combinations

import numpy as np

from spherloc.geometry import camera_centre, yaw_of, yaw_rotation
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.trace import ConsensusStage
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import Frame, RunView, even, one_color
from spherloc_viz.layers.primitives import Chart, Curve, FloatArray, SceneItem, Segments, Step, Table
from spherloc_viz.layers.scene import camera


def frames(view: RunView, stage: ConsensusStage) -> list[Frame]:
    """The bound; then the clique and the poses, where the search has found any."""
    out = [_bound(view, stage)]
    if len(stage.clique):
        out.append(_clique(view, stage))
    if len(stage.support):
        out.append(_poses(view, stage))
    return out


def _most(stage: ConsensusStage) -> int:
    return int(stage.bound.max())


def _best(stage: ConsensusStage) -> int:
    """Correspondences that the best known pose explains."""
    return int(stage.support.max(initial=stage.seed_support))


def _bound(view: RunView, stage: ConsensusStage) -> Frame:
    most, best, start = _most(stage), _best(stage), view.standing(np.eye(3))
    open_share = 100.0 * np.count_nonzero(stage.bound > best) / len(stage.bound)
    left = f"{open_share:.3g} % of all yaws could hide a better one" if open_share else "no yaw could hide a better one"
    return Frame(
        Step(
            "consensus-bound",
            "What no pose can beat, at each yaw",
            f"Matches that one pose explains agree in pairs at its yaw, as {stage.arcs:,} arcs tell, so the largest "
            f"set that agrees at a yaw is a bound: no pose explains more than {most} of {len(view.points)} matches. "
            f"The first guess explains {stage.seed_support} and the best pose {best}, and {left}.",
            f"max over θ of ω(G(θ)) = {most},  ij ∈ G(θ) ⇔ |f_ij(θ)| ≤ τ_ij",
            _effort(stage),
        ),
        start,
        view.colors(style.UNDECIDED),
        view.nobody(),
        extra=lambda: _ring(view, stage, start),
        charts=(chart(view, stage),),
    )


def _effort(stage: ConsensusStage) -> str:
    end = (
        "every yaw that could hide a better pose was searched to its end."
        if stage.finished
        else "the budget ran out before every yaw was searched, so that the bound is larger than it might be."
    )
    return f"Effort: {stage.effort:,} words of bitsets; {end}"


def _clique(view: RunView, stage: ConsensusStage) -> Frame:
    turned = view.standing(yaw_rotation(stage.yaw_rad))
    size, most = len(stage.clique), _most(stage)
    pairs, note = _pairs(stage)
    return Frame(
        Step(
            "consensus-clique",
            "The largest set that agrees",
            _agreement(view, stage),
            f"{size} ≤ max over θ of ω(G(θ)) ≤ {most}",
            note,
        ),
        turned,
        view.colors(style.UNDECIDED, (stage.clique, style.CLIQUE)),
        view.nobody(),
        extra=lambda: (_edges(view, pairs),),
        charts=(chart(view, stage),),
    )


def _agreement(view: RunView, stage: ConsensusStage) -> str:
    """What the largest set is, and what follows."""
    size, most, best = len(stage.clique), _most(stage), _best(stage)
    labels = view.trace.problem.truth_inliers
    right = "" if labels is None else f", {np.count_nonzero(labels[stage.clique])} of them right ones,"
    if size > best:
        return (
            f"{size} matches{right} agree in pairs at some yaw, {size - best} more than the best pose explains. "
            "But pairs that agree need not share one position, and no pose that was tried explains them all."
        )
    yaw, pairs = np.degrees(stage.yaw_rad), size * (size - 1) // 2
    larger = "No larger set agrees at any yaw" if size >= most else f"A larger set, of up to {most}, is not excluded"
    return (
        f"The {size} matches{right} that the best pose explains agree at its yaw of {yaw:.2f}°"
        f"{ring.off_truth(view, stage.yaw_rad)}: each of their {pairs:,} pairs has an arc there. "
        f"{larger}, and that bounds what a better pose could explain."
    )


def _pairs(stage: ConsensusStage) -> tuple[np.ndarray, str]:
    """Pairs (P, 2) of the clique to draw, and the rule by which others are left out."""
    pairs = np.array(list(combinations(stage.clique.tolist(), 2)), dtype=np.int64).reshape(-1, 2)
    drawn = pairs[even(np.arange(len(pairs)), style.MAX_DRAWN_PAIRS)]
    if len(drawn) == len(pairs):
        return drawn, f"All {len(pairs):,} pairs are drawn, as lines on the map."
    return (
        drawn,
        f"An even sample of {len(drawn):,} of {len(pairs):,} pairs is drawn, as lines on the map.",
    )


def _edges(view: RunView, pairs: np.ndarray) -> Segments:
    return Segments("pairs/clique", "pairs", view.points[pairs], one_color(style.CLIQUE, len(pairs)), 1.0)


def _poses(view: RunView, stage: ConsensusStage) -> Frame:
    states = [view.aligned_pose(state) for state in stage.cam_from_map]
    rivals, count = states[1 : 1 + style.MAX_DRAWN_RIVALS], len(states)
    if rivals:
        away, turned = translation_error_m(states[0], states[1]), rotation_error_deg(states[0], states[1])
        other = f"The best other pose, {away:.2f} m and {turned:.1f}° away, explains {stage.support[1]}"
    else:
        other = "No clearly different pose was found beside it"
    note = f"The best and {len(rivals)} of {count - 1:,} other poses are shown." if count > len(rivals) + 1 else ""
    return Frame(
        Step(
            "consensus-poses",
            "The poses that were verified",
            f"The best pose explains {stage.support[0]} of {len(view.points)} matches from {view.position(states[0])}. "
            f"{other}; no pose explains more than {_most(stage)}.",
            f"{_best(stage)} ≤ max over R, t of Σ 1(‖π(R p + t) − u‖ ≤ ε) ≤ {_most(stage)}",
            note,
        ),
        states[0],
        view.colors(style.UNDECIDED, (stage.clique, style.CLIQUE)),
        np.isin(np.arange(len(view.points)), stage.clique),
        located=True,
        extra=lambda: _ghosts(view, rivals),
        charts=(chart(view, stage),),
        tables=(_table(view, stage, [states[0], *rivals]),),
    )


def _ghosts(view: RunView, rivals: list[FloatArray]) -> tuple[SceneItem, ...]:
    if not rivals:
        return ()
    ghosts = [camera("cameras/rivals", state, 1.5 * view.sphere_m, style.RIVAL, 2.0) for state in rivals]
    ends = np.concatenate([ghost.points for ghost in ghosts])
    return (Segments("cameras/rivals", "cameras", ends, one_color(style.RIVAL, len(ends)), 2.0),)


def _table(view: RunView, stage: ConsensusStage, states: list[FloatArray]) -> Table:
    rows = []
    for rank, (state, support) in enumerate(zip(states, stage.support, strict=False), 1):
        centre = camera_centre(view.trace.problem.aligned.unalign_pose(state))
        place = " ".join(f"{value:.2f}" for value in centre)
        off = () if view.truth is None else (f"{translation_error_m(view.truth, state):.3f} m",)
        rows.append((str(rank), str(support), f"{np.degrees(yaw_of(state[:, :3])):.2f}°", place, *off))
    columns = ("", "explains", "yaw", "camera (m)", *(() if view.truth is None else ("off the truth",)))
    return Table("verified poses", columns, tuple(rows))


def chart(view: RunView, stage: ConsensusStage) -> Chart:
    """The bound over yaw, what the first guess and the best pose explain, the truth and the estimate."""
    peak, ends = float(max(_most(stage), 1)), np.array([-180.0, 180.0])
    curves = [
        ring.step_curve("bound", stage.bound),
        Curve("first guess", ends, np.full(2, float(stage.seed_support)), style.SAMPLE, "level"),
        Curve("best pose", ends, np.full(2, float(_best(stage))), style.INLIER, "level"),
        *ring.markers(view, peak, _yaw(stage)),
    ]
    return Chart("consensus", "No pose with this yaw explains more than", "yaw (°)", "matches", tuple(curves))


def _yaw(stage: ConsensusStage) -> float | None:
    """Yaw of the best pose, if there is one."""
    return stage.yaw_rad if len(stage.support) else None


def _ring(view: RunView, stage: ConsensusStage, cam_from_map: FloatArray) -> tuple[SceneItem, ...]:
    """The bound around the sphere, where it is largest in the colour of the clique, and the best pose's support as a
    circle: what pokes out of it could hide a better pose."""
    centre, heights, most = camera_centre(cam_from_map), ring.by_degree(stage.bound), max(1, _most(stage))
    feet, tops = ring.circle(view, centre, np.zeros(())), ring.circle(view, centre, heights / most)
    colors = one_color(style.UNDECIDED, len(feet))
    colors[heights == most] = style.CLIQUE
    support = ring.circle(view, centre, np.array(_best(stage) / most))
    return (
        ring.bars("ring/bars", feet, tops, colors),
        ring.outline("ring/bound", tops, style.SPHERE),
        ring.outline("ring/support", support, style.INLIER),
        *ring.spokes(view, centre, _yaw(stage)),
    )
