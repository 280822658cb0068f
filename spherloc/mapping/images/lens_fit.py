"""Fits the lens of a fisheye to matches between its images: that with which they fit motions of the camera best.

The lens is radial, r = f theta (1 + k1 theta^2 + k2 theta^4) (Eq. 4). Lenses of all usual kinds and fields of view are
tried. The best of each kind are refined together with the relative poses of the pairs, by the distance of each match
from its epipolar curves in pixels (the Sampson distance), or from its place if the camera only turned: there a wrong
lens would make up a motion. If the camera only went straight ahead, any radial lens fits:
so the two halves of the pairs are fitted by themselves as well, from opposite expectations, and what they and other
lenses that fit nearly as well differ by says how well the lens is known.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from math import pi
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.mapping.images.image_circle import Circle
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.mapping.two_view.telling import far_rotation, unmoved
from spherloc.types import BoolArray, FloatArray, IntArray

PixelPairs = tuple[FloatArray, FloatArray]
"""Matched pixels (M, 2) of two images."""

HALF_FIELDS_RAD = np.radians([50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 110.0])
CIRCLE_FIELDS_RAD = HALF_FIELDS_RAD[2:]
"""Angles at the rim that are tried, without an image circle and with one."""
KINDS = ((1 / 12, 1 / 120), (0.0, 0.0), (-1 / 24, 1 / 1920))
"""k1 and k2 that are tried: of the stereographic, equidistant and equisolid projections."""
STAGE, FITS = "fits of the lens to the matches", len(KINDS) + 3
"""What progress is called, and the number of fits: one of each kind, then by all pairs and by two halves of them."""
SD_K = np.array([0.06, 0.015])
"""How much k1 and k2 of real lenses vary."""
SHIFT_K1 = 0.04
"""The two halves expect a k1 that is larger and one that is smaller by this."""
CIRCLE_HALF_RAD, SD_HALF_RAD = np.radians(95.0), np.radians(15.0)
"""Angle at the rim of an image circle, and how much it varies."""
SD_CENTRE = 0.02
"""How far the principal point is from the centre, as a share of the radius."""
WEIGHT_PX = 5.0
"""Weight of one standard deviation from what is expected: as much as so many pixels of a match."""
TRIED_PAIRS, TRIED_MATCHES = 6, 250
"""Number of pairs by which lenses are tried, and largest number of matches of each."""
FIRST_PAIRS = 12
"""Number of pairs by which the best of those are refined."""
MAX_MATCHES = 400
"""Largest number of matches of a pair that count."""
TRIED_PX = 2.0
FIRST_BOUNDS_PX, BOUNDS_PX = (3.0, 1.5), (2.0, 1.5, 1.0)
"""Bounds on a match, one refinement after another: of the lenses that are tried, and of the best."""
MAX_STEPS = 15
"""Largest number of steps of a refinement; the next one goes on."""
NEARLY = 0.85
"""Another lens fits nearly as well if its score is this share of that of the best."""
LAST_PX = 0.7
"""The lens is taken of which most matches are within this bound, and closest."""
MIN_MATCHES = 20
"""Least number of matches of a pair that fit."""
RANSAC_TRIALS = 1000
QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Radii at which two lenses are compared, as quantiles of those of the matches."""
MAX_THETA_RAD = 0.95 * pi
_NEWTON_STEPS = 8
_MIN_SLOPE = 0.1
_STEP = 1e-6


