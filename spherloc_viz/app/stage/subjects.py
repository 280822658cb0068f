"""What a view of a picture must hold."""

from functools import lru_cache

import numpy as np

from spherloc.types import FloatArray
from spherloc_viz.layers import LAST
from spherloc_viz.layers.frame import RING_ROOM, SPHERE_ROOM, circle, dense_points, sphere_box
from spherloc_viz.layers.point_cloud import REFERENCES
from spherloc_viz.layers.primitives import Mesh, Picture, Points, Segments

SMALL_WALK, WALK_ROOM = 1.0 / 3.0, 0.4
"""If photographs were taken in a part of the map that is smaller than this share of it, the view from above and that of
the outcome show that part, with room around it, as a share of its size."""


def followed(picture: Picture) -> tuple[FloatArray, FloatArray]:
    """Points (K, 3) that the view of a step must hold, and those (L, 3) that are not to be hidden."""
    focus = picture.focus
    walk = walk_at_end(picture)
    if walk is not None:
        return walk, walk
    route = [item.positions for item in picture.scene if isinstance(item, Points) and item.layer == "trajectory"]
    subject = np.vstack([focus.points, *route]) if focus.view == "Overview" else focus.points
    return subject, subject if focus.clear is None else focus.clear


def subject_of(name: str, picture: Picture) -> FloatArray:
    """Points (K, 3) that a view of that name must hold."""
    items = {item.name: item for item in picture.scene}
    if name == "Sphere":
        return _sphere(items["sphere/surface"], any(item.layer == "yaw ring" for item in picture.scene))
    if name == "Balls" and picture.focus.view == "Balls":
        return picture.focus.points
    points, surface = items["map/points"], items["sphere/surface"]
    assert isinstance(points, Points) and isinstance(surface, Mesh)
    lines = [
        item.points.reshape(-1, 3)
        for item in picture.scene
        if isinstance(item, Segments) and item.layer in ("cameras", "scale bar")
    ]
    walk = _walk(picture) if name == "Above" else None
    if walk is not None:
        return walk
    return np.vstack([dense_points(points.positions), surface.vertices, *lines, *_route(picture)])


def _walk(picture: Picture) -> FloatArray | None:
    """Points (K, 3) around where the photographs of a map and the query were taken, if that is a small part of the map;
    None without it or without a position of the query."""
    items = {item.name: item for item in picture.scene}
    points, camera = items["map/points"], items.get("cameras/estimate")
    assert isinstance(points, Points)
    route = _route(picture)
    if not route or not isinstance(camera, Segments):  # without a position, the sphere is elsewhere
        return None
    taken = np.vstack([*route, camera.points[:1, 0]])
    extent_m, whole_m = (float(np.ptp(places, axis=0).max()) for places in (taken, dense_points(points.positions)))
    if not 0.0 < extent_m < SMALL_WALK * whole_m:
        return None
    return np.vstack([taken - WALK_ROOM * extent_m, taken + WALK_ROOM * extent_m])


def walk_at_end(picture: Picture) -> FloatArray | None:
    """Points (K, 3) around where photographs were taken, which the last step is about if they are a small part of the
    map; None otherwise."""
    return _walk(picture) if picture.step.stage == LAST else None


def _route(picture: Picture) -> list[FloatArray]:
    """Where the queries of a sequence and the references were taken: arrays (K, 3)."""
    return [
        item.positions
        for item in picture.scene
        if isinstance(item, Points) and (item.layer == "trajectory" or item.name == REFERENCES)
    ]


def _sphere(surface: object, ring: bool) -> FloatArray:
    """The sphere with some room, or the ring around it."""
    assert isinstance(surface, Mesh)
    centre, radius_m = centre_and_radius(surface)
    return circle(centre, RING_ROOM * radius_m) if ring else sphere_box(centre, SPHERE_ROOM * radius_m)


def surface_of(picture: Picture) -> Mesh | None:
    """The surface of the sphere; None if the picture has none."""
    return next((item for item in picture.scene if isinstance(item, Mesh) and item.name == "sphere/surface"), None)


@lru_cache(maxsize=8)
def centre_and_radius(surface: Mesh) -> tuple[FloatArray, float]:
    """Centre (3,) and radius, m, of the sphere."""
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    return (low + high) / 2, float(high[0] - low[0]) / 2
