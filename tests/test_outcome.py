"""Localized, doubtful or failed: what speaks against a pose, and how often believed poses are wrong."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.failures import failure_case
from spherloc.diagnosis import Cause, diagnose
from spherloc.estimators import default_options, estimate
from spherloc.estimators.base import options_type
from spherloc.free_gravity import MIN_LEAD, lead
from spherloc.geometry import yaw_rotation
from spherloc.metrics import evaluate
from spherloc.outcome import Outcome, judge
from spherloc.problem import Problem
from spherloc_viz.app.text import ToldBeside, summary_html


def solved(problem, estimator="ransac-2p", **options):
    return estimate(problem, estimator, options_type(estimator)(bound_px=problem.bound_px or 3.0, **options))


def test_believed_poses_are_right(scene_of):
    """From easy to hopeless, on held-out seeds: believed ones are right, and most of what can be known is believed."""
    believed, wrong, easy = 0, 0, 0
    for seed in range(60_000, 60_060):
        rate = (0.5, 0.8, 0.9, 0.95, 0.98, 1.0)[seed % 6]
        scene = scene_of("mei", correspondences=100, outlier_rate=rate, gravity_error_deg=0.5 * (seed % 2))
        trace = solved(scene.problem(seed))
        accepted, right = judge(trace).outcome is Outcome.LOCALIZED, bool(evaluate(trace).success)
        believed, wrong = believed + accepted, wrong + (accepted and not right)
        easy += accepted and rate <= 0.8
    assert wrong == 0 and easy >= 19 and believed >= 27


@pytest.mark.parametrize(
    "cause, words",
    [
        (Cause.TOO_FEW_INLIERS, "expected by chance"),
        (Cause.WRONG_REFERENCE, "expected by chance"),
        (Cause.AMBIGUOUS, "Another pose explains"),
    ],
)
def test_what_speaks_against_a_pose(cause, words):
    judged = [judge(solved(failure_case(cause, seed).problem)) for seed in range(4000, 4006)]
    doubts = [one for one in judged if one.outcome is not Outcome.LOCALIZED]
    assert len(doubts) >= 5
    assert sum(words in " ".join(one.reasons) for one in doubts) >= 4
    assert all((one.score < 0.0) == bool(one.reasons) for one in judged)


@pytest.mark.parametrize("moved, outcome", [(0, "localized"), (45, "localized"), (75, "doubtful")])
def test_two_poses_that_stand_out_are_not_called_localized(scene_of, moved, outcome):
    """Part of the matches are of the same structure 4 m beside; the outcome and the diagnosis say the same."""
    problem = scene_of("mei", correspondences=200, outlier_rate=0.0).problem(3)
    points = problem.points.copy()
    points[:moved] += [4.0, 0.0, 0.0]
    unknown = {"truth_cam_from_map": None, "truth_inliers": None}
    trace = solved(replace(problem, points=points, **unknown))
    assert lead(200 - moved, moved) > MIN_LEAD
    assert judge(trace).outcome == outcome
    assert (diagnose(trace).cause is Cause.OK) == (outcome == "localized")
    told = summary_html(trace, ToldBeside("gravity prior off"))
    assert ("Localized, but in doubt: gravity prior off" in told) == (outcome == "localized")


def test_degenerate_poses_are_doubtful():
    outcomes = []
    for seed in range(4000, 4010):
        trace = solved(failure_case(Cause.DEGENERATE, seed).problem)
        outcomes.append(judge(trace).outcome is Outcome.LOCALIZED and not evaluate(trace).success)
    assert sum(outcomes) <= 1


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p"])
def test_two_matches_and_repeated_ones_are_no_evidence(scene_of, estimator):
    """Two matches agree with a pose whatever they are, and so do two that are each there ten times."""
    two = scene_of("panorama", correspondences=2, outlier_rate=0.0).problem(1)
    repeated = replace(
        two,
        pixels=np.repeat(two.pixels, 10, axis=0),
        points=np.repeat(two.points, 10, axis=0),
        truth_inliers=np.ones(20, dtype=bool),
    )
    for problem in (two, repeated):
        judged = judge(solved(problem, estimator))
        assert judged.outcome is not Outcome.LOCALIZED and judged.reasons


def test_a_refinement_that_keeps_a_wrong_gravity_is_doubtful(scene_of):
    """Its inliers are counted at a bound that allows for gravity's error, so that another pose has no more of them."""
    scene = scene_of("mei", outlier_rate=0.5, gravity_error_deg=1.0)
    wrong, believed = 0, 0
    for seed in range(12):
        trace = solved(scene.problem(seed), "mc-exact", gravity_sd_deg=0.0)
        wrong += not evaluate(trace).success
        believed += judge(trace).outcome is Outcome.LOCALIZED and not evaluate(trace).success
    assert wrong >= 4 and not believed