@dataclass(frozen=True)
class RadialLens:
    """A radial lens."""

    f: float
    cx: float
    cy: float
    k1: float
    k2: float

    def angles(self, radii_px: FloatArray) -> FloatArray:
        """Angles (N,) to the optical axis, rad, of pixels at such distances (N,) from the principal point."""
        radii = radii_px / self.f
        theta = radii.copy()
        for _ in range(_NEWTON_STEPS):
            off = theta * (1.0 + self.k1 * theta**2 + self.k2 * theta**4) - radii
            theta = np.clip(theta - off / self.slope(theta), 0.0, MAX_THETA_RAD)
        return theta

    def slope(self, theta: FloatArray) -> FloatArray:
        """(N,) dr / dtheta over f, never near zero, at angles (N,)."""
        return np.maximum(1.0 + 3.0 * self.k1 * theta**2 + 5.0 * self.k2 * theta**4, _MIN_SLOPE)

    def bearings(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and how they change, (N, 3) per pixel, outwards and sideways."""
        offset = pixels - (self.cx, self.cy)
        radii = np.maximum(np.linalg.norm(offset, axis=1), 1e-6)
        theta = self.angles(radii)
        ahead, around = np.cos(theta), np.sin(theta)
        out = offset / radii[:, None]
        rays = np.column_stack([out * around[:, None], ahead])
        outwards = np.column_stack([out * ahead[:, None], -around]) / (self.f * self.slope(theta))[:, None]
        sideways = np.column_stack([-out[:, 1], out[:, 0], 0.0 * around]) * (around / radii)[:, None]
        return rays, outwards, sideways


@dataclass(frozen=True)
class Expected:
    """What is expected of a lens before it is fitted, by a circle that its image has or may have."""

    rim: Circle
    half_rad: float | None
    """Angle at the rim; None if that may be any."""
    k1: float = 0.0

    def off(self, lens: RadialLens) -> FloatArray:
        """(4,) how far a lens is from it, in pixels, or (5,) where an angle at the rim is expected."""
        sd_px = SD_CENTRE * self.rim.radius
        off = [
            (lens.k1 - self.k1) / SD_K[0],
            lens.k2 / SD_K[1],
            (lens.cx - self.rim.x) / sd_px,
            (lens.cy - self.rim.y) / sd_px,
        ]
        if self.half_rad is not None:
            half = self.half_rad
            reach = lens.f * half * (1.0 + lens.k1 * half**2 + lens.k2 * half**4)
            off.append((reach - self.rim.radius) / (lens.f * SD_HALF_RAD))
        return WEIGHT_PX * np.array(off)


@dataclass(frozen=True, eq=False)
class LensFit:
    """A lens that was fitted, and how well."""

    lens: RadialLens
    matches: int
    """Number of the matches that fit."""
    radii_px: FloatArray
    """Their distances from the principal point."""
    score: float


def fit_lens(
    pycolmap: Any, pairs: Sequence[PixelPairs], rim: Circle, tell: Tell, *, is_circle: bool
) -> tuple[LensFit, float]:
    """The lens that fits pairs of images, those with most matches first, and the largest angle, rad, by which lenses
    differ from it that fit nearly as well, or that two halves of the pairs have.

    ``rim`` is the image circle, or one through the corners if the image has none. Raises ``ValueError`` if hardly any
    match fits.
    """
    every = [tuple(_even(pixels, MAX_MATCHES) for pixels in pair) for pair in pairs]
    expected = Expected(rim, float(CIRCLE_HALF_RAD) if is_circle else None)
    few = every[:FIRST_PAIRS]
    tried: list[LensFit] = []
    starts = _starts(pycolmap, every, rim, CIRCLE_FIELDS_RAD if is_circle else HALF_FIELDS_RAD)
    for done, lens in enumerate(starts, start=1):
        with suppress(ValueError):
            tried.append(_refined(pycolmap, few, lens, expected, FIRST_BOUNDS_PX))
        tell(STAGE, done, FITS)
    if not tried:
        raise ValueError("hardly any match fits a motion of the camera, whatever the lens")
    best, *others = sorted(tried, key=lambda fit: -fit.score)
    whole = _refined(pycolmap, every, best.lens, expected, BOUNDS_PX)
    tell(STAGE, FITS - 2, FITS)
    radii = np.quantile(whole.radii_px, QUANTILES)

    def off_rad(other: LensFit) -> float:
        return float(np.abs(other.lens.angles(radii) - whole.lens.angles(radii)).max())

    alike = []
    rivals = [other for other in others if other.score > NEARLY * best.score]
    same = _refined(pycolmap, few, whole.lens, expected, BOUNDS_PX[-1:]) if rivals else whole
    for rival in rivals:
        with suppress(ValueError):  # fits nothing within the last bounds
            fit = _refined(pycolmap, few, rival.lens, expected, BOUNDS_PX)
            alike += [fit] if fit.score > NEARLY * same.score else []
    for half, shift in ((every[0::2], SHIFT_K1), (every[1::2], -SHIFT_K1)):
        alike.append(_refined(pycolmap, half, whole.lens, replace(expected, k1=shift), BOUNDS_PX))
    tell(STAGE, FITS, FITS)
    return whole, max(map(off_rad, alike))


def _even(pixels: FloatArray, most: int) -> FloatArray:
    return pixels[np.unique(np.linspace(0, len(pixels) - 1, most).astype(int))] if len(pixels) > most else pixels


def _starts(pycolmap: Any, pairs: Sequence[Any], rim: Circle, half_fields_rad: FloatArray) -> list[RadialLens]:
    """The best lens of each kind, by the number of matches that fit."""
    lenses = []
    for half, (k1, k2) in product(half_fields_rad, KINDS):
        reach = half * (1.0 + k1 * half**2 + k2 * half**4)
        lenses.append(RadialLens(rim.radius / reach, rim.x, rim.y, k1, k2))
    few = [tuple(_even(pixels, TRIED_MATCHES) for pixels in pair) for pair in pairs[:TRIED_PAIRS]]

    def worth(lens: RadialLens) -> int:
        return sum(motion.worth for pair in few if (motion := _motion(pycolmap, pair, lens, TRIED_PX)))

    counts = dict(as_completed(worth, lenses))
    best = [max((lens for lens in lenses if lens.k1 == k1), key=counts.__getitem__) for k1, _ in KINDS]
    return sorted(best, key=lambda lens: -counts[lens])


@dataclass(frozen=True, eq=False)
class PairMotion:
    """How the camera moved between two images."""

    fits: IntArray
    """(K,) matches that fit."""
    turn: FloatArray
    """Rotation (3, 3) of the second camera from the first."""
    move: FloatArray
    """Direction (3,) of the first camera's centre, seen from the second; any if the camera only turned."""
    only_turned: bool

    @property
    def worth(self) -> int:
        """Number of distances that fit: a match fixes two where the camera only turned, else one."""
        return (2 if self.only_turned else 1) * len(self.fits)


def _motion(pycolmap: Any, pair: Any, lens: RadialLens, bound_px: float) -> PairMotion | None:
    """The motion that matched pixels fit under a lens, a rotation alone if that says more; None if hardly any fits."""
    first, second = (lens.bearings(pixels)[0] for pixels in pair)
    turn = far_rotation(first, second, bound_px / lens.f)
    found: list[PairMotion] = []
    if turn is not None:
        fits = np.flatnonzero(unmoved(first, second, turn, bound_px / lens.f))
        found.append(PairMotion(fits, turn, np.array([1.0, 0.0, 0.0]), only_turned=True))
    geometry = _two_view_geometry(pycolmap, (first, second), lens, bound_px)
    if len(geometry.inlier_matches) >= MIN_MATCHES and geometry.cam2_from_cam1 is not None:
        pose = np.asarray(geometry.cam2_from_cam1.matrix())
        fits = geometry.inlier_matches[:, 0].astype(np.int64)
        move = pose[:, 3] if pose[:, 3].any() else np.array([1.0, 0.0, 0.0])
        found.append(PairMotion(fits, pose[:, :3], move, only_turned=False))
    best = max(found, key=lambda motion: motion.worth, default=None)
    return best if best is not None and len(best.fits) >= MIN_MATCHES else None


def _two_view_geometry(pycolmap: Any, rays: tuple[FloatArray, FloatArray], lens: RadialLens, bound_px: float) -> Any:
    """The ``TwoViewGeometry`` of matched bearings, on a panorama of the lens' pixels per radian."""
    height = max(64, round(pi * lens.f))
    sphere = Equirectangular(2 * height, height)
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_MATCHES
    options.ransac.max_error, options.ransac.random_seed = bound_px, 0
    options.ransac.max_num_trials = RANSAC_TRIALS
    options.compute_relative_pose = True
    size = [sphere.width, sphere.height]
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size)
    first, second = (sphere.project(one)[0] for one in rays)
    each = np.arange(len(first), dtype=np.uint32)
    pairs = np.column_stack([each, each])
    return pycolmap.estimate_calibrated_two_view_geometry(camera, first, camera, second, pairs, options)


