"""Counting the correspondences that a gravity-aligned pose explains: the inner loop of every estimator."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def count_inliers(yaw, translation, bearings, points, weights, bound_px):
    """Correspondences whose first-order reprojection error is within their bound; as in ``refine``."""
    c, s = np.cos(yaw), np.sin(yaw)
    inliers = 0
    for k in range(len(points)):
        x = points[k, 0] * c + points[k, 2] * s + translation[0]
        y = points[k, 1] + translation[1]
        z = points[k, 2] * c - points[k, 0] * s + translation[2]
        if bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z <= 0.0:
            continue
        du = weights[k, 0, 0] * x + weights[k, 0, 1] * y + weights[k, 0, 2] * z
        dv = weights[k, 1, 0] * x + weights[k, 1, 1] * y + weights[k, 1, 2] * z
        if du * du + dv * dv <= bound_px[k] * bound_px[k] * (x * x + y * y + z * z):
            inliers += 1
    return inliers