def on_one_circle(rng, right, wrong):
    """Thirty matches of points on a circle through the camera, which are seen alike from all of the circle; ``right``
    ones that fix the camera, and ``wrong`` ones that agree with a place 0.9 m farther along the circle."""

    def seen_from(angle_rad, points):
        """Bearings in a camera on the circle that looks across it: half of the angle turns what it sees on it."""
        turn = yaw_rotation(-angle_rad / 2.0)
        rays = (points - 8.5 * np.array([-np.sin(angle_rad), 0.0, -np.cos(angle_rad)])) @ turn.T
        return rays / np.linalg.norm(rays, axis=1)[:, None]

    camera = Equirectangular(2000, 1000)
    across = rng.uniform(-1.2, 1.2, 30)
    far = 8.5 * np.column_stack([np.sin(across), rng.uniform(-0.02, 0.02, 30), np.cos(across)])
    others = rng.uniform([-8.0, -2.0, -2.0], [8.0, 2.0, 8.0], (right + wrong + 60, 3))
    anywhere = rng.normal(size=(60, 3))
    bearings = [seen_from(0.0, far), seen_from(0.0, others[:right]), seen_from(0.105, others[right:-60]), anywhere]
    pixels = camera.project(np.concatenate(bearings))[0] + rng.normal(0.0, 0.5, (len(far) + len(others), 2))
    down = np.array([0.0, 1.0, 0.0])
    points = np.concatenate([far, others])
    return Problem("one circle", camera, pixels, points, gravity_camera=down, gravity_map=down)


@pytest.mark.parametrize("right, wrong", [(25, 0), (8, 8)])
def test_wrong_matches_that_fix_a_pose_which_most_leave_open(rng, right, wrong):
    """Eight wrong matches are as many as the right ones, and the others agree with both."""
    trace = solved(on_one_circle(rng, right, wrong), "mc-exact")
    judged = judge(trace)
    assert np.count_nonzero(trace.inlier_mask) >= 30 + max(right, wrong) - 2
    assert (judged.outcome is Outcome.LOCALIZED) == (not wrong)
    assert any("all matches about as well" in reason for reason in judged.reasons) == bool(wrong)


def test_no_pose_has_failed_and_a_judgement_is_repeatable(scene_of):
    trace = solved(scene_of("fisheye", outlier_rate=0.9).problem(2))
    assert judge(trace) == judge(trace)
    lost = replace(trace, cam_from_map=None, inlier_mask=np.zeros(len(trace.problem), bool), message="No pose: none.")
    assert judge(lost).outcome is Outcome.FAILED and judge(lost).reasons == ("No pose: none.",)


def test_truth_is_not_looked_at(scene_of):
    problem = scene_of("mei", outlier_rate=0.5).problem(3)
    blind = replace(problem, truth_cam_from_map=None, truth_inliers=None)
    options = default_options("mc", problem)
    assert judge(estimate(problem, "mc", options)) == judge(estimate(blind, "mc", options))


def test_the_diagnosis_doubts_what_the_outcome_doubts_for_its_covariance(scene_of):
    """A few matches a problem, so that the covariance is near the limit: both say the same of the same pose."""
    seen = set()
    for seed in range(61_000, 61_040):
        problem = scene_of("panorama", correspondences=14, outlier_rate=0.2, noise_px=3.0).problem(seed)
        trace = estimate(problem, "mc", {"bound_px": 9.0, "noise_px": 3.0})
        cause, judged = diagnose(trace, use_truth=False).cause, judge(trace)
        fixed = all("Its inliers" not in reason for reason in judged.reasons)
        seen.add((cause, fixed))
        assert (cause, fixed) not in {(Cause.OK, False), (Cause.DEGENERATE, True)}, seed
    assert {(Cause.OK, True), (Cause.DEGENERATE, False)} <= seen
