"""Fisheye with six radial, two tangential and four thin-prism coefficients: FISHEYE624 of Project Aria.

It is COLMAP's RAD_TAN_THIN_PRISM_FISHEYE. A bearing at the angle theta goes to the radius theta_d, as with
Kannala-Brandt, at a point q of the plane, and q is then moved by the tangential and prism terms d(q). The derivative
of d has a norm of at most 1/2 within a disc, ``_prism_radius``; there q + d(q) is one to one, and repeating
q = m - d(q), kept in the disc, always leads to the one q of a point m. All valid points lie within that disc, which
for real lenses is far wider than the image.
"""

from dataclasses import dataclass
from functools import cached_property
from math import hypot
from typing import ClassVar

import numpy as np

from spherloc.cameras import _checks
from spherloc.cameras._radial import AngleCurve, first_positive_root
from spherloc.types import BoolArray, FloatArray

_FARTHEST = 1e3
"""Largest radius of the disc, focal lengths: no image is a thousand focal lengths wide."""
_NEWTON_STEPS = 4
"""Number of Newton steps: enough for real lenses, whose prism terms are a few thousandths."""
_PATIENT_STEPS = 60
"""Number of contracting steps, each of which at least halves the error."""
_TOLERANCE = 1e-13
"""Residual of q + d(q) = m, relative to 1 + |m|, that counts as solved."""


@dataclass(frozen=True)
class Fisheye624(_checks.FocalCamera):
    """Fisheye camera with radial, tangential and thin-prism distortion; fx, fy are pixels per radian on the axis."""

    model: ClassVar[str] = "fisheye624"

    distortion: tuple[float, ...]
    """k0 to k5 (radial), p0, p1 (tangential) and s0 to s3 (prism), without unit, in Aria's and COLMAP's order."""

    def __post_init__(self) -> None:
        self.check_lens("k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3")
        with np.errstate(all="ignore"):
            self.check_sees_image(self._curve.end)

    @property
    def max_angle_rad(self) -> float:
        """Largest angle to the optical axis that the model can invert, at most pi."""
        return self._curve.max_angle_rad

    def _plane_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Directions within ``max_angle_rad`` of the optical axis are valid."""
        x, y, valid = self._curve.plane(points)
        dx, dy = self._shift(x, y)
        return x + dx, y + dy, valid

    def _bearings(self, pixels: FloatArray) -> FloatArray:
        return self._curve.bearings(*self._unshift(pixels))

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        with np.errstate(all="ignore"):
            x, y = self._unshift(pixels)
            xx, xy, yx, yy = self._shift_jacobian(x, y)
            inverse = np.array([[yy, -xy], [-yx, xx]]) / (xx * yy - xy * yx)
            return np.einsum("nij,jkn->nik", self._curve.jacobian(x, y), inverse) / (self.fx, self.fy)

    @cached_property
    def _curve(self) -> AngleCurve:
        return AngleCurve(self.distortion[:6], self._prism_radius)

    @cached_property
    def _prism_radius(self) -> float:
        """Radius below which the derivative of ``_shift`` has a norm of at most 1/2.

        With h = r hypot(p0, p1), the tangential part is a symmetric matrix of norm 6 h at most (``Mei._fold_radius``),
        and the prism part the product of (2 s0 + 4 s1 r^2, 2 s2 + 4 s3 r^2) with (x, y).
        """
        p0, p1, s0, s1, s2, s3 = self.distortion[6:]
        linear = 6.0 * hypot(p0, p1) + 2.0 * hypot(s0, s2)
        return min(first_positive_root([-2.0 * linear, 0.0, -8.0 * hypot(s1, s3)]), _FARTHEST)

    def _shift(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """d(q): by how much the tangential and prism terms move points (x, y) of the plane, each (N,)."""
        p0, p1, s0, s1, s2, s3 = self.distortion[6:]
        s = x * x + y * y
        # Both tangential terms share a factor: 2 p1 x y + p0 (s + 2 x^2) = p0 s + 2 x (p0 x + p1 y).
        common = 2.0 * (p0 * x + p1 * y)
        return x * common + s * (p0 + s0 + s1 * s), y * common + s * (p1 + s2 + s3 * s)

    def _shift_jacobian(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Entries xx, xy, yx, yy, each (N,), of the Jacobian of q + d(q)."""
        p0, p1, s0, s1, s2, s3 = self.distortion[6:]
        s = x * x + y * y
        common = 2.0 * (p0 * x + p1 * y)
        mixed = 2.0 * (p1 * x + p0 * y)
        prism_x, prism_y = 2.0 * s0 + 4.0 * s1 * s, 2.0 * s2 + 4.0 * s3 * s
        xx = 1.0 + common + x * (4.0 * p0 + prism_x)
        yy = 1.0 + common + y * (4.0 * p1 + prism_y)
        return xx, mixed + y * prism_x, mixed + x * prism_y, yy

    def _unshift(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve q + d(q) = m for pixels (N, 2): x, y of q, each (N,); NaN where there is no solution in the disc."""
        mx, my = self.plane(pixels)
        x, y = mx.copy(), my.copy()
        for _ in range(_NEWTON_STEPS):
            dx, dy = self._shift(x, y)
            dx, dy = mx - x - dx, my - y - dy
            xx, xy, yx, yy = self._shift_jacobian(x, y)
            determinant = xx * yy - xy * yx
            x, y = x + (yy * dx - xy * dy) / determinant, y + (xx * dy - yx * dx) / determinant
        # d moves a point of the disc by less than half the disc's radius: farther points have no solution.
        hard = ~self._is_solution(x, y, mx, my) & (np.hypot(mx, my) < 1.5 * self._prism_radius)
        if hard.any():
            x[hard], y[hard] = self._unshift_in_disc(mx[hard], my[hard])
        unsolved = ~self._is_solution(x, y, mx, my)
        x[unsolved] = y[unsolved] = np.nan
        return x, y

    def _unshift_in_disc(self, mx: FloatArray, my: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Many contracting steps, each brought back into the disc."""
        x, y = mx, my
        for _ in range(_PATIENT_STEPS):
            inward = np.minimum(1.0, self._prism_radius / np.hypot(x, y))
            x, y = inward * x, inward * y
            dx, dy = self._shift(x, y)
            x, y = mx - dx, my - dy
        return x, y

    def _is_solution(self, x: FloatArray, y: FloatArray, mx: FloatArray, my: FloatArray) -> BoolArray:
        """Whether (x, y) solves q + d(q) = m in the disc, where there is no second solution."""
        dx, dy = self._shift(x, y)
        small = np.hypot(x + dx - mx, y + dy - my) <= _TOLERANCE * (1.0 + np.hypot(mx, my))
        return small & (np.hypot(x, y) <= self._prism_radius * (1.0 + _TOLERANCE))
