"""The yaw ring around the sphere, which shows a count over yaw, and the chart of the same count.

On the ring, the direction of a yaw is where the camera looks with that yaw.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from spherloc.geometry import wrap_angle, yaw_of
from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import RunView, one_color
from spherloc_viz.layers.primitives import Curve, Label, SceneItem, Segments

FOOT = 2.05
"""Radius at which the outline has the height 0, in sphere radii."""
HEIGHT = 0.9
"""Height of the outline at its peak, in sphere radii."""
END = FOOT + HEIGHT + 0.15
"""Radius at which lines through the ring end, in sphere radii."""
BEYOND = END + 0.5
"""Radius at which the line of the true yaw ends where another one would hide it, in sphere radii."""
TRUTH = "ring/truth"
"""Name of the line of the true yaw."""
HIDES_RAD = np.radians(4.0)
"""Least angle between two lines that can be told apart."""
PIECE_RAD = np.radians(2.5)
"""Largest angle between the lines that fill a piece of the ring."""
DEGREES = 360
"""Number of points of the outline."""
GOLDEN = 0.6180339887498949
"""Golden ratio: the fractional parts of its multiples are spread evenly, however many are taken."""


def directions(yaw_rad: FloatArray) -> FloatArray:
    """Directions (N, 3) in which the camera looks with the yaws (N,): R^T e_z."""
    return np.column_stack([-np.sin(yaw_rad), np.zeros_like(yaw_rad), np.cos(yaw_rad)])


_EVERY_DEGREE = directions(np.radians(np.arange(DEGREES) - 179.5))
_CIRCLE = directions(np.radians(np.arange(-180, 180, 5)))


def by_degree(counts: np.ndarray) -> np.ndarray:
    """The largest of the counts (K,), K a multiple of 360, within each degree (360,)."""
    return counts.reshape(DEGREES, -1).max(axis=1)


def circle(view: RunView, centre: FloatArray, heights: FloatArray) -> FloatArray:
    """Points (360, 3) around the ring, one per degree, at heights (360,) or (), where 1 is that of the peak."""
    radius = np.broadcast_to(FOOT + HEIGHT * np.asarray(heights), DEGREES)
    return centre + view.sphere_m * radius[:, None] * _EVERY_DEGREE


def circle_of(view: RunView, centre: FloatArray, radius: float) -> FloatArray:
    """Points (72, 3) around the sphere at a radius in sphere radii."""
    return centre + view.sphere_m * radius * _CIRCLE


def loop(name: str, layer: str, line: FloatArray, color: style.RGB) -> Segments:
    """The closed line through the points (K, 3)."""
    points = np.stack([line, np.roll(line, -1, axis=0)], axis=1)
    return Segments(name, layer, points, one_color(color, len(line)), 2.5)


def outline(name: str, line: FloatArray, color: style.RGB) -> Segments:
    """A closed line of the ring through the points (K, 3)."""
    return loop(name, "yaw ring", line, color)


def pieces(name: str, view: RunView, lo_rad: FloatArray, hi_rad: FloatArray) -> Segments:
    """The pieces of the ring from yaws (A,) to yaws (A,), and lines from the sphere to them."""
    yaws = [np.linspace(lo, hi, 2 + int((hi - lo) / PIECE_RAD)) for lo, hi in zip(lo_rad, hi_rad, strict=True)]
    outer = [FOOT * directions(some) for some in yaws]
    along = np.concatenate([np.stack([some[:-1], some[1:]], axis=1) for some in outer])
    across = np.concatenate([np.stack([some / FOOT, some], axis=1) for some in outer])
    lines = view.middle + view.sphere_m * np.concatenate([along, across])
    return Segments(name, "yaw ring", lines, one_color(style.SAMPLE, len(lines)), 2.0)


def bars(name: str, feet: FloatArray, tops: FloatArray, colors: ByteArray) -> Segments:
    """Lines from the foot of the outline to it, (360, 3) each."""
    return Segments(name, "yaw ring", np.stack([feet, tops], axis=1), colors, 2.0)


def spokes(
    view: RunView, centre: FloatArray, yaw_rad: float | None, candidates_rad: Iterable[float] = ()
) -> list[Segments]:
    """Lines in the directions of the estimated yaw, if there is one yet, and of the true one, if that is known. A line
    that would hide another one or a candidate's is drawn only beyond its end."""
    out = [] if yaw_rad is None else [spoke("ring/estimate", view, centre, yaw_rad, style.ESTIMATE)]
    if view.truth is not None:
        true_rad = yaw_of(view.truth[:, :3])
        others = [*candidates_rad, *([] if yaw_rad is None else [yaw_rad])]
        begin, end = (END, BEYOND) if _hides_truth(view, others) else (1.0, END)
        out.append(spoke(TRUTH, view, centre, true_rad, style.TRUTH, begin, end))
    return out


