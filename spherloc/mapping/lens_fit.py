"""Fits the lens of a fisheye to matches between its images: that with which they fit motions of the camera best.

The lens is radial, r = f theta (1 + k1 theta^2 + k2 theta^4) (Eq. 4). Lenses of all usual kinds and fields of view are
tried. The best of each kind are refined together with the relative poses of the pairs, by the distance of each match
from its epipolar curves in pixels (the Sampson distance). If the camera only went straight ahead, any radial lens fits:
so the two halves of the pairs are fitted by themselves as well, from opposite expectations, and what they differ by
says how well the lens is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import pi
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.mapping.image_circle import Circle
from spherloc.mapping.parallel import as_completed
from spherloc.mapping.upright import Tell
from spherloc.types import FloatArray, IntArray

PixelPairs = tuple[FloatArray, FloatArray]
"""Matched pixels (M, 2) of two images."""

HALF_FIELDS_RAD = np.radians([50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 110.0])
"""Angles at the rim that are tried."""
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
        """dr / dtheta over f, never near zero."""
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
        """How far a lens (5 or 6 numbers) is from it, in pixels."""
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
    """The lens that fits pairs of images, those with most matches first, and the largest angle, rad, by which the
    lenses of two halves of the pairs differ from it.

    ``rim`` is the image circle, or one through the corners if the image has none. Raises ``ValueError`` if hardly any
    match fits.
    """
    every = [tuple(_even(pixels, MAX_MATCHES) for pixels in pair) for pair in pairs]
    expected = Expected(rim, float(CIRCLE_HALF_RAD) if is_circle else None)
    few = every[:FIRST_PAIRS]
    starts: list[LensFit] = []
    for lens in _starts(pycolmap, every, rim):
        starts.append(_refined(pycolmap, few, lens, expected, FIRST_BOUNDS_PX))
        tell(STAGE, len(starts), FITS)
    best = max(starts, key=lambda fit: fit.score)
    whole = _refined(pycolmap, every, best.lens, expected, BOUNDS_PX)
    tell(STAGE, FITS - 2, FITS)
    radii = np.quantile(whole.radii_px, QUANTILES)
    angles = whole.lens.angles(radii)
    off = 0.0
    for half, shift in ((every[0::2], SHIFT_K1), (every[1::2], -SHIFT_K1)):
        other = _refined(pycolmap, half, whole.lens, replace(expected, k1=shift), BOUNDS_PX)
        off = max(off, float(np.abs(other.lens.angles(radii) - angles).max()))
    tell(STAGE, FITS, FITS)
    return whole, off


def _even(pixels: FloatArray, most: int) -> FloatArray:
    return pixels[np.unique(np.linspace(0, len(pixels) - 1, most).astype(int))] if len(pixels) > most else pixels


def _starts(pycolmap: Any, pairs: Sequence[Any], rim: Circle) -> list[RadialLens]:
    """The best lens of each kind, by the number of matches that fit."""
    lenses = []
    for half, (k1, k2) in product(HALF_FIELDS_RAD, KINDS):
        reach = half * (1.0 + k1 * half**2 + k2 * half**4)
        lenses.append(RadialLens(rim.radius / reach, rim.x, rim.y, k1, k2))
    few = [tuple(_even(pixels, TRIED_MATCHES) for pixels in pair) for pair in pairs[:TRIED_PAIRS]]

    def fitting(lens: RadialLens) -> int:
        return sum(len(geometry.inlier_matches) for pair in few if (geometry := _two(pycolmap, pair, lens, TRIED_PX)))

    counts = dict(as_completed(fitting, lenses))
    best = [max((lens for lens in lenses if lens.k1 == k1), key=counts.__getitem__) for k1, _ in KINDS]
    return sorted(best, key=lambda lens: -counts[lens])


def _two(pycolmap: Any, pair: Any, lens: RadialLens, bound_px: float) -> Any:
    """The ``TwoViewGeometry`` of matched pixels under a lens; None if hardly any fits."""
    height = max(64, round(pi * lens.f))
    sphere = Equirectangular(2 * height, height)
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_MATCHES
    options.ransac.max_error, options.ransac.random_seed = bound_px, 0
    options.ransac.max_num_trials = RANSAC_TRIALS
    options.compute_relative_pose = True
    size = [sphere.width, sphere.height]
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size)
    seen = [sphere.project(lens.bearings(pixels)[0])[0] for pixels in pair]
    each = np.arange(len(seen[0]), dtype=np.uint32)
    found = pycolmap.estimate_calibrated_two_view_geometry(
        camera, seen[0], camera, seen[1], np.column_stack([each, each]), options
    )
    return found if len(found.inlier_matches) >= MIN_MATCHES else None


def _refined(
    pycolmap: Any, pairs: Sequence[Any], lens: RadialLens, expected: Expected, bounds_px: Sequence[float]
) -> LensFit:
    """A lens, refined with the poses of the pairs whose matches fit it."""
    for bound_px in bounds_px:
        found = dict(
            as_completed(
                lambda pair, bound=bound_px, now=lens: _two(pycolmap, pairs[pair], now, bound), range(len(pairs))
            )
        )
        kept = [pair for pair in range(len(pairs)) if found[pair] is not None]
        if not kept:
            raise ValueError("hardly any match fits a motion of the camera")
        chosen = [found[pair].inlier_matches[:, 0] for pair in kept]
        seen = [
            np.concatenate([pairs[pair][side][some] for pair, some in zip(kept, chosen, strict=True)])
            for side in (0, 1)
        ]
        of = np.repeat(np.arange(len(kept)), [len(some) for some in chosen])
        lens, off = _adjusted(lens, _motions([found[pair] for pair in kept]), (seen[0], seen[1]), of, expected)
    radii = np.linalg.norm(np.concatenate(seen) - (lens.cx, lens.cy), axis=1)
    score = float(np.maximum(1.0 - (off / LAST_PX) ** 2, 0.0).sum())
    return LensFit(lens, len(of), radii, score)


def _motions(geometries: Sequence[Any]) -> FloatArray:
    """Rotation vectors and directions (P, 6) of relative poses; of pairs from one place, any direction."""
    poses = np.array([np.asarray(geometry.cam2_from_cam1.matrix()) for geometry in geometries])
    poses[~poses[:, :, 3].any(axis=1), 0, 3] = 1.0
    return np.hstack([Rotation.from_matrix(poses[:, :, :3]).as_rotvec(), poses[:, :, 3]])


def _adjusted(
    lens: RadialLens, motions: FloatArray, seen: PixelPairs, of: IntArray, expected: Expected
) -> tuple[RadialLens, FloatArray]:
    """The lens and the distances (M,), px, of matched pixels (M, 2) from their epipolar curves, after both the lens and
    the motions (P, 6) were fitted; ``of`` is the motion of each match."""
    first = np.array([lens.f, lens.cx, lens.cy, lens.k1, lens.k2])
    count, size = len(of), len(first)

    def off(values: FloatArray) -> FloatArray:
        now = RadialLens(*values[:size])
        return np.concatenate([_distances_px(now, values[size:].reshape(-1, 6), seen, of), expected.off(now)])

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


def _distances_px(lens: RadialLens, motions: FloatArray, seen: PixelPairs, of: IntArray) -> FloatArray:
    """Sampson distances (M,), px, of matched pixels under motions (P, 6)."""
    turn = Rotation.from_rotvec(motions[:, :3]).as_matrix()[of]
    move = (motions[:, 3:] / np.linalg.norm(motions[:, 3:], axis=1, keepdims=True))[of]
    (rays, *ways), (others, *other_ways) = (lens.bearings(pixels) for pixels in seen)
    plane_of_other = np.cross(move, np.einsum("nij,nj->ni", turn, rays))
    plane_of_first = np.einsum("nji,nj->ni", turn, np.cross(others, move))
    slopes = [np.sum(plane_of_first * way, axis=1) for way in ways]
    slopes += [np.sum(plane_of_other * way, axis=1) for way in other_ways]
    steep = np.sqrt(sum(slope**2 for slope in slopes))
    return np.sum(others * plane_of_other, axis=1) / np.maximum(steep, 1e-9)
