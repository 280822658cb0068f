"""What a pair of bounded bearings says about yaw and depth, exactly, as sinusoids of the yaw.

For a pair (i, j) let w(yaw) = R d be the vector between its points, a = v_i . v_j and alpha the
angle between the measured bearings. Every quantity here has the form A cos yaw + B sin yaw + C, kept as the triple
(A, B, C):

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

import numpy as np

from spherloc.kernel_cache import kernel

ROUNDING = 1e-12
"""Slack of every condition, relative to its amplitude, so that rounding never excludes the true yaw."""


@kernel()
def chord(angle):
    """Distance between unit vectors at this angle, rad (any shape)."""
    return 2.0 * np.sin(0.5 * angle)


@kernel(inline="always")
def pair_sinusoids(vi, vj, pi, pj, chord_i, chord_j, sin_i, sin_j):
    """sin alpha, and the (cos, sin, constant) of f, s_i, s_j, S_i, S_j, tau, m, of two bearings and two points.

    ``vi`` and ``vj`` (3,) are the bearings, ``pi`` and ``pj`` (3,), m, the points; ``chord_i``, ``chord_j``, ``sin_i``
    and ``sin_j`` are chord and sine of the bound on each bearing's angular error. sin alpha is 0 for a pair that bounds
    nothing: its bearings are too close, or its points coincide.
    """
    zero = (0.0, 0.0, 0.0)
    d, n = minus(pi, pj), cross(vi, vj)
    sin_alpha = np.sqrt(dot(n, n))
    if sin_alpha <= chord_i + chord_j or (d[0] == 0.0 and d[1] == 0.0 and d[2] == 0.0):
        return 0.0, zero, zero, zero, zero, zero, zero
    si, sj = depths(vi, vj, d, n)
    most_i, most_j, tau = depth_bounds(si, sj, sin_alpha, chord_i, chord_j, sin_i, sin_j)
    return sin_alpha, along(n, d), si, sj, most_i, most_j, tau


@kernel(inline="always")
def depths(vi, vj, d, n):
    """(cos, sin, constant) of the measured depths s_i and s_j, m, of bearings ``vi`` and ``vj`` with the cross product
    ``n``, all (3,), to points that differ by ``d`` (3,), m. The bearings must not be parallel."""
    along_i, along_j = along(vi, d), along(vj, d)
    cos_alpha, per_sin2 = dot(vi, vj), 1.0 / dot(n, n)
    si = _mix(per_sin2, along_i, -cos_alpha * per_sin2, along_j)
    return si, _mix(cos_alpha * per_sin2, along_i, -per_sin2, along_j)


@kernel(inline="always")
def depth_bounds(si, sj, sin_alpha, chord_i, chord_j, sin_i, sin_j):
    """(cos, sin, constant) of S_i, S_j and tau, m, from those of the measured depths ``si`` and ``sj``.

    ``chord_i``, ``chord_j``, ``sin_i`` and ``sin_j`` are as in ``pair_sinusoids``; these are bounds if ``sin_alpha``
    exceeds the sum of the chords.
    """
    gi, gj = chord_i / sin_alpha, chord_j / sin_alpha
    scale = 1.0 / (1.0 - gi - gj)
    most_i = _mix(scale * (1.0 - gj), si, scale * gj, sj)
    most_j = _mix(scale * (1.0 - gi), sj, scale * gi, si)
    return most_i, most_j, _mix(sin_alpha * sin_i, most_i, sin_alpha * sin_j, most_j)


@kernel(inline="always")
def along(v, d):
    """v . (R d) of a vector ``v`` (3,) and ``d`` (3,), m, as (cos, sin, constant)."""
    return v[0] * d[0] + v[2] * d[2], v[0] * d[2] - v[2] * d[0], v[1] * d[1]


@kernel(inline="always")
def _mix(a, u, b, v):
    """a u + b v of two sinusoids ``u`` and ``v``, as (cos, sin, constant)."""
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]


@kernel(inline="always")
def minus(p, q):
    """The difference of two vectors ``p`` and ``q`` (3,)."""
    return p[0] - q[0], p[1] - q[1], p[2] - q[2]


@kernel(inline="always")
def cross(u, v):
    """The cross product of two vectors ``u`` and ``v`` (3,)."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@kernel(inline="always")
def dot(u, v):
    """The inner product of two vectors ``u`` and ``v`` (3,)."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
