"""What a pair of bounded bearings says about yaw and depth, exactly, as sinusoids of yaw.

For a pair (i, j) let w(yaw) = R d be the vector between its points, a = v_i . v_j and alpha the angle between the
measured bearings. Every quantity here has the form A cos yaw + B sin yaw + C, kept as the triple (A, B, C):

- f = (v_i x v_j) . w, Eq. 22;
- the measured depths s, the least-squares solution of w = s_i v_i - s_j v_j;
- upper bounds S on the true depths. With true bearings at most eps away, chords c = 2 sin(eps / 2) and
  g = c / sin alpha, the dual vectors of v_i and v_j (length 1 / sin alpha) give
      s_i >= (1 - g_i) s_i* - g_j s_j*,    s_j >= (1 - g_j) s_j* - g_i s_i*,
  and, since that matrix is inverse-positive for g_i + g_j < 1,
      s_i* <= S_i = ((1 - g_j) s_i + g_j s_j) / (1 - g_i - g_j),    and S_j alike;
- the bound on |f| at the true yaw, tau = sin alpha (S_i sin eps_i + S_j sin eps_j): f is linear in each bearing, and
  |(v_i x v_j) . v_i*| = |v_j . (v_i* x v_i)| <= sin alpha sin eps_i.

Nothing here is a first-order approximation. A pair with g_i + g_j >= 1 (bearings too close) bounds nothing.
"""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, inline="always")
def _along(v, dx, dy, dz):
    """v . (R d) as (cos, sin, constant)."""
    return v[0] * dx + v[2] * dz, v[0] * dz - v[2] * dx, v[1] * dy


@numba.njit(cache=True, nogil=True)
def chord(angle):
    """Distance between unit vectors at this angle."""
    return 2.0 * np.sin(0.5 * angle)


@numba.njit(cache=True, nogil=True, inline="always")
def pair_sinusoids(vi, vj, pi, pj, chord_i, chord_j, sin_i, sin_j):
    """From ``chord`` and sin of the bounds: sin alpha, and the (cos, sin, constant) of f, s_i, s_j, S_i, S_j, tau.

    sin alpha is 0 for a pair that bounds nothing: its bearings are too close, or its points coincide.
    """
    zero = (0.0, 0.0, 0.0)
    dx, dy, dz = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    nx = vi[1] * vj[2] - vi[2] * vj[1]
    ny = vi[2] * vj[0] - vi[0] * vj[2]
    nz = vi[0] * vj[1] - vi[1] * vj[0]
    sin2 = nx * nx + ny * ny + nz * nz
    sin_alpha = np.sqrt(sin2)
    if sin_alpha <= chord_i + chord_j or (dx == 0.0 and dy == 0.0 and dz == 0.0):
        return 0.0, zero, zero, zero, zero, zero, zero
    dot = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    gi, gj = chord_i / sin_alpha, chord_j / sin_alpha
    scale = 1.0 / (1.0 - gi - gj)
    f = (nx * dx + nz * dz, nx * dz - nz * dx, ny * dy)
    along_i, along_j = _along(vi, dx, dy, dz), _along(vj, dx, dy, dz)
    per_sin2 = 1.0 / sin2
    si = _mix(per_sin2, along_i, -dot * per_sin2, along_j)
    sj = _mix(dot * per_sin2, along_i, -per_sin2, along_j)
    most_i = _mix(scale * (1.0 - gj), si, scale * gj, sj)
    most_j = _mix(scale * (1.0 - gi), sj, scale * gi, si)
    return sin_alpha, f, si, sj, most_i, most_j, _mix(sin_alpha * sin_i, most_i, sin_alpha * sin_j, most_j)


@numba.njit(cache=True, nogil=True, inline="always")
def _mix(a, u, b, v):
    """a u + b v of two sinusoids."""
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]
