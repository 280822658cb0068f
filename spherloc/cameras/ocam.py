"""OCamCalib's polynomial (Scaramuzza, Martinelli, Siegwart: A Toolbox for Easily Calibrating Omnidirectional Cameras,
IROS 2006), for fisheye lenses and mirrors with one centre of projection.

A pixel minus the principal point is an affine image of a point (x, y) at the distance r from the axis, in pixels, whose
ray is (x, y, f(r)) with f(r) = a0 + a1 r + a2 r^2 + ... (Eq. 3). The angle to the axis grows with r as long as
f(r) - r f'(r) > 0; the model ends there or at the image's farthest corner, beyond which nothing was calibrated. The
toolbox's second polynomial is a fit of the inverse; here the first one is inverted numerically, to the last digits.
"""

from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import Any, ClassVar, Self

import numpy as np

from spherloc.cameras import _checks
from spherloc.cameras._radial import RIM_MARGIN, InverseTable, first_positive_root
from spherloc.errors import CalibrationError, show
from spherloc.types import BoolArray, FloatArray

MAX_TERMS = 16
"""Largest number of coefficients of the polynomial; the toolbox uses five."""
_TABLE_NODES = 1025
_NEWTON_STEPS = 3
_BISECTIONS = 60
_TOLERANCE_RAD = 1e-14
_ROUNDING = 1e-12
"""Relative error of the angle at the end of the model by the rounding of a pixel."""
_MIN_DETERMINANT = 0.1


