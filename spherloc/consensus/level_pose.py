"""Level poses: fits of yaw and camera position, and from a clique of correspondences to a pose that explains them.

A level pose is an array ``pose``, five numbers: cos and sin of the yaw and the camera position in the aligned map
frame, metres. A step is four: a yaw, rad, and a shift of the camera in its own axes, m. Fits are Gauss-Newton on
weighted residuals in pixels. The clearly different poses that explain most are kept in a short list, ``BestPoses``.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spherloc.bounds import Bounds
from spherloc.consensus.inliers import count_inliers
from spherloc.consensus.pair_sinusoids import chord
from spherloc.gauss_newton import AlignedMatches
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.small_arrays import copy_matrix, copy_vector, fill_matrix, fill_vector
from spherloc.solvers.two_point import solve_pair
from spherloc.types import BoolArray, FloatArray, IndexArray

MIN_PIVOT = 1e-10
"""Of normal equations, relative to the diagonal, below which the pose is not determined."""
MAX_PAIRS = 24
"""Pairs of a clique that propose a pose."""
INLIER_ROUNDS, STEPS_PER_ROUND = 4, 3
"""Choices of inliers at most, and Gauss-Newton steps on each."""
LAWSON_ROUNDS = 12
"""Steps of Lawson's iteration, which comes close to the pose of least largest residual."""
SAME_CONSENSUS = 0.5
"""Poses whose inliers overlap as much are one: only the better is kept."""


class BoundedMatches(NamedTuple):
    """M matches with the bounds on their errors, as the exact search over yaw takes them."""

    bearings: FloatArray
    """(M, 3) measured unit vectors, aligned camera frame."""
    points: FloatArray
    """(M, 3) map points, m, aligned map frame."""
    pixel_jacobian: FloatArray
    """(M, 2, 3) px per unit of the unit vector towards the point: ``AlignedProblem.pixel_from_bearing``."""
    pixels_per_radian: FloatArray
    """(M,) its larger singular value."""
    bound_px: FloatArray
    """(M,) of the residual."""
    bound_rad: FloatArray
    """(M,) of the bearing's angular error."""
    least_cos: FloatArray
    """(M,) cosine of that, a little less: rounding must not exclude what the pixel bound allows."""
    chord: FloatArray
    """(M,) distance of unit vectors at that angle."""
    sine: FloatArray
    """(M,) sine of that angle."""


def bounded_matches(aligned: AlignedProblem, bounds: Bounds) -> BoundedMatches:
    """The matches of a problem with their bounds."""
    return BoundedMatches(
        bearings=aligned.bearings,
        points=aligned.points,
        pixel_jacobian=aligned.pixel_from_bearing,
        pixels_per_radian=aligned.pixels_per_radian,
        bound_px=bounds.pixels,
        bound_rad=bounds.radians,
        least_cos=np.cos(np.minimum(bounds.radians + 1e-9, np.pi / 2)),
        chord=chord(bounds.radians),
        sine=np.sin(bounds.radians),
    )


class BestPoses(NamedTuple):
    """The best verified level poses, clearly different ones, in falling order of support; K at most."""

    poses: FloatArray
    """(K, 5) level poses."""
    supports: IndexArray
    """(K,) how many matches each explains; 0 after the last one."""
    masks: BoolArray
    """(K, M) which."""
    known: NDArray[np.int64]
    """(1,) how many there are."""


def empty_list(most: int, count: int) -> BestPoses:
    """A list for ``most`` poses that explain some of ``count`` matches."""
    return BestPoses(
        np.empty((most, 5)), np.zeros(most, np.int32), np.zeros((most, count), np.bool_), np.zeros(1, np.int64)
    )


@kernel()
def write_level_pose(yaw, translation, pose):
    """Write the level ``pose`` (5,) of a yaw, rad, and a translation (3,), m."""
    c, s = np.cos(yaw), np.sin(yaw)
    pose[0], pose[1] = c, s
    pose[2] = s * translation[2] - c * translation[0]
    pose[3] = -translation[1]
    pose[4] = -s * translation[0] - c * translation[2]


@kernel()
def write_translation(pose, translation):
    """Write the ``translation`` (3,), m, of a level pose (5,)."""
    c, s, x, y, z = pose
    translation[0], translation[1], translation[2] = -(c * x + s * z), -y, s * x - c * z


@kernel()
def ray(point, pose):
    """The unit vector (3 numbers) to a ``point`` (3,) in camera axes, and its distance, m, from a level pose (5,)."""
    dx, dy, dz = point[0] - pose[2], point[1] - pose[3], point[2] - pose[4]
    distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    return (pose[0] * dx + pose[1] * dz) / distance, dy / distance, (pose[0] * dz - pose[1] * dx) / distance, distance