@dataclass(frozen=True, eq=False)
class LensMatches:
    """Matches that fit motions, M of them."""

    seen: PixelPairs
    """(M, 2) pixels in the first and in the second image of their pair."""
    of: IntArray
    """(M,) index of their motion."""
    only_turned: BoolArray
    """(M,) whether that is a rotation alone."""


def _refined(
    pycolmap: Any, pairs: Sequence[Any], lens: RadialLens, expected: Expected, bounds_px: Sequence[float]
) -> LensFit:
    """A lens, refined with the motions that the matches of the pairs fit."""
    for bound_px in bounds_px:
        found = dict(
            as_completed(
                lambda pair, bound=bound_px, now=lens: _motion(pycolmap, pairs[pair], now, bound), range(len(pairs))
            )
        )
        kept = [(pairs[pair], motion) for pair in range(len(pairs)) if (motion := found[pair]) is not None]
        if not kept:
            raise ValueError("hardly any match fits a motion of the camera")
        first, second = (np.concatenate([pair[side][motion.fits] for pair, motion in kept]) for side in (0, 1))
        counts = [len(motion.fits) for _, motion in kept]
        only_turned = np.repeat([motion.only_turned for _, motion in kept], counts)
        matches = LensMatches((first, second), np.repeat(np.arange(len(kept)), counts), only_turned)
        turns = Rotation.from_matrix([motion.turn for _, motion in kept]).as_rotvec()
        lens, off_px = _adjusted(lens, np.hstack([turns, [motion.move for _, motion in kept]]), matches, expected)
    radii = np.linalg.norm(np.concatenate([first, second]) - (lens.cx, lens.cy), axis=1)
    score = float(np.maximum(1.0 - (off_px / LAST_PX) ** 2, 0.0).sum())
    return LensFit(lens, len(first), radii, score)


