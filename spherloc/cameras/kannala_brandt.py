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
from spherloc.cameras._radial import AngleCurve
from spherloc.types import BoolArray, FloatArray


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
            _checks.check_sees_image(self, self._curve.end)

    @property
    def max_angle_rad(self) -> float:
        """Largest angle to the optical axis that the model can invert: the first maximum of theta_d, at most pi."""
        return self._curve.max_angle_rad

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of camera-frame points (N, 3) in metres, and the mask (N,) of directions that are valid.

        Valid is what is within ``max_angle_rad`` of the optical axis; other pixels are NaN.
        Raises ``ProblemError`` for a wrong shape.
        """
        points = _checks.rows("points", points, 3)
        with np.errstate(all="ignore"):
            x, y, valid = self._curve.plane(points)
            pixels = np.column_stack([self.cx + self.fx * x, self.cy + self.fy * y])
        pixels[~valid] = np.nan
        return pixels, valid

    def unproject(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and the mask (N,) of pixels that the lens reaches (Eq. 3-7).

        Raises ``ProblemError`` for a wrong shape.
        """
        u, v = _checks.rows("pixels", pixels, 2).T
        with np.errstate(all="ignore"):
            bearings = self._curve.bearings((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        return bearings, ~np.isnan(bearings[:, 2])

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        u, v = _checks.rows("pixels", pixels, 2).T
        with np.errstate(all="ignore"):
            jacobian = self._curve.jacobian((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        return jacobian / (self.fx, self.fy)

    def to_dict(self) -> dict[str, Any]:
        """The ``[camera]`` table: model, width, height, fx, fy, cx, cy, distortion."""
        return _checks.camera_to_table(self)

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str) -> Self:
        """Build from a ``[camera]`` table; raises ``CalibrationError`` (see ``Camera.from_dict``)."""
        return _checks.camera_from_keys(cls, table, where)

    @cached_property
    def _curve(self) -> AngleCurve:
        return AngleCurve(self.distortion)
