"""Translation balls: at a known yaw, the camera positions that agree with each pair of correspondences.

Paper, Eq. 24-27 and 38, stated for the camera position C = -R^T t in the aligned map frame instead of t: the two rays
of a pair start at their map points, and C is where they come closest. (Eq. 25's H loses rank for horizontal bearings;
the distance to both rays, H = [I - v_i v_i^T; I - v_j v_j^T], does not, and its least-squares solution is the middle of
their shortest connection.) With depth bounds S (see ``depth_bounds``) and a true yaw at most delta away, a pair of
inliers has

    |C - C_true| <= ||H^+|| hypot(S_i sin eps_i, S_j sin eps_j) + |C'| delta + |C''| delta^2 / 2,

where ||H^+|| = (1 - |cos alpha|)^(-1/2), the derivatives are by yaw, and S and |C''| are taken at their largest within
delta: the ball contains the true position.
"""

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from spherloc.consensus.depth_bounds import chord, pair_sinusoids
from spherloc.problem import AlignedProblem

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.int32]


def translation_balls(
    aligned: AlignedProblem, bound_rad: FloatArray, pairs: IndexArray, yaw_rad: float, yaw_slack_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Camera positions (P, 3) and radii (P,), metres, of ``pairs`` (P, 2) of places in ``aligned`` at a yaw.

    ``yaw_slack_rad`` (P,) bounds how far the true yaw may lie from ``yaw_rad``. A pair that bounds nothing has the
    radius inf.
    """
    centres, radii = np.empty((len(pairs), 3)), np.empty(len(pairs))
    _fill(aligned.bearings, aligned.points, bound_rad, pairs, yaw_rad, yaw_slack_rad, centres, radii)
    return centres, radii


def overlapping(centres: FloatArray, radii: FloatArray) -> BoolArray:
    """Eq. 38: symmetric matrix (M, M) of balls that overlap; false on the diagonal."""
    overlap = cdist(centres, centres) <= radii[:, None] + radii[None, :]
    np.fill_diagonal(overlap, False)
    return overlap


@numba.njit(cache=True, nogil=True)
def _fill(bearings, points, eps, pairs, yaw, slack, centres, radii):
    chords, sines = chord(eps), np.sin(eps)
    c, s = np.cos(yaw), np.sin(yaw)
    for k in range(len(pairs)):
        i, j = pairs[k]
        radii[k] = ball_of_pair(i, j, bearings, points, chords, sines, c, s, slack[k], centres[k])


@numba.njit(cache=True, nogil=True)
def ball_of_pair(i, j, bearings, points, chords, sines, c, s, slack, centre):
    """Radius of the ball of a pair at the yaw (c, s), inf if it bounds nothing; its centre is written."""
    vi, vj, pi, pj = bearings[i], bearings[j], points[i], points[j]
    sin_alpha, _, depth_i, depth_j, largest_i, largest_j, _ = pair_sinusoids(
        vi, vj, pi, pj, chords[i], chords[j], sines[i], sines[j]
    )
    if sin_alpha == 0.0:
        centre[:] = 0.5 * (pi + pj)
        return np.inf
    si, sj = _value(depth_i, c, s), _value(depth_j, c, s)
    di, dj = _slope(depth_i, c, s), _slope(depth_j, c, s)
    slope2 = 0.0
    for axis in range(3):
        ray_i, turn_i = _turned_back(vi, c, s, axis)
        ray_j, turn_j = _turned_back(vj, c, s, axis)
        centre[axis] = 0.5 * (pi[axis] - si * ray_i + pj[axis] - sj * ray_j)
        slope2 += (0.5 * (di * ray_i + si * turn_i + dj * ray_j + sj * turn_j)) ** 2
    # |(s v)''| <= |s''| + 2 |s'| + |s|, and a sinusoid's derivatives are at most its amplitude.
    bend = 0.5 * (_amplitude(depth_i) * 4.0 + abs(depth_i[2]) + _amplitude(depth_j) * 4.0 + abs(depth_j[2]))
    most_i = max(0.0, _value(largest_i, c, s) + _amplitude(largest_i) * slack)
    most_j = max(0.0, _value(largest_j, c, s) + _amplitude(largest_j) * slack)
    spread2 = (most_i * sines[i]) ** 2 + (most_j * sines[j]) ** 2
    noise = np.sqrt(spread2 / _one_minus_abs_cos(vi, vj))
    return noise + np.sqrt(slope2) * slack + 0.5 * bend * slack * slack


@numba.njit(cache=True, nogil=True, inline="always")
def _value(wave, c, s):
    return wave[0] * c + wave[1] * s + wave[2]


@numba.njit(cache=True, nogil=True, inline="always")
def _slope(wave, c, s):
    return wave[1] * c - wave[0] * s


@numba.njit(cache=True, nogil=True, inline="always")
def _amplitude(wave):
    return np.sqrt(wave[0] * wave[0] + wave[1] * wave[1])


@numba.njit(cache=True, nogil=True)
def _one_minus_abs_cos(vi, vj):
    """1 - |cos| of the angle between two unit vectors, without cancellation for small angles."""
    cx = vi[1] * vj[2] - vi[2] * vj[1]
    cy = vi[2] * vj[0] - vi[0] * vj[2]
    cz = vi[0] * vj[1] - vi[1] * vj[0]
    return (cx * cx + cy * cy + cz * cz) / (1.0 + abs(vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]))


@numba.njit(cache=True, nogil=True)
def _turned_back(v, c, s, axis):
    """Component ``axis`` of R^T v and of its derivative by yaw."""
    if axis == 0:
        return v[0] * c - v[2] * s, -v[0] * s - v[2] * c
    if axis == 1:
        return v[1], 0.0
    return v[0] * s + v[2] * c, v[0] * c - v[2] * s
