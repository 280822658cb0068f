"""EPro-PnP: its mode is the optimum, and its samples are the posterior around it."""

import cv2
import numpy as np
import pytest
from pose_samples import ahead, errors
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from spherloc.geometry import pose, transform
from spherloc.solvers.epropnp import HUBER, EproPnp

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def image_of(bearings):
    return bearings[:, :2] / bearings[:, 2:]


def turned_about_the_middle(start, points, x):
    """The pose after a rotation vector about the middle of the points and a translation, camera frame."""
    turn, middle = Rotation.from_rotvec(x[:3]).as_matrix(), transform(start, points.mean(axis=0)[None])[0]
    return pose(turn @ start[:, :3], turn @ (start[:, 3] - middle) + middle + x[3:])


def image_residuals(image, points, cam_from_map):
    rays = transform(cam_from_map, points)
    return rays[:, :2] / rays[:, 2:] - image


def test_mode_is_opencvs_and_scipys(rng):
    for _ in range(10):
        bearings, points, truth = ahead(rng, 30, noise_rad=1e-3, offset_m=2.0)
        image, found = image_of(bearings), EproPnp().solve(bearings, points)[0]
        turn, shift = cv2.Rodrigues(truth[:, :3])[0], truth[:, 3:].copy()
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-14)
        turn, shift = cv2.solvePnPRefineLM(points, image, np.eye(3), None, turn, shift, criteria)
        np.testing.assert_allclose(found, pose(cv2.Rodrigues(turn)[0], shift), atol=2e-5)
        answer = least_squares(
            lambda x, image=image, points=points, truth=truth: image_residuals(
                image, points, turned_about_the_middle(truth, points, x)
            ).ravel(),
            np.zeros(6),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        np.testing.assert_allclose(found, turned_about_the_middle(truth, points, answer.x), atol=1e-6)


def test_mode_with_outliers_is_hubers_optimum(rng):
    """No independent minimizer finds anything better from there, and outliers do weigh less than by squares."""
    for _ in range(5):
        bearings, points, truth = ahead(rng, 60, noise_rad=1e-3)
        image = image_of(bearings)
        image[:5] += rng.uniform(0.3, 0.6, (5, 2))
        bearings = np.column_stack([image, np.ones(60)]) / np.hypot(1.0, np.linalg.norm(image, axis=1))[:, None]
        found = EproPnp().solve(bearings, points)[0]
        width = HUBER * np.sqrt(image.var(axis=0).mean())

        def cost(x, image=image, points=points, found=found, width=width):
            error = np.linalg.norm(image_residuals(image, points, turned_about_the_middle(found, points, x)), axis=1)
            return np.where(error <= width, 0.5 * error**2, width * (error - 0.5 * width)).sum()

        assert minimize(cost, np.zeros(6), method="Powell", options={"xtol": 1e-10}).fun >= cost(np.zeros(6)) * (
            1 - 1e-7
        )
        assert errors(truth, found[None])[0] < 0.02


@pytest.mark.parametrize("count, noise_rad", [(12, 1e-3), (60, 1e-3), (60, 1e-5)])
def test_posterior_has_the_gauss_newton_covariance(count, noise_rad, rng):
    """For little noise the posterior is normal, and its covariance sigma^2 (J^T J)^-1."""
    ratios = []
    for seed in range(20):
        bearings, points, _ = ahead(rng, count, noise_rad)
        image, mode = image_of(bearings), EproPnp().solve(bearings, points)[0]
        posterior = EproPnp().posterior(bearings, points, mode, seed)
        columns = [
            image_residuals(image, points, turned_about_the_middle(mode, points, step))
            - image_residuals(image, points, turned_about_the_middle(mode, points, -step))
            for step in 1e-6 * np.eye(6)
        ]
        jacobian = np.array(columns).reshape(6, -1).T / 2e-6
        sigma2 = np.sum(image_residuals(image, points, mode) ** 2) / (2 * count - 6)
        expected = sigma2 * np.linalg.inv(jacobian.T @ jacobian)
        # Whitened, the sampled covariance is the identity: correlations are checked with the variances.
        whitener = np.linalg.inv(np.linalg.cholesky(expected))
        ratios.append(np.linalg.eigvalsh(whitener @ posterior.covariance @ whitener.T))
        assert posterior.effective_samples > 30
        assert posterior.weights.sum() == pytest.approx(1.0)
        assert errors(mode, posterior.mean[None])[0] < np.sqrt(np.trace(expected[:3, :3]))
    low, high = np.median(ratios, axis=0)[[0, -1]]
    assert low > 0.5 and high < 1.7


def test_posterior_is_that_of_the_points_that_were_given(rng):
    """Inside, the points are centred; what comes out must fit them where they are."""
    bearings, points, _ = ahead(rng, 40, 1e-3, offset_m=50.0)
    mode = EproPnp().solve(bearings, points)[0]
    posterior = EproPnp().posterior(bearings, points, mode, 0)
    likely = posterior.cam_from_map[np.argsort(posterior.weights)[-20:]]
    for sample in likely:
        assert np.sqrt(np.mean(image_residuals(image_of(bearings), points, sample) ** 2)) < 0.01
    assert posterior.cam_from_map.shape == (512, 3, 4)


def test_posterior_repeats_by_its_seed(rng):
    bearings, points, _ = ahead(rng, 20, 1e-3)
    mode = EproPnp().solve(bearings, points)[0]
    first, same, other = (EproPnp().posterior(bearings, points, mode, seed).cam_from_map for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other)


def test_perfect_data_have_a_posterior_too(rng):
    """Residuals of zero would make sigma zero and every sample impossible."""
    bearings, points, truth = ahead(rng, 20)
    mode = EproPnp().solve(bearings, points)[0]
    posterior = EproPnp().posterior(bearings, points, mode, 0)
    assert np.isfinite(posterior.covariance).all() and np.isfinite(posterior.weights).all()
    assert max(errors(truth, posterior.mean[None])) < 1e-6
