"""mc-exact as a user sees it: the paper's simulation, repeatability, frames, limits and options."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_alignment_invariance import turned

from benchmarks.certificate import random_problem
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.estimators.mc_exact import MAX_CORRESPONDENCES
from spherloc.geometry import DOWN, rotation_angle
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc.trace import ConsensusStage

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

Options: Any = options_type("mc-exact")
CAMERAS = ("mei", "fisheye", "panorama")


def solve(problem: Problem, options: Any = None, seed: int = 0) -> Any:
    """The trace of mc-exact, which has a certificate and its stage."""
    return estimate(problem, "mc-exact", options, seed)


def failures(scene, seeds):
    return [seed for seed in seeds if not evaluate(solve(scene.problem(seed), seed=seed)).success]


@pytest.mark.parametrize("rate", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("camera", CAMERAS)
def test_always_right_up_to_90_percent_outliers(scene_of, camera, rate):
    assert len(failures(scene_of(camera, outlier_rate=rate), range(15))) <= (1 if rate == 0.9 else 0)


@pytest.mark.parametrize("camera", CAMERAS)
def test_ten_inliers_of_two_hundred(scene_of, camera):
    assert len(failures(scene_of(camera, correspondences=200, outlier_rate=0.95), range(6))) <= 1


def test_same_arguments_same_trace(scene_of):
    problem = scene_of("fisheye", outlier_rate=0.9).problem(3)
    first, second = (solve(problem, seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.cam_from_map, second.cam_from_map)
    np.testing.assert_array_equal(first.inlier_mask, second.inlier_mask)
    assert first.certificate == second.certificate
    stages = [trace.stage(ConsensusStage) for trace in (first, second)]
    for name in ("arcs", "seed_support", "effort", "finished", "yaw_rad"):
        assert getattr(stages[0], name) == getattr(stages[1], name), name
    for name in ("bound", "clique", "cam_from_map", "support"):
        np.testing.assert_array_equal(getattr(stages[0], name), getattr(stages[1], name))


def test_seed_is_that_of_the_guess_only(scene_of):
    """Another guess, the same proven consensus."""
    problem = scene_of("mei", outlier_rate=0.85).problem(1)
    certificates = [solve(problem, seed=seed).certificate for seed in range(4)]
    assert all(c.proven for c in certificates)
    assert len({c.upper_bound for c in certificates}) == 1


@pytest.mark.parametrize("camera", CAMERAS)
def test_turned_frames_give_the_same_pose_and_certificate(rng, scene_of, camera):
    for seed in range(3):
        problem = scene_of(camera, outlier_rate=0.7).problem(seed)
        camera_turn, map_turn = Rotation.random(2, rng).as_matrix()
        here = solve(problem, seed=seed)
        there = solve(turned(problem, camera_turn, map_turn), seed=seed)
        assert here.certificate.upper_bound == there.certificate.upper_bound
        assert here.certificate.lower_bound == there.certificate.lower_bound
        rotation = camera_turn.T @ there.cam_from_map[:, :3] @ map_turn
        assert rotation_angle(here.cam_from_map[:, :3].T @ rotation) < 1e-5
        translation = camera_turn.T @ there.cam_from_map[:, 3]
        np.testing.assert_allclose(translation, here.cam_from_map[:, 3], atol=1e-4)
        np.testing.assert_array_equal(here.inlier_mask, there.inlier_mask)


@pytest.mark.parametrize("camera", CAMERAS)
def test_two_correspondences(scene_of, camera):
    for seed in range(5):
        scene = scene_of(camera, correspondences=2, outlier_rate=0.0, noise_px=0.0)
        trace = solve(scene.problem(seed), seed=seed)
        assert trace.certificate.upper_bound == 2 == trace.certificate.lower_bound
        assert trace.inlier_mask.all() and trace.certificate.nfa >= 1.0


def test_no_pose_at_all():
    """Above seen below and below above, the camera between them or not: no yaw has both in front."""
    pixels = np.array([[50.0, 30.0], [50.0, 70.0]])
    bearings = Equirectangular(200, 100).unproject(pixels)[0]
    points = np.array([[0.0, -np.sign(bearings[0, 1]), 0.0], [0.0, -np.sign(bearings[1, 1]), 0.0]])
    trace = solve(Problem("upside down", Equirectangular(200, 100), pixels, points, DOWN, DOWN))
    assert trace.cam_from_map is None and not trace.inlier_mask.any()
    assert "No pose" in trace.message
    assert trace.certificate.lower_bound == 1 <= trace.certificate.upper_bound <= 2
    stage = trace.stage(ConsensusStage)
    assert stage is not None and len(stage.cam_from_map) == 0 == len(stage.support)


@pytest.mark.parametrize("camera", CAMERAS)
def test_only_outliers(scene_of, camera):
    """What chance explains, and no claim that it is more."""
    trace = solve(scene_of(camera, correspondences=50, outlier_rate=1.0).problem())
    certificate = trace.certificate
    assert 2 <= certificate.lower_bound <= certificate.upper_bound < 20
    assert certificate.nfa > 1e-6


def crowd(count):
    rng = np.random.default_rng(0)
    pixels, points = rng.uniform(1, 99, (count, 2)), rng.uniform(-5, 5, (count, 3))
    return Problem("crowd", Equirectangular(200, 100), pixels, points, DOWN, DOWN)


def test_too_many_correspondences():
    with pytest.raises(InputError, match=r"200,000.*200,001.*ransac-2p"):
        solve(crowd(MAX_CORRESPONDENCES + 1))


@pytest.mark.parametrize("limit", [{"effort": 1e-12}, {"time_budget_s": 1e-9}])
def test_limits_are_honest(scene_of, limit):
    """Stopped at once: a pose all the same, and a bound that a full search does not contradict."""
    stopped = 0
    for seed in range(8):
        # Wide bounds and many wrong matches leave something to be searched.
        problem = replace(scene_of("mei", correspondences=60, outlier_rate=0.9).problem(seed), bound_px=25.0)
        full = solve(problem, Options(bound_px=25.0), seed)
        short = solve(problem, Options(bound_px=25.0, **limit), seed)
        assert short.cam_from_map is not None
        assert short.certificate.upper_bound >= full.certificate.lower_bound
        assert short.certificate.lower_bound <= full.certificate.upper_bound
        stage = short.stage(ConsensusStage)
        assert (stage.bound >= full.stage(ConsensusStage).bound.min()).all()
        if not stage.finished:
            stopped += 1
            assert not short.certificate.proven
    assert stopped >= 4


@pytest.mark.parametrize(("seed", "most"), [(338, 10), (403, 3), (884, 7)])
def test_poses_of_triples_find_what_those_of_pairs_do_not(seed, most):
    """Brute force explains so many; from the 2P poses of all pairs the search ended with fewer."""
    problem, bound_px, _ = random_problem(seed)
    assert solve(problem, Options(bound_px=bound_px)).certificate.lower_bound >= most


def test_more_effort_never_proves_less(scene_of):
    problem = scene_of("mei", correspondences=60, outlier_rate=0.9).problem(1)
    gaps = [solve(problem, Options(bound_px=25.0, effort=effort)).certificate.gap for effort in (1e-12, 1e-3, 0.1, 1.0)]
    assert gaps == sorted(gaps, reverse=True)


@pytest.mark.parametrize("name", ["bound_px", "effort", "time_budget_s", "noise_px"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_option_errors_name_the_option(name, value):
    with pytest.raises(InputError, match=name):
        Options(**{name: value})


def test_other_estimators_options_are_refused(scene_of):
    with pytest.raises(InputError, match="McExactOptions"):
        solve(scene_of("mei").problem(), options_type("mc")())
