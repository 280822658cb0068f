"""Map points for posed references without depth: their features, triangulated with other posed references.

Everything is measured between bearings, so that any mixture of camera models will do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.errors import InputError
from spherloc.frontend.features import FeatureOptions, extract
from spherloc.frontend.lifting import SFM_RADIUS_PX, SfmLift
from spherloc.frontend.matching import MatchOptions, match
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre
from spherloc.types import BoolArray, FloatArray

MIN_PARALLAX_DEG = 1.0
"""Least parallax: with an error of 0.1 degrees (1 px of a fisheye image is 0.15 to 0.25), the range is then accurate to
10 %."""
BOUND_PX = 2.0


@dataclass(frozen=True, eq=False)
class TriangulationLift:
    """Points of a reference's features that are matched in other references whose poses are known too.

    A match must lie on its epipolar plane, and its point must be in front of both cameras, with enough parallax and a
    small reprojection error. If a feature has several matches, those that agree on one point are taken.
    """

    view: View
    others: tuple[View, ...]
    """Views of the same places from other positions, with poses; each costs one matching."""
    features: FeatureOptions = field(default_factory=FeatureOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    bound_px: float = BOUND_PX
    """Bound on the distance to the epipolar plane and on the reprojection error."""
    least_parallax_deg: float = MIN_PARALLAX_DEG
    """Least angle between the rays of the reference and of one of the others."""
    radius_px: float = SFM_RADIUS_PX
    """A pixel takes the point of the nearest feature within this distance."""

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """See ``Lift``; also raises ``InputError`` if none of the others can be read, or if a pose is missing."""
        return self._found[0](pixels)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on views that could not be used, and why."""
        return self._found[1]

    @cached_property
    def _found(self) -> tuple[SfmLift, tuple[str, ...]]:
        own = extract(self.view, self.features)
        usable, observed, failures = [self.view], [own.pixels], []
        for other in self.others:
            try:
                features = extract(other, self.features)
                matches = match(own, features, self.matching)
            except InputError as error:
                failures.append(f"{other.name} was not used to triangulate {self.view.name}: {error}")
                continue
            pixels = np.full((len(own), 2), np.nan)
            pixels[matches.query_index] = features.pixels[matches.reference_index]
            usable.append(other)
            observed.append(pixels)
        if failures and len(usable) == 1:
            raise InputError(f"{self.view.name}: no other image can be used to triangulate; {failures[0]}")
        points = triangulated(
            [view.camera for view in usable],
            np.stack([_pose_of(view) for view in usable]),
            np.stack(observed),
            self.bound_px,
            np.radians(self.least_parallax_deg),
        )
        return SfmLift(own.pixels, points, self.radius_px), tuple(failures)


def triangulated(
    cameras: Sequence[Camera], cam_from_map: FloatArray, pixels: FloatArray, bound_px: float, least_parallax_rad: float
) -> FloatArray:
    """Map points (K, 3) of K features of the first of V views, NaN where the observations give none.

    ``cam_from_map`` (V, 3, 4) are the poses; ``pixels`` (V, K, 2) the features' observations, NaN where a view has
    none. An error in pixels is an angle divided by the largest singular value of the unprojection's Jacobian, rad/px,
    at the observed pixel.
    """
    centres = np.stack([camera_centre(matrix) for matrix in cam_from_map])
    origin = centres[0].copy()
    centres -= origin  # maps may have coordinates of millions of metres
    rays, coarseness = _rays(cameras, cam_from_map, pixels)
    bounds = bound_px * coarseness
    count = pixels.shape[1]
    best, best_support = np.full((count, 3), np.nan), np.zeros((len(cameras), count), dtype=bool)
    score = np.zeros(count)
    for other in range(1, len(cameras)):
        parallax = _angles(rays[0], rays[other])
        pair = (parallax >= least_parallax_rad) & (_off_plane(centres, rays, other) <= bounds[other])
        points = np.full((count, 3), np.nan)
        used = np.zeros_like(best_support)
        used[[0, other]] = pair
        points[pair] = _intersection(centres, rays[:, pair], used[:, pair])
        support = _agree(centres, rays, bounds, points)
        pair &= support[0] & support[other]
        # More views first, then more parallax, which is below pi.
        value = np.where(pair, support.sum(axis=0) + parallax / 4.0, 0.0)
        better = value > score
        best[better], best_support[:, better], score[better] = points[better], support[:, better], value[better]
    return origin + _refined(centres, rays, bounds, best, best_support)


