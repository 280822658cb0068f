"""P3P: the poses that three correspondences leave, without gravity, for many samples at once.

With the distances s1, s2 = u s1, s3 = v s1 of the three points from the camera, the law of cosines for each two of them
gives a polynomial of degree four in v, and u and s1 from v. The rotation then carries the triangle of the points onto
that of s_i b_i. Works on the whole sphere.

Degenerate if the three points lie in a line or the camera on a certain cylinder through them.

Grunert, 1841, in the form of Haralick et al.: Review and analysis of solutions of the three point perspective pose
estimation problem, IJCV 1994.
"""

import numpy as np

from spherloc.solvers.base import Many, checked
from spherloc.types import FloatArray, IntArray

SAMPLE_SIZE = 3
LEAST = 1e-9
"""Leading coefficients and denominators below this are rounding."""
MAX_IMAGINARY = 1e-6
"""Of a root that counts as real, by its absolute value: double roots are found with half of the digits."""


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
        found, sample = p3p(bearings[:, :SAMPLE_SIZE], points[:, :SAMPLE_SIZE])
        order = np.argsort(sample, kind="stable")
        return found[order], sample[order]


def p3p(bearings: FloatArray, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """All poses (L, 3, 4) of K samples, and the sample (L,) that each belongs to.

    ``bearings`` (K, 3, 3) are unit vectors, ``points`` (K, 3, 3) in map units, one correspondence a row.
    """
    with np.errstate(all="ignore"):
        return _poses(bearings, points)


def _poses(bearings: FloatArray, points: FloatArray) -> tuple[FloatArray, IntArray]:
    first, second, third = np.moveaxis(points, 1, 0)
    a2, b2, c2 = (np.sum((p - q) ** 2, axis=1) for p, q in ((second, third), (first, third), (first, second)))
    cos_a, cos_b, cos_g = (np.sum(bearings[:, i] * bearings[:, j], axis=1) for i, j in ((1, 2), (0, 2), (0, 1)))
    k, a, c = (a2 - c2) / b2, a2 / b2, c2 / b2
    polynomial = np.stack(
        [
            (k - 1.0) ** 2 - 4.0 * c * cos_a**2,
            4.0 * (k * (1.0 - k) * cos_b - (1.0 - a - c) * cos_a * cos_g + 2.0 * c * cos_a**2 * cos_b),
            2.0
            * (
                k**2
                - 1.0
                + 2.0 * k**2 * cos_b**2
                + 2.0 * (1.0 - c) * cos_a**2
                - 4.0 * (a + c) * cos_a * cos_b * cos_g
                + 2.0 * (1.0 - a) * cos_g**2
            ),
            4.0 * (-k * (1.0 + k) * cos_b + 2.0 * a * cos_g**2 * cos_b - (1.0 - a - c) * cos_a * cos_g),
            (1.0 + k) ** 2 - 4.0 * a * cos_g**2,
        ],
        axis=1,
    )
    sample, v = _real_roots(polynomial)
    u = ((k - 1.0)[sample] * v**2 - 2.0 * (k * cos_b)[sample] * v + (1.0 + k)[sample]) / (
        2.0 * (cos_g[sample] - v * cos_a[sample])
    )
    s1 = np.sqrt(b2[sample] / (1.0 + v**2 - 2.0 * v * cos_b[sample]))
    distances = np.stack([s1, u * s1, v * s1], axis=1)
    good = np.isfinite(distances).all(axis=1) & (distances > 0.0).all(axis=1)
    sample, distances = sample[good], distances[good]
    return _carry(points[sample], distances[:, :, None] * bearings[sample], sample)


def _real_roots(polynomial: FloatArray) -> tuple[IntArray, FloatArray]:
    """The rows (L,) and the real roots (L,) of polynomials (K, 5), highest degree first, by companion matrices."""
    rows = np.flatnonzero(np.isfinite(polynomial).all(axis=1) & (np.abs(polynomial[:, 0]) > LEAST))
    companion = np.zeros((len(rows), 4, 4), np.float64)
    companion[:, 0] = -polynomial[rows, 1:] / polynomial[rows, :1]
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    finite = np.isfinite(companion).all(axis=(1, 2))
    rows, roots = rows[finite], np.linalg.eigvals(companion[finite])
    real = np.abs(roots.imag) <= MAX_IMAGINARY * np.maximum(np.abs(roots), 1.0)
    return np.repeat(rows, 4).reshape(-1, 4)[real], np.asarray(roots.real[real], dtype=np.float64)


def _carry(points: FloatArray, rays: FloatArray, sample: IntArray) -> tuple[FloatArray, IntArray]:
    """The poses that carry triangles (L, 3, 3) of the map onto those of the camera, and the samples that have one."""
    one, other = _frames(points), _frames(rays)
    rotation = other @ np.swapaxes(one, 1, 2)
    translation = rays.mean(axis=1) - np.einsum("lij,lj->li", rotation, points.mean(axis=1))
    poses = np.concatenate([rotation, translation[:, :, None]], axis=2)
    good = np.isfinite(poses).all(axis=(1, 2))
    return poses[good], sample[good]


def _frames(triangles: FloatArray) -> FloatArray:
    """Orthonormal frames (L, 3, 3), axes as columns, of triangles (L, 3, 3): the first along the first side."""
    side, other = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    x = side / np.linalg.norm(side, axis=1, keepdims=True)
    z = np.cross(side, other)
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.asarray(np.stack([x, np.cross(z, x), z], axis=2), dtype=np.float64)
