"""Radial distortion shared by the fisheye models: where it stops being invertible, and a first guess of its inverse."""

from collections.abc import Callable, Sequence
from functools import cached_property
from math import inf

import numpy as np

from spherloc.cameras._checks import FocalCamera
from spherloc.types import BoolArray, FloatArray

RIM_MARGIN = 1e-6
"""Share by which a validity limit is reduced, less than 0.001 px: at the limit itself nothing can be inverted."""

_REAL_ROOT = 1e-7
"""Largest imaginary part of a real root: rounding makes a double root a complex pair this close to the real axis."""


def first_positive_root(coefficients: Sequence[float]) -> float:
    """Smallest t > 0 with 1 + c1 t + c2 t^2 + ... = 0, or inf; ``coefficients`` are c1, c2, ...

    The equation is solved for 1/t: that polynomial has the leading coefficient 1, so that small coefficients cause no
    overflow. A coefficient that overflowed gives 0.
    """
    if not np.isfinite(coefficients).all():
        return 0.0
    reciprocal = np.roots(np.trim_zeros(np.concatenate([[1.0], coefficients]), "b"))
    real = reciprocal.real[np.abs(reciprocal.imag) <= _REAL_ROOT * np.abs(reciprocal)]
    largest = float(real.max(initial=0.0))
    return 1.0 / largest if largest > 0.0 else np.inf


class InverseTable:
    """Piecewise linear inverse of an increasing function: a starting point for Newton's method."""

    def __init__(self, function: Callable[[FloatArray], FloatArray], nodes: FloatArray) -> None:
        self._nodes = nodes
        self._values = function(nodes)
        self.end = float(self._values[-1])
        """Value at the last node; larger values cannot be inverted."""

    def __call__(self, values: FloatArray) -> FloatArray:
        """Approximate arguments (N,) that give ``values`` (N,); the last node beyond ``end``."""
        return np.interp(values, self._values, self._nodes)


_TABLE_NODES = 1025
_NEWTON_STEPS = 2
"""Number of Newton steps from the table: its error of about 1e-6 rad is squared twice."""
_TOLERANCE = 1e-13
"""Residual of the curve, relative to 1 + theta_d, that counts as solved."""
_ROUNDING = 1e-12
"""Error of theta_d by the rounding of a pixel, with some reserve, and the share by which theta's limit is reduced."""
_BISECTIONS = 60
"""Number of halvings of pi down to the last digit of a double."""
_ON_AXIS = 1e-100
"""theta_d below which a pixel is the principal point: the direction of so small a vector has no digits left."""


