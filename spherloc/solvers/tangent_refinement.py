"""Gauss-Newton on the tangent planes of bearings: the second step of ``mlpnp``."""

import numba
import numpy as np

ITERATIONS = 10
STEP_TOLERANCE = 1e-10


@numba.njit(cache=True, nogil=True)
def refine_on_tangents(basis, points, rotation, translation):
    """R (3, 3) and t (3,) with the least sum of (n . u)^2, u the unit vector towards R p + t.

    ``basis`` (K, 2, 3) holds both tangents n of every bearing. Points (K, 3) must have their mean at the origin: steps
    turn about it.
    """
    least = np.inf
    turned, moved = rotation, translation
    for _ in range(ITERATIONS):
        normal, step = np.zeros((6, 6)), np.zeros(6)
        cost = _normal_equations(basis, points, turned, moved, normal, step)
        if not cost < least:
            break
        rotation, translation, least = turned, moved, cost
        if not _solve(normal, step):
            break
        turned, moved = np.empty((3, 3)), np.empty(3)
        _turn(step, rotation, turned)
        size2 = 0.0
        for a in range(3):
            moved[a] = translation[a] + step[3 + a]
            size2 += step[a] * step[a] + step[3 + a] * step[3 + a]
        if size2 < STEP_TOLERANCE * STEP_TOLERANCE:
            return turned, moved
    return rotation, translation


@numba.njit(cache=True, nogil=True)
def _normal_equations(basis, points, rotation, translation, normal, right):
    """Add J^T J (6, 6) and -J^T r (6,) for a rotation vector and a translation; return r^T r."""
    cost = 0.0
    arm, ray, row = np.empty(3), np.empty(3), np.empty(6)
    for k in range(len(points)):
        length = 0.0
        for a in range(3):
            arm[a] = rotation[a, 0] * points[k, 0] + rotation[a, 1] * points[k, 1] + rotation[a, 2] * points[k, 2]
            ray[a] = arm[a] + translation[a]
            length += ray[a] * ray[a]
        length = max(np.sqrt(length), 1e-300)
        for n in range(2):
            residual = 0.0
            for a in range(3):
                residual += basis[k, n, a] * ray[a] / length
            for a in range(3):
                row[3 + a] = (basis[k, n, a] - residual * ray[a] / length) / length
            row[0] = arm[1] * row[5] - arm[2] * row[4]
            row[1] = arm[2] * row[3] - arm[0] * row[5]
            row[2] = arm[0] * row[4] - arm[1] * row[3]
            cost += residual * residual
            for a in range(6):
                right[a] -= row[a] * residual
                for b in range(6):
                    normal[a, b] += row[a] * row[b]
    return cost


@numba.njit(cache=True, nogil=True)
def _solve(matrix, x):
    """Solve ``matrix`` y = ``x`` by Cholesky, in place of both; False if it is not positive definite."""
    for i in range(len(x)):
        pivot = matrix[i, i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = total / matrix[j, j]
            elif total > 1e-14 * pivot:
                matrix[i, i] = np.sqrt(total)
            else:
                return False
    for i in range(len(x)):
        for k in range(i):
            x[i] -= matrix[i, k] * x[k]
        x[i] /= matrix[i, i]
    for i in range(len(x) - 1, -1, -1):
        for k in range(i + 1, len(x)):
            x[i] -= matrix[k, i] * x[k]
        x[i] /= matrix[i, i]
    return True


@numba.njit(cache=True, nogil=True)
def _turn(step, rotation, turned):
    """Fill ``turned`` with exp(step[:3]) R: Rodrigues' formula on each column."""
    x, y, z = step[0], step[1], step[2]
    angle = np.sqrt(x * x + y * y + z * z)
    first = np.sin(angle) / angle if angle > 1e-8 else 1.0
    half = np.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    second = 2.0 * half * half
    for c in range(3):
        p, q, r = rotation[0, c], rotation[1, c], rotation[2, c]
        u, v, w = y * r - z * q, z * p - x * r, x * q - y * p
        turned[0, c] = p + first * u + second * (y * w - z * v)
        turned[1, c] = q + first * v + second * (z * u - x * w)
        turned[2, c] = r + first * w + second * (x * v - y * u)
