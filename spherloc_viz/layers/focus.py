"""What must be on the screen at a step, so that one sees what its caption speaks of.

Every step has one focus, whatever step was looked at before.
"""

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.types import FloatArray
from spherloc_viz.layers.frame import Frame, RunView
from spherloc_viz.layers.primitives import Focus

STRAY = 4.0
"""Map points farther from the middle than this many times the median distance are not framed: they would make all
others small."""
SPHERE_ROOM = 1.35
"""Radius of what is framed around the unit sphere, in sphere radii."""
RING_ROOM = 3.0
"""Radius of the yaw ring with its outline, in sphere radii."""
CAMERA_ROOM = 2.0
"""Radius of what is framed around a camera, in sphere radii."""
FEW_BALLS = 3
"""Up to so many balls are framed whole."""


def focus_of(view: RunView, frame: Frame) -> Focus:
    """What a frame names itself; else its ring, else its sphere, and wherever matches are drawn as rays or the camera
    has a position, the whole map."""
    if frame.focus is not None:
        return frame.focus
    if any(item.layer == "yaw ring" for item in frame.items):
        return ring_focus(view)
    if frame.located or frame.rays.any() or any(item.layer == "pairs" for item in frame.items):
        return map_focus(view, frame.cam_from_map)
    return Focus(
        "Sphere", view.kept("sphere focus", None, lambda: sphere_box(view.middle, SPHERE_ROOM * view.sphere_m))
    )


def ring_focus(view: RunView, *more: FloatArray) -> Focus:
    """The yaw ring, and ``more`` points (K, 3)."""
    ring = view.kept("ring focus", None, lambda: circle(view.middle, RING_ROOM * view.sphere_m))
    return Focus("Sphere", np.vstack([ring, *more]) if more else ring, ring)


def map_focus(view: RunView, cam_from_map: FloatArray) -> Focus:
    """The map without its strays, the true camera, and a camera at a pose (3, 4)."""
    dense = view.kept("dense map", None, lambda: dense_points(view.points))
    cameras = [cam_from_map] if view.truth is None else [cam_from_map, view.truth]
    boxes = [sphere_box(camera_centre(pose), CAMERA_ROOM * view.sphere_m) for pose in cameras]
    return Focus("Overview", np.vstack([dense, *boxes]), dense)


def close_focus(view: RunView, cam_from_map: FloatArray, *more: FloatArray) -> Focus:
    """A camera at a pose (3, 4), and ``more`` points (K, 3)."""
    box = sphere_box(camera_centre(cam_from_map), CAMERA_ROOM * view.sphere_m)
    return Focus("Sphere", np.vstack([box, *more]))


def dense_points(positions: FloatArray) -> FloatArray:
    """Those of the points (N, 3) that are no strays."""
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return positions[away <= STRAY * np.median(away)]


def sphere_box(centre: FloatArray, reach_m: float) -> FloatArray:
    """Points (6, 3) that far to all sides of a place."""
    sides = np.vstack([np.eye(3), -np.eye(3)])
    return centre + reach_m * sides


def circle(centre: FloatArray, radius_m: float) -> FloatArray:
    """A level circle (36, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    return centre + radius_m * np.column_stack([np.cos(angle), 0.0 * angle, np.sin(angle)])


def ball_boxes(centers: FloatArray, radii_m: FloatArray) -> FloatArray:
    """Boxes (K, 3) around balls (B, 3), (B,): around all of a few; of more, around the denser half.

    These are the balls nearest to the median of the smaller half: a ball as large as the map holds it all in it.
    """
    if len(radii_m) > FEW_BALLS:
        small = np.argsort(radii_m, kind="stable")[: max(1, len(radii_m) // 2)]
        away = np.linalg.norm(centers - np.median(centers[small], axis=0), axis=1)
        near = np.argsort(away, kind="stable")[: max(FEW_BALLS, len(away) // 2)]
    else:
        near = np.arange(len(radii_m))
    reach = radii_m[near, None]
    return np.vstack([centers[near] - reach, centers[near] + reach])
