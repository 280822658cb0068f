"""The diagnosis names the cause of cases that are made to fail, says so with numbers, and tells truth from data."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import real_failures
from spherloc.bounds import bounds_of
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.failures import MAKERS, failure_case
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, diagnose
from spherloc.diagnosis.evidence import apart, gather
from spherloc.diagnosis.information import pose_sd
from spherloc.estimators import default_options, estimate
from spherloc.estimators.base import options_type
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc.refine import RefinementOptions, refine, residuals_px
from spherloc.trace import ConsensusStage
from tests.needs import real_data

SEEDS = range(3000, 3003)
MADE = [Cause(name) for name in MAKERS]
"""Causes that cases can be made for."""


def run(cause, seed):
    case = failure_case(cause, seed)
    options = replace(default_options(case.estimator, case.problem), **case.options)
    return estimate(case.problem, case.estimator, options, case.seed)


@pytest.fixture(scope="module")
def traces():
    return {cause: [run(cause, seed) for seed in SEEDS] for cause in MADE}


@pytest.mark.parametrize("use_truth, least", [(True, 0.95), (False, 0.85)])
def test_causes_are_named(traces, use_truth, least):
    """A small confusion matrix; ``benchmarks/diagnosis.py`` makes the large one."""
    called = [(cause, diagnose(trace, use_truth).cause) for cause in MADE for trace in traces[cause]]
    wrong = [f"{cause} called {name}" for cause, name in called if cause != name]
    assert len(wrong) <= (1 - least) * len(called), wrong
    assert all(sum(cause == name for cause, name in called if cause == row) >= 0.5 * len(SEEDS) for row in MADE)


@pytest.mark.parametrize("use_truth", [True, False])
@pytest.mark.parametrize("cause", MADE)
def test_words(traces, cause, use_truth):
    """Sentences with this run's numbers, and a doubt unless the run is fine."""
    for trace in traces[cause][:3]:
        diagnosis = diagnose(trace, use_truth)
        assert diagnosis.doubtful == (diagnosis.cause != Cause.OK)
        assert diagnosis.used_truth == use_truth
        sentences = [diagnosis.summary, diagnosis.advice, *diagnosis.evidence]
        assert all(not text[0].islower() and text.endswith(".") and "nan" not in text for text in sentences), sentences
        assert not any("inf" in text.split() or "inf°" in text for text in sentences), sentences
        assert str(len(trace.problem)) in " ".join(diagnosis.evidence)
        assert any(text.startswith("Truth") for text in diagnosis.evidence) == use_truth


@pytest.mark.parametrize("use_truth", [True, False])
@pytest.mark.parametrize("cause", [Cause.AMBIGUOUS, Cause.FALSE_CONSENSUS])
def test_the_other_pose_is_shown(traces, cause, use_truth):
    """It is another pose, many correspondences support it, and the certificate says what no pose exceeds."""
    for trace in traces[cause]:
        diagnosis = diagnose(trace, use_truth)
        if diagnosis.cause != cause:
            continue
        aligned, alternative = trace.problem.aligned, diagnosis.alternative_cam_from_map
        assert alternative is not None and trace.cam_from_map is not None
        turn, distance = apart(alternative, trace.cam_from_map)
        assert turn > np.radians(3) or distance > 0.3
        support = np.count_nonzero(residuals_px(aligned, aligned.align_pose(alternative)) <= trace.options.bound_px)
        assert support > 0.4 * np.count_nonzero(trace.inlier_mask)
        assert any("within the gravity bound explains more than" in text for text in diagnosis.evidence)


def test_truth_shows_the_true_pose(traces):
    for trace in traces[Cause.FALSE_CONSENSUS]:
        alternative = diagnose(trace).alternative_cam_from_map
        assert alternative is not None and trace.problem.truth_cam_from_map is not None
        turn, distance = apart(alternative, trace.problem.truth_cam_from_map)
        assert turn < np.radians(1) and distance < 0.1