@dataclass(frozen=True)
class Ocam:
    """Wide camera whose rays have a depth that is a polynomial of the distance to the axis in the image."""

    model: ClassVar[str] = "ocam"

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    cx: float
    """Principal point, x in pixels; the centre of the top-left pixel is 0.5."""
    cy: float
    """Principal point, y in pixels; the centre of the top-left pixel is 0.5."""
    affine: tuple[float, ...]
    """a11, a12, a21, a22: u = cx + a11 x + a12 y, v = cy + a21 x + a22 y. OCamCalib's c, d, e are a22, a21, a12."""
    polynomial: tuple[float, ...]
    """a0, a1, ...: depth of the ray along +z at the distances r^0, r^1, ... px. OCamCalib's have the other sign."""

    def __post_init__(self) -> None:
        checks = {"width": _checks.whole_pixels, "height": _checks.whole_pixels}
        for key, check in (checks | {"cx": _checks.finite, "cy": _checks.finite}).items():
            object.__setattr__(self, key, check(key, getattr(self, key)))
        object.__setattr__(self, "affine", _checks.coefficients("affine", self.affine, "a11, a12, a21, a22"))
        if not self._determinant > _MIN_DETERMINANT:
            raise CalibrationError(
                f"camera key 'affine' is {show(list(self.affine))}, which mirrors the image or flattens it: "
                "check the order of the coefficients."
            )
        given: Any = self.polynomial
        terms = len(given) if isinstance(given, list | tuple | np.ndarray) else 0
        if not 1 <= terms <= MAX_TERMS:
            raise CalibrationError(
                f"camera key 'polynomial' is {show(given)}: give a list of 1 to {MAX_TERMS} finite numbers, a0, a1, ..."
            )
        names = ", ".join(f"a{power}" for power in range(terms))
        object.__setattr__(self, "polynomial", _checks.coefficients("polynomial", given, names))
        if not self.polynomial[0] > 0.0:
            raise CalibrationError(
                f"camera key 'polynomial' begins with {self.polynomial[0]:g}: give a positive a0, the focal length in "
                "pixels."
            )
        with np.errstate(all="ignore"):
            if not self.max_radius >= 1.0:
                raise CalibrationError(
                    f"camera key 'polynomial' is {show(list(self.polynomial))}, which cannot be inverted one pixel "
                    "away from the principal point: check the order and the signs of the coefficients."
                )
            nearest = [[min(max(self.cx, 0.0), self.width), min(max(self.cy, 0.0), self.height)]]
            if not self.unproject(np.array(nearest))[1][0]:
                raise CalibrationError(
                    f"camera keys 'cx', 'cy' are {self.cx:g}, {self.cy:g}, from where the lens reaches no pixel of the "
                    f"{self.width} x {self.height} image: give the principal point in pixels."
                )

    @property
    def _determinant(self) -> float:
        a11, a12, a21, a22 = self.affine
        return a11 * a22 - a12 * a21

    @cached_property
    def max_radius(self) -> float:
        """Distance from the axis, px, below which the model is one to one."""
        focal = self.polynomial[0]
        # f - r f' = a0 (1 - (a2 r^2 + 2 a3 r^3 + ...) / a0), a1 drops out
        slope = [(1 - power) * a / focal for power, a in enumerate(self.polynomial)][1:]
        fold = first_positive_root(slope) * (1.0 - RIM_MARGIN)
        corners = [(u, v) for u in (0.0, float(self.width)) for v in (0.0, float(self.height))]
        farthest = float(np.hypot(*self._plane(np.array(corners))).max())
        return min(fold, farthest * (1.0 + RIM_MARGIN) + 1.0)

    def _plane(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """x and y, (N,) each, px, of pixels (N, 2) in the plane before the affine map."""
        u, v = _checks.rows("pixels", pixels, 2).T
        a11, a12, a21, a22 = self.affine
        east, south = u - self.cx, v - self.cy
        return (a22 * east - a12 * south) / self._determinant, (a11 * south - a21 * east) / self._determinant

    def _depth(self, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
        """f(r) and f'(r), (N,) each."""
        depth, slope = np.zeros_like(radius), np.zeros_like(radius)
        for a in reversed(self.polynomial):
            slope = slope * radius + depth
            depth = depth * radius + a
        return depth, slope

    def _angle(self, radius: FloatArray) -> FloatArray:
        """Angles (N,) to the optical axis, rad, at distances (N,) px from it."""
        return np.arctan2(radius, self._depth(radius)[0])

    @cached_property
    def _inverse(self) -> InverseTable:
        return InverseTable(self._angle, np.linspace(0.0, self.max_radius, _TABLE_NODES))

    def _radius(self, theta: FloatArray) -> FloatArray:
        """r of angles (N,) to the axis, rad; NaN beyond the model's end."""
        end = self._inverse.end
        inside = theta <= end * (1.0 + _ROUNDING)
        theta = np.where(inside, np.minimum(theta, end), np.nan)
        radius = self._inverse(theta)
        for _ in range(_NEWTON_STEPS):
            depth, slope = self._depth(radius)
            radius = radius + (theta - np.arctan2(radius, depth)) * (radius**2 + depth**2) / (depth - radius * slope)
        # Newton's method may diverge where the angle hardly changes.
        hard = inside & ~(np.abs(self._angle(radius) - theta) <= _TOLERANCE_RAD) | (radius > self.max_radius)
        if hard.any():
            low, high = np.zeros(int(hard.sum())), np.full(int(hard.sum()), self.max_radius)
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                below = self._angle(middle) < theta[hard]
                low, high = np.where(below, middle, low), np.where(below, high, middle)
            radius[hard] = 0.5 * (low + high)
        return np.where(inside, radius, np.nan)

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of camera-frame points (N, 3) in metres, and the mask (N,) of directions that are valid.

        Directions before the fold and within the circle around the image are valid; other pixels are NaN. Raises
        ``ProblemError`` for a wrong shape.
        """
        points = _checks.rows("points", points, 3)
        with np.errstate(all="ignore"):
            x, y, z = points.T
            lateral = np.hypot(x, y)
            valid = np.isfinite(lateral + z) & ((lateral > 0.0) | (z > 0.0))
            radius = self._radius(np.where(valid, np.arctan2(lateral, z), pi + 1.0))
            valid &= np.isfinite(radius)
            scale = np.where(lateral > 0.0, radius / lateral, 0.0)
            a11, a12, a21, a22 = self.affine
            x, y = scale * x, scale * y
            pixels = np.column_stack([self.cx + a11 * x + a12 * y, self.cy + a21 * x + a22 * y])
        pixels[~valid] = np.nan
        return pixels, valid

    def _rays(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """x, y, f(r) and f'(r) / r, (N,) each; NaN beyond the model's end."""
        x, y = self._plane(pixels)
        radius = np.hypot(x, y)
        outside = ~(radius <= self.max_radius)
        x, y, radius = (np.where(outside, np.nan, value) for value in (x, y, radius))
        depth, slope = self._depth(radius)
        return x, y, depth, np.where(radius > 0.0, slope / radius, 0.0)

    def unproject(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and the mask (N,) of pixels that the lens reaches.

        Raises ``ProblemError`` for a wrong shape.
        """
        with np.errstate(all="ignore"):
            x, y, depth, _ = self._rays(pixels)
            length = np.hypot(np.hypot(x, y), depth)
            bearings = np.column_stack([x / length, y / length, depth / length])
        return bearings, ~np.isnan(bearings[:, 2])

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        with np.errstate(all="ignore"):
            x, y, depth, growth = self._rays(pixels)
            length = np.hypot(np.hypot(x, y), depth)
            ray = np.column_stack([x, y, depth]) / length[:, None]
            moved = np.zeros((len(x), 3, 2))
            moved[:, 0, 0] = moved[:, 1, 1] = 1.0
            moved[:, 2, 0], moved[:, 2, 1] = growth * x, growth * y
            moved /= length[:, None, None]
            by_plane = moved - ray[:, :, None] * np.einsum("nk,nkc->nc", ray, moved)[:, None, :]
            a11, a12, a21, a22 = self.affine
            jacobian = by_plane @ (np.array([[a22, -a12], [-a21, a11]]) / self._determinant)
        jacobian[np.isnan(ray[:, 2])] = np.nan
        return jacobian

    def to_dict(self) -> dict[str, Any]:
        """The ``[camera]`` table: model and all fields."""
        return _checks.camera_to_table(self)

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str) -> Self:
        """Build from a ``[camera]`` table; raises ``CalibrationError`` (see ``Camera.from_dict``)."""
        return _checks.camera_from_keys(cls, table, where)
