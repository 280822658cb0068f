"""Yaw arcs: for every pair of correspondences, the yaws at which both can be inliers; and the yaw that most arcs cover.

**Arcs.** At the true yaw of a pair of inliers, |f| <= tau, S_i >= 0 and S_j >= 0 (see ``pair_sinusoids``). Each of
these is A cos yaw + B sin yaw + C >= 0, which is one arc, so the feasible yaws are an intersection of four arcs in
closed form: usually one short arc around each root of Eq. 22 with positive depths. The arcs bound: the true yaw
cannot be outside while the noise is within its bound. They are intersected as pairs of unit vectors (cos, sin), from
the first end counterclockwise to the second, so that angles are computed only of the arcs that are returned: half of
all pairs have none.

**The deepest yaw**, covered by most arcs: a maximum clique of the rotation graph (Eq. 34, 37) without building a graph.
Arcs on a line that overlap pairwise share a point, so a clique of their graph is a point and the arcs over it. On the
circle this holds for the arcs through any one yaw, which is what the estimator needs. Sorting the ends and walking
them finds the deepest yaw exactly, in O(A log A). (Eq. 37 as printed has the interval ends swapped.)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.pair_rows import fill_rows
from spherloc.consensus.pair_sinusoids import ROUNDING, chord, pair_sinusoids
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.types import FloatArray, IndexArray
from spherloc.watch import DONE, SELDOM, Watch, stopped

FULL = 2.0 * np.pi
"""The whole circle, rad."""
MAX_ARCS = 4
"""Four arcs of a circle intersect in at most four."""
MIN_SINE = 1e-9
"""Sine of the angle by which the ends of a short arc may be swapped by rounding. No long arc leaves so little open."""
BINS = 1440
"""Bins of the overlap curve kept for display, a quarter of a degree each."""
MAX_SORTED = 2_000_000
"""Numbers that are sorted at once: some hundredths of a second."""


def yaw_arcs(
    aligned: AlignedProblem, bound_rad: FloatArray, widest_rad: float = FULL, watch: Watch | None = None
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """All arcs: pairs (A, 2) of matches of ``aligned``, lower ends (A,) in [-pi, pi), upper ends (A,) >= lower.

    ``bound_rad`` (M,) bounds the angular error of each bearing. Arcs wider than ``widest_rad`` are left out, and so is
    a pair that bounds nothing: it would cover every yaw alike. ``watch`` counts the pairs; raises ``Cancelled``.
    """
    watch = watch or Watch()
    count = len(aligned.bearings)
    watch.expect(count * (count - 1) // 2)
    room = MAX_ARCS * (count * (count - 1) // 2)
    # Memory that is never touched is never used, so room for the worst case costs nothing.
    pairs = np.empty((room, 2), np.int32)
    lo, hi = np.empty(room), np.empty(room)

    def fill(rows: tuple[int, int], part: tuple[NDArray, ...]) -> int:
        return _fill(aligned.bearings, aligned.points, bound_rad, widest_rad, rows, part, watch.board)

    pairs, lo, hi = fill_rows(count, MAX_ARCS, (pairs, lo, hi), fill)
    watch.check()
    return pairs, lo, hi


@kernel(inline="always")
def _sine_and_cosine(u0, v0, u1, v1):
    """Of an arc's width, from its ends, unit vectors (u0, v0) and (u1, v1).

    The sine is below 0 only if the arc is longer than half the circle.
    """
    sine, cosine = u0 * v1 - v0 * u1, u0 * u1 + v0 * v1
    return (0.0 if sine < 0.0 and sine > -MIN_SINE and cosine > 0.0 else sine), cosine


@kernel()
def _holds(u0, v0, u1, v1, x, y):
    """Whether the arc from (u0, v0) to (u1, v1) holds the direction (x, y)."""
    after_first, before_second = u0 * y - v0 * x >= 0.0, x * v1 - y * u1 >= 0.0
    if _sine_and_cosine(u0, v0, u1, v1)[0] >= 0.0:
        return after_first and before_second and u0 * x + v0 * y + u1 * x + v1 * y >= 0.0
    return after_first or before_second


@kernel()
def _cut(arcs, count, a, b, c):
    """Replace ``count`` of the ``arcs`` (K, 4), rows (u0, v0, u1, v1), by what of them has a cos + b sin + c >= 0.

    Returns how many are left. A row of zeros is the whole circle.
    """
    square = a * a + b * b
    amplitude = np.sqrt(square)
    c += ROUNDING * (amplitude + abs(c))
    if c >= amplitude:
        return count
    if c < -amplitude:
        return 0
    kept, split = 0, count
    for k in range(count):
        u0, v0, u1, v1 = arcs[k, 0], arcs[k, 1], arcs[k, 2], arcs[k, 3]
        at_first, at_second = a * u0 + b * v0 + c, a * u1 + b * v1 + c
        sine, cosine = _sine_and_cosine(u0, v0, u1, v1)
        # Between the ends of a short arc, a wave leaves the range of its values there by this at most.
        bulge = 0.5 * amplitude * (1.0 - cosine)
        if sine > 0.0 and max(at_first, at_second) < -bulge:
            continue
        if sine <= 0.0 or min(at_first, at_second) < bulge:
            # The condition holds from ``first`` to ``second``, around (a, b).
            root, per_square = np.sqrt(max(square - c * c, 0.0)), 1.0 / square
            first_u, first_v = (b * root - c * a) * per_square, (-a * root - c * b) * per_square
            second_u, second_v = (-b * root - c * a) * per_square, (a * root - c * b) * per_square
            whole, outside = u0 == 0.0 and v0 == 0.0, at_first < 0.0 and at_second < 0.0
            if outside and not whole and not _holds(u0, v0, u1, v1, a, b):
                continue
            if at_first >= 0.0 and at_second >= 0.0 and not whole and _holds(u0, v0, u1, v1, -a, -b):
                arcs[split, 0], arcs[split, 1], arcs[split, 2], arcs[split, 3] = first_u, first_v, u1, v1
                split += 1
                u1, v1 = second_u, second_v
            if at_first < 0.0 or whole:
                u0, v0 = first_u, first_v
            if at_second < 0.0 or whole:
                u1, v1 = second_u, second_v
        arcs[kept, 0], arcs[kept, 1], arcs[kept, 2], arcs[kept, 3] = u0, v0, u1, v1
        kept += 1
    for k in range(count, split):
        arcs[kept] = arcs[k]
        kept += 1
    return kept


@kernel(inline="always")
def _clear_sign(wave, u0, v0, u1, v1, cosine):
    """1 or -1 if the ``wave`` (cos, sin, constant) has this sign on all of a short arc, 0 if unclear.

    The arc is from (u0, v0) to (u1, v1); ``cosine`` is that of its width.
    """
    at_first, at_second = wave[0] * u0 + wave[1] * v0 + wave[2], wave[0] * u1 + wave[1] * v1 + wave[2]
    # At least the bulge of ``_cut``.
    amplitude = abs(wave[0]) + abs(wave[1])
    bulge = 0.5 * amplitude * (1.0 - cosine)
    below = -bulge - ROUNDING * (amplitude + abs(wave[2]))
    return (min(at_first, at_second) >= bulge) - (max(at_first, at_second) < below)


@kernel()
def _arcs_at_roots(f, tau, most_i, most_j, arcs):
    """Write the arcs where all conditions hold to ``arcs`` (K, 4), if f has two roots and at most a short one at each.

    Returns how many, or -1 where it is not so simple. ``f``, ``tau`` and the upper bounds on both depths, ``most_i``
    and ``most_j``, are waves (cos, sin, constant). Gives what four cuts give, for most pairs, with few branches.
    """
    a, b, c = tau[0] - f[0], tau[1] - f[1], tau[2] - f[2]
    d, e, g = tau[0] + f[0], tau[1] + f[1], tau[2] + f[2]
    square, square2 = a * a + b * b, d * d + e * e
    amplitude, amplitude2 = np.sqrt(square), np.sqrt(square2)
    c += ROUNDING * (amplitude + abs(c))
    g += ROUNDING * (amplitude2 + abs(g))
    if c < -amplitude or g < -amplitude2:
        return 0
    if c >= amplitude or g >= amplitude2:
        return -1
    root, per_square = np.sqrt(square - c * c), 1.0 / square
    root2, per_square2 = np.sqrt(square2 - g * g), 1.0 / square2
    ends = (
        ((b * root - c * a) * per_square, (-a * root - c * b) * per_square),
        ((-e * root2 - g * d) * per_square2, (d * root2 - g * e) * per_square2),
        ((e * root2 - g * d) * per_square2, (-d * root2 - g * e) * per_square2),
        ((-b * root - c * a) * per_square, (a * root - c * b) * per_square),
    )
    below = -2.0 * ROUNDING * (amplitude + abs(c) + amplitude2 + abs(g))
    count, roots, clear = 0, 0, True
    for k in (0, 2):
        u0, v0 = ends[k]
        u1, v1 = ends[k + 1]
        sine, cosine = _sine_and_cosine(u0, v0, u1, v1)
        # At the ends |f| = |tau|: where tau is negative there, no yaw near the root fulfils both conditions.
        at_first, at_second = tau[0] * u0 + tau[1] * v0 + tau[2], tau[0] * u1 + tau[1] * v1 + tau[2]
        real, none = (at_first >= 0.0) & (at_second >= 0.0), (at_first < below) & (at_second < below)
        sign_i, sign_j = _clear_sign(most_i, u0, v0, u1, v1, cosine), _clear_sign(most_j, u0, v0, u1, v1, cosine)
        holds = real & (sign_i > 0) & (sign_j > 0)
        clear &= none | (real & (sine > 0.0) & (holds | (sign_i < 0) | (sign_j < 0)))
        arcs[count, 0], arcs[count, 1], arcs[count, 2], arcs[count, 3] = u0, v0, u1, v1
        count += holds
        roots += real
    # The second condition must fail in the middle of where the first holds, or the arcs around two roots are one.
    return count if clear and (roots < 2 or c * amplitude2 >= a * d + b * e) else -1


@kernel()
def _fill(bearings, points, eps, widest, rows, found, board):
    """Write the arcs of the pairs (i, j) with i from ``rows[0]`` up to ``rows[1]`` to the arrays ``found``: pairs
    (K, 2), first and second ends (K,), (K,), rad. Returns how many.

    ``bearings`` (M, 3), ``points`` (M, 3), m, ``eps`` (M,), rad, ``widest`` in rad. A watch's ``board`` counts the
    pairs and can end it.
    """
    used, (pairs, lo, hi) = 0, found
    chords, sines = chord(eps), np.sin(eps)
    least_cosine = np.cos(widest) - MIN_SINE if widest < np.pi else -2.0
    arcs = np.empty((2 * MAX_ARCS, 4))
    for i in range(rows[0], rows[1]):
        if stopped(board):
            break
        for j in range(i + 1, len(bearings)):
            sin_alpha, f, _, _, most_i, most_j, tau = pair_sinusoids(
                bearings[i], bearings[j], points[i], points[j], chords[i], chords[j], sines[i], sines[j]
            )
            if sin_alpha == 0.0:
                continue
            count = _arcs_at_roots(f, tau, most_i, most_j, arcs)
            if count < 0:
                arcs[0] = 0.0
                count = _cut(arcs, np.int64(1), tau[0] - f[0], tau[1] - f[1], tau[2] - f[2])
                count = _cut(arcs, count, tau[0] + f[0], tau[1] + f[1], tau[2] + f[2])
                count = _cut(arcs, count, most_i[0], most_i[1], most_i[2])
                count = _cut(arcs, count, most_j[0], most_j[1], most_j[2])
            for k in range(count):
                u0, v0, u1, v1 = arcs[k, 0], arcs[k, 1], arcs[k, 2], arcs[k, 3]
                start, width = -np.pi, FULL
                if u0 != 0.0 or v0 != 0.0:
                    sine, cosine = _sine_and_cosine(u0, v0, u1, v1)
                    if cosine < least_cosine:
                        continue
                    start, width = np.arctan2(v0, u0), np.arctan2(sine, cosine)
                    start -= FULL if start >= np.pi else 0.0
                    width += FULL if width < 0.0 else 0.0
                if width <= widest:
                    pairs[used, 0], pairs[used, 1] = i, j
                    lo[used], hi[used] = start, start + width
                    used += 1
        board[DONE] += len(bearings) - 1 - i
    return used


@dataclass(frozen=True, eq=False)
class YawConsensus:
    """The deepest yaw of A arcs."""

    interval_rad: tuple[float, float]
    """The longest of the intervals covered by most arcs; its upper end exceeds pi where it crosses the seam."""
    yaw_rad: float
    """Its middle, in [-pi, pi)."""
    clique: IndexArray
    """Indices of the arcs that cover it."""
    overlap: IndexArray
    """(BINS,) the most arcs over any one yaw of each bin, from -pi upwards."""


def deepest_yaw(lo_rad: FloatArray, hi_rad: FloatArray, watch: Watch | None = None) -> YawConsensus | None:
    """The yaw that most closed arcs cover, those from ``lo_rad`` (K,) to ``hi_rad`` (K,); None without arcs.

    Arcs have -pi <= lo < pi and hi <= lo + 2 pi; -pi and pi are one yaw. ``watch`` counts the steps below; raises
    ``Cancelled``.
    """
    if len(lo_rad) == 0:
        return None
    watch = watch or Watch()
    watch.expect(5)
    starts, ends, depth = _ends(lo_rad, hi_rad, watch.board)
    watch.reach(1)
    _sort(starts, watch)
    watch.reach(2)
    _sort(ends, watch)
    watch.reach(3)
    overlap = np.zeros(BINS, np.int32)
    start, end = _sweep(starts, ends, depth, overlap, watch.board)
    watch.reach(4)
    yaw = 0.5 * (start + end)
    yaw -= 2 * np.pi if yaw >= np.pi else 0.0
    clique = _covering(lo_rad, hi_rad, yaw, watch.board)
    watch.reach(5)
    return YawConsensus((start, end), yaw, clique, overlap)


def _sort(values: FloatArray, watch: Watch) -> None:
    """Sort in place, by halves where one sort would take long: numpy's cannot be stopped."""
    watch.check()
    if len(values) <= MAX_SORTED:
        values.sort()
        return
    half = len(values) // 2
    values.partition(half)
    _sort(values[:half], watch)
    _sort(values[half:], watch)


