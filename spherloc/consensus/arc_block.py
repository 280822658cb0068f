"""The arcs of one bearing's pairs with a block of others, without branches, so that they are compiled to instructions
that treat several pairs at once. ``pair_arcs`` says what the arcs are.

f > tau is excluded between two yaws, and f >= -tau is included between two others, which leaves up to two arcs.
"""

import numpy as np

from spherloc.consensus.pair_sinusoids import ROUNDING, along, cross, depth_bounds, depths, dot, minus
from spherloc.kernel_cache import kernel

BLOCK = 64
"""Largest number of pairs at once; a constant tells the compiler that the rows of what is written do not overlap."""
FIRST, SECOND, WHOLE = 1, 2, 4
"""Flags of a pair: it has a first arc, it has a second one, it has the whole circle."""
ROWS = 5
"""Rows of what is written: flags, and the turns of the first arc's two ends and of the second arc's."""


@kernel(error_model="numpy")
def arcs_of_block(rays, i, begin, end, found):
    """The arcs of the pairs of ray ``i`` with the rays from ``begin`` up to ``end``, at most ``BLOCK``.

    ``rays`` (8, M) holds the bearings (3,), the points (3,), m, and chord and sine of the bound on each bearing's
    angular error. ``found`` (ROWS * BLOCK,) is written, ``BLOCK`` numbers a row; a turn whose flag is missing is any
    number or NaN.
    """
    vi, pi = (rays[0, i], rays[1, i], rays[2, i]), (rays[3, i], rays[4, i], rays[5, i])
    chord_i, sin_i = rays[6, i], rays[7, i]
    vx, vy, vz = rays[0, begin:end], rays[1, begin:end], rays[2, begin:end]
    px, py, pz = rays[3, begin:end], rays[4, begin:end], rays[5, begin:end]
    chords, sines = rays[6, begin:end], rays[7, begin:end]
    for k in range(end - begin):
        vj, d = (vx[k], vy[k], vz[k]), minus(pi, (px[k], py[k], pz[k]))
        n = cross(vi, vj)
        sin_alpha = np.sqrt(dot(n, n))
        is_bounded = sin_alpha > chord_i + chords[k]
        f, (si, sj) = along(n, d), depths(vi, vj, d, n)
        most_i, most_j, tau = depth_bounds(si, sj, sin_alpha, chord_i, chords[k], sin_i, sines[k])
        # Outside the arc (out0, out1): f <= tau. Inside the arc [in0, in1]: -f <= tau.
        a1, b1, c1 = f[0] - tau[0], f[1] - tau[1], f[2] - tau[2]
        a2, b2, c2 = f[0] + tau[0], f[1] + tau[1], f[2] + tau[2]
        amp1, amp2 = a1 * a1 + b1 * b1, a2 * a2 + b2 * b2
        c1 -= ROUNDING * (np.sqrt(amp1) + abs(c1))
        c2 += ROUNDING * (np.sqrt(amp2) + abs(c2))
        root1, root2 = amp1 - c1 * c1, amp2 - c2 * c2
        none = ((root1 < 0.0) & (c1 > 0.0)) | ((root2 < 0.0) & (c2 < 0.0))
        free1, free2 = root1 <= 0.0, root2 <= 0.0
        # Ends by decreasing (0) and increasing (1) yaw seen from the middle of the arc (a, b).
        q1, q2, per1, per2 = np.sqrt(max(root1, 0.0)), np.sqrt(max(root2, 0.0)), 1.0 / amp1, 1.0 / amp2
        out0u, out0v = (-c1 * a1 + b1 * q1) * per1, (-c1 * b1 - a1 * q1) * per1
        out1u, out1v = (-c1 * a1 - b1 * q1) * per1, (-c1 * b1 + a1 * q1) * per1
        in0u, in0v = (-c2 * a2 + b2 * q2) * per2, (-c2 * b2 - a2 * q2) * per2
        in1u, in1v = (-c2 * a2 - b2 * q2) * per2, (-c2 * b2 + a2 * q2) * per2
        both = (not free1) & (not free2)
        begins = free2 | (both & (a2 * out1u + b2 * out1v + c2 >= 0.0))  # the excluded arc ends within the included one
        stops = free2 | (both & (a2 * out0u + b2 * out0v + c2 >= 0.0))  # and begins within it
        covers = free2 | (both & (a1 * in0u + b1 * in0v + c1 > 0.0))  # the included arc begins within the excluded one
        stops_first = stops & (covers | (not begins))
        lo_u, lo_v = out1u if begins else in0u, out1v if begins else in0v
        hi_u, hi_v = out0u if stops_first else in1u, out0v if stops_first else in1v
        has_first = (begins | stops | (not covers)) & (not _behind(most_i, most_j, lo_u, lo_v, hi_u, hi_v))
        has_second = begins & stops & (not covers) & (not _behind(most_i, most_j, in0u, in0v, out0u, out0v))
        flags = (FIRST if has_first else 0) + (SECOND if has_second else 0)
        found[k] = WHOLE if (not is_bounded) | (free1 & free2 & (not none)) else (0 if none else flags)
        found[BLOCK + k], found[2 * BLOCK + k] = _turn(lo_u, lo_v), _turn(hi_u, hi_v)
        found[3 * BLOCK + k], found[4 * BLOCK + k] = _turn(in0u, in0v), _turn(out0u, out0v)


@kernel(inline="always", error_model="numpy")
def _behind(most_i, most_j, u0, v0, u1, v1):
    """Whether S_i < 0 or S_j < 0 on all of the arc from (``u0``, ``v0``) to (``u1``, ``v1``), unit vectors, if that is
    shorter than half a circle.

    ``most_i`` and ``most_j`` are (cos, sin, constant) of S_i and S_j, m. A sinusoid exceeds the larger of its ends by
    at most its amplitude times sin^2 of half the arc's width.
    """
    half = 0.5 * (1.0 - (u0 * u1 + v0 * v1))
    is_short = u0 * v1 - v0 * u1 > 0.0  # the sine of the width
    return is_short & (_is_negative(most_i, u0, v0, u1, v1, half) | _is_negative(most_j, u0, v0, u1, v1, half))


@kernel(inline="always")
def _is_negative(wave, u0, v0, u1, v1, half):
    """Whether a cos + b sin + c of the ``wave`` (a, b, c), m, is negative on all of the arc from (``u0``, ``v0``) to
    (``u1``, ``v1``); ``half`` is sin^2 of half its width."""
    a, b, c = wave
    most = max(a * u0 + b * v0, a * u1 + b * v1) + c
    return most + np.sqrt(a * a + b * b) * half + ROUNDING * abs(c) < 0.0


@kernel(inline="always", error_model="numpy")
def _turn(c, s):
    """Turn in [0, 4] of the direction (``c``, ``s``) of any length; 4 by rounding alone."""
    quarter = s / (abs(c) + abs(s))
    return 2.0 - quarter if c < 0.0 else (quarter if quarter >= 0.0 else 4.0 + quarter)
