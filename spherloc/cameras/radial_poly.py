"""A fisheye whose curve is a polynomial with even powers, too, as WoodScape's cameras of a car (Yogamani et al., ICCV
2019) have it: rho = k1 theta + k2 theta^2 + k3 theta^3 + k4 theta^4 pixels from the principal point.

Divided by k1, the focal length, it is the curve below. It grows up to its first maximum; directions beyond that have
the pixels of others and are invalid.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from spherloc.cameras import _checks
from spherloc.cameras._radial import AngleCurve
from spherloc.types import BoolArray, FloatArray


@dataclass(frozen=True)
class RadialPoly(_checks.FocalCamera):
    """Fisheye camera with theta_d = theta (1 + d1 theta + d2 theta^2 + d3 theta^3).

    fx and fy are pixels per radian on the optical axis.
    """

    model: ClassVar[str] = "radial_poly"

    distortion: tuple[float, float, float]
    """d1, d2, d3: k2, k3 and k4, divided by k1."""

    def __post_init__(self) -> None:
        self.check_lens("d1, d2, d3")
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
        """Unit bearings (N, 3) of pixels (N, 2); NaN beyond the rim."""
        return self._curve.bearings(*self.plane(pixels))

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        with np.errstate(all="ignore"):
            return self._curve.jacobian(*self.plane(pixels)) / (self.fx, self.fy)

    @cached_property
    def _curve(self) -> AngleCurve:
        return AngleCurve(self.distortion, step=1)
