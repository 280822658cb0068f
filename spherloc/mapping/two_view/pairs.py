"""Two-view check: which matches of two images fit a relative pose, and whether chance explains as many.

Bearings are compared, so that any lens will do. COLMAP's estimator needs one right match of five or six; where gravity
is known in both images, samples of three find poses among far fewer right ones. A pose is accepted if chance does not
explain its matches (a contrario, Moisan and Stival 2004): of many wrong matches, more than fifteen may fit some pose.
Ambiguous matches that fit the pose are added afterwards.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from math import pi, tau
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.consensus.spread import spread_of
from spherloc.frontend.feature_kinds import Descriptors
from spherloc.frontend.features import Features
from spherloc.frontend.matching import FeatureMatches, MatchOptions, match
from spherloc.frontend.view import Gravity
from spherloc.geometry import DOWN, rotation_angle
from spherloc.mapping.two_view.guided import guided_matches
from spherloc.mapping.two_view.level_pairs import chance_of_fit, fitting, level_pair, log10_nfa
from spherloc.mapping.two_view.rotations import OFF_RAD
from spherloc.mapping.two_view.telling import below_sky, far_rotation, unmoved
from spherloc.mapping.two_view.triangles import MIN_FIT, Pair, Relative, elsewhere, through
from spherloc.types import BoolArray, FloatArray

MIN_MATCHES = 15
"""Least number of matches of a pair of images, after all checks."""
BOUND_RAD = float(np.radians(0.5))
"""Largest angle of a match to its epipolar plane; it is limited to what ``BOUND_PX`` allows."""
BOUND_PX = 1.5, 6.0
ONE_PLACE_RAD = float(np.radians(0.5))
"""If the rays of the matches differ by less, the two images were taken from one place and show no depth."""
LEVEL_BOUND_RAD = float(np.radians(1.2))
"""Largest angle of a match to its epipolar plane where gravity is used: it is known to a degree or less."""
PEAK = 1.7
"""Least peak (``ImagePairs.peak``) of a direction found through a third image, and of that between two panoramas."""
LEAN_RAD = float(np.radians(1.5))
"""Angle by which the gravities of two images may differ under their relative pose, besides the bounds on gravity."""
WIDE_DEG = 280.0
"""The pose of two panoramas is sure if the cube of its peak times the radius of the part of the views in which the
matches lie that fit (``Spread.radius_deg``, mean of the two) is that much: a peak of 1.5 where they lie all around, 1.8
where they are within 50 degrees of one direction, as those of a floor or of a shelf that stands at two places.
``benchmarks.maps`` counts right and wrong pairs by that number."""
MANY_AROUND, AROUND_DEG = 120, 75.0
"""It is sure, too, if so many matches fit within a part of at least that radius: on paving, which fits many directions,
the peak is low."""
SURE = 200.0
"""Of other images, which share a part of their view only, a pose is sure if so many matches fit it, times the cube of
its peak: 60 matches with a peak of 1.5, or 25 with one of 2. ``benchmarks.fisheyes`` shows pairs by that number."""
MANY_SURE = 70
"""It is sure, too, if so many matches fit: on facades they fit many directions."""
FAR = 1.0 / 3.0
"""Share of the matches that fit a rotation alone, from which on they may hide where the camera went."""
NOT_FAR = 3.0
"""A match is of no far thing from so many times the bound on: what is just beyond it has noise and no parallax."""
CLEARLY = 2.0
"""A pose is better than another if this many times as many of the matches that tell it fit; clouds may have made a pose
if this many times as many of the matches above the horizon fit it as of the others."""
SAME_RAD = 1e-6
"""A pose that was written into a database and read again is the same to this angle."""
MAX_LOG10_NFA = -1.0
"""Largest log10 of the NFA: the number of poses that as many of the matches would fit by chance."""


class ImagePairs:
    """Images, each with its camera, which are compared in pairs, in any thread."""

    def __init__(
        self,
        pycolmap: Any,
        cameras: Sequence[Camera],
        features: Sequence[Features],
        usable: Sequence[NDArray[np.int64]],
        gravity: Sequence[Gravity | None],
        matching: MatchOptions,
        promising: Collection[Pair],
        fixed: Mapping[Pair, Relative] = MappingProxyType({}),
    ) -> None:
        """``usable`` are the indices (K,) of each image's features for COLMAP, ``gravity`` that from vertical lines. Of
        joined kinds of features all are matched in ``promising`` pairs, the first in others. ``fixed`` are the relative
        poses of pairs that a calibration tells."""
        self._matching, self._promising, self._fixed = matching, promising, fixed
        self._cameras = cameras
        self._pycolmap = pycolmap
        self._features = features
        height = round(pi * min(focal_px(camera) for camera in cameras))
        sphere = Equirectangular(2 * height, height)
        bound_px = float(np.clip(BOUND_RAD * sphere.width / tau, *BOUND_PX))
        self.bound_rad = bound_px * tau / sphere.width
        """Largest angle of a match to its epipolar plane."""
        self._options = pycolmap.TwoViewGeometryOptions()
        self._options.min_num_inliers = MIN_MATCHES
        self._options.ransac.max_error = bound_px
        self._options.ransac.random_seed = 0
        self._options.compute_relative_pose = True
        self._panorama = pycolmap.Camera(
            model="EQUIRECTANGULAR", width=sphere.width, height=sphere.height, params=[sphere.width, sphere.height]
        )
        self.bearings = [
            camera.unproject(one.pixels[index])[0] for camera, one, index in zip(cameras, features, usable, strict=True)
        ]
        """(K, 3) of each image's usable features."""
        self._pixels = [sphere.project(rays)[0] for rays in self.bearings]
        self._words = [_unit(one.descriptors[index]) for one, index in zip(features, usable, strict=True)]
        self._gravity = gravity
        self._number_of = [np.full(len(found), -1) for found in features]
        for numbers, index in zip(self._number_of, usable, strict=True):
            numbers[index] = np.arange(len(index))

    def compare(self, first: int, second: int) -> tuple[NDArray[np.uint32], Any]:
        """Matches (M, 2), indices of usable features, and a ``TwoViewGeometry`` of those that fit, or None."""
        found = self._matches(first, second)
        pairs = np.column_stack(
            [self._number_of[first][found.query_index], self._number_of[second][found.reference_index]]
        )
        kept = (pairs >= 0).all(axis=1)
        pairs = pairs[kept][np.argsort(found.ratios[kept], kind="stable")].astype(np.uint32)
        geometry = self._geometry(first, second, pairs)
        as_fixed = self._as_fixed(first, second, pairs, geometry)
        if geometry is None or as_fixed is not None:
            return pairs, as_fixed
        return pairs, self._guided(first, second, geometry)

    def _as_fixed(self, first: int, second: int, pairs: NDArray[np.uint32], found: Any) -> Any:
        """A ``TwoViewGeometry`` with the pose that a calibration tells of the pair; None if it tells none, if no more
        of the matches (M, 2) fit it than wrong ones would, or if clearly more of them fit the one that was ``found``
        by them."""
        if (first, second) not in self._fixed or len(pairs) < MIN_MATCHES:
            return None
        pose = self._fixed[first, second]
        rays = self._rays(first, second, pairs)
        fits = int(np.count_nonzero(fitting(*rays, *pose, self.bound_rad)))
        if found is not None and self._support(found, *rays) > CLEARLY * fits:
            return None
        if log10_nfa(len(pairs), fits, chance_of_fit(*rays, *pose, self.bound_rad), sample=0) > MAX_LOG10_NFA:
            return None
        rays, words = (self.bearings[first], self.bearings[second]), (self._words[first], self._words[second])
        more = guided_matches(rays, words, *pose, self.bound_rad)
        if len(more) < MIN_MATCHES:
            return None
        geometry = self._pycolmap.TwoViewGeometry()
        geometry.config = self._pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.cam2_from_cam1 = self._pycolmap.Rigid3d(np.column_stack(pose))
        geometry.inlier_matches = more
        return geometry

    def is_as_fixed(self, pair: Pair, geometry: Any) -> bool:
        """Whether the pose of a pair is the one that a calibration tells."""
        return pair in self._fixed and rotation_angle(relative(geometry)[0] @ self._fixed[pair][0].T) <= SAME_RAD

    def _matches(self, first: int, second: int) -> FeatureMatches:
        one, other = self._features[first], self._features[second]
        if self._learned(first, second) or not one.parts:
            return match(one, other, self._matching)
        return match(one.parts[0], other.parts[0], replace(self._matching, method="nearest", weights=None))

    def _learned(self, first: int, second: int) -> bool:
        """Whether LightGlue matches this pair."""
        joined_kinds = bool(self._features[first].parts)
        return self._matching.method == "lightglue" and (not joined_kinds or (first, second) in self._promising)

    def between(self, pair: Pair, pairs: NDArray[np.uint32], known: Mapping[Pair, Relative], middles: list[int]) -> Any:
        """A ``TwoViewGeometry`` of matches (M, 2), with a pose found through the images ``middles``; None if there is
        none."""
        if len(pairs) < MIN_FIT:
            return None
        first, second = pair
        rays = self.bearings[first][pairs[:, 0]], self.bearings[second][pairs[:, 1]]
        pose = through(known, pair, middles, rays, self.bound_rad)
        if pose is None:
            return None
        words = self._words[first], self._words[second]
        rays = self.bearings[first], self.bearings[second]
        more = guided_matches(rays, words, *pose, self.bound_rad)
        if len(more) < MIN_MATCHES:
            return None
        if self._peak(pair, pose, len(more)) < PEAK:
            return None
        geometry = self._estimated(first, second, more)
        if not self._usable(geometry) or self.same_place(geometry) or not self._level(first, second, geometry):
            return None
        off = rotation_angle(relative(geometry)[0] @ pose[0].T)
        return geometry if off <= OFF_RAD else None

    def sureness(self, first: int, second: int, pairs: NDArray[np.uint32], geometry: Any) -> float:
        """How sure a pose is; it should be ``SURE``.

        Infinity if a calibration tells it. Of panoramas the cube of the peak times the radius of the part of the view
        in which the matches (M, 2) lie that fit, over ``WIDE_DEG``, times ``SURE``, and ``SURE`` at least if
        ``MANY_AROUND`` fit. Of others the number of those that fit, times the cube of the peak, or times what makes
        ``MANY_SURE`` sure.
        """
        if self.is_as_fixed((first, second), geometry):
            return np.inf
        rays, pose = self._rays(first, second, pairs), relative(geometry)
        fits = fitting(*rays, *pose, self.bound_rad)
        count, cameras = int(np.count_nonzero(fits)), (self._cameras[first], self._cameras[second])
        peak = self.peak(first, second, pose) ** 3
        if all(isinstance(camera, Equirectangular) for camera in cameras):
            spreads = [spread_of(camera, seen, fits) for camera, seen in zip(cameras, rays, strict=True)]
            radius_deg = float(np.mean([0.0 if spread is None else spread.radius_deg for spread in spreads]))
            many = float(count >= MANY_AROUND and radius_deg >= AROUND_DEG)
            return SURE * max(peak * radius_deg / WIDE_DEG, many)
        return count * max(peak, SURE / MANY_SURE)

    def peak(self, first: int, second: int, pose: Relative) -> float:
        """How many times as many guided matches fit a pose as one with another direction to the second camera."""
        rays, words = (self.bearings[first], self.bearings[second]), (self._words[first], self._words[second])
        return self._peak((first, second), pose, len(guided_matches(rays, words, *pose, self.bound_rad)))

    def _peak(self, pair: Pair, pose: Relative, count: int) -> float:
        """``peak`` of a pose that ``count`` guided matches fit. On floors and wallpaper it is near 1."""
        first, second = pair
        rays, words = (self.bearings[first], self.bearings[second]), (self._words[first], self._words[second])
        others = [guided_matches(rays, words, pose[0], way, self.bound_rad) for way in elsewhere(pose)]
        return count / max(1, *map(len, others))

    def _geometry(self, first: int, second: int, pairs: NDArray[np.uint32]) -> Any:
        if len(pairs) < MIN_MATCHES:
            return None
        rays = self._rays(first, second, pairs)
        geometry = max(self._poses(first, second, pairs), key=lambda one: len(one.inlier_matches), default=None)
        if geometry is not None and not self._no_chance(geometry, *rays):
            geometry = None
        telling = self._telling(first, second, rays, geometry)
        if telling is None:
            return geometry
        seen = rays[0][telling], rays[1][telling]
        fits = 0 if geometry is None else self._support(geometry, *seen)
        other = max(self._poses(first, second, pairs[telling]), key=lambda one: self._support(one, *seen), default=None)
        if other is not None and self._support(other, *seen) >= CLEARLY * fits and self._no_chance(other, *seen):
            return other
        if geometry is None or self.same_place(geometry) or self._more_than_chance(geometry, *seen):
            return geometry
        return None

    def _telling(self, first: int, second: int, rays: tuple[FloatArray, FloatArray], geometry: Any) -> BoolArray | None:
        """Mask (M,) of the bearings (M, 3) that show where the camera went, if clouds or other far things may hide it;
        None if they do not, or if all matches are theirs."""
        turn = far_rotation(*rays, self.bound_rad)
        if turn is None:
            return None
        far = unmoved(*rays, turn, self.bound_rad)
        known = all(
            self._gravity[one] is not None or isinstance(self._cameras[one], Equirectangular) for one in (first, second)
        )
        low = below_sky(*rays, (self._down(first), self._down(second))) if known else np.ones(len(far), np.bool_)
        telling = low & ~unmoved(*rays, turn, NOT_FAR * self.bound_rad)
        if np.count_nonzero(telling) < MIN_MATCHES:
            return None
        hidden = bool(far.mean() >= FAR)
        if not hidden and geometry is not None and np.count_nonzero(~low) >= MIN_MATCHES:
            shares = [
                self._support(geometry, rays[0][some], rays[1][some]) / np.count_nonzero(some) for some in (low, ~low)
            ]
            hidden = CLEARLY * shares[0] < shares[1]
        return telling if hidden else None

    def _support(self, geometry: Any, first: FloatArray, second: FloatArray) -> int:
        """How many of the bearings (M, 3) fit."""
        rotation, direction = relative(geometry)
        if self.same_place(geometry):
            return int(np.count_nonzero(unmoved(first, second, rotation, self.bound_rad)))
        return int(np.count_nonzero(fitting(first, second, rotation, direction, self.bound_rad)))

    def _rays(self, first: int, second: int, pairs: NDArray[np.uint32]) -> tuple[FloatArray, FloatArray]:
        """Bearings of matches (M, 2) in both images, each (M, 3)."""
        return self.bearings[first][pairs[:, 0]], self.bearings[second][pairs[:, 1]]

    def _poses(self, first: int, second: int, pairs: NDArray[np.uint32]) -> list[Any]:
        """Usable ``TwoViewGeometry`` of matches (M, 2), and of those of them that fit two level cameras."""
        level = level_pair(*self._rays(first, second, pairs), (self._down(first), self._down(second)), LEVEL_BOUND_RAD)
        found = [self._estimated(first, second, pairs)]
        if level is not None and np.count_nonzero(level.fits) >= MIN_MATCHES:
            found.append(self._estimated(first, second, pairs[level.fits]))
        return [one for one in found if self._usable(one) and self._level(first, second, one)]

    def _down(self, index: int) -> FloatArray:
        gravity = self._gravity[index]
        return DOWN if gravity is None else gravity.down

    def _level(self, first: int, second: int, geometry: Any) -> bool:
        """Whether the gravities of both images agree under the pose; true where lines do not show both."""
        one, other = self._gravity[first], self._gravity[second]
        if one is None or other is None:
            return True
        bound_rad = LEAN_RAD + (one.bound_rad or 0.0) + (other.bound_rad or 0.0)
        return bool(relative(geometry)[0] @ one.down @ other.down >= np.cos(bound_rad))

    def _estimated(self, first: int, second: int, pairs: NDArray[np.uint32]) -> Any:
        return self._pycolmap.estimate_calibrated_two_view_geometry(
            self._panorama, self._pixels[first], self._panorama, self._pixels[second], pairs, self._options
        )

    def _usable(self, geometry: Any) -> bool:
        kinds = self._pycolmap.TwoViewGeometryConfiguration
        if geometry.cam2_from_cam1 is None:  # COLMAP found matches that fit, but no pose that they agree on
            return False
        if geometry.config == kinds.PLANAR:
            return geometry.tri_angle < ONE_PLACE_RAD
        return geometry.config in (kinds.CALIBRATED, kinds.PANORAMIC)

    def _no_chance(self, geometry: Any, first: FloatArray, second: FloatArray) -> bool:
        """Whether wrong matches alone would hardly fit a pose as well as these bearings (M, 3) do."""
        if self.same_place(geometry):
            return True
        pose = relative(geometry)
        fits = fitting(first, second, *pose, self.bound_rad)
        chance = chance_of_fit(first, second, *pose, self.bound_rad)
        return log10_nfa(len(first), int(np.count_nonzero(fits)), chance) <= MAX_LOG10_NFA

    def _more_than_chance(self, geometry: Any, first: FloatArray, second: FloatArray) -> bool:
        """Whether more of these bearings (M, 3) fit than wrong matches alone would: a pose that clouds have is none."""
        expected = len(first) * chance_of_fit(first, second, *relative(geometry), self.bound_rad)
        return self._support(geometry, first, second) > expected + 3.0 * np.sqrt(max(expected, 1.0))

    def _guided(self, first: int, second: int, geometry: Any) -> Any:
        """The geometry with the matches that are found near the epipolar planes, if they are more."""
        if self.same_place(geometry):
            return geometry
        rays = self.bearings[first], self.bearings[second]
        words = self._words[first], self._words[second]
        pairs = guided_matches(rays, words, *relative(geometry), self.bound_rad)
        if len(pairs) <= len(geometry.inlier_matches):
            return geometry
        other = self._estimated(first, second, pairs)
        right = self._usable(other) and not self.same_place(other) and self._level(first, second, other)
        return other if right and len(other.inlier_matches) > len(geometry.inlier_matches) else geometry

    def same_place(self, geometry: Any) -> bool:
        """Whether the two images were taken from one place."""
        return geometry.config != self._pycolmap.TwoViewGeometryConfiguration.CALIBRATED


def _unit(descriptors: Descriptors) -> NDArray[np.float32]:
    """Descriptors (N, D), scaled to length 1."""
    words = descriptors.astype(np.float32)
    return words / np.maximum(np.linalg.norm(words, axis=1, keepdims=True), np.float32(1e-9))


def relative(geometry: Any) -> Relative:
    """Rotation (3, 3) and unit direction (3,) of the second camera from the first."""
    matrix = np.asarray(geometry.cam2_from_cam1.matrix())
    return matrix[:, :3], matrix[:, 3] / max(float(np.linalg.norm(matrix[:, 3])), 1e-12)


def focal_px(camera: Camera) -> float:
    """Pixels per radian in the middle of the image."""
    ahead = np.array([[0.0, 0.0, 1.0], [1e-3, 0.0, 1.0]])
    pixels, _ = camera.project(ahead)
    return float(np.linalg.norm(pixels[1] - pixels[0]) / 1e-3)
