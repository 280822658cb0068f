"""2P-RANSAC: sampling, stopping, what it records, and what it says when there is no pose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chisquare

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.consensus.two_point_search import sample_pair
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.geometry import DOWN
from spherloc.metrics import ransac_success_probability
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.trace import RansacStage, RefinementStage

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

Options = options_type("ransac-2p")


def run(problem, seed=0, **options):
    return estimate(problem, "ransac-2p", Options(**options), seed)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_pairs_are_uniform_and_never_equal(count):
    """Every ordered pair equally often: a sampler that never draws the last index, or favours one, is caught."""
    pairs = np.array([sample_pair(np.uint64(1), k, count) for k in range(100_000)])
    assert (pairs[:, 0] != pairs[:, 1]).all() and pairs.min() == 0 and pairs.max() == count - 1
    table = np.bincount(pairs[:, 0] * count + pairs[:, 1], minlength=count * count).reshape(count, count)
    frequency = table[~np.eye(count, dtype=bool)]
    assert frequency.sum() == 100_000
    assert chisquare(frequency).pvalue > 1e-3


def test_first_samples_of_many_seeds_are_uniform():
    """Neighbouring seeds are as good as distant ones."""
    firsts = [sample_pair(np.uint64(seed), 0, 5) for seed in range(50_000)]
    table = np.bincount([5 * i + j for i, j in firsts], minlength=25).reshape(5, 5)
    assert chisquare(table[~np.eye(5, dtype=bool)]).pvalue > 1e-3


def split_mix(state):
    """SplitMix64's output function in Python's own integers."""
    state = (state ^ (state >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    state = (state ^ (state >> 27)) * 0x94D049BB133111EB % 2**64
    return state ^ (state >> 31)


@pytest.mark.parametrize("seed", [0, 1, 2**63 - 1])
def test_samples_are_the_same_on_every_machine(seed):
    """Integer arithmetic only, here without a word of fixed width."""
    assert split_mix(0x9E3779B97F4A7C15) == 0xE220A8397B1DCDAF, "the first output of the published generator at 0"
    for k in range(200):
        bits = split_mix((split_mix(seed) + (k + 1) * 0x9E3779B97F4A7C15) % 2**64)
        i, j = (bits >> 32) * 5000 >> 32, (bits % 2**32) * 4999 >> 32
        assert sample_pair(np.uint64(seed), k, 5000) == (i, j + (j >= i))


def test_seed_decides_everything(scene_of):
    problem = scene_of("mei").problem()
    first, same, other = (run(problem, seed).stage(RansacStage) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.samples, same.samples)
    np.testing.assert_array_equal(first.cam_from_map, same.cam_from_map)
    assert not np.array_equal(first.samples, other.samples)


def test_improvements_are_recorded_as_they_happened(scene_of):
    """Each one explains more than the one before; its mask, its sample and its pose belong together."""
    for seed in range(10):
        problem = scene_of("fisheye").problem(seed)
        stage = run(problem, seed).stage(RansacStage)
        counts = stage.inlier_masks.sum(axis=1)
        assert (np.diff(counts) > 0).all() and (np.diff(stage.improved_at) >= 0).all()
        assert stage.iterations == 1000 and stage.improved_at[-1] < 1000
        for cam_from_map, mask, sample in zip(stage.cam_from_map, stage.inlier_masks, stage.samples, strict=True):
            assert mask[sample].all(), "a minimal solution explains its own sample"
            error = residuals_px(problem.aligned, problem.aligned.align_pose(cam_from_map))
            np.testing.assert_array_equal(mask[problem.usable], error <= 8.0)


def test_samples_name_places_in_the_problem(scene_of):
    """With unusable pixels in between, indices among the usable ones would be off."""
    problem = scene_of("fisheye", outlier_rate=0.2).problem()
    pixels = problem.pixels.copy()
    pixels[::3] = -1000.0
    problem = replace(problem, pixels=pixels)
    assert not problem.usable[::3].any()
    trace = run(problem)
    stage = trace.stage(RansacStage)
    assert problem.usable[stage.samples].all()
    assert stage.inlier_masks.shape == (len(stage.samples), 100)
    assert not trace.inlier_mask[::3].any() and trace.inlier_mask.sum() > 40


@pytest.mark.parametrize("confidence", [0.5, 0.99, 0.999999])
def test_confidence_stops_as_eq_28_says(scene_of, confidence):
    """Not before the best hypothesis found so far gives the probability, and not a sample later."""
    for seed in range(20):
        problem = scene_of("mei", outlier_rate=0.7).problem(seed)
        stage = run(problem, seed, confidence=confidence, iterations=100_000).stage(RansacStage)
        rate = stage.inlier_masks[-1].mean()
        lost = 1e-3 * (1.0 - confidence)  # what the early test may lose is earned by more samples
        assert stage.iterations < 100_000
        reached = ransac_success_probability(rate, 2, stage.iterations) - lost
        assert stage.confidence_reached == pytest.approx(reached, abs=1e-12) and reached >= confidence
        if stage.iterations - 1 != stage.improved_at[-1]:
            assert ransac_success_probability(rate, 2, stage.iterations - 1) - lost < confidence


def test_confidence_of_the_plain_form(scene_of):
    """All samples are drawn, all are counted in full, and Eq. 28 holds to the letter."""
    stage = run(scene_of("mei").problem(), iterations=70).stage(RansacStage)
    rate = stage.inlier_masks[-1].mean()
    assert stage.confidence_reached == pytest.approx(ransac_success_probability(rate, 2, 70), abs=1e-12)


def test_confidence_never_exceeds_the_iterations(scene_of):
    """And one can see that they ran out."""
    problem = scene_of("mei", outlier_rate=0.9).problem()
    stage = run(problem, confidence=0.999999, iterations=50).stage(RansacStage)
    assert stage.iterations == 50
    assert stage.confidence_reached < 0.5


def test_perfect_data_need_one_sample(scene_of):
    problem = scene_of("mei", outlier_rate=0.0, noise_px=0.0).problem()
    stage = run(problem, confidence=0.999).stage(RansacStage)
    assert stage.iterations == stage.improved_at[-1] + 1 <= 3


def test_stopping_early_keeps_the_beginning(scene_of):
    """The confidence cuts a run short; it does not draw other samples."""
    problem = scene_of("mei", outlier_rate=0.5).problem()
    whole, short = run(problem).stage(RansacStage), run(problem, confidence=0.9).stage(RansacStage)
    count = len(short.improved_at)
    assert short.iterations < whole.iterations
    np.testing.assert_array_equal(short.samples, whole.samples[:count])
    np.testing.assert_array_equal(short.cam_from_map, whole.cam_from_map[:count])


def test_bound_changes_the_result(scene_of):
    """A bound that is not handed on would give the same inliers."""
    problem = scene_of("mei", noise_px=2.0).problem()
    counts = [run(problem, bound_px=bound).inlier_mask.sum() for bound in (0.5, 2.0, 8.0, 200.0)]
    assert counts[0] < counts[1] < counts[2] < counts[3]


def degenerate_problem():
    """All points on one vertical line: every pair has one point above the other."""
    camera = Equirectangular(1000, 500)
    points = np.column_stack([np.full(9, 1.0), np.arange(9.0), np.full(9, 3.0)])
    pixels = np.column_stack([np.linspace(100, 900, 9), np.linspace(150, 350, 9)])
    return Problem("line", camera, pixels, points, DOWN, DOWN)


def test_no_pose_is_a_sentence():
    trace = run(degenerate_problem(), iterations=70)
    assert trace.cam_from_map is None
    assert trace.message.startswith("No pose: ") and trace.message.endswith(".") and "70" in trace.message
    assert not trace.inlier_mask.any() and trace.inlier_mask.shape == (9,)
    assert trace.stage(RefinementStage) is None
    stage = trace.stage(RansacStage)
    assert stage.samples.shape == (0, 2) and stage.confidence_reached == 0.0
    assert stage.cam_from_map.shape == (0, 3, 4) and stage.inlier_masks.shape == (0, 9)


@pytest.mark.parametrize("count", [2, 3])
def test_smallest_problems(scene_of, count):
    """Two correspondences have nothing to vote with, but a pose that explains both."""
    found = 0
    for seed in range(30):
        trace = run(scene_of("mei", correspondences=count, outlier_rate=0.0).problem(seed), seed)
        found += trace.cam_from_map is not None and trace.inlier_mask.all()
        assert trace.message.endswith(".")
    assert found >= 20


@pytest.mark.parametrize(
    "options",
    [
        {"bound_px": 0.0},
        {"bound_px": -1.0},
        {"bound_px": np.nan},
        {"bound_px": np.inf},
        {"bound_px": None},
        {"iterations": 0},
        {"iterations": -5},
        {"iterations": 2.5},
        {"iterations": None},
        {"iterations": 10**8 + 1},
        {"confidence": 0.0},
        {"confidence": 1.0},
        {"confidence": np.nan},
        {"confidence": True},
        {"scoring": "mlesac"},
        {"scoring": None},
        {"scoring": 1},
        {"local_optimization": None},
        {"local_optimization": "yes"},
        {"local_optimization": 1},
    ],
)
def test_bad_options_are_input_errors(options):
    name = next(iter(options))
    with pytest.raises(InputError, match=f"option {name} is") as caught:
        Options(**options)
    assert "\n" not in str(caught.value)