def _hides_truth(view: RunView, yaws_rad: Sequence[float]) -> bool:
    """Whether the line of one of these yaws would hide that of the true one."""
    if view.truth is None:
        return False
    return bool(np.any(np.cos(np.array(yaws_rad) - yaw_of(view.truth[:, :3])) > np.cos(HIDES_RAD)))


def true_ends(items: Iterable[SceneItem]) -> list[FloatArray]:
    """Both ends (2, 3) of the line of the true yaw, if there is one among the items."""
    return [item.points[0] for item in items if isinstance(item, Segments) and item.name == TRUTH]


def spoke(
    name: str,
    view: RunView,
    centre: FloatArray,
    yaw_rad: float,
    color: style.RGB,
    begin: float = 1.0,
    end: float = END,
) -> Segments:
    """A line in the direction of a yaw, from the sphere through the ring, or between two radii."""
    radii = view.sphere_m * np.array([begin, end])
    ends = centre + radii[:, None] * directions(np.array([yaw_rad]))
    return Segments(name, "yaw ring", ends[None], one_color(color, 1), 4.0)


def name(path: str, view: RunView, yaw_rad: float, words: str, counts: np.ndarray | None = None) -> Label:
    """A label outside the ring at a yaw: beyond the lines that end there, or right at the outline of ``counts`` (K,),
    over all yaws."""
    radius = BEYOND if _hides_truth(view, [yaw_rad]) else END
    if counts is not None:
        heights = by_degree(counts) / max(1, int(counts.max()))
        radius = FOOT + HEIGHT * float(heights[int(np.degrees(wrap_angle(yaw_rad)) + 180.0) % DEGREES])
    place = view.middle + view.sphere_m * radius * directions(np.array([yaw_rad]))[0]
    return Label(path, "yaw ring", place - np.array([0.0, 0.25 * view.sphere_m, 0.0]), words)


def step_curve(label: str, counts: np.ndarray) -> Curve:
    """Counts over all yaws as a curve in degrees."""
    yaws = np.linspace(-180.0, 180.0, len(counts) + 1)[:-1]
    return Curve(label, yaws, counts.astype(np.float64), style.UNDECIDED, "step")


ESTIMATE = "estimate"
"""Label of the estimated yaw's marker in a chart."""


def markers(view: RunView, height: float, yaw_rad: float | None) -> list[Curve]:
    """The true yaw, if it is known, and the estimated one, if there is one yet, in a chart."""
    out = []
    if view.truth is not None:
        out.append(marker("truth", yaw_of(view.truth[:, :3]), height, style.TRUTH))
    if yaw_rad is not None:
        out.append(marker(ESTIMATE, yaw_rad, height, style.ESTIMATE))
    return out


def marker(label: str, yaw_rad: float, height: float, color: style.RGB) -> Curve:
    """A marker of a yaw in a chart."""
    return Curve(label, np.array([np.degrees(yaw_rad)]), np.array([height]), color, "marker")


def off_truth(view: RunView, yaw_rad: float) -> str:
    """Difference of a yaw from the true one, as part of a sentence; empty if that is unknown."""
    if view.truth is None:
        return ""
    return f", {abs(np.degrees(wrap_angle(yaw_rad - yaw_of(view.truth[:, :3])))):.2f}° from the truth"


def peaks(counts: np.ndarray, reach: int, most: int) -> np.ndarray:
    """Indices of the ``most`` highest peaks of counts (K,) around the circle, highest first.

    At a peak no count within ``reach`` places is larger, and no other peak is that close. Equal ones come in an order
    that jumps around the circle, so that a few of many do not lie side by side.
    """
    highest, width = np.concatenate([counts[-reach:], counts, counts[:reach]]), 1
    while width <= 2 * reach:  # the highest of ``width`` places in a row, each time of up to twice as many
        step = min(width, 2 * reach + 1 - width)
        highest, width = np.maximum(highest[:-step], highest[step:]), width + step
    candidates = np.flatnonzero((counts == highest) & (counts > 0))
    candidates = candidates[np.lexsort((candidates * GOLDEN % 1.0, -counts[candidates]))]
    found: list[int] = []
    near: set[int] = set()
    for place in candidates.tolist():
        if len(found) == most:
            break
        if place not in near:
            found.append(place)
            near.update(other % len(counts) for other in range(place - reach, place + reach + 1))
    return np.array(found, dtype=np.int64)


def degrees_of(place: float, places: int) -> float:
    """Yaw, in degrees, where the given one of ``places`` equal parts of the circle begins."""
    return -180.0 + 360.0 * place / places
