"""What every picture shows: map points, the unit sphere with its bearings, matches, true and estimated camera."""

from functools import cache

import numpy as np
import trimesh

from spherloc.geometry import camera_centre
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, RunView, one_color
from spherloc_viz.layers.primitives import FloatArray, Mesh, Points, SceneItem, Segments


@cache
def _icosphere() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def base_items(view: RunView, frame: Frame) -> tuple[SceneItem, ...]:
    """The primitives that do not depend on the stage."""
    centre = camera_centre(frame.cam_from_map)
    items: list[SceneItem] = [
        Points("map/points", "map", view.points, frame.colors, 0.07 * view.dot_m, np.arange(len(view.points))),
        *_sphere(view, frame),
    ]
    if frame.located:
        items.append(camera("cameras/estimate", frame.cam_from_map, 1.9 * view.sphere_m, style.ESTIMATE, 2.5))
    if view.truth is not None:
        items.append(camera("cameras/truth", view.truth, 1.9 * view.sphere_m, style.TRUTH, 2.5))
        if frame.located:
            ends = np.array([[camera_centre(view.truth), centre]])
            items.append(Segments("cameras/error", "cameras", ends, one_color(style.OUTLIER, 1), 3.0))
    return tuple(items)


def _sphere(view: RunView, frame: Frame) -> list[SceneItem]:
    rotation = frame.cam_from_map[:, :3]
    centre = camera_centre(view.standing(rotation) if frame.sphere_aside else frame.cam_from_map)
    vertices, faces = _icosphere()
    aligned = view.trace.problem.aligned
    dots = centre + view.sphere_m * aligned.bearings @ rotation
    drawn = np.flatnonzero(frame.rays[aligned.index])[: style.MAX_DRAWN_RAYS]
    ends = np.stack([dots[drawn], view.points[aligned.index[drawn]]], axis=1)
    colors = frame.colors[aligned.index]
    surface = Mesh("sphere/surface", "sphere", centre + view.sphere_m * vertices, faces, style.SPHERE, 0.25)
    return [
        surface,
        Points("sphere/bearings", "sphere", dots, colors, 0.04 * view.dot_m, aligned.index),
        Segments("rays", "rays", ends, colors[drawn], 1.5),
    ]


def camera(name: str, cam_from_map: FloatArray, size_m: float, color: style.RGB, width_px: float) -> Segments:
    """An open pyramid around the viewing direction, its upper edge marked by a roof."""
    centre, rotation = camera_centre(cam_from_map), cam_from_map[:, :3]
    corners = np.array([[-0.5, -0.4, 0.7], [0.5, -0.4, 0.7], [0.5, 0.4, 0.7], [-0.5, 0.4, 0.7]])
    roof = np.array([0.0, -0.62, 0.7])
    lines = [(np.zeros(3), corner) for corner in corners]
    lines += [(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    lines += [(corners[0], roof), (roof, corners[1])]
    ends = centre + size_m * np.array(lines) @ rotation
    return Segments(name, "cameras", ends, one_color(color, len(lines)), width_px)
