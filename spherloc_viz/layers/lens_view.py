"""Draws the map as it would look from a pose through the lens of the query, for a comparison with the photograph.

The colours come from the reference images that the query was matched with: their pixels have map points, by depth or by
triangulation, which are drawn where the query's camera would see them. Near points hide far ones.
"""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.geometry import transform
from spherloc.types import BoolArray, FloatArray
from spherloc_viz.layers.query_image import photograph

WIDTH_PX = 640
"""Width of the picture."""
MAX_PIXELS = 250_000
"""Largest number of pixels of a reference that are used."""
MAX_REFERENCES = 4
LEVELS = 4
"""Number of pictures, each half as large as the one before: gaps of a picture are filled from a smaller one."""
NEARER = 0.9
"""A pixel of a smaller picture replaces that of a larger one if its distance is less by this factor: the larger one
shows something far away through a gap."""
DENSE = 0.05
"""Least share of pixels with points at which gaps are filled; fewer points are drawn as dots."""
DOT_PX = 2


def through_lens(
    camera: Camera, cam_from_map: FloatArray, references: Iterable[View]
) -> tuple[NDArray[np.uint8], float] | None:
    """Picture (H, W, 4) of the map, sRGB and whether there is something, and the share that is covered, 0 to 1.

    None if no reference has points that the camera sees. References that cannot be read are left out.
    """
    found = [_coloured(view) for view in list(references)[:MAX_REFERENCES] if view.lift is not None]
    points = np.concatenate([one[0] for one in found]) if found else np.empty((0, 3))
    colors = np.concatenate([one[1] for one in found]) if found else np.empty((0, 3), np.uint8)
    in_camera = transform(cam_from_map, points)
    pixels, valid = camera.project(in_camera)
    with np.errstate(invalid="ignore"):
        valid &= ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    if not valid.any():
        return None
    scale = min(1.0, WIDTH_PX / camera.width)
    size = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    share = pixels[valid] / [camera.width, camera.height]
    ranges = np.linalg.norm(in_camera[valid], axis=1)
    drawn = [_drawn(share, ranges, colors[valid], (size[0] >> level, size[1] >> level)) for level in range(LEVELS)]
    covered = float(np.isfinite(drawn[0][1]).mean())
    image, depth = _filled(drawn) if covered >= DENSE else _dotted(*drawn[0])
    there = np.isfinite(depth)
    return np.dstack([image, np.where(there, 255, 0).astype(np.uint8)]), float(there.mean())


def _coloured(view: View) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Points (M, 3) of a reference's pixels and their colours (M, 3), sRGB."""
    nothing = np.empty((0, 3)), np.empty((0, 3), np.uint8)
    photo = photograph(view.path)
    if photo is None or view.lift is None:
        return nothing
    camera = view.camera
    step = max(1.0, np.sqrt(camera.width * camera.height / MAX_PIXELS))
    u, v = np.meshgrid(np.arange(step / 2, camera.width, step), np.arange(step / 2, camera.height, step))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    try:
        points, valid = view.lift(pixels)
    except InputError:
        return nothing
    rows, columns = (photo.scale * pixels[valid][:, ::-1]).astype(int).T
    height, width = photo.image.shape[:2]
    return points[valid], photo.image[np.minimum(rows, height - 1), np.minimum(columns, width - 1)]


Drawn = tuple[NDArray[np.uint8], FloatArray]
"""Picture (H, W, 3) and the distance (H, W) of what is in it, inf where there is nothing."""


def _drawn(share: FloatArray, ranges: FloatArray, colors: NDArray[np.uint8], size: tuple[int, int]) -> Drawn:
    width, height = (max(1, side) for side in size)
    columns, rows = (share * [width, height]).astype(int).T
    order = np.argsort(-ranges, kind="stable")  # the nearest is written last
    rows, columns = rows[order].clip(0, height - 1), columns[order].clip(0, width - 1)
    image, depth = np.zeros((height, width, 3), np.uint8), np.full((height, width), np.inf)
    image[rows, columns], depth[rows, columns] = colors[order], ranges[order]
    return image, depth


def _filled(drawn: Sequence[Drawn]) -> Drawn:
    """The largest picture, with pixels of smaller ones where it has gaps or only points far behind."""
    image, depth = drawn[-1]
    for finer, near in drawn[-2::-1]:
        size = finer.shape[1], finer.shape[0]
        coarse = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        behind = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float64)
        own: BoolArray = near <= behind / NEARER
        image, depth = np.where(own[..., None], finer, coarse), np.where(own, near, behind)
    return image, depth


def _dotted(image: NDArray[np.uint8], depth: FloatArray) -> Drawn:
    """A picture with few points, each drawn as a dot."""
    kernel = np.ones((2 * DOT_PX + 1, 2 * DOT_PX + 1), np.uint8)
    there = cv2.dilate(np.isfinite(depth).astype(np.uint8), kernel) > 0
    return np.asarray(cv2.dilate(image, kernel), np.uint8), np.where(there, 1.0, np.inf)
