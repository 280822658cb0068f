"""Random correspondences of a known pose, and the error of an estimate, for the tests of the solvers."""

import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.geometry import pose, tangent_basis, transform
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.solvers.epnp import Epnp
from spherloc.solvers.epnp_sphere import EpnpSphere
from spherloc.solvers.epropnp import EproPnp, EproPnpSphere
from spherloc.solvers.mlpnp import Mlpnp
from spherloc.solvers.odlt import Odlt, OdltSphere
from spherloc.solvers.svd import Svd

SOLVERS = (Svd(), Mlpnp(), Epnp(), Odlt(), EproPnp(), EpnpSphere(), OdltSphere(), EproPnpSphere())


def random_rotation(rng):
    return Rotation.random(None, rng).as_matrix()


def noisy(rng, bearings, noise_rad):
    """Bearings moved in their tangent planes."""
    shift = noise_rad * rng.standard_normal((len(bearings), 2))
    moved = bearings + np.einsum("nij,ni->nj", tangent_basis(bearings), shift)
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def around(rng, count, noise_rad=0.0, offset_m=20.0):
    """Bearings over the whole sphere, points, truth; the map's origin is up to ``offset_m`` away."""
    rays = rng.standard_normal((count, 3)) * rng.uniform(2.0, 6.0, (count, 1))
    return _seen(rng, rays, noise_rad, offset_m)


def ahead(rng, count, noise_rad=0.0, offset_m=20.0):
    """The same with all bearings within 120 degrees about +z."""
    plane = np.column_stack([rng.uniform(-1.7, 1.7, (count, 2)), np.ones(count)])
    return _seen(rng, plane * rng.uniform(1.0, 8.0, (count, 1)), noise_rad, offset_m)


def plane(rng, count, noise_rad=0.0, thickness_m=0.0):
    """Points on one slanted wall, all in front of the camera."""
    flat = rng.uniform(-4.0, 4.0, (count, 3)) * [1.0, 1.0, 0.0] + thickness_m * rng.uniform(-1.0, 1.0, (count, 3))
    slant = Rotation.from_rotvec(rng.uniform(-0.7, 0.7, 3)).as_matrix()
    return _seen(rng, flat @ slant.T + [0.0, 0.0, 6.0], noise_rad, 20.0)


def _seen(rng, rays, noise_rad, offset_m):
    truth = pose(random_rotation(rng), rng.uniform(-offset_m, offset_m, 3))
    points = (rays - truth[:, 3]) @ truth[:, :3]
    bearings = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return noisy(rng, bearings, noise_rad), points, truth


def sample_for(solver, rng, count, noise_rad=0.0):
    """Correspondences over the field that the solver claims."""
    return (ahead if solver.pinhole else around)(rng, count, noise_rad)


def errors(truth, poses):
    """Rotation error, rad, and position error, m, of the only pose; infinite if there is none."""
    assert len(poses) <= 1
    if len(poses) == 0:
        return np.inf, np.inf
    return np.radians(rotation_error_deg(truth, poses[0])), translation_error_m(truth, poses[0])


def angular_cost(bearings, points, cam_from_map):
    """Sum of squared sines of the angles between bearings and points: what maximum likelihood minimizes."""
    rays = transform(cam_from_map, points)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.sum(np.cross(bearings, unit) ** 2))