@kernel(inline="always")
def _kind(lo, hi):
    """Whether an arc from ``lo`` to ``hi``, rad, is the whole circle; whether it crosses the seam; its end below pi."""
    full = hi - lo >= 2 * np.pi
    wraps = hi >= np.pi and not full
    return full, wraps, hi - 2 * np.pi if wraps else hi


@kernel()
def _ends(lo, hi, board):
    """Lower and upper ends (K,) of the arcs but whole circles, in any order, and how many arcs cover -pi from before.

    ``lo`` (A,) and ``hi`` (A,) are in rad; a watch's ``board`` can end it.
    """
    starts, ends = np.empty(len(lo)), np.empty(len(lo))
    count, depth = 0, 0
    for k in range(len(lo)):
        if k & SELDOM == 0 and stopped(board):
            break
        full, wraps, end = _kind(lo[k], hi[k])
        starts[count], ends[count] = lo[k], end
        count += not full
        depth += full or wraps
    return starts[:count], ends[:count], depth


@kernel()
def _covering(lo, hi, yaw, board):
    """Indices (K,) of the arcs, ``lo`` (A,) and ``hi`` (A,), rad, that cover a ``yaw`` of [-pi, pi).

    A watch's ``board`` can end it.
    """
    covering = np.empty(len(lo), np.int32)
    count = 0
    for k in range(len(lo)):
        if k & SELDOM == 0 and stopped(board):
            break
        full, wraps, end = _kind(lo[k], hi[k])
        above, below = lo[k] <= yaw, yaw <= end
        covering[count] = k
        count += full | (wraps & (above | below)) | (above & below)
    return covering[:count].copy()


