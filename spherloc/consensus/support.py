"""From a clique of correspondences to a pose that explains them, and a short list of the best such poses."""

import numba
import numpy as np

from spherloc.consensus.inliers import count_inliers
from spherloc.gauss_newton import polish
from spherloc.solvers.two_point import solve_pair

MOST_PAIRS = 24
"""Pairs of a clique that propose a pose."""
ROUNDS = 4
STEPS = 3
SQUEEZES = 12
SAME_CONSENSUS = 0.5
"""Poses whose inliers overlap as much are one: only the better is kept."""


@numba.njit(cache=True, nogil=True)
def mark_support(data, rotation, translation, mask):
    """Set ``mask`` (M,) to what a level pose explains; returns how many."""
    bearings, points, weights, bound_px, least_cos = data[:5]
    inliers = 0
    for k in range(len(points)):
        mask[k] = (
            residual(rotation, translation, bearings[k], points[k], weights[k], least_cos[k]) <= bound_px[k]
        )
        inliers += mask[k]
    return inliers


@numba.njit(cache=True, nogil=True)
def climb(data, rotation, translation, mask):
    """Fit a level pose to what it explains, and again while that grows; in place. Returns its support."""
    points, weights, noise_px = data[1], data[2], data[5]
    best = mark_support(data, rotation, translation, mask)
    turned, moved, chosen = rotation.copy(), translation.copy(), mask.copy()
    for _ in range(ROUNDS):
        polish(points, weights, chosen, turned, moved, noise_px, 0.0, 0, STEPS)
        support = mark_support(data, turned, moved, chosen)
        if support <= best:
            break
        best = support
        rotation[:], translation[:], mask[:] = turned, moved, chosen
    return best


@numba.njit(cache=True, nogil=True)
def squeeze(data, members, rotation, translation, mask):
    """Turn and move a level pose so that the worst of ``members`` fits better, and keep what explains most; in place.

    A fit of least squares leaves out a correspondence beyond its bound though another pose explains it as well as all
    others. Lawson's iteration, which multiplies each weight by its residual, comes close to the pose of least largest
    residual. Returns its support.
    """
    bearings, points, weights, bound_px, _, noise_px = data
    best = mark_support(data, rotation, translation, mask)
    few, rays = points[members], bearings[members]
    flat, everyone = weights[members], np.ones(len(members), np.bool_)
    scaled, heavy = np.empty_like(flat), np.ones(len(members))
    turned, moved, chosen = rotation.copy(), translation.copy(), np.empty_like(mask)
    for _ in range(SQUEEZES):
        for k in range(len(members)):
            share = residual(turned, moved, rays[k], few[k], flat[k], 0.0) / bound_px[members[k]]
            heavy[k] *= min(max(share, 1e-3), 10.0)
        heavy /= np.mean(heavy)
        for k in range(len(members)):
            scaled[k] = flat[k] * np.sqrt(heavy[k])
        polish(few, scaled, everyone, turned, moved, noise_px, 0.0, 0, 1)
        support = mark_support(data, turned, moved, chosen)
        if support > best:
            best = support
            rotation[:], translation[:], mask[:] = turned, moved, chosen
        if best >= len(members):
            break
    return best


@numba.njit(cache=True, nogil=True)
def residual(rotation, translation, bearing, point, weight, least_cos):
    """Residual of one correspondence, px; inf farther from its bearing than the angle of that cosine."""
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    norm = np.sqrt(x * x + y * y + z * z)
    along = bearing[0] * x + bearing[1] * y + bearing[2] * z
    if along <= 0.0 or along < least_cos * norm:
        return np.inf
    du = weight[0, 0] * x + weight[0, 1] * y + weight[0, 2] * z
    dv = weight[1, 0] * x + weight[1, 1] * y + weight[1, 2] * z
    return np.sqrt(du * du + dv * dv) / norm


@numba.njit(cache=True, nogil=True)
def _propose(data, clique, rotation, translation):
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
                    level(yaws[k], rotation)
                    translation[:] = translations[k]
    return best > 0


@numba.njit(cache=True, nogil=True)
def level(yaw, rotation):
    """Write the rotation about y, Eq. 1."""
    c, s = np.cos(yaw), np.sin(yaw)
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = c, 0.0, s
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 0.0, 1.0, 0.0
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = -s, 0.0, c


@numba.njit(cache=True, nogil=True)
def verify(data, clique, poses, supports, masks, known):
    """Find the level pose that explains most of a clique, and keep it among the ``known`` ones if it is good.

    ``data`` are bearings (M, 3), points (M, 3), weights (M, 2, 3), bounds (M,), px, cosines of the angular bounds (M,),
    and the noise, px. ``poses``
    (K, 3, 4), ``supports`` (K,) and ``masks`` (K, M) are kept in falling order of support. Returns how many are known.
    """
    rotation, translation = np.empty((3, 3)), np.empty(3)
    if not _propose(data, clique, rotation, translation):
        return known
    mask = np.empty(masks.shape[1], np.bool_)
    support = climb(data, rotation, translation, mask)
    if support < len(clique):
        support = squeeze(data, clique, rotation, translation, mask)
    return keep(rotation, translation, support, mask, poses, supports, masks, known)


@numba.njit(cache=True, nogil=True)
def keep(rotation, translation, support, mask, poses, supports, masks, known):
    """Put a pose in its place in the list of known ones, unless a better one explains much the same."""
    place = known
    for k in range(known):
        shared = np.count_nonzero(masks[k] & mask)
        if shared >= SAME_CONSENSUS * min(support, supports[k]):
            if support <= supports[k]:
                return known
            place = k
            break
    if place == len(supports):
        place -= 1
        if support <= supports[place]:
            return known
    known = max(known, place + 1)
    while place > 0 and supports[place - 1] < support:
        supports[place] = supports[place - 1]
        poses[place], masks[place] = poses[place - 1], masks[place - 1]
        place -= 1
    supports[place] = support
    poses[place, :, :3], poses[place, :, 3], masks[place] = rotation, translation, mask
    return known
