"""The rectified virtual camera that gives pinhole solvers a wide image (Sec. VI-C).

The fisheye or panorama pixel is unprojected to the sphere and projected again by a pinhole,

    x = v_x / v_z,   y = v_y / v_z,

that looks along the camera's +z axis. A pinhole's image grows without bound towards 90 degrees, so it must end
somewhere, and the correspondences beyond are lost. The paper does not say where its own ended.
"""

from dataclasses import dataclass

import numpy as np

from spherloc.types import BoolArray, FloatArray


@dataclass(frozen=True)
class VirtualPinhole:
    """A square image on the plane z = 1 of the camera frame."""

    fov_deg: float = 120.0
    """Field of view across its width and across its height, degrees: 120 is about what wide rectified images keep,
    since beyond the pixels at the edge are stretched more than fourfold."""

    def sees(self, bearings: FloatArray) -> BoolArray:
        """Which of the ``bearings`` (M, 3), camera frame, fall into the image: mask (M,)."""
        reach = np.tan(np.radians(self.fov_deg / 2)) * bearings[:, 2]
        return (reach > 0.0) & (np.abs(bearings[:, :2]) <= reach[:, None]).all(axis=1)


def image_plane(bearings: FloatArray) -> FloatArray:
    """Calibrated image coordinates (K, 2), x = v_x / v_z and y = v_y / v_z, of bearings with z > 0."""
    return np.ascontiguousarray(bearings[:, :2] / bearings[:, 2:])
