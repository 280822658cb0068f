"""The map of real images around a run: its points in grey, and where its reference images were taken."""

import numpy as np

from spherloc.datasets.map_scene import MapScene
from spherloc.geometry import camera_centre
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import even, one_color
from spherloc_viz.layers.primitives import Label, Points, SceneItem

LAYER = "point cloud"
MAX_POINTS = 8000
"""Largest number of points of the map that are drawn, an even sample."""
SHARE, REACH = 0.9, 2.0
"""Points farther from the middle than this share of them, by more than this factor, are left out: they are wrong."""
DOT, REFERENCE_DOT = 0.0007, 0.01
"""Radius of a point's dot, as a share of the extent of the points, and of a reference's, of that of the references."""
MAX_NAMED = 12
"""Largest number of references, and of localized queries, whose names are shown."""
REFERENCES = "cloud/references"
"""Name of the dots where the references were taken."""


def reference_dots(scene: MapScene, turn: FloatArray) -> Points:
    """Where a scene's references were taken; ``turn`` (3, 3) is the aligned frame from the map frame."""
    posed = [view.cam_from_map for view in scene.references if view.cam_from_map is not None]
    places = np.array([camera_centre(pose) for pose in posed]).reshape(-1, 3) @ turn.T
    size_m = float(np.max(np.ptp(places, axis=0), initial=0.0)) or 1.0
    return Points(REFERENCES, LAYER, places, one_color(style.REFERENCE, len(places)), REFERENCE_DOT * size_m)


def cloud_items(scene: MapScene, turn: FloatArray) -> tuple[SceneItem, ...]:
    """The points and the references of a scene that has points, these named if they are few; nothing for another
    scene. ``turn`` is as in ``reference_dots``."""
    if scene.cloud is None or not len(scene.cloud):
        return ()
    away = np.linalg.norm(scene.cloud - np.median(scene.cloud, axis=0), axis=1)
    near = np.flatnonzero(away <= REACH * np.quantile(away, SHARE))
    points = scene.cloud[even(near, MAX_POINTS)] @ turn.T
    radius_m = DOT * float(np.max(np.ptp(points, axis=0)))
    dots = reference_dots(scene, turn)
    names = [view.name for view in scene.references if view.cam_from_map is not None]
    labels = [
        Label(f"cloud/name-{k}", LAYER, place + np.array([0.0, 3.0 * dots.radius_m, 0.0]), name)
        for k, (place, name) in enumerate(zip(dots.positions, names, strict=True))
    ]
    return (
        Points("cloud/points", LAYER, points, one_color(style.CLOUD, len(points)), radius_m),
        dots,
        *(labels if len(labels) <= MAX_NAMED else ()),
    )