def _pose_of(view: View) -> FloatArray:
    if view.cam_from_map is None:
        raise InputError(f"{view.name}: has no pose to triangulate with; leave it out.")
    return view.cam_from_map


def _rays(cameras: Sequence[Camera], cam_from_map: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit directions (V, K, 3) in the map frame and rad/px (V, K), NaN where there is no observation."""
    rays, coarseness = np.full((*pixels.shape[:2], 3), np.nan), np.full(pixels.shape[:2], np.nan)
    for index, camera in enumerate(cameras):
        seen = np.flatnonzero(np.isfinite(pixels[index]).all(axis=1))
        bearings, valid = camera.unproject(pixels[index, seen])
        seen, bearings = seen[valid], bearings[valid]
        rays[index, seen] = bearings @ cam_from_map[index, :, :3]
        jacobian = camera.unprojection_jacobian(pixels[index, seen])
        coarseness[index, seen] = np.linalg.norm(jacobian, ord=2, axis=(1, 2))
    return rays, coarseness


def _angles(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles (...,) between vectors (..., 3), exact for small ones."""
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.arctan2(sine, (first * second).sum(axis=-1))


def _off_plane(centres: FloatArray, rays: FloatArray, other: int) -> FloatArray:
    """Angle (K,) between the other view's rays and the epipolar planes of the first one's."""
    normal = np.cross(centres[other] - centres[0], rays[0])
    with np.errstate(invalid="ignore", divide="ignore"):
        sine = (normal * rays[other]).sum(axis=1) / np.linalg.norm(normal, axis=1)
        return np.abs(np.arcsin(np.clip(sine, -1.0, 1.0)))


def _intersection(
    centres: FloatArray, rays: FloatArray, used: BoolArray, weights: FloatArray | None = None
) -> FloatArray:
    """Points (K, 3) with the least sum of squared distances to the used rays (V, K), which must not be parallel."""
    weights = used.astype(np.float64) if weights is None else weights
    rays = np.where(used[..., None], rays, 0.0)
    # Sum of w (I - d d^T), and the same applied to the centres.
    normal = weights.sum(axis=0)[:, None, None] * np.eye(3) - np.einsum("vk,vki,vkj->kij", weights, rays, rays)
    along = np.einsum("vki,vi->vk", rays, centres)
    right = weights.T @ centres - np.einsum("vk,vk,vki->ki", weights, along, rays)
    return np.linalg.solve(normal, right[..., None])[..., 0]


def _agree(centres: FloatArray, rays: FloatArray, bounds: FloatArray, points: FloatArray) -> BoolArray:
    """Mask (V, K): the view observes the point, which is in front of it, within its bound."""
    with np.errstate(invalid="ignore"):
        return _angles(points[None] - centres[:, None], rays) <= bounds


def _refined(
    centres: FloatArray, rays: FloatArray, bounds: FloatArray, points: FloatArray, support: BoolArray
) -> FloatArray:
    """The points, refined with all views that support them, by angular instead of metric distances to the rays.

    A point that would leave the bound of one of its views is not changed.
    """
    known = np.flatnonzero(np.isfinite(points[:, 0]))
    rays, used, refined = rays[:, known], support[:, known], points[known]
    for _ in range(2):
        ranges = np.linalg.norm(refined[None] - centres[:, None], axis=2)
        weights = np.where(used, 1.0 / np.maximum(ranges, 1e-12) ** 2, 0.0)
        refined = _intersection(centres, rays, used, weights / weights.max(axis=0))
    stays = (~used | _agree(centres, rays, bounds[:, known], refined)).all(axis=0)
    result = points.copy()
    result[known[stays]] = refined[stays]
    return result
