"""EPro-PnP: the most likely pose by Levenberg-Marquardt, and its posterior by Monte Carlo; the published solver alone.

    p(R, t | x) ~ exp(-1/2 sum rho(|w_i (pi(R p_i + t) - x_i)|^2)),   rho: Huber

The network of the paper learns the weights w_i; without it all correspondences weigh the same, 1 / sigma with sigma
estimated from the residuals. ``solve`` returns the mode, as the published inference does, from an EPnP start.
``posterior`` samples around it by adaptive multiple importance sampling: four rounds of 128 poses, drawn from a
Student t with 3 degrees of freedom for the position and from an angular central Gaussian for the quaternion, both
fitted to all samples so far, each sample weighted by the mixture of the proposals. (The angular central Gaussian of
the quaternion q = (w, x, y, z) has the density |L|^-1/2 (q^T L^-1 q)^-2, with heavy tails and no seam; constant factors
cancel and are left out.) Works on the image plane of a
pinhole, whose noise is taken to be the same everywhere; five correspondences, for the EPnP start.

Chen, Wang, Wang, Tian, Xiong, Li: EPro-PnP: Generalized end-to-end probabilistic perspective-n-points for monocular
object pose estimation, CVPR 2022.
"""

from collections.abc import Callable
from dataclasses import dataclass

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
FIRST_RADIUS, MOST_RADIUS = 30.0, 1e16
LEAST_SIGMA = 1e-6
"""On the image plane, about a thousandth of a pixel: perfect data have a posterior too."""
SAMPLING_ROUNDS = 4
SAMPLES = 128
"""Poses a round."""
T_FREEDOM = 3.0
ACG_ROUNDS = 3
"""Fixed-point iterations of the maximum-likelihood fit of an angular central Gaussian."""
WIDEN = 1e-3
"""Widens a proposal that collapses in one direction, relative to the geometric mean of its variances."""
ROUNDING = 1e-14
"""Least variance relative to the sum of all: what double precision keeps of a narrow orientation."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """S weighted poses."""

    cam_from_map: FloatArray
    """(S, 3, 4)."""
    weights: FloatArray
    """(S,), of sum 1."""
    mean: FloatArray
    """(3, 4): the mean position of the points' middle in the camera frame and the mean quaternion."""
    covariance: FloatArray
    """(6, 6) about the mean of a rotation vector, which turns about the middle of the points, and a translation: camera
    frame, rad and m."""

    @property
    def effective_samples(self) -> float:
        """How many equally weighted samples are worth as much (Kish)."""
        return float(1.0 / np.sum(self.weights**2))


