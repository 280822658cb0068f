"""Yaw arcs: for every pair of correspondences, the yaws that agree with it up to its bounds.

With measured bearings, f(yaw) = rho cos(yaw - phi) + d3 (Eq. 22, 33) need not vanish at the true yaw. If the
bearings are off by at most eps_i and eps_j, then |f| <= tau with

    tau = sin(alpha) (s_i sin eps_i + s_j sin eps_j),

where alpha is the angle between the measured bearings and s are the true depths: f is linear in each bearing, and
v_i x v_j has the component |sin(alpha)| |sin eps| along the other ray. The true depths are unknown; those at the root
stand in for them (first order). A pair whose bearings are closer than eps_i + eps_j, or whose points coincide, says
nothing and has no arc; nor has a root with a negative depth.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.problem import AlignedProblem
from spherloc.solvers.two_point import DEGENERATE, depths, yaw_coefficients

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]


def yaw_arcs(aligned: AlignedProblem, bound_rad: FloatArray) -> tuple[IndexArray, FloatArray, FloatArray]:
    """All arcs: pairs (A, 2) of places in ``aligned``, lower ends (A,) in [-pi, pi), upper ends (A,) >= lower.

    ``bound_rad`` (M,) bounds the angular error of each bearing.
    """
    count = len(aligned.bearings)
    room = count * (count - 1)
    pairs = np.empty((room, 2), np.int32)
    lo, hi = np.empty(room), np.empty(room)
    used = _fill(aligned.bearings, aligned.points, np.sin(bound_rad), pairs, lo, hi)
    return pairs[:used].copy(), lo[:used].copy(), hi[:used].copy()


@numba.njit(cache=True, nogil=True)
def _branch(vi, vj, pi, pj, sin_i, sin_j, coefficients, sign):
    """Arc offsets (near, far) from phi on one branch, 0 <= near <= far <= pi; far < 0 if there is none."""
    d1, d2, d3, sin2, _ = coefficients
    rho, phi = np.sqrt(d1 * d1 + d2 * d2), np.arctan2(d2, d1)
    root = phi + sign * np.arccos(min(1.0, max(-1.0, -d3 / rho)))
    si, sj = depths(vi, vj, pi, pj, np.cos(root), np.sin(root), sin2)
    if si <= 0.0 or sj <= 0.0:
        return 0.0, -1.0
    tau = np.sqrt(sin2) * (si * sin_i + sj * sin_j)
    if abs(d3) - tau > rho:
        return 0.0, -1.0
    return np.arccos(min(1.0, (tau - d3) / rho)), np.arccos(max(-1.0, (-tau - d3) / rho))


@numba.njit(cache=True, nogil=True)
def _fill(bearings, points, sin_eps, pairs, lo, hi):
    used, full = 0, 2.0 * np.pi
    for i in range(len(bearings)):
        for j in range(i + 1, len(bearings)):
            vi, vj, pi, pj = bearings[i], bearings[j], points[i], points[j]
            coefficients = yaw_coefficients(vi, vj, pi, pj)
            d1, d2, _, sin2, dist2 = coefficients
            if sin2 <= (sin_eps[i] + sin_eps[j]) ** 2 or d1 * d1 + d2 * d2 <= DEGENERATE**2 * dist2:
                continue
            phi = np.arctan2(d2, d1)
            near_p, far_p = _branch(vi, vj, pi, pj, sin_eps[i], sin_eps[j], coefficients, 1.0)
            near_m, far_m = _branch(vi, vj, pi, pj, sin_eps[i], sin_eps[j], coefficients, -1.0)
            first = used
            if far_p >= 0.0 and far_m >= 0.0 and near_p == 0.0 and near_m == 0.0:
                # Both branches reach phi: one arc, or the whole circle if they meet again on the far side.
                lo[used], hi[used] = phi - far_m, phi + far_p
                used += 1
            elif far_p >= 0.0 and far_m >= 0.0 and far_p == np.pi and far_m == np.pi:
                lo[used], hi[used] = phi + near_p, phi + full - near_m
                used += 1
            else:
                if far_p >= 0.0:
                    lo[used], hi[used] = phi + near_p, phi + far_p
                    used += 1
                if far_m >= 0.0:
                    lo[used], hi[used] = phi - far_m, phi - near_m
                    used += 1
            for k in range(first, used):
                width = min(hi[k] - lo[k], full)
                start = (lo[k] + np.pi) % full - np.pi
                pairs[k, 0], pairs[k, 1] = i, j
                lo[k], hi[k] = start, start + width
    return used
