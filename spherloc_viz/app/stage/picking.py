"""Finds the correspondences that a click or a rectangle on the canvas picks."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import viser
import viser.transforms as vtf

from spherloc.types import FloatArray
from spherloc_viz.layers.primitives import Balls, Points, SceneItem, Segments

DOT_PX = 8.0
"""Largest distance of a click from a dot that it picks."""
LINE_PX = 5.0
"""Largest distance of a click from a line that it picks."""
NEAR = 1e-6
"""Depths below this, m, count as behind the viewer."""


@dataclass(frozen=True, eq=False)
class Viewer:
    """Pose and field of view of a page's viewer, as viser reports them."""

    position: FloatArray
    """Position (3,), aligned map frame, m."""
    map_from_viewer: FloatArray
    """Rotation (3, 3); the viewer's axes are OpenCV's."""
    slopes: FloatArray
    """(2,) half of the canvas' width and height, at depth 1."""
    radians_per_pixel: float

    def project(self, positions: FloatArray) -> FloatArray:
        """Places (N, 2) on the canvas, from (0, 0), its upper left corner, to (1, 1); NaN behind the viewer."""
        offset = (positions - self.position) @ self.map_from_viewer
        depth = np.where(offset[:, 2:] > NEAR, offset[:, 2:], np.nan)
        return 0.5 * (offset[:, :2] / (depth * self.slopes) + 1.0)


def viewer_of(camera: viser.CameraHandle) -> Viewer:
    """The viewer of a client; viser's field of view is the vertical one."""
    slope, height = float(np.tan(0.5 * camera.fov)), max(1, camera.image_height)
    return Viewer(
        np.array(camera.position),
        np.asarray(vtf.SO3(np.array(camera.wxyz)).as_matrix(), np.float64),
        slope * np.array([camera.image_width / height, 1.0]),
        2.0 * slope / height,
    )


def inside(
    items: Iterable[SceneItem], viewer: Viewer, low: tuple[float, float], high: tuple[float, float]
) -> tuple[int, ...]:
    """Correspondences with a dot inside the rectangle between two places on the canvas, hidden or not."""
    found: set[int] = set()
    for item in items:
        if not isinstance(item, Points) or item.ids is None:
            continue
        places = viewer.project(item.positions)
        with np.errstate(invalid="ignore"):
            within = ((places >= low) & (places <= high)).all(axis=1)
        found.update(item.ids[within].tolist())
    return tuple(sorted(found))


def nearest(
    items: Iterable[SceneItem], origin: FloatArray, direction: FloatArray, radians_per_pixel: float
) -> tuple[int, ...]:
    """The correspondences that a ray from the viewer picks: those of the nearest dot, else of a line, else of a ball.

    Of several balls the smallest is picked, since the larger ones around it can be clicked beside it. () for nothing.
    """
    items, forward = tuple(items), direction / np.linalg.norm(direction)
    dots = [item for item in items if isinstance(item, Points) and item.ids is not None]
    dot = _dot(dots, origin, forward, DOT_PX * radians_per_pixel)
    if dot is not None and dot[0].ids is not None:
        return (int(dot[0].ids[dot[1]]),)
    return _line(items, origin, forward, LINE_PX * radians_per_pixel) or _ball(items, origin, forward)


def photograph(
    items: Iterable[SceneItem], origin: FloatArray, direction: FloatArray, radians_per_pixel: float
) -> tuple[str, str] | None:
    """The photograph on whose dot a ray from the viewer picks, as the layer of the dot and its name; None for another
    dot, or none."""
    dots = [item for item in items if isinstance(item, Points) and (item.ids is not None or item.photographs)]
    found = _dot(dots, origin, direction / np.linalg.norm(direction), DOT_PX * radians_per_pixel)
    return (found[0].layer, found[0].photographs[found[1]]) if found is not None and found[0].photographs else None


def _dot(dots: Iterable[Points], origin: FloatArray, forward: FloatArray, reach: float) -> tuple[Points, int] | None:
    """The nearest dot to a ray, as an item and a number in it."""
    best, found = (reach, np.inf), None
    for item in dots:
        depth, away = _along(item.positions - origin, forward)
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = np.where(depth > NEAR, np.maximum(away - item.radius_m, 0.0) / depth, np.inf)
        if not len(miss):
            continue
        at = int(np.lexsort((depth, miss))[0])
        score = (float(miss[at]), float(depth[at]))
        if score < best:
            best, found = score, (item, at)
    return found


def _line(items: Iterable[SceneItem], origin: FloatArray, forward: FloatArray, reach: float) -> tuple[int, ...]:
    best, found = reach, ()
    across = np.linalg.svd(forward[None])[2][1:]
    for item in items:
        if not isinstance(item, Segments) or item.ids is None or not len(item.points):
            continue
        offset = item.points - origin
        depth = offset @ forward
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = (offset @ across.T) / depth[..., None]
            start, along = flat[:, 0], flat[:, 1] - flat[:, 0]
            share = np.clip(-np.sum(start * along, axis=1) / np.sum(along**2, axis=1), 0.0, 1.0)
            miss = np.linalg.norm(start + np.nan_to_num(share)[:, None] * along, axis=1)
        # A line that passes the viewer has no straight image; its other parts are found from farther away.
        miss[(depth <= NEAR).any(axis=1)] = np.inf
        at = int(np.argmin(miss))
        if miss[at] < best:
            best, found = float(miss[at]), _pair(item.ids[at])
    return found


def _ball(items: Iterable[SceneItem], origin: FloatArray, forward: FloatArray) -> tuple[int, ...]:
    smallest, found = np.inf, ()
    for item in items:
        if not isinstance(item, Balls) or item.ids is None or not len(item.radii_m):
            continue
        depth, away = _along(item.centers - origin, forward)
        radii = np.where((depth > NEAR) & (away <= item.radii_m), item.radii_m, np.inf)
        at = int(np.argmin(radii))
        if radii[at] < smallest:
            smallest, found = float(radii[at]), _pair(item.ids[at])
    return found


def _along(offset: FloatArray, forward: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Depth (N,) along a ray and distance (N,) from it."""
    depth = offset @ forward
    return depth, np.linalg.norm(offset - depth[:, None] * forward, axis=1)


def _pair(ids: FloatArray) -> tuple[int, ...]:
    return int(ids[0]), int(ids[1])
