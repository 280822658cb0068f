"""Largest consensus of a small problem, the slow and plain way: shares no search and no arithmetic with ``spherloc``
but the 2P solver that proposes where to start.

A pose is (yaw, translation, tilt): R = exp([a, 0, c]) R_y(yaw) with |(a, c)| at most the gravity bound. From the 2P
pose of every pair, level and tilted, and from the true pose, Gauss-Newton steps whose weights favour the worst residual
try to win one correspondence more, then another.
"""

import numpy as np

from spherloc.geometry import yaw_of
from spherloc.kernel_cache import kernel
from spherloc.problem import AlignedProblem
from spherloc.solvers.two_point import two_point
from spherloc.types import FloatArray

STEPS = 8
STEP = 1e-6
TILTS = 3
"""Directions in which gravity is also taken to be off, each by half the bound."""
NEAR = 3
"""Starts that explain fewer than the best by more than this are not climbed from."""


@kernel()
def _rotation(state, out):
    """R of a state, by Rodrigues' formula for the tilt."""
    a, c = state[4], state[5]
    angle = np.sqrt(a * a + c * c)
    first = np.sin(angle) / angle if angle > 1e-12 else 1.0
    second = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-12 else 0.5
    cosine, sine = np.cos(state[0]), np.sin(state[0])
    out[0, 1], out[1, 1], out[2, 1] = -first * c, 1.0 - second * angle * angle, first * a
    for i, left, right in (
        (0, 1.0 - second * c * c, second * a * c),
        (1, first * c, -first * a),
        (2, second * a * c, 1.0 - second * a * a),
    ):
        out[i, 0] = left * cosine - right * sine
        out[i, 2] = left * sine + right * cosine


@kernel()
def _residuals(state, bearings, points, weights, out):
    """Residuals (N, 2), px, of a state; inf behind the measured bearing."""
    rotation = np.empty((3, 3))
    _rotation(state, rotation)
    for k in range(len(points)):
        p0, p1, p2 = points[k, 0], points[k, 1], points[k, 2]
        x = state[1] + rotation[0, 0] * p0 + rotation[0, 1] * p1 + rotation[0, 2] * p2
        y = state[2] + rotation[1, 0] * p0 + rotation[1, 1] * p1 + rotation[1, 2] * p2
        z = state[3] + rotation[2, 0] * p0 + rotation[2, 1] * p1 + rotation[2, 2] * p2
        length = np.sqrt(x * x + y * y + z * z)
        ahead = bearings[k, 0] * x + bearings[k, 1] * y + bearings[k, 2] * z > 0.0
        for row in range(2):
            value = (weights[k, row, 0] * x + weights[k, row, 1] * y + weights[k, row, 2] * z) / length
            out[k, row] = value if ahead else np.inf


@kernel()
def _support(state, data, bound_px, norms):
    """How many a state explains; writes the norm (N,) of every residual."""
    bearings, points, weights = data
    residuals = np.empty((len(points), 2))
    _residuals(state, bearings, points, weights, residuals)
    count = 0
    for k in range(len(points)):
        norms[k] = np.sqrt(residuals[k, 0] ** 2 + residuals[k, 1] ** 2)
        count += norms[k] <= bound_px
    return count


@kernel()
def _step(state, data, members, norms, bound_px, limit_rad):
    """One weighted Gauss-Newton step on ``members``, in place; false where it is impossible."""
    bearings, points, weights = data
    free = 6 if limit_rad > 0.0 else 4
    rows = 2 * len(members)
    jacobian, residual = np.zeros((rows, free)), np.zeros(rows)
    here, ahead = np.empty((len(points), 2)), np.empty((len(points), 2))
    _residuals(state, bearings, points, weights, here)
    for column in range(free):
        moved = state.copy()
        moved[column] += STEP
        _residuals(moved, bearings, points, weights, ahead)
        for m in range(len(members)):
            k = members[m]
            weight = min(max(norms[k] / bound_px, 0.3), 3.0) ** 2
            for row in range(2):
                residual[2 * m + row] = weight * here[k, row]
                jacobian[2 * m + row, column] = weight * (ahead[k, row] - here[k, row]) / STEP
    normal = jacobian.T @ jacobian
    for column in range(free):
        normal[column, column] += 1e-9 * normal[column, column] + 1e-12
    right = jacobian.T @ residual
    if not (np.isfinite(normal).all() and np.isfinite(right).all()):
        return False
    change = np.linalg.solve(normal, right)
    state[:free] -= change
    tilt = np.sqrt(state[4] ** 2 + state[5] ** 2)
    if tilt > limit_rad:
        state[4] *= limit_rad / tilt
        state[5] *= limit_rad / tilt
    return True


