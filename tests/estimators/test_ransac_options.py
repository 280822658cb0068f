"""2P-RANSAC's search against a plain loop over the same samples; MSAC, local optimization, confidence; hard cases."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chisquare, hypergeom

from spherloc.bounds import bounds_of
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.consensus import two_point_search
from spherloc.consensus.inliers import BLOCK, count_inliers, score_inliers
from spherloc.consensus.two_point_search import sample_pair, search_two_point
from spherloc.estimators import estimate, options_type
from spherloc.gauss_newton import AlignedMatches
from spherloc.geometry import DOWN, pose, yaw_rotation
from spherloc.metrics import evaluate
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.solvers.two_point import two_point
from spherloc.trace import RansacStage

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

Options = options_type("ransac-2p")


def tilted(problem):
    """The problem with half a degree of doubt about gravity: a bound of its own for every correspondence."""
    return replace(problem, gravity_bound_rad=np.radians(0.5))


def improvements(aligned, bound_px, seed, samples, msac):
    """(sample, i, j, yaw, inliers) of each improvement, by a loop that skips nothing."""
    pairs = np.array([sample_pair(np.uint64(seed), k, len(bound_px)) for k in range(samples)])
    yaws, translations, exists = two_point(aligned.bearings[pairs], aligned.points[pairs])
    best, found = 0.0, []
    for k, root in np.argwhere(exists):
        error = residuals_px(aligned, pose(yaw_rotation(yaws[k, root]), translations[k, root]))
        inliers = int(np.count_nonzero(error <= bound_px))
        score = np.maximum(0.0, 1.0 - np.square(error / bound_px)).sum() if msac else inliers
        if score > best:
            best = score
            found.append((k, *pairs[k], yaws[k, root], inliers))
    return found


@pytest.mark.parametrize("confidence", [None, 0.999])
@pytest.mark.parametrize("scoring", ["count", "msac"])
@pytest.mark.parametrize(
    "camera, count, rate", [("mei", 100, 0.8), ("fisheye", 333, 0.5), ("panorama", 1000, 0.9), ("mei", 40, 0.0)]
)
def test_search_is_the_plain_loop(scene_of, camera, count, rate, scoring, confidence):
    """Blocks, early ends and the order of the correspondences change nothing."""
    for seed in range(3):
        problem = tilted(scene_of(camera, correspondences=count, outlier_rate=rate).problem(seed))
        aligned = problem.aligned
        bound_px = bounds_of(aligned, 4.0).pixels
        found = search_two_point(aligned, bound_px, seed, 700, confidence, scoring)
        expected = improvements(aligned, bound_px, seed, found.drawn, scoring == "msac")
        assert found.drawn == 700 or confidence is not None
        at, i, j, yaw, inliers = (np.array(column) for column in zip(*expected, strict=True))
        np.testing.assert_array_equal(found.improved_at, at)
        np.testing.assert_array_equal(found.samples, np.column_stack([i, j]))
        np.testing.assert_array_equal(found.support, inliers)
        np.testing.assert_allclose(found.yaws_rad, yaw, atol=1e-12)
        assert not found.locally_optimized.any()


def test_scores_are_those_of_the_residuals(scene_of):
    """Counts, masks and MSAC costs of good and of random poses, against numpy."""
    problem = tilted(scene_of("fisheye", outlier_rate=0.3).problem())
    aligned, rng = problem.aligned, np.random.default_rng(5)
    bound_px = bounds_of(aligned, 3.0).pixels
    truth = aligned.align_pose(problem.truth_cam_from_map)
    yaw = np.arctan2(truth[0, 2], truth[0, 0])
    matches = AlignedMatches(aligned.bearings, aligned.points, aligned.pixel_from_bearing)
    for scale in np.repeat([0.0, 0.001, 0.01, 0.1, 3.0], 20):
        angle, t = yaw + scale * rng.normal(), truth[:, 3] + scale * rng.normal(size=3)
        error = residuals_px(aligned, pose(yaw_rotation(angle), t))
        mask = np.zeros(len(bound_px), dtype=bool)
        inliers, support = score_inliers(angle, t, matches, bound_px, mask)
        np.testing.assert_array_equal(mask, error <= bound_px)
        assert inliers == count_inliers(angle, t, matches, bound_px) == np.count_nonzero(mask)
        cost = np.minimum(np.square(error / bound_px), 1.0).sum()
        assert len(mask) - support == pytest.approx(cost, abs=1e-8)


def test_point_opposite_of_its_bearing_is_no_inlier(scene_of):
    """The early test lets it pass; the score must not."""
    aligned = scene_of("mei", correspondences=20, outlier_rate=0.0, noise_px=0.0).problem().aligned
    matches = AlignedMatches(aligned.bearings, aligned.points, aligned.pixel_from_bearing)
    opposite = -aligned.bearings
    opposite.setflags(write=False)
    flipped, bound_px = matches._replace(bearings=opposite), np.full(20, 8.0)
    truth = search_two_point(aligned, np.full(20, 8.0), 0, 50)
    mask = np.ones(20, dtype=bool)
    assert score_inliers(truth.yaws_rad[-1], truth.translations[-1], matches, bound_px, mask)[0] == 20
    assert score_inliers(truth.yaws_rad[-1], truth.translations[-1], flipped, bound_px, mask) == (0, 0.0)
    assert not mask.any()


@pytest.mark.parametrize("miss", [1e-2, 1e-6, 1e-12])
def test_early_test_loses_no_more_than_it_says(miss):
    """Against the exact distribution of what a random part holds of the best set; and it does turn away."""
    asked = 0
    for count in (100, 1000, 5000):
        for target in (2, 5, count // 10, count // 2, count - 1):
            for seen in (BLOCK, 4 * BLOCK, count // 2):
                if seen < count:
                    least = two_point_search._least_of_first(seen, target, count, miss)
                    assert 0 <= least <= min(seen, target)
                    assert hypergeom.cdf(least - 1, count, target, seen) <= miss
                    asked += least > 0
    assert asked >= 10


def test_order_of_the_correspondences_is_uniform():
    """A shuffle that moves some of them less would make the early test lose more than it says."""
    orders = np.array([two_point_search._shuffled(np.uint64(seed), 6) for seed in range(30_000)])
    assert (np.sort(orders, axis=1) == np.arange(6)).all()
    for place in range(6):
        assert chisquare(np.bincount(orders[:, place], minlength=6)).pvalue > 1e-4
    codes = np.unique(orders @ 6 ** np.arange(6), return_counts=True)[1]
    assert len(codes) == 720 and chisquare(codes).pvalue > 1e-4


def test_local_optimization_gains_support(scene_of):
    """With noise near the bound, two samples alone explain little."""
    gained, plain, optimized = 0, 0, 0
    for seed in range(20):
        problem = scene_of("mei", outlier_rate=0.5, noise_px=2.0).problem(seed)
        options = {"bound_px": 5.0, "iterations": 60}
        stage = estimate(problem, "ransac-2p", Options(**options), seed).stage(RansacStage)
        plain += stage.inlier_masks[-1].sum()
        stage = estimate(problem, "ransac-2p", Options(**options, local_optimization=True), seed).stage(RansacStage)
        optimized += stage.inlier_masks[-1].sum()
        counts, fitted = stage.inlier_masks.sum(axis=1), np.flatnonzero(stage.locally_optimized)
        assert (np.diff(counts) > 0).all() and not stage.locally_optimized[0]
        np.testing.assert_array_equal(stage.improved_at[fitted], stage.improved_at[fitted - 1])
        np.testing.assert_array_equal(stage.samples[fitted], stage.samples[fitted - 1])
        assert not stage.locally_optimized[fitted - 1].any()
        for k in range(len(counts)):
            error = residuals_px(problem.aligned, problem.aligned.align_pose(stage.cam_from_map[k]))
            np.testing.assert_array_equal(stage.inlier_masks[k][problem.usable], error <= 5.0)
        gained += len(fitted)
    assert gained >= 20 and optimized > 1.05 * plain


def test_local_optimization_draws_the_same_samples(scene_of):
    """It only adds hypotheses: the samples that it kept are those which the plain form draws at that number."""
    problem = scene_of("mei").problem()
    stage = estimate(problem, "ransac-2p", Options(local_optimization=True), 3).stage(RansacStage)
    for k, sample in zip(stage.improved_at, stage.samples, strict=True):
        assert tuple(sample) == sample_pair(np.uint64(3), k, 100)


def test_msac_prefers_the_better_fit(scene_of):
    """A wide bound counts all inliers for many poses; their squared errors still tell these apart."""
    errors = {"count": [], "msac": []}
    for scoring, degrees in errors.items():
        for seed in range(20):
            problem = scene_of("mei", outlier_rate=0.3).problem(seed)
            trace = estimate(problem, "ransac-2p", Options(bound_px=30.0, scoring=scoring), seed)
            scores = evaluate(replace(trace, cam_from_map=trace.stage(RansacStage).cam_from_map[-1]))
            degrees.append(scores.rotation_error_deg)
    assert np.median(errors["msac"]) < 0.7 * np.median(errors["count"])


@pytest.mark.parametrize("scoring", ["count", "msac"])
def test_always_right_at_90_percent_outliers(scene_of, scoring):
    """99.9 % confidence means what it says."""
    options = Options(iterations=100_000, confidence=0.999, scoring=scoring, local_optimization=True)
    for seed in range(50):
        trace = estimate(
            scene_of("mei", correspondences=200, outlier_rate=0.9).problem(seed), "ransac-2p", options, seed
        )
        assert evaluate(trace).success, seed
        stage = trace.stage(RansacStage)
        assert stage.confidence_reached >= 0.999 and stage.iterations < 1500


@pytest.mark.parametrize("options", [{"scoring": "msac"}, {"local_optimization": True, "confidence": 0.99}])
def test_seed_decides_everything(scene_of, options):
    problem = scene_of("panorama").problem()
    first, same, other = (estimate(problem, "ransac-2p", Options(**options), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.cam_from_map, same.cam_from_map)
    for a, b in zip(first.stages, same.stages, strict=True):
        np.testing.assert_array_equal(a.cam_from_map, b.cam_from_map)
    assert not np.array_equal(first.stage(RansacStage).samples, other.stage(RansacStage).samples)


def test_search_says_when_samples_ran_out(scene_of):
    """3 % inliers and 200 samples: a clean one is unlikely, and the caller can see it."""
    aligned = scene_of("mei", correspondences=200, outlier_rate=0.97).problem().aligned
    found = search_two_point(aligned, np.full(200, 8.0), 0, 200, 0.999)
    assert found.drawn == 200 and 0.0 <= found.confidence_reached < 0.3


def panorama_problem(points, pixels):
    return Problem("hard", Equirectangular(1000, 500), np.array(pixels), np.array(points, dtype=float), DOWN, DOWN)


ALL_OPTIONS = [
    {"confidence": confidence, "scoring": scoring, "local_optimization": local}
    for confidence in (None, 0.999)
    for scoring in ("count", "msac")
    for local in (False, True)
]


@pytest.mark.parametrize("options", ALL_OPTIONS)
def test_hard_cases_end_in_a_sentence(scene_of, options):
    """Equal points, equal pixels, points above one another, two correspondences, outliers only."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(50, 450, (9, 2))
    nothing = [
        panorama_problem(np.ones((9, 3)), pixels),
        panorama_problem(rng.normal(size=(9, 3)), np.tile(pixels[:1], (9, 1))),
        panorama_problem(np.column_stack([np.ones(9), np.arange(9.0), np.ones(9)]), pixels),
        panorama_problem(np.ones((2, 3)), pixels[:2]),
    ]
    for problem in nothing:
        trace = estimate(problem, "ransac-2p", Options(iterations=300, **options))
        assert trace.cam_from_map is None and trace.message.startswith("No pose: none of 300 sampled pairs")
        assert trace.stage(RansacStage).confidence_reached == 0.0
    for problem in (
        scene_of("mei", correspondences=2, outlier_rate=0.0).problem(),
        scene_of("mei", outlier_rate=1.0).problem(),
        panorama_problem(np.repeat(rng.normal(size=(3, 3)), 3, axis=0), pixels),
    ):
        trace = estimate(problem, "ransac-2p", Options(iterations=300, **options))
        assert trace.message.endswith(".")
        assert trace.cam_from_map is None or np.isfinite(trace.cam_from_map).all()
        assert 0.0 <= trace.stage(RansacStage).confidence_reached <= 1.0
