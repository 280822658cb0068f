"""2P: yaw and position of a gravity-aligned camera from two correspondences.

Paper, Eq. 18-27, solved without its divisions by y_c, which fail for horizontal bearings. With d = p_i - p_j
and n = v_i x v_j, both rays and R d lie in one plane: n . (R d) = 0, that is Eq. 22 with

    d1 = n_x d_x + n_z d_z,   d2 = n_x d_z - n_z d_x,   d3 = n_y d_y,

the paper's Eq. 23 times n_x / (y_ci y_cj). Two roots in yaw; positive depths settle most of the ambiguity.
Degenerate only if n or d is vertical (both bearings horizontal; one point above the other) or if two bearings
or two points coincide.
"""

import numpy as np

from spherloc.errors import ProblemError
from spherloc.kernel_cache import kernel
from spherloc.types import BoolArray, FloatArray

DEGENERATE = 1e-12
"""Below this, relative to |d|, the pair says nothing about yaw."""


@kernel()
def yaw_coefficients(vi, vj, pi, pj):
    """(d1, d2, d3) of Eq. 22, m, |n|^2 = sin^2 of the angle between the bearings, and |d|^2, m^2.

    ``vi`` and ``vj`` (3,) are unit bearings, ``pi`` and ``pj`` (3,) points, m.
    """
    dx, dy, dz = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    nx = vi[1] * vj[2] - vi[2] * vj[1]
    ny = vi[2] * vj[0] - vi[0] * vj[2]
    nz = vi[0] * vj[1] - vi[1] * vj[0]
    return nx * dx + nz * dz, nx * dz - nz * dx, ny * dy, nx * nx + ny * ny + nz * nz, dx * dx + dy * dy + dz * dz


@kernel()
def depths(vi, vj, pi, pj, cosine, sine, sin2):
    """Depths (s_i, s_j), m, with R d = s_i v_i - s_j v_j in the least-squares sense; sin2 = |v_i x v_j|^2.

    ``cosine`` and ``sine`` are those of the yaw; bearings ``vi``, ``vj`` and points ``pi``, ``pj`` (3,) are as in
    ``yaw_coefficients``.
    """
    dx, dy, dz = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    rx, rz = dx * cosine + dz * sine, dz * cosine - dx * sine
    nx = vi[1] * vj[2] - vi[2] * vj[1]
    ny = vi[2] * vj[0] - vi[0] * vj[2]
    nz = vi[0] * vj[1] - vi[1] * vj[0]
    # s_i = (v_i x v_j) . (R d x v_j) / sin2: no difference of nearly equal numbers for nearly parallel bearings.
    si = nx * (dy * vj[2] - rz * vj[1]) + ny * (rz * vj[0] - rx * vj[2]) + nz * (rx * vj[1] - dy * vj[0])
    sj = nx * (dy * vi[2] - rz * vi[1]) + ny * (rz * vi[0] - rx * vi[2]) + nz * (rx * vi[1] - dy * vi[0])
    return si / sin2, sj / sin2


@kernel()
def solve_pair(vi, vj, pi, pj, yaws, translations):
    """Write the roots with positive depths to ``yaws`` (2,), rad, and ``translations`` (2, 3), m; return how many.

    ``vi`` and ``vj`` (3,) are unit bearings, ``pi`` and ``pj`` (3,) points, m.
    """
    d1, d2, d3, sin2, dist2 = yaw_coefficients(vi, vj, pi, pj)
    rho = np.sqrt(d1 * d1 + d2 * d2)
    # Where both roots meet, rounding may put |d3| above rho.
    rounding = DEGENERATE * np.sqrt(dist2)
    if rho <= rounding or abs(d3) > rho + rounding:
        return 0
    phi, half = np.arctan2(d2, d1), np.arccos(min(1.0, max(-1.0, -d3 / rho)))
    found = 0
    for sign in (1.0, -1.0):
        yaw = phi + sign * half
        c, s = np.cos(yaw), np.sin(yaw)
        si, sj = depths(vi, vj, pi, pj, c, s, sin2)
        if si <= 0.0 or sj <= 0.0:
            continue
        yaws[found] = np.arctan2(s, c)
        # Eq. 27 at an exact root: both rays agree, and their mean halves the rounding error.
        translations[found, 0] = 0.5 * (si * vi[0] + sj * vj[0] - (pi[0] + pj[0]) * c - (pi[2] + pj[2]) * s)
        translations[found, 1] = 0.5 * (si * vi[1] + sj * vj[1] - pi[1] - pj[1])
        translations[found, 2] = 0.5 * (si * vi[2] + sj * vj[2] + (pi[0] + pj[0]) * s - (pi[2] + pj[2]) * c)
        found += 1
    return found


@kernel()
def _solve_batch(bearings, points, yaws, translations, valid):
    """Write ``solve_pair`` of B pairs, see ``two_point``; ``valid`` (B, 2) becomes true where there is a root.

    ``bearings`` and ``points`` (B, 2, 3) are as there; ``yaws`` (B, 2) and ``translations`` (B, 2, 3) are written.
    """
    for b in range(len(bearings)):
        found = solve_pair(bearings[b, 0], bearings[b, 1], points[b, 0], points[b, 1], yaws[b], translations[b])
        valid[b, :found] = True


def two_point(bearings: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Solve B pairs of correspondences between gravity-aligned frames (y down).

    ``bearings`` (B, 2, 3) are unit vectors, ``points`` (B, 2, 3) metres. Returns yaws (B, 2), rad in [-pi, pi],
    translations (B, 2, 3), metres, and which of the two roots exist (B, 2); p_cam = R_y(yaw) p_map + t. Missing roots
    are NaN.

    Raises ``ProblemError`` for other shapes.
    """
    bearings = np.ascontiguousarray(bearings, dtype=np.float64)
    points = np.ascontiguousarray(points, dtype=np.float64)
    for name, array in (("bearings", bearings), ("points", points)):
        if array.ndim != 3 or array.shape != (len(bearings), 2, 3):
            raise ProblemError(f"two_point: {name} have shape {array.shape}; give ({len(bearings)}, 2, 3).")
    count = len(bearings)
    yaws, translations = np.full((count, 2), np.nan), np.full((count, 2, 3), np.nan)
    valid = np.zeros((count, 2), dtype=bool)
    _solve_batch(bearings, points, yaws, translations, valid)
    return yaws, translations, valid
