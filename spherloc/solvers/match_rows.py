"""Two linear equations a match, on one image plane or on the sphere: what EPnP, oDLT and EPro-PnP are made of.

    n_1 . X = 0,  n_2 . X = 0,   residual (n_1 . X, n_2 . X) / (a . X),   X = R p + t

On the image plane z = 1, n_1 = (1, 0, -x), n_2 = (0, 1, -y) and a = (0, 0, 1): the residual is that of the image
coordinates. On the sphere every match has an image plane of its own, that about its bearing: n_1 and n_2 are tangents
and a is the bearing. So the solvers, which were made for the first, work for all directions by the second, and their
residuals are angles (their tangents) instead of stretched image coordinates.
"""

from typing import NamedTuple

import numpy as np

from spherloc.geometry import tangent_basis
from spherloc.types import FloatArray


class MatchRows(NamedTuple):
    """The equations of K matches."""

    normals: FloatArray
    """(K, 2, 3)."""
    axes: FloatArray
    """(K, 3)."""

    def ahead(self, rays: FloatArray) -> FloatArray:
        """a . X (K,) of rays (K, 3): above 0 in front of the image plane."""
        return np.einsum("ki,ki->k", self.axes, rays)

    def residuals(self, rays: FloatArray) -> FloatArray:
        """(K, 2) of rays (K, 3)."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.einsum("kri,ki->kr", self.normals, rays) / self.ahead(rays)[:, None]


def plane_rows(bearings: FloatArray) -> MatchRows:
    """Those of the image plane z = 1, of bearings (K, 3) with z > 0."""
    normals = np.zeros((len(bearings), 2, 3))
    normals[:, 0, 0] = normals[:, 1, 1] = 1.0
    normals[:, :, 2] = -image_plane(bearings)
    return MatchRows(normals, np.tile([0.0, 0.0, 1.0], (len(bearings), 1)))


def sphere_rows(bearings: FloatArray) -> MatchRows:
    """Those of the planes about each of the unit ``bearings`` (K, 3)."""
    return MatchRows(tangent_basis(bearings), bearings)


def image_plane(bearings: FloatArray) -> FloatArray:
    """Calibrated image coordinates (K, 2), x = v_x / v_z and y = v_y / v_z, of bearings with z > 0."""
    return np.ascontiguousarray(bearings[:, :2] / bearings[:, 2:])
