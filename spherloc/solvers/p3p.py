"""P3P: the poses that three correspondences leave, without gravity, for many samples at once.

With the distances s1, s2 = u s1, s3 = v s1 of the three points from the camera, the law of cosines for each two of them
gives a polynomial of degree four in v, and u and s1 from v. The rotation then carries the triangle of the points onto
that of s_i b_i. Works on the whole sphere.

Degenerate if the three points lie in a line or the camera on a certain cylinder through them.

Grunert, 1841, in the form of Haralick et al.: Review and analysis of solutions of the three point perspective pose
estimation problem, IJCV 1994.
"""

import numpy as np

from spherloc.kernel_cache import kernel
from spherloc.solvers.base import Many, checked
from spherloc.types import FloatArray, IntArray

SAMPLE_SIZE = 3
MAX_SOLUTIONS = 4
LEAST = 1e-9
"""Leading coefficients below this are rounding."""
MAX_IMAGINARY = 1e-6
"""Of a root that counts as real, by its absolute value: double roots are found with half of the digits."""
MAX_STEPS = 40
"""Of the search for roots: five to eight are the rule, a double root takes twenty."""
STEP_TOLERANCE = 1e-15
"""Of a root, by its absolute value."""


class P3p:
    """Grunert's solution, as RANSAC takes it: up to four poses a sample."""

    name = "P3P"
    sample_size = SAMPLE_SIZE
    pinhole = False

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; of more than three correspondences the first three are taken."""
        bearings, points = checked(self, bearings, points)
        return self.solve_each(bearings[None], points[None])[0]

    def solve_each(self, bearings: FloatArray, points: FloatArray) -> Many:
        """The poses of each of B samples: ``bearings`` (B, K, 3) and ``points`` (B, K, 3), metres."""
        return p3p(bearings[:, :SAMPLE_SIZE], points[:, :SAMPLE_SIZE])


def p3p(bearings: FloatArray, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """All poses (L, 3, 4) of K samples, and the sample (L,) that each belongs to, ascending.

    ``bearings`` (K, 3, 3) are unit vectors, ``points`` (K, 3, 3) in map units, one correspondence a row.
    """
    count = len(bearings)
    poses, found = np.empty((count, MAX_SOLUTIONS, 3, 4)), np.zeros(count, np.int64)
    one, some = (np.ascontiguousarray(array, dtype=np.float64) for array in (bearings, points))
    for array in (one, some):
        array.setflags(write=False)  # kernels are compiled for one or the other
    _solve_each(one, some, poses, found)
    there = np.arange(MAX_SOLUTIONS) < found[:, None]
    return poses[there], np.repeat(np.arange(count), found)


@kernel()
def _solve_each(bearings, points, poses, found):
    """Write the ``poses`` (K, 4, 3, 4) of K samples and how many each has, ``found`` (K,).

    ``bearings`` (K, 3, 3) and ``points`` (K, 3, 3) are as in ``p3p``.
    """
    for k in range(len(bearings)):
        found[k] = solve_triplet(bearings[k], points[k], poses[k])


@kernel()
def solve_triplet(bearings, points, poses):
    """Write the poses (4, 3, 4) of three correspondences, unit ``bearings`` (3, 3) and ``points`` (3, 3); return how
    many there are."""
    a2, b2, c2 = _distance2(points, 1, 2), _distance2(points, 0, 2), _distance2(points, 0, 1)
    cos_a, cos_b, cos_g = _dot(bearings, 1, 2), _dot(bearings, 0, 2), _dot(bearings, 0, 1)
    if not (a2 > 0.0 and b2 > 0.0 and c2 > 0.0):
        return 0
    k, a, c = (a2 - c2) / b2, a2 / b2, c2 / b2
    p4 = (k - 1.0) ** 2 - 4.0 * c * cos_a**2
    p3 = 4.0 * (k * (1.0 - k) * cos_b - (1.0 - a - c) * cos_a * cos_g + 2.0 * c * cos_a**2 * cos_b)
    p2 = k**2 - 1.0 + 2.0 * k**2 * cos_b**2 + 2.0 * (1.0 - c) * cos_a**2
    p2 = 2.0 * (p2 - 4.0 * (a + c) * cos_a * cos_b * cos_g + 2.0 * (1.0 - a) * cos_g**2)
    p1 = 4.0 * (-k * (1.0 + k) * cos_b + 2.0 * a * cos_g**2 * cos_b - (1.0 - a - c) * cos_a * cos_g)
    p0 = (1.0 + k) ** 2 - 4.0 * a * cos_g**2
    if not abs(p4) > LEAST:
        return 0
    roots = np.empty(4, np.complex128)
    _quartic_roots(p3 / p4, p2 / p4, p1 / p4, p0 / p4, roots)
    rays, found = np.empty((3, 3)), 0
    for root in roots:
        v = root.real
        if not abs(root.imag) <= MAX_IMAGINARY * max(abs(root), 1.0):
            continue
        below, stretch = 2.0 * (cos_g - v * cos_a), 1.0 + v * v - 2.0 * v * cos_b
        if below == 0.0 or not stretch > 0.0:
            continue
        u = ((k - 1.0) * v * v - 2.0 * k * cos_b * v + 1.0 + k) / below
        s1 = np.sqrt(b2 / stretch)
        if not (0.0 < s1 < np.inf and 0.0 < u * s1 < np.inf and 0.0 < v * s1 < np.inf):
            continue
        for axis in range(3):
            rays[0, axis] = s1 * bearings[0, axis]
            rays[1, axis] = u * s1 * bearings[1, axis]
            rays[2, axis] = v * s1 * bearings[2, axis]
        found += _carry(points, rays, poses[found])
    return found


@kernel()
def _distance2(points, i, j):
    """|p_i - p_j|^2 of rows ``i`` and ``j`` of ``points`` (3, 3)."""
    x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    return x * x + y * y + z * z


@kernel()
def _dot(bearings, i, j):
    """v_i . v_j of rows ``i`` and ``j`` of ``bearings`` (3, 3)."""
    return bearings[i, 0] * bearings[j, 0] + bearings[i, 1] * bearings[j, 1] + bearings[i, 2] * bearings[j, 2]


@kernel()
def _quartic_roots(c3, c2, c1, c0, roots):
    """Write the ``roots`` (4,) of x^4 + c3 x^3 + c2 x^2 + c1 x + c0, all at once, by Aberth's method."""
    # No root lies outside of this circle (Fujiwara).
    size = 2.0 * max(abs(c3), np.sqrt(abs(c2)), abs(c1) ** (1.0 / 3.0), abs(0.5 * c0) ** 0.25)
    start = 0.5 * size + 1e-300
    roots[0], roots[1] = start * (0.83 + 0.56j), start * (-0.56 + 0.83j)
    roots[2], roots[3] = start * (-0.83 - 0.56j), start * (0.56 - 0.83j)
    for _ in range(MAX_STEPS):
        moved = 0.0
        for k in range(4):
            x = roots[k]
            value = (((x + c3) * x + c2) * x + c1) * x + c0
            slope = ((4.0 * x + 3.0 * c3) * x + 2.0 * c2) * x + c1
            if value == 0.0:
                continue
            away = 0.0 + 0.0j
            for other in range(4):
                if other != k and roots[other] != x:
                    away += 1.0 / (x - roots[other])
            below = slope - value * away
            if below == 0.0:
                continue
            step = value / below
            roots[k] = x - step
            moved = max(moved, abs(step) / (abs(x) + 1e-300))
        if moved < STEP_TOLERANCE:
            break


