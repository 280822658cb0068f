"""EPro-PnP: its mode is the optimum."""

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
