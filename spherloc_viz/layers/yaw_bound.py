"""The bound of the exact consensus over yaw: what no pose can beat, and the yaws at which it is highest."""

from functools import partial

import numpy as np

from spherloc.geometry import yaw_rotation
from spherloc.trace import ConsensusStage
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import Frame, Plan, RunView, one_color
from spherloc_viz.layers.primitives import Chart, Curve, SceneItem

PEAKS = 16
"""At most so many peaks of the bound are visited."""
REACH = 10
"""A peak is the highest within so many quarters of a degree."""


def highest_bound(stage: ConsensusStage) -> int:
    """No pose explains more correspondences."""
    return int(stage.bound.max())


def best_support(stage: ConsensusStage) -> int:
    """Correspondences that the best known pose explains."""
    return int(stage.support.max(initial=stage.seed_support))


def plans(view: RunView, stage: ConsensusStage) -> list[Plan]:
    """The first guess, the bound, and its peaks from the highest down."""
    charts = {"consensus": partial(chart, view, stage)}
    out = [
        Plan("consensus-guess", "The first guess", lambda: _guess(view, stage)),
        Plan("consensus-bound", "What no pose can beat, at each yaw", lambda: _bound(view, stage), charts),
    ]
    peaks = ring.peaks(stage.bound, REACH, PEAKS)
    for rank, place in enumerate(peaks.tolist(), 1):
        yaw = ring.degrees_of(place + 0.5, len(stage.bound))
        title = f"At {yaw:.1f}°: at most {stage.bound[place]}"
        with_candidate = {"consensus": partial(chart, view, stage, candidate_rad=np.radians(yaw))}
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
        view.nobody(),
    )


def _bound(view: RunView, stage: ConsensusStage) -> Frame:
    most, best, start = highest_bound(stage), best_support(stage), view.standing(np.eye(3))
    open_share = 100.0 * np.count_nonzero(stage.bound > best) / len(stage.bound)
    left = f"{open_share:.3g} % of all yaws could hide a better one" if open_share else "no yaw could hide a better one"
    if stage.arcs:
        why = (
            f"Matches that one pose explains agree in pairs at its yaw, as {stage.arcs:,} arcs tell, so the largest "
            "set that agrees at a yaw is a bound"
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
        view.nobody(),
        note=_effort(stage),
        items=(
            *_ring(view, stage),
            ring.name("ring/name", view, stage.yaw_rad + np.pi, "bound: most matches at each yaw"),
        ),
    )


def _effort(stage: ConsensusStage) -> str:
    end = (
        "every yaw that could hide a better pose was searched to its end."
        if stage.finished
        else "the budget ran out before every yaw was searched, so that the bound is larger than it might be."
    )
    what = "words of bitsets and tests of a match" if stage.arcs else "tests of a match"
    return f"Effort: {stage.effort:,} {what}; {end}"


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
        view.nobody(),
        note=f"Yaws are searched by falling bound until none could hide a better pose.{rest}",
        items=(
            *_ring(view, stage, place),
            ring.spoke("ring/candidate", view, view.middle, yaw, style.SAMPLE),
        ),
    )


def chart(view: RunView, stage: ConsensusStage, candidate_rad: float | None = None) -> Chart:
    """The bound over yaw, what the first guess and the best pose explain, the truth, the estimate, a candidate yaw."""
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
    """The bound around the sphere, where it is largest in the colour of the clique, or in that of a sample at one
    place, and the best pose's support as a circle: what pokes out of it could hide a better pose."""
    centre, heights, most = view.middle, ring.by_degree(stage.bound), max(1, highest_bound(stage))
    feet, tops = ring.circle(view, centre, np.zeros(())), ring.circle(view, centre, heights / most)
    colors = one_color(style.UNDECIDED, len(feet))
    if place is None:
        colors[heights == most] = style.CLIQUE
    else:
        colors[place * len(feet) // len(stage.bound)] = style.SAMPLE
    support = ring.circle(view, centre, np.array(best_support(stage) / most))
    return (
        ring.bars("ring/bars", feet, tops, colors),
        ring.outline("ring/bound", tops, style.SPHERE),
        ring.outline("ring/support", support, style.INLIER),
        *ring.spokes(view, centre, _yaw(stage)),
    )
