"""Success rates on the paper's simulation (Sec. VI-A.2), and three real images with known poses."""

import pytest

from spherloc.datasets import load_scene
from spherloc.estimators import estimate
from spherloc.metrics import evaluate

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERAS = ("mei", "fisheye", "panorama")


def failures(scene, estimator, seeds):
    """The seeds whose pose is more than 1 degree or 0.1 m off."""
    return [seed for seed in seeds if not evaluate(estimate(scene.problem(seed), estimator, seed=seed)).success]


@pytest.mark.parametrize("rate", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_always_right_up_to_80_percent_outliers(scene_of, estimator, camera, rate):
    assert failures(scene_of(camera, outlier_rate=rate), estimator, range(30)) == []


@pytest.mark.parametrize("camera", CAMERAS)
def test_mc_at_90_percent_outliers(scene_of, camera):
    """Ten inliers among a hundred."""
    assert len(failures(scene_of(camera, outlier_rate=0.9), "mc", range(100))) <= 10


@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_reported_inliers_are_the_true_ones(scene_of, estimator):
    for seed in range(10):
        trace = estimate(scene_of("mei", outlier_rate=0.5, noise_px=0.5).problem(seed), estimator, seed=seed)
        scores = evaluate(trace)
        assert scores.recall >= 0.98 and scores.precision >= 0.94
        count = int(trace.inlier_mask.sum())
        assert trace.message == f"Pose found: {count} of 100 correspondences agree with it."


@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
@pytest.mark.parametrize(
    "image, degrees, metres", [("rgb", 0.3, 0.02), ("slam_left", 0.3, 0.02), ("slam_right", 1.0, 0.03)]
)
def test_real_fisheye_images(aria, image, degrees, metres, estimator):
    """Measured SIFT matches, half and more of them wrong."""
    trace = estimate(load_scene(aria / f"{image}.toml").problem(), estimator)
    scores = evaluate(trace)
    assert scores.rotation_error_deg is not None and scores.translation_error_m is not None, trace.message
    assert scores.rotation_error_deg < degrees
    assert scores.translation_error_m < metres
