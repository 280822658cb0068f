"""EPro-PnP: the most likely pose by Levenberg-Marquardt; the published solver alone.

    p(R, t | x) ~ exp(-1/2 sum rho(|w_i (pi(R p_i + t) - x_i)|^2)),   rho: Huber

The network of the paper learns the weights w_i; without it all correspondences weigh the same. ``solve`` returns the
mode, as the published inference does, from an EPnP start. (The paper's samples of the posterior around it are for
training, and are not here.) Works on the image plane of a pinhole, whose noise is taken to be the same everywhere; five
correspondences, for the EPnP start.

Chen, Wang, Wang, Tian, Xiong, Li: EPro-PnP: Generalized end-to-end probabilistic perspective-n-points for monocular
object pose estimation, CVPR 2022.
"""

import numpy as np

from spherloc.geometry import pose, so3_exp, transform
from spherloc.solvers.base import checked
from spherloc.solvers.epnp import Epnp, image_plane
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
        # A start with a point behind the image plane has no likelihood to climb.
        starts = [start for start in Epnp().solve(bearings, points - middle) if _all_ahead(points - middle, start)]
        modes = [_moved(_mode(image_plane(bearings), points - middle, start), -middle) for start in starts]
        return np.array(modes).reshape(-1, 3, 4)


def _moved(cam_from_map: FloatArray, shift: FloatArray) -> FloatArray:
    """The pose for points that were moved by ``-shift``."""
    rotation = cam_from_map[:, :3]
    return pose(rotation, cam_from_map[:, 3] + rotation @ shift)


def _all_ahead(points: FloatArray, cam_from_map: FloatArray) -> bool:
    return bool((transform(cam_from_map, points)[:, 2] > 0.0).all())


def _huber_width(image: FloatArray) -> float:
    return HUBER * float(np.sqrt(np.mean(np.var(image, axis=0))))


def _cost(
    image: FloatArray, points: FloatArray, rotations: FloatArray, translations: FloatArray, width: float
) -> FloatArray:
    """Half the sum of Huber's rho at poses (S, 3, 3), (S, 3); inf where a point is behind the image plane."""
    rays = points @ rotations.transpose(0, 2, 1) + translations[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        error = np.linalg.norm(rays[..., :2] / rays[..., 2:] - image, axis=-1)
    rho = np.where(error <= width, error**2, 2.0 * width * error - width**2)
    return np.where((rays[..., 2] > 0.0).all(axis=1), 0.5 * rho.sum(axis=1), np.inf)


def _linearized(
    image: FloatArray, points: FloatArray, cam_from_map: FloatArray, width: float
) -> tuple[FloatArray, FloatArray, float]:
    """Residuals (2 K,) scaled so that half their square is rho to first order, their Jacobian (2 K, 6), and the cost.

    The step is a rotation vector about the middle of the points (the origin here), then a translation.
    """
    arm = points @ cam_from_map[:, :3].T
    rays = arm + cam_from_map[:, 3]
    by_ray = np.zeros((len(points), 2, 3))
    by_ray[:, 0, 0] = by_ray[:, 1, 1] = 1.0 / rays[:, 2]
    by_ray[:, :, 2] = -rays[:, :2] / rays[:, 2:] ** 2
    # Rows of -skew(arm) by the cross product of each row of by_ray with the arm, the other way round.
    by_turn = np.cross(arm[:, None], by_ray)
    residual = rays[:, :2] / rays[:, 2:] - image
    error = np.linalg.norm(residual, axis=1)
    root = np.sqrt(width / np.maximum(error, width))[:, None]
    jacobian = (root[..., None] * np.concatenate([by_turn, by_ray], axis=2)).reshape(-1, 6)
    cost = float(_cost(image, points, cam_from_map[None, :, :3], cam_from_map[None, :, 3], width)[0])
    return (root * residual).ravel(), jacobian, cost


def _mode(image: FloatArray, points: FloatArray, start: FloatArray) -> FloatArray:
    """Levenberg-Marquardt with a trust region that follows how well the linear model foretells the decrease."""
    width = _huber_width(image)
    state, radius, shrink = start, FIRST_RADIUS, 2.0
    residual, jacobian, cost = _linearized(image, points, state, width)
    for _ in range(ITERATIONS):
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        damping = np.diag(np.maximum(np.diag(normal), 1e-6 * np.trace(normal)) / radius)
        step = np.asarray(-np.linalg.solve(normal + damping, gradient), dtype=np.float64)
        foretold = -step @ (0.5 * normal @ step + gradient)
        if foretold <= DECREASE_TOLERANCE * cost:
            break
        candidate = pose(so3_exp(step[:3]) @ state[:, :3], state[:, 3] + step[3:])
        reached = float(_cost(image, points, candidate[None, :, :3], candidate[None, :, 3], width)[0])
        ratio = (cost - reached) / foretold
        if ratio >= 1e-3:
            state, shrink = candidate, 2.0
            radius = min(radius / max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), MAX_RADIUS)
            residual, jacobian, cost = _linearized(image, points, state, width)
        else:
            radius, shrink = radius / shrink, 2.0 * shrink
    return state