@pytest.mark.parametrize("use_truth", [True, False])
def test_a_refinement_that_believes_a_wrong_gravity(use_truth):
    """Gravity is within its bound, but the refinement is told to keep it: no search has missed anything."""
    scene = load_scene(bundled_scenes()["mei_outliers_80"])
    problem = Variation(outlier_rate=0.5, gravity_error_deg=1.0).problem(scene, 1)
    for estimator in ("mc", "mc-exact"):
        options = replace(default_options(estimator, problem), gravity_sd_deg=0.0)
        trace = estimate(problem, estimator, options, 1)
        diagnosis = diagnose(trace, use_truth)
        assert diagnosis.cause == Cause.GRAVITY_OFF and "the refinement keeps it as it is" in diagnosis.summary
        assert "gravity_sd_deg" in diagnosis.advice
        counted, (told, allowing) = np.count_nonzero(trace.inlier_mask), diagnosis.evidence[:2]
        assert f"The run counts {counted}," in allowing and not told.startswith(f"{counted} of")
        assert diagnose(estimate(problem, estimator, seed=1), use_truth).cause == Cause.OK


def changed(trace, **fields):
    return replace(trace, problem=replace(trace.problem, **fields))


def test_truth_is_not_looked_at_unless_asked_for(traces):
    for cause in MADE:
        trace = traces[cause][0]
        blind = changed(trace, truth_cam_from_map=None, truth_inliers=None)
        told, asked = diagnose(trace, use_truth=False), diagnose(blind, use_truth=True)
        assert (told.cause, told.summary, told.evidence) == (asked.cause, asked.summary, asked.evidence)
        assert not told.used_truth and not asked.used_truth


@pytest.mark.parametrize("kept", ["truth_cam_from_map", "truth_inliers"])
def test_half_a_truth_is_used(traces, kept):
    """The true pose alone, or labels alone, tell nearly as much as both."""
    other = {"truth_cam_from_map", "truth_inliers"} - {kept}
    right = 0
    for cause in (Cause.OK, Cause.FALSE_CONSENSUS, Cause.ITERATIONS_RAN_OUT, Cause.BOUND_TOO_SMALL):
        for trace in traces[cause]:
            diagnosis = diagnose(changed(trace, **dict.fromkeys(other)))
            assert diagnosis.used_truth
            right += diagnosis.cause == cause
    assert right >= 0.9 * 4 * len(SEEDS)


def test_same_run_same_diagnosis(traces):
    trace = traces[Cause.AMBIGUOUS][1]
    one, two = diagnose(trace), diagnose(trace)
    assert (one.cause, one.evidence) == (two.cause, two.evidence)
    np.testing.assert_array_equal(one.alternative_cam_from_map, two.alternative_cam_from_map)


def test_rivals_of_the_exact_search_are_heard(traces):
    """Its stage has verified poses; a second one that shares most matches with the first is found there only."""
    trace = next(t for t in traces[Cause.AMBIGUOUS] + traces[Cause.FALSE_CONSENSUS] if t.stage(ConsensusStage))
    assert diagnose(trace, use_truth=False).cause in (Cause.AMBIGUOUS, Cause.FALSE_CONSENSUS)


@settings(max_examples=12)
@given(st.integers(2, 9), st.integers(0, 10_000), st.sampled_from(["ransac-2p", "mc", "mc-exact"]))
def test_tiny_problems_are_never_ok(count, seed, estimator):
    """Random matches; whatever few of them allow, it is no error and no success."""
    rng = np.random.default_rng(seed)
    camera = failure_case(Cause.OK, seed % 5).problem.camera
    pixels = np.array([camera.width, camera.height]) * rng.uniform(0.35, 0.65, (count, 2))
    points = rng.uniform(-5, 5, (count, 3))
    problem = Problem("tiny", camera, pixels, points, np.array([0.0, 1, 0]), np.array([0.0, 1, 0]))
    diagnosis = diagnose(estimate(problem, estimator, seed=seed))
    assert diagnosis.cause in (Cause.TOO_FEW_INLIERS, Cause.WRONG_REFERENCE) and diagnosis.doubtful


def test_standard_deviations_are_those_of_the_refinement(traces):
    """Two derivations of one covariance: about the camera here, about the points' middle there."""
    for trace in traces[Cause.OK] + traces[Cause.GRAVITY_OFF]:
        aligned = trace.problem.aligned
        options = RefinementOptions(gravity_sd_deg=0.2)
        start = aligned.align_pose(trace.cam_from_map)
        fitted, inliers, stage = refine(aligned, start, bounds_of(aligned, 8.0), options)
        rotation, position, _ = pose_sd(aligned, fitted, inliers, 1.0, np.radians(0.2), 0)
        expected = [np.sqrt(np.linalg.norm(block, 2)) for block in (stage.covariance[:3, :3], stage.covariance[3:, 3:])]
        np.testing.assert_allclose([rotation, position], expected, rtol=0.02)


