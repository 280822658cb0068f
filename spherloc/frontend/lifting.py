"""Lifting: from a pixel of a posed reference image to its map point, by depth maps, point clouds or SfM points.

A lift is cheap to make and reads its file when it is first used. Its data (a depth map, a projected cloud) stay in
memory for the ``_KEPT`` lifts that were used last: neighbouring queries share their references, while the data of
thousands of references would fill the memory.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera, in_image
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.geometry import camera_centre, transform
from spherloc.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from scipy.spatial import KDTree

SAME_SURFACE = 0.05
"""Ranges whose relative difference is less than this belong to one surface."""
SFM_RADIUS_PX = 2.0
CLOUD_RADIUS_PX = 6.0
"""Search radius: scan lines of lidars are 3 to 4 px apart in usual fisheye images (64 beams over 27 degrees, 128 over
90)."""

_KEPT = 8
_CELLS_PER_RADIUS = 3
"""Number of cells of the depth buffer per search radius."""
_NEIGHBOURS = 36
"""Number of neighbours that are searched: no more cells touch a disc of three cells' radius, so none is missed."""
_CHUNK = 500_000
"""Points that are projected at once: a map of tens of millions must not be in memory several times."""
_MIN_Z = 1e-3
"""Least cosine to the optical axis for which a z-depth gives a range."""
_RIDGE = 0.1
"""Weight, in search radii, of the prior that a fitted plane faces the camera: a single scan line does not fix it."""


@dataclass(frozen=True, eq=False)
class DepthLift:
    """Points from the depth map of an image.

    Between pixel centres, depth is interpolated only where the four pixels around agree within ``SAME_SURFACE``;
    elsewhere it is that of the nearest pixel, so that no point lies between a near edge and the surface behind it.
    """

    load_depth: Callable[[], NDArray[np.floating]]
    """Loads the depth map (H, W), of the image's size, metres; values that are not positive and finite are missing."""
    camera: Camera
    cam_from_map: FloatArray
    """Pose (3, 4) of the image."""
    along: Literal["ray", "z"]
    """Whether depth is the distance to the camera or only its part along the optical axis."""

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """See ``Lift``; also raises ``InputError`` if the depth map has another size than the image."""
        bearings, seen = self.camera.unproject(pixels)
        depth = np.full(len(pixels), np.nan)
        inside = seen & in_image(self.camera, pixels)
        depth[inside] = _interpolated(_depth_map(self), pixels[inside], isinstance(self.camera, Equirectangular))
        if self.along == "z":
            with np.errstate(invalid="ignore"):
                depth /= np.where(bearings[:, 2] > _MIN_Z, bearings[:, 2], np.nan)
        return _in_map(bearings, depth, self.cam_from_map)


@lru_cache(maxsize=_KEPT)
def _depth_map(lift: DepthLift) -> NDArray[np.float32]:
    depth = np.asarray(lift.load_depth())
    if depth.shape != (lift.camera.height, lift.camera.width):
        raise InputError(
            f"the depth map has the shape {depth.shape}, its image {lift.camera.height} rows of {lift.camera.width}; "
            "give a depth map of the image's size."
        )
    with np.errstate(all="ignore"):
        return np.where((depth > 0) & np.isfinite(depth), depth, np.nan).astype(np.float32)


def _interpolated(depth: NDArray[np.float32], pixels: FloatArray, wraps: bool) -> FloatArray:
    """Depth (N,) at pixels (N, 2) inside the image, NaN where there is none."""
    height, width = depth.shape
    position = pixels - 0.5
    low = np.floor(position).astype(np.int64)
    right, below = (position - low).T
    columns = low[:, 0, None] + (0, 1, 0, 1)
    columns = columns % width if wraps else np.clip(columns, 0, width - 1)
    rows = np.clip(low[:, 1, None] + (0, 0, 1, 1), 0, height - 1)
    around = depth[rows, columns].astype(np.float64)
    weights = np.column_stack([(1 - right) * (1 - below), right * (1 - below), (1 - right) * below, right * below])
    # A NaN among the four makes the comparison false.
    smooth = around.max(axis=1) <= (1.0 + SAME_SURFACE) * around.min(axis=1)
    nearest = around[np.arange(len(around)), weights.argmax(axis=1)]
    return np.where(smooth, (weights * around).sum(axis=1), nearest)


