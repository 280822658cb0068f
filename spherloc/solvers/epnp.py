"""EPnP: the pose from four control points of which every map point is a weighted sum; OpenCV's implementation.

    p_i = sum_j a_ij c_j,   x_i ~ sum_j a_ij c_j'   (12 unknowns: the control points c_j' in the camera frame)

Works on the image plane of a pinhole, with five correspondences at least, as OpenCV's own RANSAC samples them.

Lepetit, Moreno-Noguer, Fua: EPnP: An accurate O(n) solution to the PnP problem, IJCV 81, 2009.
"""

import cv2
import numpy as np

from spherloc.solvers.base import NO_POSES, checked, poses
from spherloc.solvers.linear_pose import condition
from spherloc.solvers.virtual_pinhole import image_plane
from spherloc.types import FloatArray


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
