"""EPnP: the pose from four control points of which every map point is a weighted sum; OpenCV's implementation.

    p_i = sum_j a_ij c_j,   x_i ~ sum_j a_ij c_j'   (12 unknowns: the control points c_j' in the camera frame)

Works on the image plane of a pinhole, with five correspondences at least, as OpenCV's own RANSAC samples them.

Like the other pinhole solvers it gets a wide image from a rectified virtual camera (Sec. VI-C): the fisheye or panorama
pixel is unprojected to the sphere and projected again by a pinhole,

    x = v_x / v_z,   y = v_y / v_z,

that looks along the camera's +z axis. A pinhole's image grows without bound towards 90 degrees, so it must end
somewhere, and the correspondences beyond are lost. The paper does not say where its own ended.

Lepetit, Moreno-Noguer, Fua: EPnP: An accurate O(n) solution to the PnP problem, IJCV 81, 2009.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from spherloc.solvers.base import NO_POSES, checked, poses
from spherloc.solvers.linear_pose import condition
from spherloc.solvers.match_rows import image_plane
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


class Epnp:
    """OpenCV's EPnP."""

    name = "EPnP"
    sample_size = 5
    pinhole = True

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose."""
        bearings, points = checked(self, bearings, points)
        if condition(points) is None:
            return NO_POSES
        try:
            found, turn, translation = cv2.solvePnP(
                points, image_plane(bearings), np.eye(3), None, flags=cv2.SOLVEPNP_EPNP
            )
        except cv2.error:  # raised for some degenerate samples instead of returning False
            return NO_POSES
        rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
        translation = np.asarray(translation, dtype=np.float64).ravel()
        # Most points behind the image plane: the mirrored solution of a degenerate sample.
        ahead = points @ rotation[2] + translation[2] > 0.0
        found = found and 2 * np.count_nonzero(ahead) > len(points)
        return poses(rotation, translation) if found else NO_POSES
