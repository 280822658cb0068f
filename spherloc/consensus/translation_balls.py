"""Translation balls: at a known yaw, the camera positions that agree with each pair of correspondences.

Paper, Eq. 24-27 and 38, stated for the camera position C = -R^T t in the aligned map frame instead of t: the two rays
of a pair start at their map points, and C is where they come closest. (Eq. 25's H loses rank for horizontal bearings;
the distance to both rays, H = [I - v_i v_i^T; I - v_j v_j^T], does not, and its least-squares solution is the middle of
their shortest connection.) The ball around C contains the true position of a pair of inliers, to first order, since

    |C - C_true| <= ||H^+|| hypot(s_i sin eps_i, s_j sin eps_j) + |dC/dyaw| |yaw - yaw_true|,

||H^+|| = (1 - |cos alpha|)^(-1/2), and the true yaw lies in the pair's own arc.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.problem import AlignedProblem
from spherloc.solvers.two_point import depths, yaw_coefficients

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.int32]


def translation_balls(
    aligned: AlignedProblem, bound_rad: FloatArray, pairs: IndexArray, yaw_rad: float, yaw_slack_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Camera positions (P, 3) and radii (P,), metres, of ``pairs`` (P, 2) of places in ``aligned`` at a yaw.

    ``yaw_slack_rad`` (P,) bounds how far the true yaw may lie from ``yaw_rad``. A pair with a negative depth at this
    yaw gets the radius inf.
    """
    centres, radii = np.empty((len(pairs), 3)), np.empty(len(pairs))
    _fill(aligned.bearings, aligned.points, np.sin(bound_rad), pairs, yaw_rad, yaw_slack_rad, centres, radii)
    return centres, radii


def overlapping(centres: FloatArray, radii: FloatArray) -> BoolArray:
    """Eq. 38: symmetric matrix (M, M) of balls that overlap; false on the diagonal."""
    distance = np.linalg.norm(centres[:, None, :] - centres[None, :, :], axis=2)
    overlap = distance <= radii[:, None] + radii[None, :]
    np.fill_diagonal(overlap, False)
    return overlap


@numba.njit(cache=True, nogil=True)
def _fill(bearings, points, sin_eps, pairs, yaw, slack, centres, radii):
    c, s = np.cos(yaw), np.sin(yaw)
    for k in range(len(pairs)):
        i, j = pairs[k]
        vi, vj, pi, pj = bearings[i], bearings[j], points[i], points[j]
        sin2 = yaw_coefficients(vi, vj, pi, pj)[3]
        si, sj = depths(vi, vj, pi, pj, c, s, sin2)
        # d depth / d yaw: R'(yaw) d is R(yaw + pi/2) d without its y part, so the vertical offset drops out.
        di, dj = depths(vi, vj, pi, pj, -s, c, sin2)
        vi_y, vj_y, dot = vi[1], vj[1], vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
        height = pi[1] - pj[1]
        di -= (vi_y - dot * vj_y) * height / sin2
        dj -= (dot * vi_y - vj_y) * height / sin2
        slope2 = 0.0
        for axis in range(3):
            ray_i, turn_i = _turned_back(vi, c, s, axis)
            ray_j, turn_j = _turned_back(vj, c, s, axis)
            centres[k, axis] = 0.5 * (pi[axis] - si * ray_i + pj[axis] - sj * ray_j)
            slope2 += (0.5 * (di * ray_i + si * turn_i + dj * ray_j + sj * turn_j)) ** 2
        if si <= 0.0 or sj <= 0.0:
            radii[k] = np.inf
            continue
        noise = np.sqrt(((si * sin_eps[i]) ** 2 + (sj * sin_eps[j]) ** 2) / _one_minus_abs_cos(dot, sin2))
        radii[k] = noise + np.sqrt(slope2) * slack[k]


@numba.njit(cache=True, nogil=True)
def _one_minus_abs_cos(dot, sin2):
    """1 - |cos alpha|, without cancellation for small angles."""
    return sin2 / (1.0 + abs(dot))


@numba.njit(cache=True, nogil=True)
def _turned_back(v, c, s, axis):
    """Component ``axis`` of R^T v and of its derivative by yaw."""
    if axis == 0:
        return v[0] * c - v[2] * s, -v[0] * s - v[2] * c
    if axis == 1:
        return v[1], 0.0
    return v[0] * s + v[2] * c, v[0] * c - v[2] * s