@kernel()
def linearized(jacobian_row, gx, gy, gz, distance):
    """A residual, px, one of two, of the ray (gx, gy, gz), and its derivative by the four numbers of a step.

    ``jacobian_row`` (3,) is a row of the match's pixel Jacobian, ``distance`` that of its point, m.
    """
    wx, wy, wz = jacobian_row[0], jacobian_row[1], jacobian_row[2]
    r = wx * gx + wy * gy + wz * gz
    return r, wx * gz - wz * gx, (r * gx - wx) / distance, (r * gy - wy) / distance, (r * gz - wz) / distance


@kernel()
def accumulate(normal, gradient, weight, r, row):
    """Add a residual ``r`` with derivative ``row`` (4,) and a ``weight`` to the normal equations.

    These are ``normal`` (4, 4), of which the lower triangle is kept, and ``gradient`` (4,).
    """
    for a in range(4):
        gradient[a] += weight * row[a] * r
        for b in range(a + 1):
            normal[a, b] += weight * row[a] * row[b]


@kernel()
def fit(points, pixel_jacobian, weights, pose, steps):
    """Move a level ``pose`` (5,) by Gauss-Newton ``steps`` on residuals weighted by ``weights`` (M,).

    ``points`` (M, 3), m, ``pixel_jacobian`` (M, 2, 3), px. Stops where the equations are degenerate.
    """
    normal, gradient, step = np.empty((4, 4)), np.empty(4), np.empty(4)
    for _ in range(steps):
        fill_matrix(normal, 0.0)
        fill_vector(gradient, 0.0)
        for k in range(len(points)):
            if weights[k] == 0.0:
                continue
            gx, gy, gz, distance = ray(points[k], pose)
            for axis in range(2):
                r, by_yaw, by_x, by_y, by_z = linearized(pixel_jacobian[k, axis], gx, gy, gz, distance)
                accumulate(normal, gradient, weights[k], r, (by_yaw, by_x, by_y, by_z))
        if solve_step(normal, gradient, step) < 0.0:
            return
        move(pose, step)


@kernel()
def solve_step(normal, gradient, step):
    """Write the ``step`` (4,) that solves the normal equations; return the fall of the cost, -1 if they are degenerate.

    They are ``normal`` (4, 4), whose lower triangle becomes its Cholesky factor, and ``gradient`` (4,).
    """
    fall = 0.0
    for a in range(4):
        pivot = normal[a, a]
        for b in range(a):
            for d in range(b):
                normal[a, b] -= normal[a, d] * normal[b, d]
            normal[a, b] /= normal[b, b]
            normal[a, a] -= normal[a, b] ** 2
        if not normal[a, a] > MIN_PIVOT * pivot:
            return -1.0
        normal[a, a] = np.sqrt(normal[a, a])
        step[a] = -gradient[a]
        for b in range(a):
            step[a] -= normal[a, b] * step[b]
        step[a] /= normal[a, a]
        fall += step[a] ** 2
    for a in range(3, -1, -1):
        for b in range(a + 1, 4):
            step[a] -= normal[b, a] * step[b]
        step[a] /= normal[a, a]
    return fall


@kernel()
def move(pose, step):
    """Turn and move a level ``pose`` (5,) by a ``step`` (4,), rad and m."""
    c, s = pose[0], pose[1]
    pose[2] += c * step[1] - s * step[3]
    pose[3] += step[2]
    pose[4] += s * step[1] + c * step[3]
    pose[0], pose[1] = c * np.cos(step[0]) - s * np.sin(step[0]), s * np.cos(step[0]) + c * np.sin(step[0])


@kernel()
def residual(matches, k, pose, least_cos):
    """Residual of match ``k`` at a level ``pose`` (5,), px; inf behind, or farther from the bearing than ``least_cos``.

    ``matches`` are ``BoundedMatches``.
    """
    gx, gy, gz, _ = ray(matches.points[k], pose)
    v, jacobian = matches.bearings[k], matches.pixel_jacobian[k]
    along = v[0] * gx + v[1] * gy + v[2] * gz
    if along <= 0.0 or along < least_cos:
        return np.inf
    du = jacobian[0, 0] * gx + jacobian[0, 1] * gy + jacobian[0, 2] * gz
    dv = jacobian[1, 0] * gx + jacobian[1, 1] * gy + jacobian[1, 2] * gz
    return np.sqrt(du * du + dv * dv)


@kernel()
def mark_support(matches, pose, mask):
    """Set ``mask`` (M,) to what a level ``pose`` (5,) explains of ``matches``, ``BoundedMatches``; returns how many."""
    inliers = 0
    for k in range(len(mask)):
        mask[k] = residual(matches, k, pose, matches.least_cos[k]) <= matches.bound_px[k]
        inliers += mask[k]
    return inliers