@dataclass(frozen=True, eq=False)
class PointCloudLift:
    """Points from a cloud (lidar) that is projected into an image.

    The range is that of a plane fitted to the projected points around the pixel. Where they do not lie on one surface,
    the pixel has a point only if the nearest projected one belongs to the foremost surface: other points are behind it
    and are only seen through the gaps between its points.
    """

    load_points: Callable[[], NDArray[np.floating]]
    """Loads the points (M, 3), map frame, metres."""
    camera: Camera
    cam_from_map: FloatArray
    """Pose (3, 4) of the image."""
    radius_px: float = CLOUD_RADIUS_PX
    """Search radius; a pixel without a projected point within half of it has no point."""

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """See ``Lift``."""
        bearings, seen = self.camera.unproject(pixels)
        ranges = np.full(len(pixels), np.nan)
        buffer = _depth_buffer(self)
        asked = np.flatnonzero(seen & in_image(self.camera, pixels))
        if buffer is not None and len(asked):
            distances, index = buffer.tree.query(pixels[asked], k=_NEIGHBOURS, distance_upper_bound=self.radius_px)
            ranges[asked] = _surface_range(buffer, bearings[asked], distances, index, self.radius_px)
        return _in_map(bearings, ranges, self.cam_from_map)


@dataclass(frozen=True, eq=False)
class _DepthBuffer:
    """For every cell of the image with points of the cloud, the nearest of them."""

    tree: "KDTree"
    """Search tree of their pixels, which wraps around the seam of a panorama."""
    bearings: FloatArray
    """(K + 1, 3) in the camera frame; the last one, NaN, stands for "no neighbour" in the tree's answers."""
    inverse_ranges: FloatArray
    """(K + 1,) inverse ranges, 1/m."""


@lru_cache(maxsize=_KEPT)
def _depth_buffer(lift: PointCloudLift) -> _DepthBuffer | None:
    """The depth buffer of a lift's cloud; None if no point of the cloud is in the image."""
    camera, cloud = lift.camera, np.asarray(lift.load_points())
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise InputError(f"the point cloud has the shape {cloud.shape}; give rows of x, y, z in metres.")
    cell_px = lift.radius_px / _CELLS_PER_RADIUS
    columns = int(np.ceil(camera.width / cell_px))
    parts = []
    for start in range(0, len(cloud), _CHUNK):
        with np.errstate(all="ignore"):
            points = transform(lift.cam_from_map, cloud[start : start + _CHUNK].astype(np.float64))
        parts.append(_foremost(camera, points[np.isfinite(points).all(axis=1)], cell_px, columns))
    points = _foremost(camera, np.concatenate(parts), cell_px, columns) if parts else np.empty((0, 3))
    if not len(points):
        return None
    ranges = np.linalg.norm(points, axis=1)
    wraps = isinstance(camera, Equirectangular)
    from scipy.spatial import KDTree  # takes half a second

    tree = KDTree(camera.project(points)[0], boxsize=[camera.width, 0] if wraps else None)
    nothing = np.full((1, 3), np.nan)
    return _DepthBuffer(tree, np.vstack([points / ranges[:, None], nothing]), np.append(1.0 / ranges, np.nan))


