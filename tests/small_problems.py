"""Small problems whose consensus is known from below, and poses that explain much, found without the exact search."""

from dataclasses import dataclass

import numpy as np

from spherloc.bounds import Bounds, bounds_of
from spherloc.geometry import tangent_basis, yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.solvers.two_point import two_point

LAWSON_ROUNDS = 15
TOPPED_UP = 3


@dataclass(frozen=True, eq=False)
class Tight:
    """A problem whose inliers have residuals just within their bounds at a level pose, which makes every proof hard."""

    aligned: AlignedProblem
    bounds: Bounds
    yaw: float
    centre: np.ndarray
    inliers: np.ndarray


def tight_problem(rng, count, outliers, bound_px, gravity_bound_rad=0.0, share=1.0 - 1e-6, nearest=0.3):
    """All-round bearings with unequal pixels of their own, depths from ``nearest`` to 30 m, some points seen twice."""
    bearings = _unit(rng.normal(size=(count, 3)) * [1.0, 1.0 if rng.random() < 0.7 else 0.05, 1.0])
    spin = rng.uniform(0, np.pi, count)
    turn = np.stack([np.cos(spin), np.sin(spin), -np.sin(spin), np.cos(spin)], axis=1).reshape(count, 2, 2)
    stretch = rng.uniform(150.0, 400.0, (count, 2, 1))
    weights = turn @ (stretch * tangent_basis(bearings))
    yaw, centre = rng.uniform(-np.pi, np.pi), rng.uniform(-3, 3, 3)
    aligned = AlignedProblem(
        index=np.arange(count), count=count, camera_turn=np.eye(3), map_turn=np.eye(3), bearings=bearings,
        points=np.zeros((count, 3)), pixel_from_bearing=weights, radians_per_pixel=1.0 / stretch.min(axis=(1, 2)),
        gravity_bound_rad=gravity_bound_rad, gravity_sd_rad=gravity_bound_rad / 3.0,
    )  # fmt: skip
    bounds = bounds_of(aligned, bound_px)
    angle = rng.uniform(-np.pi, np.pi, count)
    shares = np.where(rng.random(count) < 0.7, share, rng.uniform(0.0, share, count))
    residual = (shares * bounds.pixels)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    beside = np.einsum("kij,kj->ki", np.linalg.pinv(weights), residual)
    rays = beside + np.sqrt(1.0 - np.sum(beside**2, axis=1))[:, None] * bearings
    depths = 10 ** rng.uniform(np.log10(nearest), 1.5, (count, 1))
    points = centre + (depths * rays) @ yaw_rotation(yaw)
    inliers = np.ones(count, dtype=bool)
    inliers[rng.permutation(count)[:outliers]] = False
    points[~inliers] = rng.uniform(-5, 5, (outliers, 3))
    if outliers >= 2 and rng.random() < 0.3:
        twice = np.flatnonzero(~inliers)[:2]
        points[twice[0]] = points[rng.integers(count)]
        points[twice[1]] = points[twice[0]]
    for array in (aligned.bearings, points, weights):
        array.setflags(write=False)
    object.__setattr__(aligned, "points", points)
    inliers = explained(aligned, bounds, np.array([yaw]), centre[None])[0] & inliers
    return Tight(aligned, bounds, yaw, centre, inliers)


def level_poses(yaws, centres):
    """Poses (K, 3, 4) of yaws (K,) and camera positions (K, 3)."""
    rotations = _rotations(yaws)
    return np.concatenate([rotations, -rotations @ centres[:, :, None]], axis=2)


def explained(aligned, bounds, yaws, centres):
    """(K, M) what level poses explain, by definition: pixels within their bound, and the angle within its own."""
    ray, _ = _rays(aligned, yaws, centres)
    residual = np.linalg.norm(np.einsum("mij,kmj->kmi", aligned.pixel_from_bearing, ray), axis=2)
    cross = np.linalg.norm(np.cross(np.broadcast_to(aligned.bearings, ray.shape), ray), axis=2)
    along = np.einsum("mj,kmj->km", aligned.bearings, ray)
    with np.errstate(invalid="ignore"):
        return (residual <= bounds.pixels) & (along > 0) & (np.arctan2(cross, along) <= bounds.radians + 1e-9)


