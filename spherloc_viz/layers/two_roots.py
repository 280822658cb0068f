"""One pair of matches and the two yaws at which its rays can meet their points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spherloc.geometry import wrap_angle, yaw_rotation
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.arcs import Arcs
from spherloc_viz.layers.frame import Frame, RunView, one_color, ring_focus
from spherloc_viz.layers.primitives import Chart, SceneItem, Segments


@dataclass(frozen=True, eq=False)
class PairRoots:
    """Eq. 22 of two correspondences."""

    wave: FloatArray
    """(d1, d2, d3)."""
    yaws_rad: FloatArray
    """(0 or 2,) roots, in [-pi, pi)."""
    in_front: np.ndarray
    """(0 or 2,) whether both points are in front of the camera there."""


def pair_roots(view: RunView, first: int, second: int) -> PairRoots:
    """Where the wave of two correspondences is zero."""
    aligned = view.trace.problem.aligned
    vi, vj = aligned.bearings[np.searchsorted(aligned.index, [first, second])]
    d, n = view.points[first] - view.points[second], np.cross(vi, vj)
    wave = np.array([n[0] * d[0] + n[2] * d[2], n[0] * d[2] - n[2] * d[0], n[1] * d[1]])
    rho = float(np.hypot(wave[0], wave[1]))
    if rho == 0.0 or abs(wave[2]) > rho:
        return PairRoots(wave, np.zeros(0), np.zeros(0, dtype=bool))
    half = float(np.arccos(-wave[2] / rho))
    yaws = np.asarray(wrap_angle(np.arctan2(wave[1], wave[0]) + half * np.array([1.0, -1.0])))
    # R d = s_i v_i - s_j v_j has both depths positive if both points are in front.
    rays = np.column_stack([vi, -vj])
    depths = np.array([np.linalg.lstsq(rays, yaw_rotation(yaw) @ d, rcond=None)[0] for yaw in yaws])
    return PairRoots(wave, yaws, np.all(depths > 0.0, axis=1))


def charts(view: RunView, arcs: Arcs, chart: Callable[[RunView, np.ndarray], Chart]) -> dict[str, Callable[[], Chart]]:
    """The overlap of the pair's own arcs."""
    return {"yaw": lambda: chart(view, arcs.overlap_of(arcs.example).overlap)}


def pair(view: RunView, arcs: Arcs) -> Frame:
    """A pair, and the arc of yaws that it allows."""
    example, stage = arcs.example, arcs.stage
    first, second = (int(number) for number in stage.pairs[example[0]])
    k = int(example[np.argmax(arcs.in_clique[example])])
    lo, hi = np.degrees(stage.lo_rad[k]), np.degrees(stage.hi_rad[k])
    also = ", and a second arc" if len(example) > 1 else ""
    d1, d2, d3 = pair_roots(view, first, second).wave
    return Frame(
        f"Matches {first} and {second} can both be right only where the line between their points turns into the plane "
        f"of their bearings, and that fixes the yaw. With {view.trace.options.bound_px:.3g} px of noise it is an arc "
        f"of {hi - lo:.2g}°, from {lo:.2f}° to {hi:.2f}°{also}.",
        f"{d1:.3g} cos θ {_signed(d2)} sin θ {_signed(d3)} = 0   (Eq. 22)",
        *_shown(view, (first, second), 0.5 * float(stage.lo_rad[k] + stage.hi_rad[k])),
        note=stage.rule,
        items=(
            *_items(view, arcs, np.array([k]), (first, second)),
            ring.name(
                "ring/name", view, 0.5 * float(stage.lo_rad[k] + stage.hi_rad[k]), "arc: the yaws this pair allows"
            ),
        ),
        focus=ring_focus(view, view.points[[first, second]]),
    )


def roots(view: RunView, arcs: Arcs) -> Frame:
    """All arcs of the pair, and how many arcs pairs have."""
    example, stage = arcs.example, arcs.stage
    first, second = (int(number) for number in stage.pairs[example[0]])
    found = pair_roots(view, first, second)
    one, several = arcs.pair_counts
    none = stage.pairs_total - one - several
    other = example[np.argmin(arcs.in_clique[example])]
    return Frame(
        f"{_why(found, len(example))} Of all {stage.pairs_total:,} pairs, {several:,} have two arcs or more, {one:,} "
        f"have one, and {none:,} have none.",
        "θ = atan2(d2, d1) ± arccos(−d3 / √(d1² + d2²))   (Eq. 22-23)",
        *_shown(view, (first, second), 0.5 * float(stage.lo_rad[other] + stage.hi_rad[other])),
        note=stage.rule,
        items=_items(view, arcs, example, (first, second)),
        focus=ring_focus(view, view.points[[first, second]]),
    )


def _why(roots: PairRoots, arcs: int) -> str:
    """Why the pair has as many arcs as it has, as a sentence."""
    if len(roots.yaws_rad) == 0:
        return "The wave of this pair only comes near zero, so it has no exact root."
    one, two = (f"{value:.2f}°" for value in np.degrees(roots.yaws_rad))
    wave = f"A wave crosses zero twice in a turn, so the pair has two roots, {one} and {two}"
    if roots.in_front.all() and arcs > 1:
        return f"{wave}, and both put its points in front of the camera: only other matches tell the two apart."
    if roots.in_front.all():
        return f"{wave}, but the arc around one of them is too wide to say much."
    behind = two if roots.in_front[0] else one
    return f"{wave}, but {behind} would put a point behind the camera."


def _signed(value: float) -> str:
    return f"{'−' if value < 0 else '+'} {abs(value):.3g}"


def _shown(view: RunView, numbers: tuple[int, int], yaw_rad: float) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """The sphere at a yaw, the pair in its colour, and its rays."""
    mask = view.mask(np.array(numbers))
    return view.standing(yaw_rotation(yaw_rad)), view.colors(style.UNDECIDED, (mask, style.SAMPLE)), mask


def _items(view: RunView, arcs: Arcs, shown: np.ndarray, numbers: tuple[int, int]) -> tuple[SceneItem, ...]:
    """Some arcs of the pair with a spoke through each, and the line between its points."""
    middles = 0.5 * (arcs.stage.lo_rad + arcs.stage.hi_rad)[shown]
    spokes = [ring.spoke("ring/candidate", view, view.middle, float(yaw), style.SAMPLE).points for yaw in middles]
    marked = np.ones(len(shown), dtype=bool)
    ends = view.points[list(numbers)][None]
    ids = np.array([numbers], dtype=np.int64)
    return (
        arcs.drawn(view, shown, marked, style.SAMPLE),
        ring.outline("ring/overlap", ring.circle(view, view.middle, np.zeros(())), style.SPHERE),
        Segments("ring/candidate", "yaw ring", np.concatenate(spokes), one_color(style.SAMPLE, len(spokes)), 4.0),
        *ring.spokes(view, view.middle, None),
        Segments("pairs/sample", "pairs", ends, one_color(style.SAMPLE, 1), 3.0, ids=ids),
    )
