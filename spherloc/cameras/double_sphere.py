"""Double sphere camera model (Usenko, Demmel, Cremers: The Double Sphere Camera Model, 3DV 2018).

A bearing is moved by xi along z, as in the unified model, and then goes through that model's projection (``_unified``
with beta = 1). Both steps can fold: the first, with xi > 1, where z = -1/xi, the second, with alpha > 1/2, where the
moved ray has z = -d2 (1 - alpha) / alpha. With xi >= 1 the first comes first, since the moved ray never looks back.
These are the exact folds; the limit w2 that the paper prints differs from the second one by up to a few degrees.
"""

from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import ClassVar

import numpy as np

from spherloc.cameras import _checks, eucm
from spherloc.cameras._radial import RIM_MARGIN
from spherloc.errors import CalibrationError
from spherloc.types import BoolArray, FloatArray

_LARGEST_XI = 1e3
"""Largest xi, far beyond that of any lens, which is between -1 and 1."""
_TOUCHES = 1.0 - 1e-6
"""From this xi on, the second centre counts as lying on the first sphere; 0.0015 rad around -z are lost by that."""


@dataclass(frozen=True)
class DoubleSphere(_checks.FocalCamera):
    """Fisheye camera that projects onto two unit spheres, one after the other, and from there onto the plane.

    fx and fy are those of the projection behind both spheres.
    """

    model: ClassVar[str] = "double_sphere"

    xi: float
    """Distance between the centres of the two spheres, above -1."""
    alpha: float
    """Share of the distance to the second sphere in the depth, 0 to 1; beyond 1/2 the image is finite."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "xi", _checks.finite("xi", self.xi))
        if not -1.0 < self.xi <= _LARGEST_XI:
            raise CalibrationError(f"camera key 'xi' is {self.xi:g}: give a number above -1 and up to {_LARGEST_XI:g}.")
        object.__setattr__(self, "alpha", eucm.alpha_of(self.alpha))
        self.check_focal()
        with np.errstate(all="ignore"):
            keys = f"camera keys 'xi', 'alpha' are {self.xi:g}, {self.alpha:g}"
            self.check_sees_image(self.max_radius, keys)

    @cached_property
    def max_radius(self) -> float:
        """Distance from the principal point, in focal lengths, below which the model is one to one."""
        second = eucm.max_radius(self.alpha, 1.0)
        if self.xi < _TOUCHES:
            return second
        # At the fold of the first sphere the sine of the moved ray's angle is 1 / xi; it is at 90 degrees if xi is 1.
        sine = min(1.0 / self.xi, 1.0)
        depth = self.alpha + (1.0 - self.alpha) * sqrt(1.0 - sine * sine)
        return min(sine / depth * (1.0 - RIM_MARGIN), second) if depth > 0.0 else second

    def _plane_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Directions before both folds are valid (see the module's docstring)."""
        x, y, z = points.T
        norm = np.hypot(np.hypot(x, y), z)
        mx, my, valid = eucm.plane_points(x, y, z + self.xi * norm, self.alpha, 1.0)
        return mx, my, valid & (norm + self.xi * z > 0.0) & (norm < np.inf) & (np.hypot(mx, my) < self.max_radius)

    def _bearings(self, pixels: FloatArray) -> FloatArray:
        moved = eucm.rays(*self.plane_within(pixels, self.max_radius), self.alpha, 1.0)
        root, reach = self._first_sphere(moved)
        z = moved[:, 2] * root - self.xi * (moved[:, 0] ** 2 + moved[:, 1] ** 2)
        return np.column_stack([reach * moved[:, 0], reach * moved[:, 1], z])

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        mx, my = self.plane_within(pixels, self.max_radius)
        moved = eucm.rays(mx, my, self.alpha, 1.0)
        jacobian = eucm.rays_jacobian(mx, my, self.alpha, 1.0) / (self.fx, self.fy)
        root, reach = self._first_sphere(moved)
        # d reach = xi reach / root dz, with z of the moved ray
        longer = (self.xi / root)[:, None, None] * moved[:, :, None] * jacobian[:, None, 2, :]
        return reach[:, None, None] * (jacobian + longer)

    def _first_sphere(self, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Intersection of unit rays (N, 3) from (0, 0, -xi) with the unit sphere: the square root in the solution of
        the quadratic equation, and the distance along the ray."""
        sine_squared = moved[:, 0] ** 2 + moved[:, 1] ** 2
        root = np.sqrt(1.0 - self.xi**2 * sine_squared)
        return root, self.xi * moved[:, 2] + root