@kernel(inline="always")
def _bin(yaw):
    """The bin of ``overlap`` that holds a yaw of [-pi, pi], rad."""
    return max(0, min(BINS - 1, int((yaw + np.pi) * (BINS / (2 * np.pi)))))


@kernel()
def _sweep(starts, ends, depth, overlap, board):
    """Walk the sorted ends from -pi to pi, starting with ``depth`` arcs that cover -pi; fill ``overlap`` (BINS,).

    ``starts`` and ``ends`` (K,) are in rad. Returns the longest interval of greatest depth. Where an arc ends and
    another starts at the same yaw, both cover it, since arcs are closed. A watch's ``board`` can end it.
    """
    count = len(starts)
    opened, closed = 0, 0
    here, first, best, best_lo, best_hi = -np.pi, 0, -1, -np.pi, np.pi
    # The interval that starts at -pi continues the one that ends at pi.
    seam_depth, seam_end = -1, -np.pi
    while True:
        next_open = starts[opened] if opened < count else np.inf
        next_close = ends[closed] if closed < count else np.inf
        there = min(next_open, next_close, np.pi)
        last = _bin(there)
        for b in range(first, last + 1):
            overlap[b] = max(overlap[b], depth)
        if seam_depth < 0 and there > -np.pi:
            seam_depth, seam_end = depth, there
        far = there + (seam_end + np.pi if there == np.pi and depth == seam_depth and here > -np.pi else 0.0)
        if depth > best or (depth == best and far - here > best_hi - best_lo):
            best, best_lo, best_hi = depth, here, far
        if there == np.pi or ((opened + closed) & SELDOM == 0 and stopped(board)):
            return best_lo, best_hi
        # Which one comes next is as good as random: arithmetic instead of a branch.
        opens = np.int64(next_open <= next_close)
        depth += 2 * opens - 1
        opened += opens
        closed += 1 - opens
        here, first = there, last
