"""auto looks closer where the front end expects few right matches, and says what it went by."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.estimators import estimate
from spherloc.metrics import rotation_error_deg
from spherloc.trace import DecisionStage


def decision_of(scene_of, expected):
    problem = scene_of("panorama", correspondences=900, outlier_rate=0.97, seed=3).problem()
    trace = estimate(replace(problem, estimated_outlier_rate=expected), "auto")
    stage = trace.stage(DecisionStage)
    assert isinstance(stage, DecisionStage)
    return stage, trace


def test_a_high_expected_outlier_rate_asks_for_more_samples(scene_of):
    """Eq. 28: two of 3 % right matches are drawn once in 1111 samples; 500 would mostly miss them."""
    usual, _ = decision_of(scene_of, None)
    closer, trace = decision_of(scene_of, 0.97)
    assert usual.samples <= 500 < closer.samples <= 5000
    assert "the front end expects 3 %" in closer.reason and "front end" not in usual.reason
    assert trace.cam_from_map is not None and trace.inlier_mask.sum() >= 20


@pytest.mark.parametrize("expected", [0.0, 0.5, 1.0])
def test_any_expectation_is_usable(scene_of, expected):
    stage, trace = decision_of(scene_of, expected)
    assert stage.samples >= 1 and trace.cam_from_map is not None


@pytest.mark.parametrize(("outlier_rate", "chosen"), [(0.3, "ransac-2p"), (0.8, "mc-exact")])
def test_uncertain_gravity_is_proven_where_few_matches_agree_only(scene_of, outlier_rate, chosen):
    """The proof takes seconds there: not where sampling is safe."""
    scene = scene_of("panorama", correspondences=60, outlier_rate=outlier_rate, gravity_error_deg=1.0)
    problem = replace(scene.problem(3), gravity_bound_rad=np.radians(3.0))
    trace = estimate(problem, "auto")
    stage = trace.stage(DecisionStage)
    assert isinstance(stage, DecisionStage) and stage.chosen == chosen
    assert (trace.certificate is not None) == (chosen == "mc-exact")
    assert rotation_error_deg(trace.cam_from_map, problem.truth_cam_from_map) < 1.0
