"""oDLT: its weights make the linear solution nearly as good as the best one."""

import cv2
import numpy as np
import pytest
from pose_samples import ahead, errors

from spherloc.geometry import pose
from spherloc.solvers.match_rows import plane_rows
from spherloc.solvers.odlt import Odlt, odlt

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def on_the_image(rng, count, noise, nearest_m=0.5):
    """``ahead`` with noise of the same size everywhere on the image plane, and depths that differ a lot."""
    bearings, points, truth = ahead(rng, count)
    rays = points @ truth[:, :3].T + truth[:, 3]
    rays *= rng.uniform(nearest_m, 10.0, (count, 1)) / rays[:, 2:]
    points = (rays - truth[:, 3]) @ truth[:, :3]
    image = rays[:, :2] / rays[:, 2:] + noise * rng.standard_normal((count, 2))
    bearings = np.column_stack([image, np.ones(count)])
    return bearings / np.linalg.norm(bearings, axis=1, keepdims=True), points, truth


def root_mean_square(found):
    return np.sqrt(np.mean(np.square(found), axis=0))


def test_weights_beat_the_plain_transform(rng):
    plain, weighted, best = [], [], []
    for _ in range(150):
        bearings, points, truth = on_the_image(rng, 60, 2e-3)
        plain.append(errors(truth, odlt(plane_rows(bearings), points, passes=1)))
        weighted.append(errors(truth, Odlt().solve(bearings, points)))
        image, middle = bearings[:, :2] / bearings[:, 2:], points.mean(axis=0)
        turn, shift = cv2.Rodrigues(truth[:, :3])[0], truth[:, 3] + truth[:, :3] @ middle
        turn, shift = cv2.solvePnPRefineLM(points - middle, image, np.eye(3), None, turn, shift.reshape(3, 1))
        rotation = cv2.Rodrigues(turn)[0]
        best.append(errors(truth, pose(rotation, shift.ravel() - rotation @ middle)[None]))
    plain, weighted, best = (root_mean_square(found) for found in (plain, weighted, best))
    assert (weighted < 0.95 * plain).all() and weighted[0] < 0.85 * plain[0]
    assert (weighted < 1.5 * best).all(), "the paper's claim: nearly as good as the iterated optimum"


def test_a_point_at_the_camera_does_not_spoil_the_others(rng):
    """Its depth is all noise, and so would be its weight."""
    good = 0
    for _ in range(30):
        bearings, points, truth = on_the_image(rng, 40, 1e-3)
        rays = points @ truth[:, :3].T + truth[:, 3]
        rays[0] *= 1e-4 / rays[0, 2]
        points[0] = (rays[0] - truth[:, 3]) @ truth[:, :3]
        good += errors(truth, Odlt().solve(bearings, points))[0] < 0.02
    assert good >= 27