@kernel()
def explain_more(matches, members, pose, mask):
    """Fit a level ``pose`` (5,) to what it explains of ``matches``, ``BoundedMatches``, then to all ``members`` (K,).

    Pose and ``mask`` (M,) become the best that was met. First least squares on the inliers, again while they grow. That
    leaves out a correspondence beyond its bound though another pose explains it as well as all others. So then Lawson's
    iteration on the members, unless all are inliers: each weight is multiplied by the residual, which comes close to
    the pose of least largest residual. Returns the support.
    """
    points, jacobian, count = matches.points, matches.pixel_jacobian, len(mask)
    best = mark_support(matches, pose, mask)
    weights, moved, chosen = np.empty(count), np.empty(5), np.empty(count, np.bool_)
    copy_vector(pose, moved)
    copy_vector(mask, chosen)
    climbing = True
    for done in range(INLIER_ROUNDS + LAWSON_ROUNDS):
        if climbing:
            copy_vector(chosen, weights)
        else:
            if best >= len(members):
                break
            _reweight(matches, members, moved, weights)
        fit(points, jacobian, weights, moved, STEPS_PER_ROUND if climbing else 1)
        support = mark_support(matches, moved, chosen)
        grown = support > best
        if grown:
            best = support
            copy_vector(moved, pose)
            copy_vector(chosen, mask)
        if climbing and not (grown and done + 1 < INLIER_ROUNDS):
            climbing = False
            copy_vector(pose, moved)
            fill_vector(weights, 0.0)
            for k in members:
                weights[k] = 1.0
    return best


@kernel()
def _reweight(matches, members, pose, weights):
    """Multiply the ``weights`` (M,) of the ``members`` (K,) by the share of the bound that their residuals take.

    The residuals are those of ``matches``, ``BoundedMatches``, at a level ``pose`` (5,). The mean weight becomes 1.
    """
    total = 0.0
    for k in members:
        weights[k] *= min(max(residual(matches, k, pose, 0.0) / matches.bound_px[k], 1e-3), 10.0)
        total += weights[k]
    for k in members:
        weights[k] *= len(members) / total


@kernel()
def _propose(matches, clique, pose):
    """Write the 2P pose of a pair of the ``clique`` (K,) that explains most of the clique; false if no pair has one.

    The clique has numbers of ``matches``, ``BoundedMatches``; the level ``pose`` (5,) is written.
    """
    bearings, points = matches.bearings, matches.points
    few = AlignedMatches(np.empty((len(clique), 3)), np.empty((len(clique), 3)), np.empty((len(clique), 2, 3)))
    bound_px = np.empty(len(clique))
    for index in range(len(clique)):
        copy_vector(bearings[clique[index]], few.bearings[index])
        copy_vector(points[clique[index]], few.points[index])
        copy_matrix(matches.pixel_jacobian[clique[index]], few.pixel_jacobian[index])
        bound_px[index] = matches.bound_px[clique[index]]
    yaws, translations = np.empty(2), np.empty((2, 3))
    size, best, tried = len(clique), 0, 0
    for apart in range(1, size):
        for a in range(size - apart):
            if tried >= MAX_PAIRS and best > 0:
                return True
            tried += 1
            i, j = clique[a], clique[a + apart]
            for root in range(solve_pair(bearings[i], bearings[j], points[i], points[j], yaws, translations)):
                inliers = count_inliers(yaws[root], translations[root], few, bound_px)
                if inliers > best:
                    best = inliers
                    write_level_pose(yaws[root], translations[root], pose)
    return best > 0


@kernel()
def verify(matches, clique, best):
    """Find the level pose that explains most of a ``clique`` (K,), and add it to ``best`` if it is good.

    ``best`` are ``BestPoses``. The clique has numbers of ``matches``, ``BoundedMatches``.
    """
    pose = np.empty(5)
    if _propose(matches, clique, pose):
        improve(matches, clique, pose, best)


@kernel()
def improve(matches, members, pose, best):
    """Improve a level ``pose`` (5,) in place, and add it to ``best``, as ``verify`` does.

    ``matches`` and ``members`` are as in ``explain_more``.
    """
    mask = np.empty(best.masks.shape[1], np.bool_)
    support = explain_more(matches, members, pose, mask)
    _keep(pose, support, mask, best)


@kernel()
def _keep(pose, support, mask, best):
    """Insert a ``pose`` (5,) that explains ``mask`` (M,) into ``best``, unless a better one explains much the same.

    ``support`` is how many it explains.
    """
    poses, supports, masks, known = best.poses, best.supports, best.masks, best.known[0]
    position = known
    for index in range(known):
        shared = 0
        for k in range(len(mask)):
            shared += masks[index, k] and mask[k]
        if shared >= SAME_CONSENSUS * min(support, supports[index]):
            if support <= supports[index]:
                return
            position = index
            break
    if position == len(supports):
        position -= 1
        if support <= supports[position]:
            return
    best.known[0] = max(known, position + 1)
    while position > 0 and supports[position - 1] < support:
        supports[position] = supports[position - 1]
        copy_vector(poses[position - 1], poses[position])
        copy_vector(masks[position - 1], masks[position])
        position -= 1
    supports[position] = support
    copy_vector(pose, poses[position])
    copy_vector(mask, masks[position])
