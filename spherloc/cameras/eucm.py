"""Extended unified camera model (Khomutenko, Garnier, Martinet: An enhanced unified camera model, RA-L 2015).

The formulas and the limits are as in Usenko, Demmel, Cremers (3DV 2018). COLMAP, Kalibr and Basalt have it.
"""

from dataclasses import dataclass
from functools import cached_property
from math import inf, sqrt
from typing import ClassVar

import numpy as np

from spherloc.cameras import _checks
from spherloc.cameras._radial import RIM_MARGIN
from spherloc.errors import CalibrationError
from spherloc.types import BoolArray, FloatArray

_FARTHEST = 1e3
"""Largest ``max_radius``: no image is a thousand focal lengths wide."""


def alpha_of(value: object) -> float:
    """The checked key ``alpha``; raises ``CalibrationError`` unless it is a number from 0 to 1."""
    alpha = _checks.finite("alpha", value)
    if not 0.0 <= alpha <= 1.0:
        raise CalibrationError(f"camera key 'alpha' is {alpha:g}: give a number from 0 to 1.")
    return alpha


def max_radius(alpha: float, beta: float) -> float:
    """Radius in the plane below which the projection is one to one."""
    curvature = beta * (2.0 * alpha - 1.0)
    return min(1.0 / sqrt(curvature) if curvature > 0.0 else inf, _FARTHEST) * (1.0 - RIM_MARGIN)


def plane_points(
    x: FloatArray, y: FloatArray, z: FloatArray, alpha: float, beta: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Plane coordinates of rays, each (N,), and the mask (N,) of rays before the fold and before infinity."""
    d = np.hypot(sqrt(beta) * np.hypot(x, y), z)
    denominator = alpha * d + (1.0 - alpha) * z
    steepest = min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha)
    return x / denominator, y / denominator, (denominator > 0.0) & (z > -steepest * d)


def rays(x: FloatArray, y: FloatArray, alpha: float, beta: float) -> FloatArray:
    """Unit rays (N, 3) through the plane points x, y, each (N,); NaN beyond the fold."""
    z, _ = _depth(x, y, alpha, beta)
    length = np.hypot(np.hypot(x, y), z)
    return np.column_stack([x / length, y / length, z / length])


def rays_jacobian(x: FloatArray, y: FloatArray, alpha: float, beta: float) -> FloatArray:
    """d ray / d (x, y), (N, 3, 2)."""
    z, slope = _depth(x, y, alpha, beta)
    length = np.hypot(np.hypot(x, y), z)
    ray = np.column_stack([x, y, z]) / length[:, None]
    moved = np.zeros((len(x), 3, 2))
    moved[:, 0, 0] = moved[:, 1, 1] = 1.0
    moved[:, 2, 0], moved[:, 2, 1] = 2.0 * slope * x, 2.0 * slope * y
    moved /= length[:, None, None]
    return moved - ray[:, :, None] * np.einsum("nk,nkc->nc", ray, moved)[:, None, :]


def _depth(x: FloatArray, y: FloatArray, alpha: float, beta: float) -> tuple[FloatArray, FloatArray]:
    """z of the ray (x, y, z) through a plane point, and its derivative by x^2 + y^2, each (N,)."""
    s = beta * (x * x + y * y)
    root = np.sqrt(1.0 - (2.0 * alpha - 1.0) * s)
    below = alpha * root + 1.0 - alpha
    z = (1.0 - alpha * alpha * s) / below
    return z, beta * (0.5 * z * alpha * (2.0 * alpha - 1.0) / root - alpha * alpha) / below


@dataclass(frozen=True)
class Eucm(_checks.FocalCamera):
    """Fisheye camera that projects onto an ellipsoid and from there, by a second centre, onto the plane."""

    model: ClassVar[str] = "eucm"

    alpha: float
    """Share of the distance to the ellipsoid in the depth, 0 to 1; 0 is a pinhole, beyond 1/2 the image is finite."""
    beta: float
    """Squared ratio of the ellipsoid's axes, above 0; 1 is a sphere."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "alpha", alpha_of(self.alpha))
        object.__setattr__(self, "beta", _checks.positive("beta", self.beta))
        self.check_focal()
        with np.errstate(all="ignore"):
            keys = f"camera keys 'alpha', 'beta' are {self.alpha:g}, {self.beta:g}"
            self.check_sees_image(self.max_radius, keys)

    @cached_property
    def max_radius(self) -> float:
        """Distance from the principal point, in focal lengths, below which the model is one to one."""
        return max_radius(self.alpha, self.beta)

    def _plane_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Valid is z > -w d with w = min(alpha, 1 - alpha) / max(alpha, 1 - alpha)."""
        x, y, z = points.T
        mx, my, valid = plane_points(x, y, z, self.alpha, self.beta)
        return mx, my, valid & (np.hypot(mx, my) < self.max_radius) & np.isfinite(z)

    def _bearings(self, pixels: FloatArray) -> FloatArray:
        return rays(*self.plane_within(pixels, self.max_radius), self.alpha, self.beta)

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        mx, my = self.plane_within(pixels, self.max_radius)
        return rays_jacobian(mx, my, self.alpha, self.beta) / (self.fx, self.fy)
