"""Kannala-Brandt fisheye camera (Sec. IV-B.1, Eq. 3-7); OpenCV calls it fisheye, Kalibr equidistant.

Eq. 5-7 go through tan(theta) and end at 90 degrees. The bearing here is
v = (sin(theta) x0 / theta_d, sin(theta) y0 / theta_d, cos(theta)), the same direction without that end.
theta_d(theta) grows only up to its first maximum: directions beyond it fall back onto pixels of others and are invalid.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from spherloc.cameras import _checks
from spherloc.cameras._radial import RIM_MARGIN, InverseTable, first_positive_root
from spherloc.cameras.base import BoolArray, FloatArray

_TABLE_NODES = 1025
_NEWTON_STEPS = 2
"""Enough from a table of this size: its error of about 1e-6 rad is squared twice."""
_TOLERANCE = 1e-13
"""Residual of Eq. 4, relative to 1 + theta_d, that counts as solved."""
_ROUNDING = 1e-12
"""Error of theta_d that the rounding of a pixel may cause, with some reserve, and share of theta given up for it."""
_BISECTIONS = 60
"""Halvings of pi down to the last digit of a double."""
_ON_AXIS = 1e-100
"""theta_d below which a pixel is the principal point: the direction of so small a vector has no digits left."""


@dataclass(frozen=True)
class KannalaBrandt:
    """Fisheye camera with theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""

    model: ClassVar[str] = "kannala_brandt"

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    fx: float
    """Focal length along x in pixels per radian on the optical axis."""
    fy: float
    """Focal length along y in pixels per radian on the optical axis."""
    cx: float
    """Principal point, x in pixels; the centre of the top-left pixel is 0.5."""
    cy: float
    """Principal point, y in pixels; the centre of the top-left pixel is 0.5."""
    distortion: tuple[float, float, float, float]
    """k1, k2, k3, k4 of Eq. 4."""

    def __post_init__(self) -> None:
        _checks.check_lens(self, "k1, k2, k3, k4")
        with np.errstate(all="ignore"):
            _checks.check_sees_image(self, self._inverse.end)

    @cached_property
    def max_angle_rad(self) -> float:
        """Largest angle to the optical axis that the model can invert: the first maximum of theta_d, at most pi."""
        slope = [(2 * n + 1) * k for n, k in enumerate(self.distortion, start=1)]
        return float(min(np.sqrt(first_positive_root(slope)), np.pi) * (1.0 - RIM_MARGIN))

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of camera-frame points (N, 3) in metres, and the mask (N,) of directions that are valid.

        Valid is what is within ``max_angle_rad`` of the optical axis; other pixels are NaN.
        Raises ``ProblemError`` for a wrong shape.
        """
        x, y, z = _checks.rows("points", points, 3).T
        with np.errstate(all="ignore"):
            lateral = np.hypot(x, y)
            theta = np.arctan2(lateral, z)
            valid = (theta <= self.max_angle_rad) & np.isfinite(lateral + z) & ((lateral > 0) | (z > 0))
            scale = np.where(lateral > 0, self._theta_d(theta) / lateral, 0.0)
            pixels = np.column_stack([self.cx + self.fx * (scale * x), self.cy + self.fy * (scale * y)])
        pixels[~valid] = np.nan
        return pixels, valid

    def unproject(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and the mask (N,) of pixels that the lens reaches (Eq. 3-7).

        Raises ``ProblemError`` for a wrong shape.
        """
        with np.errstate(all="ignore"):
            east, south, theta_d = self._polar(pixels)
            theta = self._theta(theta_d)
            sine = np.sin(theta)
            bearings = np.column_stack([sine * east, sine * south, np.cos(theta)])
        return bearings, ~np.isnan(theta)

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid.

        Along the radius the bearing turns by d theta / d theta_d, across it by sin(theta) / theta_d.
        """
        with np.errstate(all="ignore"):
            east, south, theta_d = self._polar(pixels)
            theta = self._theta(theta_d)
            sine, cosine = np.sin(theta), np.cos(theta)
            turn = 1.0 / self._slope(theta)
            radial, across = cosine * turn, np.where(theta_d > _ON_AXIS, sine / theta_d, 1.0)
            mixed = (radial - across) * east * south
            jacobian = np.empty((len(theta), 3, 2))
            jacobian[:, 0, 0] = radial * east**2 + across * south**2
            jacobian[:, 0, 1] = jacobian[:, 1, 0] = mixed
            jacobian[:, 1, 1] = radial * south**2 + across * east**2
            jacobian[:, 2, 0] = -sine * turn * east
            jacobian[:, 2, 1] = -sine * turn * south
            jacobian /= (self.fx, self.fy)
        jacobian[np.isnan(theta)] = np.nan
        return jacobian

    def to_dict(self) -> dict[str, Any]:
        """The ``[camera]`` table: model, width, height, fx, fy, cx, cy, distortion."""
        return _checks.camera_to_table(self)

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str) -> Self:
        """Build from a ``[camera]`` table; raises ``CalibrationError`` (see ``Camera.from_dict``)."""
        return _checks.camera_from_keys(cls, table, where)

    @cached_property
    def _inverse(self) -> InverseTable:
        return InverseTable(self._theta_d, np.linspace(0.0, self.max_angle_rad, _TABLE_NODES))

    def _theta_d(self, theta: FloatArray) -> FloatArray:
        """Eq. 4."""
        k1, k2, k3, k4 = self.distortion
        s = theta * theta
        return theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))

    def _slope(self, theta: FloatArray) -> FloatArray:
        """d theta_d / d theta."""
        k1, k2, k3, k4 = self.distortion
        s = theta * theta
        return 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * (9.0 * k4))))

    def _polar(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit direction in the image plane, x and y, and distance theta_d from the principal point (Eq. 3), (N,)."""
        u, v = _checks.rows("pixels", pixels, 2).T
        x0, y0 = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        theta_d = np.hypot(x0, y0)
        on_axis = theta_d <= _ON_AXIS
        return np.where(on_axis, 1.0, x0 / theta_d), np.where(on_axis, 0.0, y0 / theta_d), theta_d

    def _theta(self, theta_d: FloatArray) -> FloatArray:
        """Solve Eq. 4 for theta (N,); NaN beyond the rim."""
        theta = self._inverse(theta_d)
        for _ in range(_NEWTON_STEPS):
            theta -= (self._theta_d(theta) - theta_d) / self._slope(theta)
        # A direction at the rim stays valid although its pixel was rounded, and its bearing stays within the rim.
        inside = theta_d <= self._inverse.end + _ROUNDING
        rim = self.max_angle_rad * (1.0 - _ROUNDING)
        theta = np.where(inside, np.minimum(theta, rim), np.nan)
        # Newton may jump where the slope nearly vanishes; theta_d still increases there: bisect.
        hard = inside & ~(np.abs(self._theta_d(theta) - theta_d) <= _TOLERANCE * (1.0 + theta_d))
        if hard.any():
            theta[hard] = self._bisect(theta_d[hard], rim)
        return theta

    def _bisect(self, theta_d: FloatArray, rim: float) -> FloatArray:
        low, high = np.zeros_like(theta_d), np.full_like(theta_d, rim)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            below = self._theta_d(middle) < theta_d
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return 0.5 * (low + high)
