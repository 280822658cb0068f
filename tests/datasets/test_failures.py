"""Cases that fail for one known cause: the cause is there, and taking it away makes the run succeed."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.datasets.failures import MAKERS, failure_case
from spherloc.diagnosis import Cause
from spherloc.errors import InputError
from spherloc.estimators import default_options, estimate
from spherloc.geometry import DOWN, transform
from spherloc.metrics import evaluate

SEEDS = range(2000, 2008)


def run(case, problem=None, **changes):
    """The case's run, on another problem or with other options."""
    problem = case.problem if problem is None else problem
    options = replace(default_options(case.estimator, problem), **{**case.options, **changes})
    return estimate(problem, case.estimator, options, case.seed)


def success(trace):
    return bool(evaluate(trace).success)


def without(problem, mask):
    """The problem less the masked correspondences."""
    kept = {name: getattr(problem, name)[~mask] for name in ("pixels", "points", "truth_inliers")}
    return replace(problem, **kept)


def test_there_is_a_maker_for_every_cause():
    assert set(MAKERS) == set(Cause) - {Cause.UNKNOWN}


@pytest.mark.parametrize("cause", MAKERS)
def test_a_seed_gives_one_case(cause):
    one, two, other = failure_case(cause, 3), failure_case(cause, 3), failure_case(cause, 4)
    assert one.cause == cause and (one.estimator, one.options, one.seed) == (two.estimator, two.options, two.seed)
    np.testing.assert_array_equal(one.problem.pixels, two.problem.pixels)
    np.testing.assert_array_equal(one.problem.points, two.problem.points)
    assert len(other.problem) != len(one.problem) or (other.problem.points != one.problem.points).any()


@pytest.mark.parametrize("cause", MAKERS)
def test_labels_are_true(cause):
    """Right matches are the true pose's projections but for noise, and wrong ones are elsewhere."""
    for seed in SEEDS:
        problem = failure_case(cause, seed).problem
        assert problem.usable.all() and problem.truth_inliers is not None and problem.truth_cam_from_map is not None
        pixels, valid = problem.camera.project(transform(problem.truth_cam_from_map, problem.points))
        right = problem.truth_inliers
        assert valid[right].all()
        noise_px = 5.0 if cause == Cause.BOUND_TOO_SMALL else 1.1
        off = np.linalg.norm(pixels - problem.pixels, axis=1)
        assert off[right].max(initial=0.0) < 6 * noise_px
        assert np.median(off[valid & ~right]) > 50 if (valid & ~right).sum() > 20 else True


def test_ok_succeeds():
    assert all(success(run(failure_case(Cause.OK, seed))) for seed in SEEDS)


def test_too_few_are_as_few_as_chance_gives():
    for seed in SEEDS:
        case = failure_case(Cause.TOO_FEW_INLIERS, seed)
        assert 2 <= np.count_nonzero(case.problem.truth_inliers) <= 3
        assert np.count_nonzero(run(case).inlier_mask) <= 5


def test_a_sparse_map_lacks_what_the_images_share():
    for seed in SEEDS:
        case = failure_case(Cause.MAP_TOO_SPARSE, seed)
        assert 2 <= np.count_nonzero(case.problem.truth_inliers) <= 3
        assert case.problem.verified_without_point >= 30


def test_wrong_reference_has_nothing_right():
    for seed in SEEDS:
        case = failure_case(Cause.WRONG_REFERENCE, seed)
        assert not case.problem.truth_inliers.any()
        assert np.ptp(case.problem.points, axis=0).max() <= 5.0, "points of one place"
        assert np.count_nonzero(run(case).inlier_mask) <= 8


def test_false_consensus_wins_and_hides_the_true_pose():
    for seed in SEEDS:
        case = failure_case(Cause.FALSE_CONSENSUS, seed)
        trace, right = run(case), case.problem.truth_inliers
        assert not success(trace)
        assert np.count_nonzero(trace.inlier_mask) > 1.15 * np.count_nonzero(right)
        assert success(run(case, without(case.problem, trace.inlier_mask & ~right)))


def test_ambiguous_poses_are_supported_alike():
    successes = []
    for seed in SEEDS:
        case = failure_case(Cause.AMBIGUOUS, seed)
        trace, right = run(case), case.problem.truth_inliers
        found, true = np.count_nonzero(trace.inlier_mask), np.count_nonzero(right)
        assert 0.9 < found / true < 1.1
        successes.append(success(trace))
        other = run(case, without(case.problem, trace.inlier_mask))
        assert success(other) != successes[-1]
        assert np.count_nonzero(other.inlier_mask) > 0.85 * found
    assert 0 < sum(successes) < len(successes), "luck decides"


def test_gravity_alone_is_off():
    found = 0
    for seed in SEEDS:
        case = failure_case(Cause.GRAVITY_OFF, seed)
        problem = case.problem
        off = np.degrees(np.arccos(problem.gravity_camera @ DOWN) - problem.gravity_bound_rad)
        assert 2.99 < off < 10.01
        found += success(run(case))
        assert success(run(case, replace(problem, gravity_camera=DOWN)))
    assert found <= len(SEEDS) // 2


def test_bound_alone_is_too_small():
    successes = 0
    for seed in SEEDS:
        case = failure_case(Cause.BOUND_TOO_SMALL, seed)
        tight = evaluate(run(case))
        wide = evaluate(run(case, replace(case.problem, bound_px=4 * 2.5 * case.problem.bound_px)))
        assert tight.recall is not None and tight.recall < 0.6
        assert wide.recall is not None and wide.recall > 0.95
        successes += bool(wide.success)
    assert successes >= len(SEEDS) - 1, "the noise itself is small enough for a pose"


def test_degenerate_matches_agree_but_do_not_fix_the_pose():
    traces = [run(failure_case(Cause.DEGENERATE, seed)) for seed in SEEDS]
    recalls = [evaluate(trace).recall or 0.0 for trace in traces]
    assert sum(map(success, traces)) <= 2
    assert min(recalls) > 0.3 and np.median(recalls) > 0.9


def test_more_iterations_would_have_found_it():
    for seed in SEEDS:
        case = failure_case(Cause.ITERATIONS_RAN_OUT, seed)
        assert not success(run(case))
        more = {"effort": 1.0} if case.estimator == "mc-exact" else {"iterations": 100_000, "confidence": 0.9999}
        assert success(run(case, **more))


def test_unknown_causes_and_seeds_are_refused():
    with pytest.raises(InputError, match="unknown cause 'bad luck'"):
        failure_case("bad luck", 0)
    with pytest.raises(InputError, match="seed is -1"):
        failure_case(Cause.OK, -1)