def _foremost(camera: Camera, points: FloatArray, cell_px: float, columns: int) -> FloatArray:
    """The nearest of the camera-frame points (M, 3) in every cell of the image."""
    pixels, valid = camera.project(points)
    valid &= in_image(camera, pixels)
    points, cells = points[valid], (pixels[valid] // cell_px).astype(np.int64)
    order = np.argsort(np.linalg.norm(points, axis=1))
    _, first = np.unique((cells[:, 1] * columns + cells[:, 0])[order], return_index=True)
    return points[order[first]]


def _surface_range(
    buffer: _DepthBuffer, bearings: FloatArray, distances: FloatArray, index: NDArray[np.int64], radius_px: float
) -> FloatArray:
    """Range (N,) of the surface at ``bearings`` (N, 3), NaN where there is none; neighbours are (N, K), nearest first.

    For points of a plane, the inverse range is linear in the bearing, 1/r = m . b, whatever the camera model and
    however slanted the plane.
    """
    found = np.isfinite(distances)
    around, inverse = buffer.bearings[index], buffer.inverse_ranges[index]
    close = distances[:, 0] <= radius_px / 2
    weights = np.where(found, 1.0 / (1.0 + np.where(found, distances, 0.0)) ** 2, 0.0)
    around, inverse = np.where(found[..., None], around, 0.0), np.where(found, inverse, 0.0)
    facing = bearings * inverse[:, :1]
    # The prior (a ridge term) pulls m to a surface that faces the camera at the range of the nearest point.
    spread = np.where(found[..., None], around - bearings[:, None], 0.0)
    ridge = _RIDGE**2 * (weights[..., None] * spread**2).sum(axis=(1, 2)) + 1e-12
    normal = np.einsum("nk,nki,nkj->nij", weights, around, around) + ridge[:, None, None] * np.eye(3)
    right = np.einsum("nk,nki,nk->ni", weights, around, inverse - np.einsum("nki,ni->nk", around, facing))
    plane = facing + np.linalg.solve(normal, right[..., None])[..., 0]
    misfit = np.abs(np.einsum("nki,ni->nk", around, plane) - inverse)
    single = (misfit <= SAME_SURFACE * inverse).all(axis=1)
    on_plane = np.einsum("ni,ni->n", bearings, plane)
    foremost = inverse[:, 0] >= inverse.max(axis=1) / (1.0 + SAME_SURFACE)
    with np.errstate(divide="ignore"):
        ranges = np.where(single, 1.0 / on_plane, np.where(foremost, 1.0 / inverse[:, 0], np.nan))
    return np.where(close & (ranges > 0), ranges, np.nan)


@dataclass(frozen=True, eq=False)
class SfmLift:
    """Points of the keypoints that a structure-from-motion model observed in an image."""

    pixels: FloatArray
    """(K, 2) observed keypoints."""
    points: FloatArray
    """(K, 3) their points, map frame, metres."""
    radius_px: float = SFM_RADIUS_PX
    """A pixel takes the point of the nearest keypoint within this distance."""

    @cached_property
    def _known(self) -> "tuple[KDTree, FloatArray]":
        finite = np.isfinite(self.pixels).all(axis=1) & np.isfinite(self.points).all(axis=1)
        from scipy.spatial import KDTree

        return KDTree(self.pixels[finite]), np.vstack([self.points[finite], np.full((1, 3), np.nan)])

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """See ``Lift``."""
        tree, points = self._known
        none = len(points) - 1
        usable = np.isfinite(pixels).all(axis=1)
        index = np.full(len(pixels), none)
        if none and usable.any():
            _, index[usable] = tree.query(pixels[usable], distance_upper_bound=self.radius_px)
        return points[index], index < none


def _in_map(bearings: FloatArray, ranges: FloatArray, cam_from_map: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Map points (N, 3) at ``ranges`` (N,), NaN for none, along camera-frame ``bearings`` (N, 3), and their mask."""
    points = (bearings * ranges[:, None]) @ cam_from_map[:, :3] + camera_centre(cam_from_map)
    known = np.isfinite(bearings[:, 0] * ranges)
    points[~known] = np.nan
    return points, known
