"""ATE and RPE: against scipy's alignment and by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spherloc.experiments.summary import align, trajectory_error


def walk(rng, count):
    rotations = Rotation.random(count, rng).as_matrix()
    return np.concatenate([rotations, rng.uniform(-5, 5, (count, 3, 1))], axis=2)


def moved(poses, scale, rotation, shift):
    places = scale * poses[:, :, 3] @ rotation.T + shift
    return np.concatenate([rotation @ poses[:, :, :3], places[:, :, None]], axis=2)


def test_a_moved_trajectory_is_right_after_its_alignment(rng):
    truth = walk(rng, 20)
    turn = Rotation.random(None, rng).as_matrix()
    found = trajectory_error(truth, moved(truth, 1.0, turn, [1.0, 2.0, 3.0]), ordered=True)
    assert found.poses == 20 and found.ate_m > 1.0
    assert found.ate_rigid_m == pytest.approx(0.0, abs=1e-12)
    assert found.rpe_m == pytest.approx(0.0, abs=1e-12) and found.rpe_deg == pytest.approx(0.0, abs=1e-6)
    scaled = trajectory_error(truth, moved(truth, 0.3, turn, [0.0, 0.0, 1.0]), ordered=True)
    assert scaled.ate_rigid_m > 1.0 and scaled.ate_similarity_m == pytest.approx(0.0, abs=1e-12)
    assert scaled.rpe_m > 1.0


def test_alignment_is_the_best_rotation(rng):
    """Against scipy, whose rotation is that of centred points; mirror images too."""
    for _ in range(20):
        places, true_places = rng.standard_normal((2, 15, 3))
        _, rotation, _ = align(places, true_places, with_scale=False)
        best, _ = Rotation.align_vectors(true_places - true_places.mean(axis=0), places - places.mean(axis=0))
        np.testing.assert_allclose(rotation, best.as_matrix(), atol=1e-9)


def test_the_scale_is_where_the_error_is_least(rng):
    places, true_places = rng.standard_normal((2, 12, 3))
    scale, rotation, translation = align(places, true_places, with_scale=True)

    def cost(factor):
        middle = factor * (places - places.mean(axis=0)) @ rotation.T
        return np.sum((middle - (true_places - true_places.mean(axis=0))) ** 2)

    assert cost(scale) <= min(cost(scale * 1.001), cost(scale * 0.999))
    ends = scale * places @ rotation.T + translation
    np.testing.assert_allclose(ends.mean(axis=0), true_places.mean(axis=0), atol=1e-12)


def test_errors_by_hand():
    truth = np.tile(np.eye(3, 4), (3, 1, 1))
    truth[:, 0, 3] = [0.0, 1.0, 2.0]
    estimate = truth.copy()
    estimate[1, 1, 3] = 0.3
    estimate[2, :, :3] = Rotation.from_rotvec([0, 0, np.radians(6.0)]).as_matrix()
    found = trajectory_error(truth, estimate, ordered=True)
    assert found.ate_m == pytest.approx(np.sqrt(0.09 / 3))
    assert found.rpe_m == pytest.approx(0.3)
    assert found.rpe_deg == pytest.approx(6.0 / np.sqrt(2))
    unordered = trajectory_error(truth, estimate, ordered=False)
    assert unordered.rpe_m is None and unordered.rpe_deg is None


def test_too_little_to_align():
    truth = np.tile(np.eye(3, 4), (4, 1, 1))
    truth[:, 0, 3] = np.arange(4.0)
    assert trajectory_error(truth[:0], truth[:0], ordered=True) is None
    assert trajectory_error(truth[:2], truth[:2], ordered=True).ate_rigid_m is None
    assert trajectory_error(truth, truth, ordered=True).ate_similarity_m is None  # on a line
