"""The variance that the residuals show: its scale, repeated matches, and whether stated errors are true in the end."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from spherloc.estimators import estimate
from spherloc.estimators.base import options_type
from spherloc.geometry import camera_centre
from spherloc.noise_scale import PRIOR_GROUPS, SHARED_PX, variance_factor
from spherloc.refine import matches_of
from spherloc.trace import RefinementStage


def factor_of(problem, noise_px=1.0, dof=4):
    """At the true pose, less the part that all matches share."""
    aligned = problem.aligned
    everything = np.ones(len(aligned.points), dtype=bool)
    found = variance_factor(
        matches_of(aligned), aligned.align_pose(problem.truth_cam_from_map), everything, noise_px, dof
    )
    return found - (SHARED_PX / noise_px) ** 2 * len(problem) / dof


@pytest.mark.parametrize("noise_px", [0.2, 1.0, 4.0])
def test_scale_of_the_noise(scene_of, noise_px):
    """Its square on average, drawn towards the stated noise by the prior."""
    scene = scene_of("mei", correspondences=200, outlier_rate=0.0, noise_px=noise_px)
    factors = [factor_of(scene.problem(seed)) for seed in range(30)]
    share = 200 / (PRIOR_GROUPS + 200)
    # At the true pose no freedom is lost, so the correction for it makes the scale larger by 1 %.
    assert np.mean(factors) == pytest.approx(1 - share + share * noise_px**2 * 200 / 198, rel=0.12)


@pytest.mark.parametrize("same", ["points", "pixels", "both"])
def test_repeated_matches_count_once(scene_of, same):
    """Each match five times: five times the variance, as the matrix of normal equations is five times as large."""
    factors = []
    for seed in range(30):
        problem = scene_of("fisheye", correspondences=60, outlier_rate=0.0).problem(seed)
        pixels, points = np.repeat(problem.pixels, 5, axis=0), np.repeat(problem.points, 5, axis=0)
        if same == "points":
            pixels = pixels + 1e-6 * np.arange(len(pixels))[:, None]
        if same == "pixels":
            points = points + 1e-9 * np.arange(len(points))[:, None]
        labels = np.ones(len(points), dtype=bool)
        factors.append(factor_of(replace(problem, pixels=pixels, points=points, truth_inliers=labels)))
    share = 60 / (PRIOR_GROUPS + 60)
    assert np.mean(factors) == pytest.approx(1 - share + share * 5.0 * 60 / 58, rel=0.15)


def test_too_few_say_nothing(scene_of):
    problem = scene_of("panorama", correspondences=4, outlier_rate=0.0, noise_px=9.0).problem(1)
    matches, pose = matches_of(problem.aligned), problem.truth_cam_from_map
    assert variance_factor(matches, pose, np.ones(4, dtype=bool), 1.0, 4) == 1.0


@pytest.mark.parametrize("gravity_error_deg", [0.0, 1.0])
def test_true_poses_lie_within_their_sigmas(scene_of, gravity_error_deg):
    """End to end on held-out seeds, with noise that is half of what is stated: 2 and 3 sigma hold, and not by far."""
    scene = scene_of("mei", correspondences=150, outlier_rate=0.4, gravity_error_deg=gravity_error_deg)
    for noise_px, most in ((1.0, 1.6), (0.5, 0.9)):
        squares, shares = [], []
        for seed in range(8000, 8060):
            problem = replace(scene, noise_px=noise_px).problem(seed)
            trace = estimate(problem, "ransac-2p", options_type("ransac-2p")(bound_px=3.0))
            stage, truth = trace.stage(RefinementStage), problem.truth_cam_from_map
            turn = Rotation.from_matrix(truth[:, :3] @ trace.cam_from_map[:, :3].T).as_rotvec()
            error = np.concatenate([turn, camera_centre(truth) - camera_centre(trace.cam_from_map)])
            square = error @ np.linalg.pinv(stage.covariance, rcond=1e-9, hermitian=True) @ error
            squares.append(square / stage.dof)
            shares.append(chi2.cdf(square, stage.dof))
        assert 0.2 < np.mean(squares) < most, np.mean(squares)
        assert np.mean(np.array(shares) <= 0.9545) > 0.85 and np.mean(np.array(shares) <= 0.9973) > 0.93
