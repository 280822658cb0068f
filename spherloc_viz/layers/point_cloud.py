"""The map of real images around a run: its points in grey, and where its reference images were taken."""

from dataclasses import replace

import numpy as np

from spherloc.datasets.map_scene import MapScene
from spherloc.geometry import camera_centre
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.camera_shape import camera_lines
from spherloc_viz.layers.frame import even, one_color
from spherloc_viz.layers.primitives import Label, Picture, Points, SceneItem, Segments

LAYER = "point cloud"
MAX_POINTS = 8000
"""Largest number of points of the map that are drawn, an even sample."""
SHARE, REACH = 0.9, 2.0
"""Points farther from the middle than this share of them, by more than this factor, are left out: they are wrong."""
BODY, SMALLEST_BODY = 0.3, 0.01
"""Size of the camera of a reference, as a share of the usual distance of references from their nearest ones, but at
least the second share of the extent of all."""
DOT, REFERENCE_DOT = 0.0004, 0.01
"""Radius of a point's dot, as a share of the extent of the points, and of a reference's, of that of the references."""
MAX_NAMED = 12
"""Largest number of references, and of localized queries, whose names are shown."""
REFERENCES = "cloud/references"
"""Name of the dots where the references were taken."""
WRONG_RAYS = "rays-wrong"
"""Name of the second halves of the lines to inliers that are wrong by the truth."""
FEW_RAYS = 40
"""Largest number of lines to the inliers at the outcome of a query image, which is about where it was taken."""


def reference_dots(scene: MapScene, turn: FloatArray) -> Points:
    """Where a scene's references were taken; ``turn`` (3, 3) is the aligned frame from the map frame."""
    posed = [(view.name, view.cam_from_map) for view in scene.references if view.cam_from_map is not None]
    names = tuple(name for name, _ in posed)
    places = np.array([camera_centre(pose) for _, pose in posed]).reshape(-1, 3) @ turn.T
    size_m = float(np.max(np.ptp(places, axis=0), initial=0.0)) or 1.0
    colors = one_color(style.REFERENCE, len(places))
    return Points(REFERENCES, LAYER, places, colors, REFERENCE_DOT * size_m, photographs=names)


def with_few_rays(picture: Picture, inliers: int) -> Picture:
    """The picture with an even sample of the lines to so many inliers, and a note of that."""
    rays = next((item for item in picture.scene if item.name == "rays"), None)
    if not isinstance(rays, Segments) or len(rays.points) <= FEW_RAYS:
        return picture
    kept = even(np.arange(len(rays.points)), FEW_RAYS)
    few = replace(rays, points=rays.points[kept], colors=rays.colors[kept])
    note = f"{picture.step.note} {FEW_RAYS} of the {inliers:,} lines to the inliers are drawn.".strip()
    scene = tuple(few if item is rays else item for item in picture.scene)
    wrong = next((item for item in scene if item.name == WRONG_RAYS), None)
    if isinstance(wrong, Segments):  # the halves of those lines that are left
        own = (wrong.points[:, None, 0] == few.points[None, :, 1]).all(axis=2).any(axis=1)
        halves = replace(wrong, points=wrong.points[own], colors=wrong.colors[own])
        scene = tuple(halves if item is wrong else item for item in scene)
    return replace(picture, step=replace(picture.step, note=note), scene=scene)


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
    labels = [
        Label(f"cloud/name-{k}", LAYER, place + np.array([0.0, 3.0 * dots.radius_m, 0.0]), name)
        for k, (place, name) in enumerate(zip(dots.positions, dots.photographs, strict=True))
    ]
    return (
        Points("cloud/points", LAYER, points, one_color(style.CLOUD, len(points)), radius_m),
        dots,
        _bodies(scene, turn, dots),
        *(labels if len(labels) <= MAX_NAMED else ()),
    )


def _bodies(scene: MapScene, turn: FloatArray, dots: Points) -> Segments:
    """The cameras of the references, which tell them from points, and where they looked."""
    places, size_m = dots.positions, SMALLEST_BODY / REFERENCE_DOT * dots.radius_m
    if len(places) > 1:
        from scipy.spatial import KDTree  # takes half a second

        nearest_m = KDTree(places).query(places, k=2)[0][:, 1]
        size_m = max(size_m, BODY * float(np.median(nearest_m)))
    turned = [view.cam_from_map @ _turned(turn) for view in scene.references if view.cam_from_map is not None]
    lines = np.array([camera_lines(pose, size_m) for pose in turned]).reshape(-1, 2, 3)
    return Segments("cloud/cameras", LAYER, lines, one_color(style.REFERENCE, len(lines)), 2.0)


def _turned(turn: FloatArray) -> FloatArray:
    """The transform (4, 4) from the aligned frame to the map frame; ``turn`` (3, 3) is the other way."""
    transform = np.eye(4)
    transform[:3, :3] = turn.T
    return transform
