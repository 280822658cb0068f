"""From a clique of correspondences to a level pose that explains them, and a short list of the best such poses.

A pose is ``here``, see ``level_fit``. ``data`` are bearings (M, 3), points (M, 3), weights (M, 2, 3), bounds (M,),
px, and cosines of the angular bounds (M,).
"""

import numba
import numpy as np

from spherloc.consensus.inliers import count_inliers
from spherloc.consensus.level_fit import fit, place, ray
from spherloc.solvers.two_point import solve_pair

MOST_PAIRS = 24
"""Pairs of a clique that propose a pose."""
ROUNDS = 4
STEPS = 3
SQUEEZES = 12
SAME_CONSENSUS = 0.5
"""Poses whose inliers overlap as much are one: only the better is kept."""


@numba.njit(cache=True, nogil=True)
def residual(data, k, here, least_cos):
    """Residual of a correspondence, px; inf farther from its bearing than the angle of that cosine, or behind it."""
    gx, gy, gz, _ = ray(data[1][k], here)
    v, weight = data[0][k], data[2][k]
    along = v[0] * gx + v[1] * gy + v[2] * gz
    if along <= 0.0 or along < least_cos:
        return np.inf
    du = weight[0, 0] * gx + weight[0, 1] * gy + weight[0, 2] * gz
    dv = weight[1, 0] * gx + weight[1, 1] * gy + weight[1, 2] * gz
    return np.sqrt(du * du + dv * dv)


@numba.njit(cache=True, nogil=True)
def mark_support(data, here, mask):
    """Set ``mask`` (M,) to what a level pose explains; returns how many."""
    inliers = 0
    for k in range(len(mask)):
        mask[k] = residual(data, k, here, data[4][k]) <= data[3][k]
        inliers += mask[k]
    return inliers


@numba.njit(cache=True, nogil=True)
def explain_more(data, members, here, mask):
    """Fit a level pose to what it explains, then squeeze ``members`` in; ``here`` and ``mask`` (M,) become the best.

    First least squares on the inliers, again while they grow. That leaves out a correspondence beyond its bound though
    another pose explains it as well as all others. So then Lawson's iteration on ``members`` (K,), unless all are
    inliers: each weight is multiplied by the residual, which comes close to the pose of least largest residual.
    Returns the support.
    """
    points, weights, count = data[1], data[2], len(mask)
    best = mark_support(data, here, mask)
    heavy, moved, chosen = np.empty(count), here.copy(), mask.copy()
    climbing = True
    for k in range(ROUNDS + SQUEEZES):
        if climbing:
            heavy[:] = chosen
        else:
            if best >= len(members):
                break
            _reweight(data, members, moved, heavy)
        fit(points, weights, heavy, moved, STEPS if climbing else 1)
        support = mark_support(data, moved, chosen)
        grown = support > best
        if grown:
            best = support
            here[:], mask[:] = moved, chosen
        if climbing and not (grown and k + 1 < ROUNDS):
            climbing = False
            moved[:] = here
            heavy[:] = 0.0
            heavy[members] = 1.0
    return best


@numba.njit(cache=True, nogil=True)
def _reweight(data, members, here, heavy):
    """Multiply the members' weights by the share of the bound that their residuals take; their mean becomes 1."""
    total = 0.0
    for k in members:
        heavy[k] *= min(max(residual(data, k, here, 0.0) / data[3][k], 1e-3), 10.0)
        total += heavy[k]
    for k in members:
        heavy[k] *= len(members) / total


@numba.njit(cache=True, nogil=True)
def _propose(data, clique, here):
    """The 2P pose of a pair of the clique that explains most of the clique; false if no pair has one."""
    bearings, points, weights, bound_px = data[:4]
    few = (bearings[clique], points[clique], weights[clique], bound_px[clique])
    yaws, translations = np.empty(2), np.empty((2, 3))
    size, best, tried = len(clique), 0, 0
    for apart in range(1, size):
        for a in range(size - apart):
            if tried >= MOST_PAIRS and best > 0:
                return True
            tried += 1
            i, j = clique[a], clique[a + apart]
            for k in range(solve_pair(bearings[i], bearings[j], points[i], points[j], yaws, translations)):
                inliers = count_inliers(yaws[k], translations[k], *few)
                if inliers > best:
                    best = inliers
                    place(yaws[k], translations[k], here)
    return best > 0


@numba.njit(cache=True, nogil=True)
def verify(data, clique, poses, supports, masks, known):
    """Find the level pose that explains most of a clique, and keep it among the ``known`` ones if it is good.

    ``poses`` (K, 5), ``supports`` (K,) and ``masks`` (K, M) are kept in falling order of support. Returns how many are
    known.
    """
    here = np.empty(5)
    if not _propose(data, clique, here):
        return known
    return improve(data, clique, here, poses, supports, masks, known)


@numba.njit(cache=True, nogil=True)
def improve(data, members, here, poses, supports, masks, known):
    """Improve a level pose and keep it, as ``verify`` does."""
    mask = np.empty(masks.shape[1], np.bool_)
    support = explain_more(data, members, here, mask)
    return _keep(here, support, mask, poses, supports, masks, known)


@numba.njit(cache=True, nogil=True)
def _keep(here, support, mask, poses, supports, masks, known):
    """Put a pose in its place in the list of known ones, unless a better one explains much the same."""
    position = known
    for k in range(known):
        shared = np.count_nonzero(masks[k] & mask)
        if shared >= SAME_CONSENSUS * min(support, supports[k]):
            if support <= supports[k]:
                return known
            position = k
            break
    if position == len(supports):
        position -= 1
        if support <= supports[position]:
            return known
    known = max(known, position + 1)
    while position > 0 and supports[position - 1] < support:
        supports[position] = supports[position - 1]
        poses[position], masks[position] = poses[position - 1], masks[position - 1]
        position -= 1
    supports[position] = support
    poses[position], masks[position] = here, mask
    return known
