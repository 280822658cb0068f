"""Monte Carlo samples of a pose posterior by adaptive multiple importance sampling (see ``epropnp``).

Position: Student t with 3 degrees of freedom. Orientation: angular central Gaussian of the quaternion (w, x, y, z),
whose density |L|^-1/2 (q^T L^-1 q)^-2 has heavy tails and no seam. Constant factors cancel and are left out.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.types import FloatArray

ROUNDS = 4
SAMPLES = 128
"""Poses a round."""
T_FREEDOM = 3.0
ACG_ROUNDS = 3
"""Fixed-point iterations of the maximum-likelihood fit of an angular central Gaussian."""
WIDEN = 1e-3
"""Rounds a proposal that collapses in one direction, relative to the geometric mean of its variances."""
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
    proposals = [_first(mode, covariance)]
    translations, quaternions, likelihood = np.empty((0, 3)), np.empty((0, 4)), np.empty(0)
    weights = np.empty(0)
    for number in range(ROUNDS):
        positions, turns = proposals[-1].draw(rng)
        likelihood = np.append(likelihood, log_likelihood(_matrices(turns), positions))
        translations, quaternions = np.vstack([translations, positions]), np.vstack([quaternions, turns])
        densities = [proposal.log_density(translations, quaternions) for proposal in proposals]
        logarithm = likelihood - np.logaddexp.reduce(densities, axis=0)
        weights = np.exp(logarithm - logarithm.max())
        weights /= weights.sum()
        if number < ROUNDS - 1:
            proposals.append(_fitted(translations, quaternions, weights, proposals[-1]))
    return _summary(translations, quaternions, weights, origin)


def _first(mode: FloatArray, covariance: FloatArray) -> _Proposal:
    """The proposal that Gauss-Newton suggests."""
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
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def _summary(translations: FloatArray, quaternions: FloatArray, weights: FloatArray, origin: FloatArray) -> Posterior:
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
