"""EPnP on the whole sphere: Lepetit's control points with the equations of bearings instead of image coordinates.

    p_i = sum_j a_ij c_j,   n . sum_j a_ij c_j' = 0 for both tangents n of bearing i,   c' = sum_k beta_k N_k

N_k are the vectors that nearly solve the equations; the beta_k follow from the known distances between the control
points: three guesses (one, two and three vectors), each improved by Gauss-Newton, and the pose with the least residual
is taken. Points in a plane have three control points instead of four. Five correspondences; nothing in it divides by
a depth along z, so that bearings may point anywhere.

Lepetit, Moreno-Noguer, Fua: EPnP: An accurate O(n) solution to the PnP problem, IJCV 81, 2009.
"""

from itertools import combinations

import numpy as np

from spherloc.solvers.base import NO_POSES, checked, poses
from spherloc.solvers.linear_pose import DEGENERATE, condition
from spherloc.solvers.match_rows import MatchRows, sphere_rows
from spherloc.types import FloatArray

PLANAR = 1e-3
"""Points whose smallest spread is below this share of the largest have three control points."""
STEPS = 10
"""Of Gauss-Newton on the betas."""
GUESSES = (
    ((0, 0), (0, 1), (0, 2), (0, 3)),
    ((0, 0), (0, 1), (1, 1)),
    ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2)),
)
"""Products of two betas that a guess solves for; all others are taken to be 0."""
BEHIND = 10.0
"""Residual of a point behind its image plane."""


class EpnpSphere:
    """EPnP of bearings."""

    name = "EPnP on the sphere"
    sample_size = 5
    pinhole = False

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose."""
        bearings, points = checked(self, bearings, points)
        return epnp(sphere_rows(bearings), points)


def epnp(rows: MatchRows, points: FloatArray) -> FloatArray:
    """At most one pose (S, 3, 4) of the points (K, 3) by the equations of their matches."""
    conditioned = condition(points)
    if conditioned is None:
        return NO_POSES
    points, middle, scale = conditioned
    spread2, axes = np.linalg.eigh(points.T @ points / len(points))
    spread2, axes = spread2[::-1], axes[:, ::-1]
    if spread2[1] <= DEGENERATE * spread2[0]:
        return NO_POSES
    kept = 2 if spread2[2] <= PLANAR**2 * spread2[0] else 3
    root = np.sqrt(spread2[:kept])
    control = np.vstack([np.zeros(3), (axes[:, :kept] * root).T])
    coordinates = points @ axes[:, :kept] / root
    shares = np.column_stack([1.0 - coordinates.sum(axis=1), coordinates])
    system = (shares[:, None, :, None] * rows.normals[:, :, None, :]).reshape(2 * len(points), -1)
    # All vectors are needed where there are fewer equations than unknowns, and no others.
    right = np.linalg.svd(system, full_matrices=len(system) < system.shape[1])[2]
    vectors = right[::-1][:4].reshape(-1, kept + 1, 3)
    best, least = NO_POSES, np.inf
    for betas in _betas(vectors, control):
        rays = shares @ np.einsum("k,kci->ci", betas, vectors)
        if 2 * np.count_nonzero(rows.ahead(rays) > 0.0) < len(points):
            rays = -rays
        found = _carried(points, rays)
        if found is None:
            continue
        rotation, translation = found
        moved = points @ rotation.T + translation
        off = np.where(rows.ahead(moved)[:, None] > 0.0, np.abs(rows.residuals(moved)), BEHIND)
        cost = float(np.minimum(off, BEHIND).sum())
        if cost < least:
            least, best = cost, poses(rotation, translation / scale - rotation @ middle)
    return best


def _betas(vectors: FloatArray, control: FloatArray) -> list[FloatArray]:
    """The guesses (V,) for the control points (C, 3) in the map, from the vectors (V, C, 3), improved."""
    pairs = np.array(list(combinations(range(len(control)), 2)))
    length2 = np.sum((control[pairs[:, 0]] - control[pairs[:, 1]]) ** 2, axis=1)
    apart = (vectors[:, pairs[:, 0]] - vectors[:, pairs[:, 1]]).transpose(1, 0, 2)
    found = []
    for products in GUESSES:
        if len(products) > len(pairs):
            continue
        columns = [(1.0 if i == j else 2.0) * np.einsum("pi,pi->p", apart[:, i], apart[:, j]) for i, j in products]
        answer = np.linalg.lstsq(np.column_stack(columns), length2, rcond=None)[0]
        found.append(_improved(_first_guess(dict(zip(products, answer, strict=True)), len(vectors)), apart, length2))
    return [betas for betas in found if np.isfinite(betas).all()]


def _first_guess(product: dict[tuple[int, int], float], count: int) -> FloatArray:
    """The betas (count,) whose products these are, as far as they agree."""
    betas = np.zeros(count)
    betas[0] = np.sqrt(abs(product[0, 0]))
    sign = -1.0 if product[0, 0] < 0.0 else 1.0
    if (1, 1) in product:
        betas[1] = np.sqrt(max(0.0, sign * product[1, 1])) * (1.0 if sign * product[0, 1] >= 0.0 else -1.0)
    for (i, j), value in product.items():
        if i == 0 and j > 0 and not (j == 1 and (1, 1) in product) and betas[0] > 0.0:
            betas[j] = sign * value / betas[0]
    return betas


def _improved(betas: FloatArray, apart: FloatArray, length2: FloatArray) -> FloatArray:
    """Gauss-Newton on the distances of the control points: ``apart`` (P, V, 3), squared ``length2`` (P,)."""
    free = min(len(betas), len(length2))
    for _ in range(STEPS):
        between = np.einsum("k,pki->pi", betas, apart)
        jacobian = 2.0 * np.einsum("pki,pi->pk", apart[:, :free], between)
        step = np.linalg.lstsq(jacobian, length2 - np.sum(between**2, axis=1), rcond=None)[0]
        betas = betas.copy()
        betas[:free] += step
    return betas


def _carried(points: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """R and t that carry conditioned points (K, 3) onto rays (K, 3) best; None if not finite or of rank 1."""
    if not np.isfinite(rays).all():
        return None
    middle = rays.mean(axis=0)
    left, stretch, right = np.linalg.svd((rays - middle).T @ points)
    if stretch[1] <= DEGENERATE * stretch[0]:
        return None
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * flip) @ right
    return rotation, middle - rotation @ points.mean(axis=0)