@kernel()
def _climb(start, data, bound_px, limit_rad):
    """The most that steps from a state lead to, winning one correspondence at a time."""
    norms = np.empty(len(data[1]))
    best_state, best = start.copy(), _support(start, data, bound_px, norms)
    improved = True
    while improved and best < len(norms):
        improved = False
        for more in range(3):  # fit what it explains and its next neighbours
            state = best_state.copy()
            count = _support(state, data, bound_px, norms)
            members = np.argsort(norms)[: min(count + more, len(norms))]
            if not np.isfinite(norms[members]).all() or len(members) < 2:
                break
            for _ in range(STEPS):
                if not _step(state, data, members, norms, bound_px, limit_rad):
                    break
                count = _support(state, data, bound_px, norms)
                if count > best:
                    best, best_state, improved = count, state.copy(), True
            if improved:
                break
    return best


@kernel()
def _search(starts, data, bound_px, limit_rad):
    """The largest consensus reached from any of the states (S, 6)."""
    supports, norms = np.empty(len(starts), np.int64), np.empty(len(data[1]))
    for s in range(len(starts)):
        supports[s] = _support(starts[s], data, bound_px, norms)
    best = 0
    for s in np.argsort(-supports):
        if supports[s] < best - NEAR:
            break
        best = max(best, _climb(starts[s], data, bound_px, limit_rad))
    return best


def _state_of(aligned: AlignedProblem, cam_from_map: FloatArray) -> FloatArray:
    """(yaw, translation, tilt) (6,) of a pose between the problem's own frames."""
    rotation, translation = np.hsplit(aligned.align_pose(cam_from_map), [3])
    down = rotation[:, 1]
    axis = np.array([down[2], 0.0, -down[0]])  # y x down: about which y was turned to where it is
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, down[1]))
    a, _, c = axis / length * angle if length > 0.0 else np.zeros(3)
    state, tilt = np.array([0.0, *translation.ravel(), a, c]), np.empty((3, 3))
    _rotation(state, tilt)
    state[0] = yaw_of(tilt.T @ rotation)
    return state


def largest_consensus(aligned: AlignedProblem, bound_px: float, truth: FloatArray) -> int:
    """Correspondences within ``bound_px`` at the best pose found whose tilt is within the gravity bound.

    A lower bound of the true maximum, and so of every honest upper bound; ``truth`` (3, 4) is the true pose.
    """
    limit_rad = aligned.gravity_bound_rad
    pairs = np.column_stack(np.triu_indices(len(aligned.points), 1))
    tilts = [(0.0, 0.0)]
    if limit_rad > 0.0:
        around = 2 * np.pi * np.arange(TILTS) / TILTS
        tilts += [(0.5 * limit_rad * np.cos(angle), 0.5 * limit_rad * np.sin(angle)) for angle in around]
    state = _state_of(aligned, truth)
    tilt = float(np.hypot(*state[4:]))
    state[4:] *= min(1.0, limit_rad / tilt) if tilt > 0.0 else 0.0
    starts = [state[None]]
    for a, c in tilts:
        turn = np.empty((3, 3))
        _rotation(np.array([0.0, 0.0, 0.0, 0.0, a, c]), turn)
        # p = T (R_y m + t'): the level pose (R_y, t') of the bearings turned back.
        yaws, translations, exists = two_point(aligned.bearings[pairs] @ turn, aligned.points[pairs])
        count = int(np.count_nonzero(exists))
        starts.append(
            np.column_stack([yaws[exists], translations[exists] @ turn.T, np.full(count, a), np.full(count, c)])
        )
    data = (aligned.bearings, aligned.points, aligned.pixel_from_bearing)
    return int(_search(np.concatenate(starts), data, bound_px, limit_rad))
