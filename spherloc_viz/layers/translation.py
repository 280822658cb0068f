"""Translation: the balls of feasible camera positions, their overlaps, and the maximum clique."""

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.trace import TranslationStage, YawStage
from spherloc_viz import style
from spherloc_viz.layers import yaw
from spherloc_viz.layers.frame import Frame, RunView, even, one_color
from spherloc_viz.layers.primitives import Balls, Points, SceneItem, Segments, Step


def frames(view: RunView, stage: TranslationStage) -> list[Frame]:
    """All balls, then their maximum clique."""
    start = view.aligned_pose(stage.cam_from_map)
    yaw_stage = view.trace.stage(YawStage)
    charts = () if yaw_stage is None else (yaw.chart(view, yaw_stage, found=True),)
    members = np.unique(stage.pairs[stage.clique])
    drawn = _drawn(stage)
    note = _note(stage, drawn)
    largest = "the largest such set" if stage.proven else "the largest set found before the search reached its limit"
    inside = view.colors(style.UNDECIDED, (np.unique(stage.pairs), style.CLIQUE))
    return [
        Frame(
            Step(
                "balls",
                "Balls of camera positions",
                f"With the yaw known, each pair says where the camera is, up to a ball; {len(stage.edges):,} pairs of "
                f"balls overlap. Small balls come from near points under a wide angle, and inliers share one spot.",
                "H t = b,  |t_k − t| ≤ r_k   (Eq. 24-27)",
                note,
            ),
            view.standing(start[:, :3]),
            inside,
            view.nobody(),
            extra=lambda: _balls(view, stage, drawn, found=False),
            charts=charts,
        ),
        Frame(
            Step(
                "clique",
                "The maximum clique of balls",
                f"{len(stage.clique):,} of {len(stage.radii_m):,} balls overlap pairwise, from {len(members)} matches: "
                f"{largest}. The best of its pairs puts the camera at {view.position(start)}.",
                "‖t_k1 − t_k2‖ ≤ r_k1 + r_k2   (Eq. 38)",
                note,
            ),
            start,
            view.colors(style.UNDECIDED, (members, style.CLIQUE)),
            view.nobody(),
            located=True,
            sphere_aside=True,
            extra=lambda: _balls(view, stage, drawn, found=True),
            charts=charts,
        ),
    ]


def _note(stage: TranslationStage, drawn: np.ndarray) -> str:
    """By which rules balls were left out."""
    if len(drawn) == len(stage.radii_m):
        return stage.rule
    return (
        f"{stage.rule} {len(drawn)} of {len(stage.radii_m):,} balls are drawn with the overlaps between them: an even "
        "sample of the smaller half of the clique, and of the others; of the rest only the centres."
    )


def _drawn(stage: TranslationStage) -> np.ndarray:
    """Indices of the balls to draw: of the clique and of the others an even sample of the smaller half.

    Large balls hold the whole picture in them and hide it.
    """
    order = np.argsort(stage.radii_m, kind="stable")
    if len(order) <= style.MAX_DRAWN_BALLS:
        return order
    inside = np.isin(order, stage.clique)
    halves = [group[: max(1, len(group) // 2)] for group in (order[inside], order[~inside])]
    take = min(len(halves[0]), max(style.MAX_DRAWN_BALLS // 2, style.MAX_DRAWN_BALLS - len(halves[1])))
    return np.concatenate([even(halves[0], take), even(halves[1], style.MAX_DRAWN_BALLS - take)])


def _balls(view: RunView, stage: TranslationStage, drawn: np.ndarray, found: bool) -> tuple[SceneItem, ...]:
    inside = np.zeros(len(stage.radii_m), dtype=bool)
    if found:
        inside[stage.clique] = True
    items: list[SceneItem] = [_edges(stage, drawn, inside)]
    dot_m = min(0.02 * view.sphere_m, 0.1 * float(np.median(stage.radii_m[drawn])))
    for name, members, color, opacity in (
        ("balls/others", ~inside, style.UNDECIDED, 0.10),
        ("balls/clique", inside, style.CLIQUE, 0.16),
    ):
        chosen = drawn[members[drawn]]
        centres = stage.centres_m[members]
        if len(chosen):
            colors = one_color(color, len(chosen))
            items.append(Balls(name, "balls", stage.centres_m[chosen], stage.radii_m[chosen], colors, opacity))
        if len(centres):
            dots = one_color(color, len(centres))
            items.append(Points(f"{name}-centres", "balls", centres, dots, dot_m))
    if view.truth is not None:
        truth = camera_centre(view.truth)[None]
        items.append(Points("balls/truth", "balls", truth, one_color(style.TRUTH, 1), 2.0 * dot_m))
    return tuple(items)


def _edges(stage: TranslationStage, drawn: np.ndarray, inside: np.ndarray) -> Segments:
    """Overlaps between the drawn balls."""
    visible = np.zeros(len(stage.radii_m), dtype=bool)
    visible[drawn] = True
    edges = stage.edges[np.logical_and(visible[stage.edges[:, 0]], visible[stage.edges[:, 1]])]
    colors = one_color(style.UNDECIDED, len(edges))
    colors[np.logical_and(inside[edges[:, 0]], inside[edges[:, 1]])] = style.CLIQUE
    return Segments("balls/edges", "balls", stage.centres_m[edges], colors, 1.5)
