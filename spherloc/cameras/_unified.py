"""The projection that the EUCM and the second sphere of the double sphere share (Khomutenko et al. 2015).

A ray (x, y, z) meets the plane at (x, y) / (alpha d + (1 - alpha) z) with d^2 = beta (x^2 + y^2) + z^2. For
alpha > 1/2 the plane point turns back where z = -d (1 - alpha) / alpha, at the radius ``max_radius``; for
alpha <= 1/2 it goes to infinity where the denominator vanishes.
"""

from math import inf, sqrt

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
