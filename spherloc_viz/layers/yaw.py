"""Yaw: the ring of arcs around the sphere, and how many overlap at each yaw."""

import numpy as np

from spherloc.geometry import camera_centre, yaw_rotation
from spherloc.trace import YawStage
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import Frame, RunView, even, one_color
from spherloc_viz.layers.primitives import Chart, FloatArray, SceneItem, Segments, Step

INNER, OUTER = 1.3, 1.95
"""Radii of the band of arcs, in sphere radii."""
STEP_RAD = np.radians(4.0)


def frames(view: RunView, stage: YawStage) -> list[Frame]:
    """All arcs, then the deepest overlap."""
    pairs, arcs = stage.pairs_total, len(stage.lo_rad)
    members = np.unique(stage.pairs[stage.clique])
    start, turned = view.standing(np.eye(3)), view.standing(yaw_rotation(stage.yaw_rad))
    drawn = _drawn(stage)
    note = stage.rule
    if len(drawn) < arcs:
        note += f" An even sample of {len(drawn)} of {arcs:,} arcs is drawn, half of them from the clique."
    width = np.degrees(float(np.median(stage.hi_rad - stage.lo_rad)))
    yaw = np.degrees(stage.yaw_rad)
    interval = np.degrees(stage.best_rad[1] - stage.best_rad[0])
    off = ring.off_truth(view, stage.yaw_rad)
    return [
        Frame(
            Step(
                "yaw-arcs",
                "Yaw arcs of all pairs",
                f"Two matches fix the yaw up to their noise: {pairs:,} pairs give {arcs:,} arcs, {width:.1f}° wide at "
                f"the median. The ring shows where the camera would look; the outline counts the arcs.",
                "|d1 cos θ + d2 sin θ + d3| ≤ τ   (Eq. 22, 33)",
                note,
            ),
            start,
            view.colors(style.UNDECIDED),
            view.nobody(),
            extra=lambda: _ring(view, stage, start, found=False),
            charts=(chart(view, stage, found=False),),
        ),
        Frame(
            Step(
                "yaw-clique",
                "The yaw most arcs share",
                f"{len(stage.clique):,} arcs overlap at {yaw:.2f}°{off}; no other yaw lies in more. "
                f"They are a maximum clique of the rotation graph and agree on an interval of {interval:.2g}°.",
                "max over θ of Σ 1(|f(θ)| ≤ τ)   (Eq. 34, 37)",
                note,
            ),
            turned,
            view.colors(style.UNDECIDED, (members, style.CLIQUE)),
            view.nobody(),
            extra=lambda: _ring(view, stage, turned, found=True),
            charts=(chart(view, stage, found=True),),
        ),
    ]


def chart(view: RunView, stage: YawStage, found: bool) -> Chart:
    """Overlap count over yaw, with the truth and, once found, the estimate."""
    peak = float(stage.overlap.max(initial=1))
    curves = [
        ring.step_curve("arcs that overlap", stage.overlap),
        *ring.markers(view, peak, stage.yaw_rad if found else None),
    ]
    return Chart("yaw", "Arcs that overlap at each yaw", "yaw (°)", "arcs", tuple(curves))


def _drawn(stage: YawStage) -> np.ndarray:
    """Indices of the arcs to draw: an even sample of the clique's and of the others, ordered by their middles."""
    middles = 0.5 * (stage.lo_rad + stage.hi_rad)
    inside = np.zeros(len(middles), dtype=bool)
    inside[stage.clique] = True
    order = np.argsort(middles, kind="stable")
    members, others = order[inside[order]], order[~inside[order]]
    room = style.MAX_DRAWN_ARCS
    take = min(len(members), max(room // 2, room - len(others)))
    return np.concatenate([even(members, take), even(others, room - take)])


def _ring(view: RunView, stage: YawStage, cam_from_map: FloatArray, found: bool) -> tuple[SceneItem, ...]:
    centre, drawn = camera_centre(cam_from_map), _drawn(stage)
    tracks = INNER + (OUTER - INNER) * (np.arange(len(drawn)) + 0.5) / max(1, len(drawn))
    steps = np.maximum(1, np.ceil((stage.hi_rad - stage.lo_rad)[drawn] / STEP_RAD)).astype(int)
    arc = np.repeat(np.arange(len(drawn)), steps)
    part = np.arange(len(arc)) - np.repeat(np.cumsum(steps) - steps, steps)
    width = (stage.hi_rad - stage.lo_rad)[drawn][arc] / steps[arc]
    ends = stage.lo_rad[drawn][arc][:, None] + width[:, None] * (part[:, None] + np.array([0.0, 1.0]))
    points = centre + view.sphere_m * tracks[arc][:, None, None] * ring.directions(ends.ravel()).reshape(-1, 2, 3)
    colors = one_color(style.UNDECIDED, len(arc))
    if found:
        colors[np.isin(drawn, stage.clique)[arc]] = style.CLIQUE
    heights = ring.by_degree(stage.overlap)
    line = ring.circle(view, centre, heights / max(1, int(heights.max())))
    return (
        Segments("ring/arcs", "yaw ring", points, colors, 2.0),
        ring.outline("ring/overlap", line, style.SPHERE),
        *ring.spokes(view, centre, stage.yaw_rad if found else None),
    )