def _adjusted(
    lens: RadialLens, motions: FloatArray, matches: LensMatches, expected: Expected
) -> tuple[RadialLens, FloatArray]:
    """The lens and the distances of the matches, px, as of ``_distances_px``, after both the lens and the motions
    (P, 6), a rotation vector and a direction each, were fitted."""
    first = np.array([lens.f, lens.cx, lens.cy, lens.k1, lens.k2])
    size = len(first)
    of = np.concatenate([matches.of, matches.of[matches.only_turned]])
    count = len(of)

    def off(values: FloatArray) -> FloatArray:
        now = RadialLens(*values[:size])
        return np.concatenate([_distances_px(now, values[size:].reshape(-1, 6), matches), expected.off(now)])

    def slopes(values: FloatArray) -> FloatArray:
        here = off(values)
        table = np.zeros((len(here), len(values)))
        for column in range(size):
            step = _STEP * max(1.0, abs(values[column]))
            moved = values.copy()
            moved[column] += step
            table[:, column] = (off(moved) - here) / step
        for part in range(6):  # a match depends on the motion of its pair alone
            columns = size + 6 * np.arange(len(motions)) + part
            moved = values.copy()
            moved[columns] += _STEP
            table[np.arange(count), columns[of]] = (off(moved) - here)[:count] / _STEP
        return table

    start = np.concatenate([first, motions.ravel()])
    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    low[0], high[0] = 0.3 * lens.f, 3.0 * lens.f
    scale = np.concatenate([[10.0, 2.0, 2.0, 0.01, 0.01], np.full(motions.size, 0.01)])
    found = least_squares(
        off,
        start,
        jac=slopes,  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        x_scale=scale,
        loss="soft_l1",
        f_scale=0.5,
        max_nfev=MAX_STEPS,
    )
    return RadialLens(*(float(value) for value in found.x[:size])), found.fun[:count]


def _distances_px(lens: RadialLens, motions: FloatArray, matches: LensMatches) -> FloatArray:
    """Distances (M + T,) of matched pixels under motions (P, 6): the Sampson distance to the epipolar curves, or, for
    the T whose camera only turned, the offset away from the principal point and, at the end, that across."""
    turn = Rotation.from_rotvec(motions[:, :3]).as_matrix()[matches.of]
    move = (motions[:, 3:] / np.linalg.norm(motions[:, 3:], axis=1, keepdims=True))[matches.of]
    (rays, *ways), (others, *other_ways) = (lens.bearings(pixels) for pixels in matches.seen)
    turned = np.einsum("nij,nj->ni", turn, rays)
    plane_of_other = np.cross(move, turned)
    plane_of_first = np.einsum("nji,nj->ni", turn, np.cross(others, move))
    slopes = [np.sum(plane_of_first * way, axis=1) for way in ways]
    slopes += [np.sum(plane_of_other * way, axis=1) for way in other_ways]
    steep = np.sqrt(sum(slope**2 for slope in slopes))
    epipolar = np.sum(others * plane_of_other, axis=1) / np.maximum(steep, 1e-9)
    # Both pixels have noise, so that an offset is larger than a Sampson distance by the square root of two.
    away, across = (
        np.sum((turned - others) * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1e-18) / np.sqrt(2.0)
        for way in other_ways
    )
    only_turned = matches.only_turned
    return np.concatenate([np.where(only_turned, away, epipolar), across[only_turned]])
