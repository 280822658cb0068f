"""The error of a pose, and its uncertainty by its covariance: in words, as a table and on the canvas."""

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.metrics import rotation_error_deg
from spherloc.trace import RefinementStage
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, RunView, angle_text, length, one_color
from spherloc_viz.layers.primitives import Label, Points, SceneItem, Segments, Table

LAYER = "uncertainty"
SIGMAS = 3.0
"""Half axes of the ellipsoid, in standard deviations."""
VISIBLE = 0.45
"""Length, in sphere radii, to which a drawn error is magnified."""
FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
ROOM = 3.0
"""An error that would be longer than this, in sphere radii, is not magnified."""
CORNERS = 40
"""Number of points of each ellipse."""
AHEAD = 2.2
"""Length of the viewing directions, in sphere radii."""
BESIDE = 1.2
"""Distance of labels below the drawing, in sphere radii, so that they do not hide it from afar either."""
ARC_STEP_RAD = np.radians(3.0)


def is_close_up(frame: Frame) -> bool:
    """Whether the step is about the sphere, which is seen from near then."""
    return frame.focus is not None and frame.focus.view == "Sphere"


def error_items(view: RunView, frame: Frame) -> list[SceneItem]:
    """The error of the frame's pose where the truth is known, and what its covariance allows where that is known."""
    if not frame.located:
        return []
    deviations = _half_axes(view, frame)
    factor = 1 if deviations is None else _factor(np.linalg.norm(deviations, axis=1).max(), view.sphere_m)
    items = [] if deviations is None else _ellipsoid(view, frame, factor * deviations, factor)
    if view.truth is not None:
        items += [*_offset(view, frame, factor), *_angle(view, frame)]
    return items


def _half_axes(view: RunView, frame: Frame) -> FloatArray | None:
    """Half axes (3, 3), as rows in the aligned map frame, of the ellipsoid of camera positions, if the frame's pose is
    the refined one and its covariance is known."""
    stage = view.trace.stage(RefinementStage)
    if stage is None or not np.isfinite(stage.covariance).all():
        return None
    if not np.abs(frame.cam_from_map - view.aligned_pose(stage.cam_from_map[-1])).max() <= 1e-7:
        return None
    turn = view.trace.problem.aligned.map_turn
    variances, axes = np.linalg.eigh(turn @ stage.covariance[3:, 3:] @ turn.T)
    return SIGMAS * np.sqrt(np.maximum(variances, 0.0))[:, None] * axes.T


def _factor(length_m: float, sphere_m: float) -> int:
    """The smallest round factor with which a length is large enough to be seen."""
    return next((factor for factor in FACTORS if factor * length_m >= VISIBLE * sphere_m), FACTORS[-1])


def enlarged(factor: int) -> str:
    """The end of a label that says by which factor the drawing is magnified; empty for 1."""
    return "" if factor == 1 else f", enlarged {factor}×"


def _ellipsoid(view: RunView, frame: Frame, half_axes: FloatArray, factor: int) -> list[SceneItem]:
    """The three principal ellipses of the ellipsoid: lines do not hide things inside it.

    In an overview their name would lie over that of the error, if that is known.
    """
    centre, turns = camera_centre(frame.cam_from_map), np.linspace(0.0, 2.0 * np.pi, CORNERS + 1)
    circle = np.column_stack([np.cos(turns), np.sin(turns)])
    lines = np.concatenate([centre + circle @ np.delete(half_axes, k, axis=0) for k in range(3)])
    ends = np.stack([lines[:-1], lines[1:]], axis=1)
    ends = np.delete(ends, [CORNERS, 2 * CORNERS + 1], axis=0)
    ellipses = Segments("uncertainty/ellipsoid", LAYER, ends, one_color(style.ESTIMATE, len(ends)), 1.5)
    if view.truth is not None and not is_close_up(frame):
        return [ellipses]
    top = centre - np.array([0.0, np.linalg.norm(half_axes[:, 1]) + 0.1 * view.sphere_m, 0.0])
    text = f"{SIGMAS:.0f}σ of the position{enlarged(factor)}"
    return [ellipses, Label("uncertainty/sigmas", LAYER, top, text)]


