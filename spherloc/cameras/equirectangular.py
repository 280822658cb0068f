"""Equirectangular panorama (Sec. IV-B.3, Eq. 15-17), the same as COLMAP's EQUIRECTANGULAR.

The paper's vertical axis is z (Eq. 17), while the yaw of Eq. 1 turns about y. The axes are permuted here, once:
x_paper = z, y_paper = x, z_paper = -y. The centre of the image shows +z, its right half +x, its lower half +y.
"""

from dataclasses import dataclass
from math import nextafter, pi, tau
from typing import Any, ClassVar, Self

import numpy as np

from spherloc.cameras import _checks
from spherloc.errors import CalibrationError, show
from spherloc.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Equirectangular:
    """Panorama of the whole sphere: longitude along the width, latitude along the height."""

    model: ClassVar[str] = "equirectangular"

    width: int
    """Image width in pixels: 360 degrees."""
    height: int
    """Image height in pixels: 180 degrees."""
    angular: bool = False
    """Whether errors are angles instead of distances in the image, for bearings that no panorama measured: a pixel is
    then the angle of one column at the horizon, 2 pi / ``width``, in every direction and also at the poles."""

    def __post_init__(self) -> None:
        for key in ("width", "height"):
            object.__setattr__(self, key, _checks.whole_pixels(key, getattr(self, key)))
        if not isinstance(self.angular, bool):
            raise CalibrationError(f"camera key 'angular' is {show(self.angular)}: give true or false.")

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of camera-frame points (N, 3) in metres, and the mask (N,): all but zero and non-finite points.

        The pixel always lies in the image: the seam, the columns 0 and ``width`` at once, is given as 0.
        Raises ``ProblemError`` for a wrong shape.
        """
        x, y, z = _checks.rows("points", points, 3).T
        with np.errstate(all="ignore"):
            horizontal = np.hypot(x, z)
            size = np.hypot(horizontal, y)
            valid = (size > 0.0) & (size < np.inf)
            u = (np.arctan2(x, z) / tau + 0.5) * self.width
            v = (np.arctan2(y, horizontal) / pi + 0.5) * self.height
            u[u >= self.width] = 0.0
            # Pixels must be less than the height, so the pole straight below is moved into the last row.
            pixels = np.column_stack([u, np.minimum(v, nextafter(self.height, 0.0))])
        pixels[~valid] = np.nan
        return pixels, valid

    def unproject(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and the mask (N,) of pixels in the image, its borders included.

        Raises ``ProblemError`` for a wrong shape.
        """
        lon, lat, valid = self._angles(pixels)
        level = np.cos(lat)
        return np.column_stack([level * np.sin(lon), -np.sin(lat), level * np.cos(lon)]), valid

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel (N, 3, 2), per pixel; NaN where ``unproject`` is invalid.

        At the poles the column of u vanishes: every pixel of that row looks the same way. If errors are angles, the
        columns are the same two directions, each of length 2 pi / ``width``.
        """
        lon, lat, _ = self._angles(pixels)
        level, rise = np.cos(lat), np.sin(lat)
        east, north = np.sin(lon), np.cos(lon)
        jacobian = np.zeros((len(lon), 3, 2))
        per_u, per_v = tau / self.width, pi / self.height
        along = level
        if self.angular:
            along, per_v = 1.0, per_u
        jacobian[:, 0, 0] = along * north * per_u
        jacobian[:, 2, 0] = -along * east * per_u
        jacobian[:, 0, 1] = rise * east * per_v
        jacobian[:, 1, 1] = level * per_v
        jacobian[:, 2, 1] = rise * north * per_v
        jacobian[np.isnan(lon)] = np.nan
        return jacobian

    def to_dict(self) -> dict[str, Any]:
        """The ``[camera]`` table: model, width, height, and angular where errors are angles."""
        table = _checks.camera_to_table(self)
        return table if self.angular else {key: value for key, value in table.items() if key != "angular"}

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str) -> Self:
        """Build from a ``[camera]`` table; raises ``CalibrationError`` (see ``Camera.from_dict``)."""
        given = {"angular": False} | table if isinstance(table, dict) else table
        return _checks.camera_from_keys(cls, given, where)

    def _angles(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Longitude and latitude (Eq. 16) in radians and validity, each (N,); NaN angles where invalid."""
        u, v = _checks.rows("pixels", pixels, 2).T
        valid = (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
        lon = np.where(valid, (u / self.width - 0.5) * tau, np.nan)
        lat = np.where(valid, (0.5 - v / self.height) * pi, np.nan)
        return lon, lat, valid
