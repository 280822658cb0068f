"""Extended unified camera model (Khomutenko, Garnier, Martinet: An enhanced unified camera model, RA-L 2015).

The formulas and the limits are as in Usenko, Demmel, Cremers (3DV 2018). COLMAP, Kalibr and Basalt have it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from spherloc.cameras import _checks, _unified
from spherloc.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Eucm:
    """Fisheye camera that projects onto an ellipsoid and from there, by a second centre, onto the plane."""

    model: ClassVar[str] = "eucm"

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    fx: float
    """Focal length along x in pixels on the optical axis."""
    fy: float
    """Focal length along y in pixels on the optical axis."""
    cx: float
    """Principal point, x in pixels; the centre of the top-left pixel is 0.5."""
    cy: float
    """Principal point, y in pixels; the centre of the top-left pixel is 0.5."""
    alpha: float
    """Share of the distance to the ellipsoid in the depth, 0 to 1; 0 is a pinhole, beyond 1/2 the image is finite."""
    beta: float
    """Squared ratio of the ellipsoid's axes, above 0; 1 is a sphere."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "alpha", _unified.alpha_of(self.alpha))
        object.__setattr__(self, "beta", _checks.positive("beta", self.beta))
        _checks.check_focal(self)
        with np.errstate(all="ignore"):
            keys = f"camera keys 'alpha', 'beta' are {self.alpha:g}, {self.beta:g}"
            _checks.check_sees_image(self, self.max_radius, keys)

    @cached_property
    def max_radius(self) -> float:
        """Distance from the principal point, in focal lengths, below which the model is one to one."""
        return _unified.max_radius(self.alpha, self.beta)

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of camera-frame points (N, 3) in metres, and the mask (N,) of directions that are valid.

        Valid is z > -w d with w = min(alpha, 1 - alpha) / max(alpha, 1 - alpha); other pixels are NaN.
        Raises ``ProblemError`` for a wrong shape.
        """
        x, y, z = _checks.rows("points", points, 3).T
        with np.errstate(all="ignore"):
            mx, my, valid = _unified.plane_points(x, y, z, self.alpha, self.beta)
            valid &= (np.hypot(mx, my) < self.max_radius) & np.isfinite(z)
            pixels = np.column_stack([self.cx + self.fx * mx, self.cy + self.fy * my])
        pixels[~valid] = np.nan
        return pixels, valid

    def unproject(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and the mask (N,) of pixels that the lens reaches.

        Raises ``ProblemError`` for a wrong shape.
        """
        mx, my = _checks.plane(self, pixels, self.max_radius)
        return _unified.rays(mx, my, self.alpha, self.beta), ~np.isnan(mx)

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        mx, my = _checks.plane(self, pixels, self.max_radius)
        return _unified.rays_jacobian(mx, my, self.alpha, self.beta) / (self.fx, self.fy)

    def to_dict(self) -> dict[str, Any]:
        """The ``[camera]`` table: model, width, height, fx, fy, cx, cy, alpha, beta."""
        return _checks.camera_to_table(self)

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str) -> Self:
        """Build from a ``[camera]`` table; raises ``CalibrationError`` (see ``Camera.from_dict``)."""
        return _checks.camera_from_keys(cls, table, where)