class EproPnp:
    """Probabilistic PnP without a network."""

    name = "EPro-PnP"
    sample_size = Epnp.sample_size
    pinhole = True

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose, the mode of the posterior."""
        bearings, points = checked(self, bearings, points)
        middle = points.mean(axis=0)
        # A start with a point behind the image plane has no likelihood to climb.
        starts = [start for start in Epnp().solve(bearings, points - middle) if _all_ahead(points - middle, start)]
        modes = [_moved(_mode(image_plane(bearings), points - middle, start), -middle) for start in starts]
        return np.array(modes).reshape(-1, 3, 4)

    def posterior(self, bearings: FloatArray, points: FloatArray, mode: FloatArray, seed: int) -> Posterior:
        """Samples of the pose posterior around its ``mode`` (3, 4), which ``solve`` returned for the same data.

        Raises ``ProblemError`` like ``solve``.
        """
        bearings, points = checked(self, bearings, points)
        image, middle = image_plane(bearings), points.mean(axis=0)
        centred, start = points - middle, _moved(mode, middle)
        residual, jacobian, _ = _linearized(image, centred, start, _huber_width(image))
        sigma = max(float(np.sqrt(residual @ residual / max(1, len(residual) - 6))), LEAST_SIGMA)
        covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64) * sigma**2

        def log_likelihood(rotations: FloatArray, translations: FloatArray) -> FloatArray:
            return -_cost(image, centred, rotations, translations, _huber_width(image)) / sigma**2

        return sample_posterior(start, covariance, log_likelihood, middle, np.random.default_rng(seed))


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
            radius = min(radius / max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), MOST_RADIUS)
            residual, jacobian, cost = _linearized(image, points, state, width)
        else:
            radius, shrink = radius / shrink, 2.0 * shrink
    return state


@dataclass(frozen=True, eq=False)
class _Proposal:
    """One round's distribution."""

    middle: FloatArray
    spread: FloatArray
    """(3, 3) lower Cholesky factor of the position's scale."""
    turn: FloatArray
    """(4, 4) lower Cholesky factor of the angular central Gaussian."""

    def draw(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Translations (SAMPLES, 3) and quaternions (SAMPLES, 4)."""
        stretch = np.sqrt(T_FREEDOM / rng.chisquare(T_FREEDOM, SAMPLES))
        translations = self.middle + stretch[:, None] * (rng.standard_normal((SAMPLES, 3)) @ self.spread.T)
        quaternions = rng.standard_normal((SAMPLES, 4)) @ self.turn.T
        return translations, quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)

    def log_density(self, translations: FloatArray, quaternions: FloatArray) -> FloatArray:
        """(S,), up to a constant that all proposals share."""
        scaled = np.linalg.solve(self.spread, (translations - self.middle).T)
        turned = np.linalg.solve(self.turn, quaternions.T)
        return (
            -0.5 * (T_FREEDOM + 3.0) * np.log1p(np.sum(scaled**2, axis=0) / T_FREEDOM)
            - 2.0 * np.log(np.sum(turned**2, axis=0))
            - np.sum(np.log(np.diag(self.spread)))
            - np.sum(np.log(np.diag(self.turn)))
        )


def sample_posterior(
    mode: FloatArray,
    covariance: FloatArray,
    log_likelihood: Callable[[FloatArray, FloatArray], FloatArray],
    origin: FloatArray,
    rng: np.random.Generator,
) -> Posterior:
    """Sample around ``mode`` (3, 4) of points moved by ``-origin``, whose Gauss-Newton ``covariance`` is (6, 6).

    ``log_likelihood`` maps rotations (S, 3, 3) and translations (S, 3) to (S,). The returned poses are those of the
    points that were not moved.
    """
    proposals = [_first_proposal(mode, covariance)]
    translations, quaternions, likelihood = np.empty((0, 3)), np.empty((0, 4)), np.empty(0)
    weights = np.empty(0)
    for number in range(SAMPLING_ROUNDS):
        positions, turns = proposals[-1].draw(rng)
        likelihood = np.append(likelihood, log_likelihood(_matrices(turns), positions))
        translations, quaternions = np.vstack([translations, positions]), np.vstack([quaternions, turns])
        densities = [proposal.log_density(translations, quaternions) for proposal in proposals]
        logarithm = likelihood - np.logaddexp.reduce(densities, axis=0)
        weights = np.exp(logarithm - logarithm.max())
        weights /= weights.sum()
        if number < SAMPLING_ROUNDS - 1:
            proposals.append(_fitted(translations, quaternions, weights, proposals[-1]))
    return _summary(translations, quaternions, weights, origin)


def _first_proposal(mode: FloatArray, covariance: FloatArray) -> _Proposal:
    """The proposal that Gauss-Newton suggests."""
    from scipy.spatial.transform import Rotation  # takes half a second

    w, x, y, z = Rotation.from_matrix(mode[:, :3]).as_quat(scalar_first=True)
    # A small turn by the vector d moves the quaternion by tangent @ d / 2.
    tangent = np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])
    quaternion = np.array([w, x, y, z])
    scatter = np.outer(quaternion, quaternion) + 0.25 * tangent @ covariance[:3, :3] @ tangent.T
    return _Proposal(mode[:, 3], _cholesky(_rounded(covariance[3:, 3:])), _cholesky(_rounded(scatter)))


def _fitted(translations: FloatArray, quaternions: FloatArray, weights: FloatArray, last: _Proposal) -> _Proposal:
    """The proposal of the weighted samples so far; ``last`` if they are too few to span all directions."""
    middle = weights @ translations
    moved = translations - middle
    scatter = last.turn @ last.turn.T
    try:
        spread = _cholesky(_rounded((weights[:, None] * moved).T @ moved))
        for _ in range(ACG_ROUNDS):
            distance = np.sum(np.linalg.solve(_cholesky(scatter), quaternions.T) ** 2, axis=0)
            share = weights / distance
            scatter = _rounded((share[:, None] * quaternions).T @ quaternions / share.sum())
        return _Proposal(middle, spread, _cholesky(scatter))
    except np.linalg.LinAlgError:
        return last


def _rounded(covariance: FloatArray) -> FloatArray:
    """The covariance, a little wider in its narrowest directions."""
    size = len(covariance)
    volume = max(float(np.linalg.det(covariance)), 0.0) ** (1.0 / size)
    return covariance + (WIDEN * volume + ROUNDING * np.trace(covariance)) * np.eye(size)


def _cholesky(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def _matrices(quaternions: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation  # takes half a second

    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def _summary(translations: FloatArray, quaternions: FloatArray, weights: FloatArray, origin: FloatArray) -> Posterior:
    from scipy.spatial.transform import Rotation  # takes half a second

    middle = weights @ translations
    mean = _matrices(np.linalg.eigh((weights[:, None] * quaternions).T @ quaternions)[1][:, -1])
    rotations = _matrices(quaternions)
    turns = Rotation.from_matrix(rotations @ mean.T).as_rotvec()
    moved = np.column_stack([turns, translations - middle])
    samples = np.concatenate([rotations, (translations - rotations @ origin)[..., None]], axis=2)
    return Posterior(
        cam_from_map=samples,
        weights=weights,
        mean=np.column_stack([mean, middle - mean @ origin]),
        covariance=(weights[:, None] * moved).T @ moved,
    )
