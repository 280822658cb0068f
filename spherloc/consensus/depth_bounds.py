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
def pair_sinusoids(vi, vj, pi, pj, eps_i, eps_j, out):
    """Fill ``out`` (6, 3) with f, s_i, s_j, S_i, S_j, tau as (cos, sin, constant); return sin alpha, or 0.

    0 means that the pair bounds nothing: its bearings are too close, or its points coincide.
    """
    dx, dy, dz = pi[0] - pj[0], pi[1] - pj[1], pi[2] - pj[2]
    nx = vi[1] * vj[2] - vi[2] * vj[1]
    ny = vi[2] * vj[0] - vi[0] * vj[2]
    nz = vi[0] * vj[1] - vi[1] * vj[0]
    sin2 = nx * nx + ny * ny + nz * nz
    sin_alpha = np.sqrt(sin2)
    chord_i, chord_j = 2.0 * np.sin(0.5 * eps_i), 2.0 * np.sin(0.5 * eps_j)
    if sin_alpha <= chord_i + chord_j or (dx == 0.0 and dy == 0.0 and dz == 0.0):
        return 0.0
    dot = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    gi, gj = chord_i / sin_alpha, chord_j / sin_alpha
    scale, sin_i, sin_j = 1.0 / (1.0 - gi - gj), np.sin(eps_i), np.sin(eps_j)
    out[0, 0], out[0, 1], out[0, 2] = nx * dx + nz * dz, nx * dz - nz * dx, ny * dy
    along_i, along_j = _along(vi, dx, dy, dz), _along(vj, dx, dy, dz)
    for k in range(3):
        si, sj = (along_i[k] - dot * along_j[k]) / sin2, (dot * along_i[k] - along_j[k]) / sin2
        most_i, most_j = scale * ((1.0 - gj) * si + gj * sj), scale * ((1.0 - gi) * sj + gi * si)
        out[1, k], out[2, k], out[3, k], out[4, k] = si, sj, most_i, most_j
        out[5, k] = sin_alpha * (sin_i * most_i + sin_j * most_j)
    return sin_alpha