def good_poses(aligned, bounds):
    """Yaws (K,) and camera positions (K, 3) of 2P from all pairs, and of fits to what they explain and some more."""
    pairs = np.column_stack(np.triu_indices(len(aligned.bearings), 1))
    yaws, translations, exists = two_point(aligned.bearings[pairs], aligned.points[pairs])
    yaws, translations = yaws[exists], translations[exists]
    if not len(yaws):
        return np.empty(0), np.empty((0, 3))
    centres = -_unturned(yaws, translations)
    for _ in range(2):
        masks = explained(aligned, bounds, yaws, centres)
        _, first = np.unique(masks, axis=0, return_index=True)
        first = first[np.argsort(-masks[first].sum(axis=1), kind="stable")][:60]
        starts, chosen = _topped_up(aligned, bounds, yaws[first], centres[first])
        more = fit(aligned, bounds, yaws[first][starts], centres[first][starts], chosen)
        yaws, centres = np.append(yaws, more[0]), np.vstack([centres, more[1]])
    return yaws, centres


def fit(aligned, bounds, yaws, centres, chosen, rounds=LAWSON_ROUNDS):
    """Every pose of Lawson's iteration from (K,) poses towards the least largest residual of ``chosen`` (K, M)."""
    yaws, centres, heavy = yaws.copy(), centres.copy(), chosen.astype(float)
    visited = ([], [])
    for _ in range(rounds):
        ray, distance = _rays(aligned, yaws, centres)
        scaled = aligned.pixel_from_bearing / bounds.pixels[:, None, None]
        residual = np.einsum("mij,kmj->kmi", scaled, ray)
        rows = np.empty((*residual.shape, 4))
        rows[..., 0] = scaled[..., 0] * ray[..., None, 2] - scaled[..., 2] * ray[..., None, 0]
        rows[..., 1:] = residual[..., None] * ray[..., None, :] - scaled
        rows[..., 1:] /= np.maximum(distance, 1e-3)[..., None, None]
        weighed = (heavy[..., None, None] * rows).reshape(len(yaws), -1, 4).transpose(0, 2, 1)
        normal = weighed @ rows.reshape(len(yaws), -1, 4)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(4) + 1e-12 * np.eye(4)
        step = -np.linalg.solve(normal, weighed @ residual.reshape(len(yaws), -1, 1))[..., 0]
        step *= np.minimum(1.0, 0.5 / np.maximum(np.abs(step[:, :1]), 1e-12))
        centres, yaws = centres + _unturned(yaws, step[:, 1:]), yaws + step[:, 0]
        heavy = heavy * np.clip(np.linalg.norm(residual, axis=2), 1e-3, 10.0)
        heavy /= np.maximum(heavy.sum(axis=1, keepdims=True), 1e-300)
        visited[0].append(yaws)
        visited[1].append(centres)
    return np.concatenate(visited[0]), np.concatenate(visited[1])


def _topped_up(aligned, bounds, yaws, centres):
    """For each pose the sets to fit: what it explains, and that with one or two of the nearest others."""
    ray, _ = _rays(aligned, yaws, centres)
    ratio = np.linalg.norm(np.einsum("mij,kmj->kmi", aligned.pixel_from_bearing, ray), axis=2) / bounds.pixels
    ratio[np.einsum("mj,kmj->km", aligned.bearings, ray) <= 0] = np.inf
    inside = explained(aligned, bounds, yaws, centres)
    order = np.argsort(np.where(inside, -1.0, ratio), axis=1)
    starts, chosen = [], []
    for k in range(len(yaws)):
        used = np.count_nonzero(inside[k])
        others = order[k, used : used + TOPPED_UP]
        for extra in ([], *([n] for n in others), others[:2]):
            mask = inside[k].copy()
            mask[np.asarray(extra, dtype=int)] = True
            if mask.sum() >= 2:
                starts.append(k)
                chosen.append(mask)
    return np.array(starts, dtype=int), np.array(chosen).reshape(-1, len(aligned.bearings))


def _rays(aligned, yaws, centres):
    """Unit vectors (K, M, 3) from level poses to the points, camera axes, and distances (K, M)."""
    ray = (aligned.points - centres[:, None]) @ _rotations(yaws).transpose(0, 2, 1)
    distance = np.maximum(np.linalg.norm(ray, axis=2), 1e-12)
    return ray / distance[..., None], distance


def _rotations(yaws):
    """``yaw_rotation`` of each yaw, (K, 3, 3)."""
    turn = np.zeros((len(yaws), 3, 3))
    turn[:, 0, 0] = turn[:, 2, 2] = np.cos(yaws)
    turn[:, 0, 2] = np.sin(yaws)
    turn[:, 2, 0] = -turn[:, 0, 2]
    turn[:, 1, 1] = 1.0
    return turn


def _unturned(yaws, vectors):
    """Vectors (K, 3) of level cameras in the map's axes."""
    return (vectors[:, None, :] @ _rotations(yaws))[:, 0]


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
