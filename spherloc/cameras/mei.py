"""MEI omnidirectional camera (Sec. IV-B.2, Eq. 8-14), with the tangential terms p1, p2 that the paper leaves out.

A bearing is moved by xi along z and divided by its new depth (Eq. 11-12): a point (x, y) of the undistorted plane. The
distortion (Eq. 8) then moves that point. Both steps can fold: with xi > 1 the plane point turns back where z = -1/xi,
and the distortion where its Jacobian stops being positive definite. That Jacobian is symmetric, the Hessian of a
potential; on a disc where it is positive definite the distortion is the gradient of a strictly convex function and
therefore one to one. All valid points lie in such a disc, of the radius ``max_radius``.
"""

from dataclasses import dataclass
from functools import cached_property
from math import atan, hypot, sqrt
from typing import ClassVar

import numpy as np

from spherloc.cameras import _checks
from spherloc.cameras._radial import RIM_MARGIN, InverseTable, first_positive_root
from spherloc.errors import CalibrationError
from spherloc.types import BoolArray, FloatArray

_FARTHEST = 1e3
"""Largest ``max_radius``: with xi <= 1 the plane has no end, but no image is a thousand focal lengths wide."""
_LARGEST_XI = 1e3
"""Largest xi, far beyond that of any lens, which is a few at most."""
_TABLE_NODES = 1025
_NEWTON_STEPS = 3
"""Number of Newton steps from the table: enough for the tangential terms of real lenses."""
_PATIENT_STEPS = 40
"""Number of steps next to a fold, where each step only halves the error."""
_TOLERANCE = 1e-13
"""Residual of Eq. 8, relative to 1 + the distorted radius, that counts as solved."""


