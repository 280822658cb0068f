"""Kannala-Brandt fisheye camera (Sec. IV-B.1, Eq. 3-7); OpenCV calls it fisheye, Kalibr equidistant.

Eq. 5-7 go through tan(theta) and end at 90 degrees. The bearing here is
v = (sin(theta) x0 / theta_d, sin(theta) y0 / theta_d, cos(theta)), the same direction without that end.
theta_d(theta) grows only up to its first maximum: directions beyond it have the pixels of others and are invalid.
"""

from dataclasses import dataclass
from typing import ClassVar

from spherloc.cameras._radial import AngleCurve, RadialCamera


@dataclass(frozen=True)
class KannalaBrandt(RadialCamera):
    """Fisheye camera with theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).

    fx and fy are pixels per radian on the optical axis.
    """

    model: ClassVar[str] = "kannala_brandt"

    distortion: tuple[float, float, float, float]
    """k1, k2, k3, k4 of Eq. 4."""

    def __post_init__(self) -> None:
        self.check_curve("k1, k2, k3, k4")

    def _angle_curve(self) -> AngleCurve:
        """The curve by ``distortion``."""
        return AngleCurve(self.distortion)