@kernel()
def _carry(points, rays, target):
    """Write the pose ``target`` (3, 4) that carries a triangle ``points`` (3, 3) onto ``rays`` (3, 3); 1 if there is
    one, else 0."""
    one, other = np.empty((3, 3)), np.empty((3, 3))
    if not (_frame(points, one) and _frame(rays, other)):
        return 0
    for i in range(3):
        shift = 0.0
        for j in range(3):
            target[i, j] = other[0, i] * one[0, j] + other[1, i] * one[1, j] + other[2, i] * one[2, j]
        for k in range(3):
            turned = target[i, 0] * points[k, 0] + target[i, 1] * points[k, 1] + target[i, 2] * points[k, 2]
            shift += (rays[k, i] - turned) / 3.0
        target[i, 3] = shift
        if not np.isfinite(shift):
            return 0
    return 1


@kernel()
def _frame(triangle, frame):
    """Write the orthonormal ``frame`` (3, 3), axes as rows, of a triangle (3, 3), the first along its first side;
    False if it has none."""
    for axis in range(3):
        frame[0, axis] = triangle[1, axis] - triangle[0, axis]
        frame[1, axis] = triangle[2, axis] - triangle[0, axis]
    _cross(frame, 0, 1, 2)
    good = _normalize(frame, 0) and _normalize(frame, 2)
    _cross(frame, 2, 0, 1)
    return good


@kernel()
def _cross(rows, i, j, target):
    """Write the cross product of the rows i and j of ``rows`` (3, 3) to its row ``target``."""
    x = rows[i, 1] * rows[j, 2] - rows[i, 2] * rows[j, 1]
    y = rows[i, 2] * rows[j, 0] - rows[i, 0] * rows[j, 2]
    z = rows[i, 0] * rows[j, 1] - rows[i, 1] * rows[j, 0]
    rows[target, 0], rows[target, 1], rows[target, 2] = x, y, z


@kernel()
def _normalize(rows, i):
    """Scale the row i of ``rows`` (3, 3) to length 1; False if it is zero."""
    length = np.sqrt(rows[i, 0] ** 2 + rows[i, 1] ** 2 + rows[i, 2] ** 2)
    if not length > 0.0:
        return False
    for axis in range(3):
        rows[i, axis] /= length
    return True