class AngleCurve:
    """Maps directions to points of a plane in focal lengths from the principal point, and back."""

    def __init__(self, coefficients: tuple[float, ...], largest_radius: float = inf, step: int = 2) -> None:
        """theta_d = theta (1 + k1 theta^step + k2 theta^(2 step) + ...) with the ``coefficients`` k1, k2, ...; the
        curve ends at ``largest_radius`` if it reaches it."""
        self._coefficients = coefficients
        self._step = step
        self._largest_radius = largest_radius

    @cached_property
    def max_angle_rad(self) -> float:
        """Largest angle to the optical axis that can be inverted: the first maximum of theta_d, at most pi."""
        slope = [(self._step * n + 1) * k for n, k in enumerate(self._coefficients, start=1)]
        peak = float(min(first_positive_root(slope) ** (1.0 / self._step), np.pi) * (1.0 - RIM_MARGIN))
        if self.radius(np.array(peak)) <= self._largest_radius:
            return peak
        return float(self._bisect(np.array([self._largest_radius]), peak)[0])

    @property
    def end(self) -> float:
        """theta_d at ``max_angle_rad``; larger values cannot be inverted."""
        return self._inverse.end

    def radius(self, theta: FloatArray) -> FloatArray:
        """theta_d of angles (N,) in radians."""
        s = theta**self._step
        factor = np.zeros_like(s)
        for k in reversed(self._coefficients):
            factor = s * (k + factor)
        return theta * (1.0 + factor)

    def plane(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Plane coordinates of points (N, 3), each (N,), and the mask (N,) of those within ``max_angle_rad``."""
        x, y, z = points.T
        lateral = np.hypot(x, y)
        theta = np.arctan2(lateral, z)
        valid = (theta <= self.max_angle_rad) & np.isfinite(lateral + z) & ((lateral > 0) | (z > 0))
        scale = np.where(lateral > 0, self.radius(theta) / lateral, 0.0)
        return scale * x, scale * y, valid

    def bearings(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Unit bearings (N, 3) of plane coordinates, each (N,); NaN beyond the rim."""
        east, south, theta_d = _polar(x, y)
        theta = self._angle(theta_d)
        sine = np.sin(theta)
        return np.column_stack([sine * east, sine * south, np.cos(theta)])

    def jacobian(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """d bearing / d (x, y), (N, 3, 2); NaN beyond the rim.

        Along the radius the bearing turns by d theta / d theta_d, across it by sin(theta) / theta_d.
        """
        east, south, theta_d = _polar(x, y)
        theta = self._angle(theta_d)
        sine, cosine = np.sin(theta), np.cos(theta)
        turn = 1.0 / self._slope(theta)
        radial, across = cosine * turn, np.where(theta_d > _ON_AXIS, sine / theta_d, 1.0)
        jacobian = np.empty((len(theta), 3, 2))
        jacobian[:, 0, 0] = radial * east**2 + across * south**2
        jacobian[:, 0, 1] = jacobian[:, 1, 0] = (radial - across) * east * south
        jacobian[:, 1, 1] = radial * south**2 + across * east**2
        jacobian[:, 2, 0] = -sine * turn * east
        jacobian[:, 2, 1] = -sine * turn * south
        jacobian[np.isnan(theta)] = np.nan
        return jacobian

    @cached_property
    def _inverse(self) -> InverseTable:
        return InverseTable(self.radius, np.linspace(0.0, self.max_angle_rad, _TABLE_NODES))

    def _slope(self, theta: FloatArray) -> FloatArray:
        """d theta_d / d theta."""
        s = theta**self._step
        factor = np.zeros_like(s)
        for n in range(len(self._coefficients), 0, -1):
            factor = s * ((self._step * n + 1) * self._coefficients[n - 1] + factor)
        return 1.0 + factor

    def _angle(self, theta_d: FloatArray) -> FloatArray:
        """Solve the curve for theta (N,); NaN beyond the rim."""
        theta = self._inverse(theta_d)
        for _ in range(_NEWTON_STEPS):
            theta -= (self.radius(theta) - theta_d) / self._slope(theta)
        # A direction at the rim is valid although its pixel was rounded, and its bearing is limited to the rim.
        inside = theta_d <= self._inverse.end + _ROUNDING
        rim = self.max_angle_rad * (1.0 - _ROUNDING)
        theta = np.where(inside, np.minimum(theta, rim), np.nan)
        # Newton may jump where the slope nearly vanishes; theta_d still increases there: bisect.
        hard = inside & ~(np.abs(self.radius(theta) - theta_d) <= _TOLERANCE * (1.0 + theta_d))
        if hard.any():
            theta[hard] = self._bisect(theta_d[hard], rim)
        return theta

    def _bisect(self, theta_d: FloatArray, rim: float) -> FloatArray:
        low, high = np.zeros_like(theta_d), np.full_like(theta_d, rim)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            below = self.radius(middle) < theta_d
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return 0.5 * (low + high)


def _polar(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit direction in the plane, x and y, and the distance from the principal point, each (N,)."""
    theta_d = np.hypot(x, y)
    on_axis = theta_d <= _ON_AXIS
    return np.where(on_axis, 1.0, x / theta_d), np.where(on_axis, 0.0, y / theta_d), theta_d


class RadialCamera(FocalCamera):
    """A camera whose lens is an ``AngleCurve`` alone."""

    def _angle_curve(self) -> AngleCurve:
        """The curve by the camera's coefficients."""
        raise NotImplementedError

    @cached_property
    def _curve(self) -> AngleCurve:
        return self._angle_curve()

    @property
    def max_angle_rad(self) -> float:
        """Largest angle to the optical axis that the model can invert: the first maximum of theta_d, at most pi."""
        return self._curve.max_angle_rad

    def _plane_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Directions within ``max_angle_rad`` of the optical axis are valid."""
        return self._curve.plane(points)

    def _bearings(self, pixels: FloatArray) -> FloatArray:
        """Unit bearings (N, 3) of pixels (N, 2); NaN beyond the rim."""
        return self._curve.bearings(*self.plane(pixels))

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        with np.errstate(all="ignore"):
            return self._curve.jacobian(*self.plane(pixels)) / (self.fx, self.fy)

    def check_curve(self, coefficient_names: str) -> None:
        """Check and normalise all values while the camera is being constructed; raises ``CalibrationError`` for an
        unusable one, and if the lens cannot unproject any pixel of the image."""
        self.check_lens(coefficient_names)
        with np.errstate(all="ignore"):
            self.check_sees_image(self._curve.end)
