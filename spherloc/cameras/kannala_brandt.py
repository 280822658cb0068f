"""Kannala-Brandt fisheye camera (Sec. IV-B.1, Eq. 3-7); OpenCV calls it fisheye, Kalibr equidistant.

Eq. 5-7 go through tan(theta) and end at 90 degrees. The bearing here is
v = (sin(theta) x0 / theta_d, sin(theta) y0 / theta_d, cos(theta)), the same direction without that end.
theta_d(theta) grows only up to its first maximum: directions beyond it have the pixels of others and are invalid.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from spherloc.cameras import _checks
from spherloc.cameras._radial import AngleCurve
from spherloc.types import BoolArray, FloatArray


@dataclass(frozen=True)
class KannalaBrandt(_checks.FocalCamera):
    """Fisheye camera with theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).

    fx and fy are pixels per radian on the optical axis.
    """

    model: ClassVar[str] = "kannala_brandt"

    distortion: tuple[float, float, float, float]
    """k1, k2, k3, k4 of Eq. 4."""

    def __post_init__(self) -> None:
        self.check_lens("k1, k2, k3, k4")
        with np.errstate(all="ignore"):
            self.check_sees_image(self._curve.end)

    @property
    def max_angle_rad(self) -> float:
        """Largest angle to the optical axis that the model can invert: the first maximum of theta_d, at most pi."""
        return self._curve.max_angle_rad

    def _plane_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Directions within ``max_angle_rad`` of the optical axis are valid."""
        return self._curve.plane(points)

    def _bearings(self, pixels: FloatArray) -> FloatArray:
        """Unit bearings (N, 3) of pixels (N, 2) by Eq. 3 to 7; NaN beyond the rim."""
        return self._curve.bearings(*self.plane(pixels))

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        with np.errstate(all="ignore"):
            return self._curve.jacobian(*self.plane(pixels)) / (self.fx, self.fy)

    @cached_property
    def _curve(self) -> AngleCurve:
        return AngleCurve(self.distortion)