@dataclass(frozen=True)
class Mei(_checks.FocalCamera):
    """Unified omnidirectional camera with radial and tangential distortion; fx, fy are KITTI-360's gamma1, gamma2."""

    model: ClassVar[str] = "mei"

    xi: float
    """Offset of the projection centre from the centre of the unit sphere, above -1; 0 is a pinhole, 1 stereographic."""
    distortion: tuple[float, float, float, float]
    """k1, k2 (radial) and p1, p2 (tangential), without unit."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "xi", _checks.finite("xi", self.xi))
        if not -1.0 < self.xi <= _LARGEST_XI:
            raise CalibrationError(f"camera key 'xi' is {self.xi:g}: give a number above -1 and up to {_LARGEST_XI:g}.")
        self.check_lens("k1, k2, p1, p2")
        with np.errstate(all="ignore"):
            self.check_sees_image(self._reach)

    @cached_property
    def max_radius(self) -> float:
        """Radius sqrt(x^2 + y^2) in the undistorted plane below which the model is one to one."""
        sphere = 1.0 / sqrt(self.xi**2 - 1.0) if self.xi > 1.0 else np.inf
        return min(self._fold_radius, sphere * (1.0 - RIM_MARGIN))

    @cached_property
    def _fold_radius(self) -> float:
        """Radius below which the distortion alone is one to one.

        Along the radius and across it the radial terms have the Hessian diag(g, f) with g = 1 + 3 k1 r^2 + 5 k2 r^4
        and f = 1 + k1 r^2 + k2 r^4, the mean of g from 0 to r. With h = r hypot(p1, p2) and c the cosine of the angle
        to (p2, p1), the tangential terms add 2 h [[3 c, sqrt(1 - c^2)], [sqrt(1 - c^2), c]]. Up to the first root
        of g - 7 h, g > 7 h and so f > 3.5 h, and the determinant exceeds h^2 (20.5 + 35 c + 16 c^2) > 0.
        """
        k1, k2, p1, p2 = self.distortion
        fold = first_positive_root([-7.0 * hypot(p1, p2), 3.0 * k1, 0.0, 5.0 * k2])
        return min(fold, _FARTHEST) * (1.0 - RIM_MARGIN)

    def _plane_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Directions before both folds are valid (see the module's docstring)."""
        px, py, pz = points.T
        norm = np.hypot(np.hypot(px, py), pz)
        depth = pz + self.xi * norm
        x, y = px / depth, py / depth
        valid = (depth > 0.0) & (norm + self.xi * pz > 0.0) & (norm < np.inf) & (np.hypot(x, y) < self.max_radius)
        return *self._distort(x, y), valid

    def _bearings(self, pixels: FloatArray) -> FloatArray:
        """Unit bearings (N, 3) of pixels (N, 2) by Eq. 8, 13, 14; NaN beyond the rim."""
        x, y = self._undistort(pixels)
        s = x * x + y * y
        root = np.sqrt(1.0 + s * (1.0 - self.xi**2))
        scale = (self.xi + root) / (1.0 + s)
        # Eq. 14 has z = scale - xi; this form has no cancellation for a large xi.
        return np.column_stack([scale * x, scale * y, (root - self.xi * s) / (1.0 + s)])

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        with np.errstate(all="ignore"):
            x, y = self._undistort(pixels)
            s = x * x + y * y
            root = np.sqrt(1.0 + s * (1.0 - self.xi**2))
            scale = (self.xi + root) / (1.0 + s)
            # d scale = slope (x dx + y dy), and z = scale - xi changes by as much
            slope = ((1.0 - self.xi**2) / root - 2.0 * scale) / (1.0 + s)
            xx, xy, yy = self._hessian(x, y)
            determinant = xx * yy - xy * xy
            jacobian = np.empty((len(x), 3, 2))
            for column, (dx, dy, focal) in enumerate(((yy, -xy, self.fx), (-xy, xx, self.fy))):
                dx, dy = dx / (determinant * focal), dy / (determinant * focal)
                dz = slope * (x * dx + y * dy)
                jacobian[:, 0, column] = scale * dx + x * dz
                jacobian[:, 1, column] = scale * dy + y * dz
                jacobian[:, 2, column] = dz
        return jacobian

    @cached_property
    def _inverse(self) -> InverseTable:
        k1, k2, _, _ = self.distortion
        # Nodes at equal angles, since the radius of the disc may be infinite.
        nodes = np.tan(np.linspace(0.0, atan(self.max_radius), _TABLE_NODES))
        return InverseTable(lambda r: r * (1.0 + r * r * (k1 + k2 * r * r)), nodes)

    @cached_property
    def _reach(self) -> float:
        """Upper limit of the distorted radius of valid points: the tangential terms add at most 3 r^2 hypot(p1, p2)."""
        return self._inverse.end + 3.0 * self.max_radius**2 * hypot(*self.distortion[2:])

    def _distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Eq. 8 with p1, p2: where the lens moves the points (x, y) of the plane, each (N,)."""
        k1, k2, p1, p2 = self.distortion
        s = x * x + y * y
        # Both tangential terms share this factor: 2 p1 x y + p2 (s + 2 x^2) = p2 s + 2 x (p2 x + p1 y).
        common = 1.0 + s * (k1 + k2 * s) + 2.0 * (p2 * x + p1 * y)
        return x * common + p2 * s, y * common + p1 * s

    def _hessian(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Entries xx, xy, yy, each (N,), of the symmetric Jacobian of ``_distort``."""
        k1, k2, p1, p2 = self.distortion
        s = x * x + y * y
        common = 1.0 + s * (k1 + k2 * s) + 2.0 * (p2 * x + p1 * y)
        bend = 2.0 * (k1 + 2.0 * k2 * s)
        xx = common + x * (bend * x + 4.0 * p2)
        yy = common + y * (bend * y + 4.0 * p1)
        return xx, bend * x * y + 2.0 * (p1 * x + p2 * y), yy

    def _undistort(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve Eq. 8 with p1, p2 for the undistorted points x, y of pixels (N, 2), each (N,); NaN beyond the rim."""
        x0, y0 = self.plane(pixels)
        radius = np.hypot(x0, y0)
        shrink = np.where(radius > 0.0, self._inverse(radius) / radius, 1.0)
        x, y = shrink * x0, shrink * y0
        for _ in range(_NEWTON_STEPS):
            step_x, step_y = self._newton_step(x, y, x0, y0)
            x, y = x + step_x, y + step_y
        hard = ~self._is_solution(x, y, x0, y0) & (radius < self._reach)
        if hard.any():
            start_x, start_y = shrink[hard] * x0[hard], shrink[hard] * y0[hard]
            x[hard], y[hard] = self._undistort_in_disc(start_x, start_y, x0[hard], y0[hard])
        seen = self._is_solution(x, y, x0, y0) & (np.hypot(x, y) < self.max_radius)
        x[~seen] = y[~seen] = np.nan
        return x, y

    def _undistort_in_disc(
        self, x: FloatArray, y: FloatArray, x0: FloatArray, y0: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Many Newton steps, each brought back into the disc: for pixels near a fold or past the rim."""
        for _ in range(_PATIENT_STEPS):
            step_x, step_y = self._newton_step(x, y, x0, y0)
            x, y = x + step_x, y + step_y
            inward = np.minimum(1.0, self._fold_radius / np.hypot(x, y))
            x, y = inward * x, inward * y
        return x, y

    def _newton_step(
        self, x: FloatArray, y: FloatArray, x0: FloatArray, y0: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        dx, dy = self._distort(x, y)
        dx, dy = x0 - dx, y0 - dy
        xx, xy, yy = self._hessian(x, y)
        determinant = xx * yy - xy * xy
        return (yy * dx - xy * dy) / determinant, (xx * dy - xy * dx) / determinant

    def _is_solution(self, x: FloatArray, y: FloatArray, x0: FloatArray, y0: FloatArray) -> BoolArray:
        """Whether (x, y) solves Eq. 8 before the fold, where there is no second solution."""
        dx, dy = self._distort(x, y)
        small = np.hypot(dx - x0, dy - y0) <= _TOLERANCE * (1.0 + np.hypot(x0, y0))
        return small & (np.hypot(x, y) < self._fold_radius)
