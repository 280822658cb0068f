"""MLPnP: the maximum-likelihood pose from bearings of any central camera.

    J(v_i)^T (R p_i + t) = 0,   J(v_i) = null(v_i^T)   (linear, 2 rows a correspondence)
    min over R, t of sum |J(v_i)^T (R p_i + t) / |R p_i + t||^2   (Gauss-Newton)

J spans the tangent plane of a bearing, where its noise lives. Without covariances all bearings are taken to be equally
uncertain in all directions, and the linear rows are those of ``svd``. With them, both sums are weighed by the inverse
of the 2 x 2 covariance of each bearing in its tangent plane, here by taking for J the derivative of the pixel by the
bearing: its rows lie in the tangent plane, and J^T J is that inverse for pixels of equal noise.
If the points lie in a plane the linear system has only nine unknowns, two columns of the rotation in the plane's own
axes and t, and the third column is their cross product. Works on the whole sphere; six correspondences (the paper's own
least number).

Differs from the paper: points almost in a plane are treated as if they lay in it, since Gauss-Newton, which sees the
true points, then starts closer.

Urban, Leitloff, Hinz: MLPnP - A real-time maximum likelihood solution to the perspective-n-point problem, ISPRS Annals
III-3, 2016.
"""

import numpy as np

from spherloc.gauss_newton import turn
from spherloc.kernel_cache import kernel
from spherloc.small_arrays import copy_matrix, copy_vector
from spherloc.solvers.base import Many, checked, poses_of_samples
from spherloc.solvers.linear_pose import (
    DEGENERATE,
    condition_each,
    facing,
    linear_poses,
    nearest_rotation,
    null_matrix,
    tangents_of,
    translation_given,
)
from spherloc.types import BoolArray, FloatArray

PLANAR = 0.02
"""Points whose smallest spread is below this share of the largest are treated as a plane."""
ITERATIONS = 10
STEP_TOLERANCE = 1e-10
"""Of the refinement: most steps, and the length of a step (rad, and conditioned units) at which it ends."""


class Mlpnp:
    """Maximum-likelihood PnP."""

    name = "MLPnP"
    sample_size = 6
    pinhole = False

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose."""
        bearings, points = checked(self, bearings, points)
        return self.solve_each(bearings[None], points[None])[0]

    def solve_each(
        self, bearings: FloatArray, points: FloatArray, pixel_from_bearing: FloatArray | None = None
    ) -> Many:
        """At most one pose for each of B samples: ``bearings`` (B, K, 3) and ``points`` (B, K, 3), metres.

        ``pixel_from_bearing`` (B, K, 2, 3), px per unit of the bearing, brings the covariances.
        """
        points, middle, scale, exists = condition_each(points)
        if pixel_from_bearing is None:
            tangents = tangents_of(bearings)
        else:
            tangents = pixel_from_bearing / np.sqrt(0.5 * np.mean(np.sum(pixel_from_bearing**2, axis=(2, 3))))
        rotations, translations, solved = _linear_starts(bearings, points, tangents)
        exists &= solved
        refine_each(np.ascontiguousarray(tangents), np.ascontiguousarray(points), rotations, translations, exists)
        translations = translations / scale[:, None] - np.einsum("bij,bj->bi", rotations, middle)
        return poses_of_samples(rotations, translations, exists)


def _linear_starts(
    bearings: FloatArray, points: FloatArray, tangents: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """R (B, 3, 3), t (B, 3) and which exist (B,), of the linear system that suits the shape of the conditioned points.

    ``bearings`` and ``points`` are (B, K, 3), ``tangents`` (B, K, 2, 3).
    """
    spread2, axes = np.linalg.eigh(np.einsum("bki,bkj->bij", points, points))
    rotations, translations, exists = linear_poses(bearings, points, tangents)
    for sample in np.flatnonzero(spread2[:, 0] <= PLANAR**2 * spread2[:, 2]):
        one, some = bearings[sample], points[sample]
        found = _planar_pose(one, tangents[sample], some, axes[sample][:, ::-1])
        exists[sample] = found is not None
        if found is not None:
            rotations[sample], translations[sample] = found
    exists &= spread2[:, 1] > DEGENERATE * spread2[:, 2]  # on a line, about which any turn is as good
    return rotations, translations, exists


def _planar_pose(
    bearings: FloatArray, tangents: FloatArray, points: FloatArray, axes: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """R and t of points in the plane of the first two ``axes`` (3, 3), columns."""
    frame = np.column_stack([axes[:, 0], axes[:, 1], np.cross(axes[:, 0], axes[:, 1])])
    coordinates = points @ frame[:, :2]
    matrix = null_matrix(tangents, coordinates)
    if matrix is None:
        return None
    first, second = facing(matrix, bearings, coordinates)[:, :2].T
    third = np.cross(first, second)
    length = float(np.linalg.norm(third))
    if length == 0.0:
        return None
    # The square root brings the cross product to the scale of the other two columns.
    turned = nearest_rotation(np.column_stack([first, second, third / np.sqrt(length)]))
    if turned is None:
        return None
    rotation = turned @ frame.T
    projector = np.einsum("kri,krj->kij", tangents, tangents)
    translation = translation_given(rotation, projector, points)
    return None if translation is None else (rotation, translation)


@kernel()
def refine_each(basis, points, rotations, translations, exists):
    """``refine_on_tangents`` of each of B samples that ``exists`` (B,), in place of its pose.

    The poses are ``rotations`` (B, 3, 3) and ``translations`` (B, 3), m; ``basis`` (B, K, 2, 3), ``points`` (B, K, 3),
    m.
    """
    for sample in range(len(points)):
        if exists[sample]:
            start, moved = rotations[sample].copy(), translations[sample].copy()
            rotation, translation = refine_on_tangents(basis[sample], points[sample], start, moved)
            copy_matrix(rotation, rotations[sample])
            copy_vector(translation, translations[sample])


@kernel()
def refine_on_tangents(basis, points, rotation, translation):
    """R (3, 3) and t (3,) with the least sum of (n . u)^2, u the unit vector towards R p + t, by Gauss-Newton.

    ``basis`` (K, 2, 3) holds both tangents n of every bearing, ``rotation`` (3, 3) and ``translation`` (3,) are the
    start. ``points`` (K, 3) must have their mean at the origin: steps turn about it.
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
        turn(step, rotation, turned)
        size2 = 0.0
        for a in range(3):
            moved[a] = translation[a] + step[3 + a]
            size2 += step[a] * step[a] + step[3 + a] * step[3 + a]
        if size2 < STEP_TOLERANCE * STEP_TOLERANCE:
            return turned, moved
    return rotation, translation


@kernel()
def _normal_equations(basis, points, rotation, translation, normal, right):
    """Add J^T J to ``normal`` (6, 6) and -J^T r to ``right`` (6,), by rotation vector and translation; return r^T r.

    ``basis`` (K, 2, 3), ``points`` (K, 3), ``rotation`` (3, 3), ``translation`` (3,).
    """
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


@kernel()
def _solve(matrix, x):
    """Solve ``matrix`` (N, N) y = ``x`` (N,) by Cholesky, in place of both; False if it is not positive definite."""
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