def test_one_wrong_match_does_not_hide_a_degenerate_set(traces):
    """Without the matches that the position hangs on most, the valley shows."""
    for trace in traces[Cause.DEGENERATE]:
        aligned, true = trace.problem.aligned, trace.problem.aligned.align_pose(trace.problem.truth_cam_from_map)
        mask = trace.problem.truth_inliers.copy()
        open_m = pose_sd(aligned, true, mask, 1.0, 0.0, 0)[1]
        mask[np.flatnonzero(~mask)[:1]] = True
        assert pose_sd(aligned, true, mask, 1.0, 0.0, 1)[1] > 0.7 * open_m > 0.07


def test_a_right_pose_that_another_outdoes_does_not_say_that_none_comes_near(scene_of):
    """By the truth a run can be right although it has missed the best pose."""
    scene = scene_of("mei", correspondences=100, outlier_rate=0.7)
    options = {"bound_px": 1.5, "iterations": 10, "local_optimization": False}
    found = []
    for seed in range(30):
        run = estimate(scene.problem(seed), "ransac-2p", options_type("ransac-2p")(**options), seed)
        said = diagnose(run)
        assert "the pose is right" not in diagnose(run, use_truth=False).summary
        if said.cause is Cause.OK:
            told = " ".join(said.evidence)
            own, best = (
                re.search(words, told) for words in (r"(\d+) of 100 matches agree", r"a pose that (\d+) agree")
            )
            found.append(best is not None and int(own[1]) < 0.85 * int(best[1]))
            assert found[-1] == ("a longer search finds one" in said.summary)
            assert found[-1] <= ("no other pose" not in said.summary)
    assert True in found and False in found


def test_real_matches_that_fail_for_a_known_cause():
    """``benchmarks/real_failures.py`` has the whole table; here 60 of 145 are right, gravity is known to 3 degrees."""
    problem = load_scene(real_data("aria_gen2") / "slam-side-right_7385824931885.toml").problem()
    called = {
        cause: [diagnose(estimate(case, "ransac-2p"), use_truth).cause for use_truth in (True, False)]
        for cause, case in real_failures.cases(problem, 0).items()
    }
    assert all(with_truth == cause for cause, (with_truth, _) in called.items()), called
    assert sum(without == cause for cause, (_, without) in called.items()) >= len(called) - 1, called


def test_the_pose_of_a_longer_search_is_compared_with_the_true_one(scene_of):
    scene, told = scene_of("mei", correspondences=100, outlier_rate=0.97), 0
    for seed in range(3):
        run = estimate(scene.problem(seed), "mc", seed=seed)
        evidence, best = diagnose(run).evidence, gather(run).best
        said = [text for text in evidence if text.startswith("Truth: the pose of the longer search is off by ")]
        assert len(said) == any(text.startswith("A longer search finds a pose") for text in evidence)
        if said:
            truth = run.problem.truth_cam_from_map
            assert best is not None and truth is not None
            turn, distance = apart(best.cam_from_map, run.problem.aligned.align_pose(truth))
            size, degrees = re.findall(r"([\d.]+) (?:c?m)\b.* ([\d.]+)°", said[0])[0]
            metres = float(size) / (100.0 if " cm" in said[0] else 1.0)
            assert metres == pytest.approx(distance, rel=0.06) and float(degrees) == pytest.approx(
                np.degrees(turn), rel=0.06
            )
            told += 1
        assert not any("longer search is off" in text for text in diagnose(run, use_truth=False).evidence)
    assert told


def test_too_few_right_matches_are_said_to_be_a_matter_of_chance_only_if_they_are(scene_of):
    reasons = set()
    for count, seeds in ((12, range(8)), (100, range(4))):
        scene = scene_of("mei", correspondences=count, outlier_rate=1.0 - 3.0 / count)
        for seed in seeds:
            run = estimate(scene.problem(seed), "mc", seed=seed)
            said = diagnose(run)
            if said.cause is not Cause.TOO_FEW_INLIERS or not said.summary.startswith(f"Only 3 of {count}"):
                continue
            by_chance = gather(run).nfa(3) >= 0.05
            assert by_chance == ("sets of 3 are expected" in said.summary) != ("too few to be believed" in said.summary)
            assert ("right all the same" in said.summary) == bool(evaluate(run).success)
            reasons.add(by_chance)
    assert reasons == {True, False}
