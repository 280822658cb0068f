"""Yaw arcs: for every pair of correspondences, the yaws at which both can be inliers.

At the true yaw of a pair of inliers, |f| <= tau, S_i >= 0 and S_j >= 0 (see ``depth_bounds``). Each of these is
A cos yaw + B sin yaw + C <= 0, which is one arc, so the feasible yaws are an intersection of four arcs in closed form:
usually one short arc around each root of Eq. 22 with positive depths. The arcs bound: the true yaw cannot be
outside while the noise is within its bound.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.depth_bounds import chord, pair_sinusoids
from spherloc.problem import AlignedProblem

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]

FULL = 2.0 * np.pi
MOST_ARCS = 4
"""Four arcs of a circle intersect in at most four."""
ROUNDING = 1e-12
"""Slack of every condition, relative to its amplitude, so that rounding never excludes the true yaw."""


def yaw_arcs(
    aligned: AlignedProblem, bound_rad: FloatArray, widest_rad: float = FULL
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """All arcs: pairs (A, 2) of places in ``aligned``, lower ends (A,) in [-pi, pi), upper ends (A,) >= lower.

    ``bound_rad`` (M,) bounds the angular error of each bearing. Arcs wider than ``widest_rad`` are left out, and so is
    a pair that bounds nothing: it would cover every yaw alike.
    """
    count = len(aligned.bearings)
    room = MOST_ARCS * (count * (count - 1) // 2)
    # Memory that is never touched is never used, so room for the worst case costs nothing.
    pairs = np.empty((room, 2), np.int32)
    lo, hi = np.empty(room), np.empty(room)
    used = _fill(aligned.bearings, aligned.points, bound_rad, widest_rad, pairs, lo, hi)
    return pairs[:used].copy(), lo[:used].copy(), hi[:used].copy()


@numba.njit(cache=True, nogil=True)
def _where_not_positive(a, b, c):
    """The arc (start, width) on which a cos + b sin + c <= 0; its width is below 0 if there is none."""
    amplitude = np.sqrt(a * a + b * b)
    c -= ROUNDING * (amplitude + abs(c))
    if c > amplitude:
        return 0.0, -1.0
    if c <= -amplitude:
        return -np.pi, FULL
    half = np.pi - np.arccos(-c / amplitude)
    return np.arctan2(-b, -a) - half, 2.0 * half


@numba.njit(cache=True, nogil=True)
def _intersect(arcs, count, start, width, out):
    """Intersect ``count`` arcs, rows (start, width), with one more into ``out``; return how many there are."""
    kept = 0
    for k in range(count):
        if arcs[k, 1] >= FULL or width >= FULL:
            out[kept, 0], out[kept, 1] = (start, width) if arcs[k, 1] >= FULL else (arcs[k, 0], arcs[k, 1])
            kept += 1
            continue
        offset = (start - arcs[k, 0]) % FULL
        if offset <= arcs[k, 1]:
            out[kept, 0], out[kept, 1] = start, min(arcs[k, 1] - offset, width)
            kept += 1
        if offset + width >= FULL:
            out[kept, 0], out[kept, 1] = arcs[k, 0], min(arcs[k, 1], offset + width - FULL)
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)
def _fill(bearings, points, eps, widest, pairs, lo, hi):
    used = 0
    chords, sines = chord(eps), np.sin(eps)
    arcs, scratch = np.empty((MOST_ARCS + 1, 2)), np.empty((MOST_ARCS + 1, 2))
    for i in range(len(bearings)):
        for j in range(i + 1, len(bearings)):
            sin_alpha, f, _, _, most_i, most_j, tau = pair_sinusoids(
                bearings[i], bearings[j], points[i], points[j], chords[i], chords[j], sines[i], sines[j]
            )
            if sin_alpha == 0.0:
                continue
            arcs[0] = _where_not_positive(f[0] - tau[0], f[1] - tau[1], f[2] - tau[2])
            count = 1 if arcs[0, 1] >= 0.0 else 0
            for a, b, c in (
                (-f[0] - tau[0], -f[1] - tau[1], -f[2] - tau[2]),
                (-most_i[0], -most_i[1], -most_i[2]),
                (-most_j[0], -most_j[1], -most_j[2]),
            ):
                if count == 0:
                    break
                start, width = _where_not_positive(a, b, c)
                count = _intersect(arcs, count, start, width, scratch) if width >= 0.0 else 0
                arcs, scratch = scratch, arcs
            for k in range(count):
                if arcs[k, 1] > widest:
                    continue
                start = (arcs[k, 0] + np.pi) % FULL - np.pi
                start -= FULL if start >= np.pi else 0.0
                pairs[used, 0], pairs[used, 1] = i, j
                lo[used], hi[used] = start, start + min(arcs[k, 1], FULL)
                used += 1
    return used