def _offset(view: RunView, frame: Frame, factor: int) -> list[SceneItem]:
    """From the estimated to the true position, magnified like the ellipsoid.

    The words tell the angle too: two labels would lie over each other wherever the viewer looks along them.
    """
    assert view.truth is not None
    centre = camera_centre(frame.cam_from_map)
    offset = camera_centre(view.truth) - centre
    length_m = float(np.linalg.norm(offset))
    factor = factor if factor * length_m <= ROOM * view.sphere_m else 1
    end = centre + factor * offset
    angle = angle_text(rotation_error_deg(view.truth, frame.cam_from_map))
    text = f"error {angle} · {view.length(length_m)}{enlarged(factor)}"
    # Below the sphere if the error is within it, else just below the line.
    away = BESIDE if factor * length_m < 2.0 * view.sphere_m else 0.3
    below = 0.5 * (centre + end) + np.array([0.0, away * view.sphere_m, 0.0])
    return [
        Segments("uncertainty/offset", LAYER, np.array([[centre, end]]), one_color(style.OUTLIER, 1), 3.0),
        Points("uncertainty/truth", LAYER, end[None], one_color(style.TRUTH, 1), 0.05 * view.sphere_m),
        Label("uncertainty/error", LAYER, below, text),
    ]


def _angle(view: RunView, frame: Frame) -> list[SceneItem]:
    """The estimated and the true viewing direction from the estimated position, and the arc between them."""
    assert view.truth is not None
    centre, estimated, true = camera_centre(frame.cam_from_map), frame.cam_from_map[2, :3], view.truth[2, :3]
    between = float(np.arctan2(np.linalg.norm(np.cross(estimated, true)), estimated @ true))
    across = true - (true @ estimated) * estimated
    if np.linalg.norm(across) < 1e-12:
        across = frame.cam_from_map[0, :3]
    across /= np.linalg.norm(across)
    turns = np.linspace(0.0, between, 2 + int(between / ARC_STEP_RAD))[:, None]
    arc = centre + AHEAD * view.sphere_m * (np.cos(turns) * estimated + np.sin(turns) * across)
    starts, ends = np.vstack([centre, centre, arc[:-1]]), np.vstack([arc[0], arc[-1], arc[1:]])
    colors = one_color(style.OUTLIER, len(starts))
    colors[0], colors[1] = style.ESTIMATE, style.TRUTH
    return [Segments("uncertainty/angle", LAYER, np.stack([starts, ends], axis=1), colors, 2.0)]


def spread(stage: RefinementStage, metric: bool = True, extent_m: float = np.inf) -> str:
    """How far the pose is off in words; if not ``metric``, in units of the map, whose extent is ``extent_m``."""
    known = stage.expected_errors
    return (
        "unknown: the inliers leave it open"
        if known is None
        else f"{angle_text(known[0])} and {length(known[1], metric, extent_m)} RMS"
    )


def tilt(stage: RefinementStage) -> str:
    """A sentence on how the refinement used the given gravity."""
    if stage.gravity_sd_rad == 0.0:
        return "The given gravity is kept."
    leans = f"The camera leans {np.degrees(stage.tilt_rad):.3f}° from the given gravity"
    if np.isinf(stage.gravity_sd_rad):
        return f"{leans}, which was not used."
    return f"{leans}, which was trusted to {np.degrees(stage.gravity_sd_rad):.3g}° (standard deviation)."


def table(stage: RefinementStage, metric: bool = True, extent_m: float = np.inf) -> Table:
    """Standard deviations by axis; if not ``metric``, positions are in units of the map, whose extent is
    ``extent_m``."""
    deviations = np.sqrt(np.diagonal(stage.covariance))
    places = (length(value, metric, extent_m) if np.isfinite(value) else "open" for value in deviations[3:])
    rows = (
        ("rotation about x, y, z", _listed(np.degrees(deviations[:3]), "{:.3f}°")),
        ("position x, y, z", ", ".join(places)),
        ("tilt", f"{np.degrees(stage.tilt_rad):.3f}°"),
    )
    return Table("standard deviations", ("", "camera, map frame"), rows)


def _listed(values: FloatArray, form: str) -> str:
    return ", ".join(form.format(value) if np.isfinite(value) else "open" for value in values)
