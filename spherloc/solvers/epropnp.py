"""EPro-PnP: the most likely pose by Levenberg-Marquardt; the published solver alone.

    p(R, t | x) ~ exp(-1/2 sum rho(|w_i (pi(R p_i + t) - x_i)|^2)),   rho: Huber

The network of the paper learns the weights w_i; without it all correspondences weigh the same. ``solve`` returns the
mode, as the published inference does, from an EPnP start. (The paper's samples of the posterior around it are for
training, and are not here.) Works on the image plane of a pinhole, as the paper has it, or with the equations of
bearings on the whole sphere (``EproPnpSphere``); noise is taken to be the same everywhere on either. Five
correspondences, for the EPnP start.

Chen, Wang, Wang, Tian, Xiong, Li: EPro-PnP: Generalized end-to-end probabilistic perspective-n-points for monocular
object pose estimation, CVPR 2022.
"""

import numpy as np

from spherloc.geometry import pose, so3_exp, transform
from spherloc.solvers.base import checked
from spherloc.solvers.epnp import Epnp
from spherloc.solvers.epnp_sphere import EpnpSphere
from spherloc.solvers.match_rows import MatchRows, image_plane, plane_rows, sphere_rows
from spherloc.types import FloatArray

HUBER = 0.1
"""Width of the Huber kernel, as a share of the spread of the image points."""
ITERATIONS = 50
DECREASE_TOLERANCE = 1e-15
"""Relative to the cost: what rounding hides."""
FIRST_RADIUS, MAX_RADIUS = 30.0, 1e16


class EproPnp:
    """Probabilistic PnP without a network."""

    name = "EPro-PnP"
    sample_size = Epnp.sample_size
    pinhole = True

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose, the mode."""
        bearings, points = checked(self, bearings, points)
        middle = points.mean(axis=0)
        width = _huber_width(image_plane(bearings))
        return _modes(plane_rows(bearings), points - middle, middle, Epnp().solve(bearings, points - middle), width)


class EproPnpSphere:
    """Probabilistic PnP of bearings, without a network."""

    name = "EPro-PnP on the sphere"
    sample_size = EpnpSphere.sample_size
    pinhole = False

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose, the mode."""
        bearings, points = checked(self, bearings, points)
        middle = points.mean(axis=0)
        starts = EpnpSphere().solve(bearings, points - middle)
        return _modes(sphere_rows(bearings), points - middle, middle, starts, _huber_width(bearings))


def _modes(rows: MatchRows, points: FloatArray, middle: FloatArray, starts: FloatArray, width: float) -> FloatArray:
    """The mode from each start (S, 3, 4); a start with a point behind its image plane has no likelihood to climb."""
    good = [start for start in starts if (rows.ahead(transform(start, points)) > 0.0).all()]
    modes = [_moved(_mode(rows, points, start, width), -middle) for start in good]
    return np.array(modes).reshape(-1, 3, 4)


def _moved(cam_from_map: FloatArray, shift: FloatArray) -> FloatArray:
    """The pose for points that were moved by ``-shift``."""
    rotation = cam_from_map[:, :3]
    return pose(rotation, cam_from_map[:, 3] + rotation @ shift)


def _huber_width(image: FloatArray) -> float:
    """From image coordinates (K, 2), or from bearings (K, 3), which spread in two directions too."""
    return HUBER * float(np.sqrt(0.5 * np.sum(np.var(image, axis=0))))


def _cost(rows: MatchRows, points: FloatArray, cam_from_map: FloatArray, width: float) -> float:
    """Half the sum of Huber's rho at a pose; inf where a point is behind its image plane."""
    rays = transform(cam_from_map, points)
    if not (rows.ahead(rays) > 0.0).all():
        return np.inf
    error = np.linalg.norm(rows.residuals(rays), axis=1)
    return 0.5 * float(np.where(error <= width, error**2, 2.0 * width * error - width**2).sum())


def _linearized(
    rows: MatchRows, points: FloatArray, cam_from_map: FloatArray, width: float
) -> tuple[FloatArray, FloatArray]:
    """Residuals (2 K,) scaled so that half their square is rho to first order, and their Jacobian (2 K, 6).

    The step is a rotation vector about the middle of the points (the origin here), then a translation.
    """
    arm = points @ cam_from_map[:, :3].T
    rays = arm + cam_from_map[:, 3]
    residual = rows.residuals(rays)
    by_ray = rows.normals - residual[:, :, None] * rows.axes[:, None, :]
    by_ray /= rows.ahead(rays)[:, None, None]
    # Rows of -skew(arm) by the cross product of each row of by_ray with the arm, the other way round.
    by_turn = np.cross(arm[:, None], by_ray)
    error = np.linalg.norm(residual, axis=1)
    root = np.sqrt(width / np.maximum(error, width))[:, None]
    jacobian = (root[..., None] * np.concatenate([by_turn, by_ray], axis=2)).reshape(-1, 6)
    return (root * residual).ravel(), jacobian


def _mode(rows: MatchRows, points: FloatArray, start: FloatArray, width: float) -> FloatArray:
    """Levenberg-Marquardt with a trust region that follows how well the linear model foretells the decrease."""
    state, radius, shrink = start, FIRST_RADIUS, 2.0
    cost = _cost(rows, points, state, width)
    residual, jacobian = _linearized(rows, points, state, width)
    for _ in range(ITERATIONS):
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        damping = np.diag(np.maximum(np.diag(normal), 1e-6 * np.trace(normal)) / radius)
        step = np.asarray(-np.linalg.solve(normal + damping, gradient), dtype=np.float64)
        foretold = -step @ (0.5 * normal @ step + gradient)
        if foretold <= DECREASE_TOLERANCE * cost:
            break
        candidate = pose(so3_exp(step[:3]) @ state[:, :3], state[:, 3] + step[3:])
        reached = _cost(rows, points, candidate, width)
        ratio = (cost - reached) / foretold
        if ratio >= 1e-3:
            state, cost, shrink = candidate, reached, 2.0
            radius = min(radius / max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), MAX_RADIUS)
            residual, jacobian = _linearized(rows, points, state, width)
        else:
            radius, shrink = radius / shrink, 2.0 * shrink
    return state
