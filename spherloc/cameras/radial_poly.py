"""A fisheye whose curve is a polynomial with even powers, too, as WoodScape's cameras of a car (Yogamani et al., ICCV
2019) have it: rho = k1 theta + k2 theta^2 + k3 theta^3 + k4 theta^4 pixels from the principal point.

Divided by k1, the focal length, it is the curve below. It grows up to its first maximum; directions beyond that have
the pixels of others and are invalid.
"""

from dataclasses import dataclass
from typing import ClassVar

from spherloc.cameras._radial import AngleCurve, RadialCamera


@dataclass(frozen=True)
class RadialPoly(RadialCamera):
    """Fisheye camera with theta_d = theta (1 + d1 theta + d2 theta^2 + d3 theta^3).

    fx and fy are pixels per radian on the optical axis.
    """

    model: ClassVar[str] = "radial_poly"

    distortion: tuple[float, float, float]
    """d1, d2, d3: k2, k3 and k4, divided by k1."""

    def __post_init__(self) -> None:
        self.check_curve("d1, d2, d3")

    def _angle_curve(self) -> AngleCurve:
        """The curve by ``distortion``."""
        return AngleCurve(self.distortion, step=1)
