"""The ring around the sphere, on which something is shown over yaw, and the chart that shows the same.

On the ring, the direction of a yaw is where the camera looks with that yaw.
"""

import numpy as np

from spherloc.geometry import wrap_angle, yaw_of
from spherloc_viz import style
from spherloc_viz.layers.frame import RunView, one_color
from spherloc_viz.layers.primitives import ColorArray, Curve, FloatArray, Segments

FOOT = 2.05
"""Radius at which the outline has the height 0, in sphere radii."""
HEIGHT = 0.9
"""Height of the outline at its peak, in sphere radii."""
DEGREES = 360
"""Corners of the outline."""


def directions(yaw_rad: FloatArray) -> FloatArray:
    """Where the camera looks (N, 3) with the yaws (N,): R^T e_z."""
    return np.column_stack([-np.sin(yaw_rad), np.zeros_like(yaw_rad), np.cos(yaw_rad)])


def by_degree(counts: np.ndarray) -> np.ndarray:
    """The largest of the counts (K,), K a multiple of 360, within each degree (360,)."""
    return counts.reshape(DEGREES, -1).max(axis=1)


def circle(view: RunView, centre: FloatArray, heights: FloatArray) -> FloatArray:
    """Points (360, 3) around the ring, one a degree, at heights (360,) or () of which 1 is the peak."""
    radius = np.broadcast_to(FOOT + HEIGHT * np.asarray(heights), DEGREES)
    yaws = np.radians(np.arange(DEGREES) - 179.5)
    return centre + view.sphere_m * radius[:, None] * directions(yaws)


def outline(name: str, line: FloatArray, color: style.RGB) -> Segments:
    """The closed line through the points (K, 3)."""
    points = np.stack([line, np.roll(line, -1, axis=0)], axis=1)
    return Segments(name, "yaw ring", points, one_color(color, len(line)), 2.5)


def bars(name: str, feet: FloatArray, tops: FloatArray, colors: ColorArray) -> Segments:
    """Lines from the foot of the outline to it, (360, 3) each."""
    return Segments(name, "yaw ring", np.stack([feet, tops], axis=1), colors, 2.0)


def spokes(view: RunView, centre: FloatArray, yaw_rad: float | None) -> list[Segments]:
    """Where the camera looks with the estimated yaw, if there is one yet, and with the true one, if that is known."""
    out = [] if yaw_rad is None else [_spoke("ring/estimate", view, centre, yaw_rad, style.ESTIMATE)]
    if view.truth is not None:
        out.append(_spoke("ring/truth", view, centre, yaw_of(view.truth[:, :3]), style.TRUTH))
    return out


def _spoke(name: str, view: RunView, centre: FloatArray, yaw_rad: float, color: style.RGB) -> Segments:
    radii = view.sphere_m * np.array([1.0, FOOT + HEIGHT + 0.15])
    ends = centre + radii[:, None] * directions(np.array([yaw_rad]))
    return Segments(name, "yaw ring", ends[None], one_color(color, 1), 4.0)


def step_curve(label: str, counts: np.ndarray) -> Curve:
    """Counts over all yaws as a curve in degrees."""
    yaws = np.degrees(np.linspace(-np.pi, np.pi, len(counts) + 1)[:-1])
    return Curve(label, yaws, counts.astype(np.float64), style.UNDECIDED, "step")


def markers(view: RunView, height: float, yaw_rad: float | None) -> list[Curve]:
    """The true yaw, if it is known, and the estimated one, if there is one yet, in a chart."""
    out = []
    if view.truth is not None:
        out.append(_marker("truth", yaw_of(view.truth[:, :3]), height, style.TRUTH))
    if yaw_rad is not None:
        out.append(_marker("estimate", yaw_rad, height, style.ESTIMATE))
    return out


def _marker(label: str, yaw_rad: float, height: float, color: style.RGB) -> Curve:
    return Curve(label, np.array([np.degrees(yaw_rad)]), np.array([height]), color, "marker")


def off_truth(view: RunView, yaw_rad: float) -> str:
    """How far a yaw is from the true one, as part of a sentence; empty if that is unknown."""
    if view.truth is None:
        return ""
    return f", {abs(np.degrees(wrap_angle(yaw_rad - yaw_of(view.truth[:, :3])))):.2f}° from the truth"
