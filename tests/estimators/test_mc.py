"""MC (Algorithm 2): deterministic, honest about what it left out, and with a sentence where there is no pose."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.bounds import bounds_of
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.consensus.translation_balls import translation_balls
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.geometry import DOWN, camera_centre, yaw_of, yaw_rotation
from spherloc.problem import Problem
from spherloc.solvers.two_point import two_point
from spherloc.trace import RefinementStage, TranslationStage, YawStage

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

Options = options_type("mc")


def run(problem, seed=0, **options):
    return estimate(problem, "mc", Options(**options), seed)


def test_seed_changes_nothing(scene_of):
    problem = scene_of("mei").problem()
    first, other = run(problem, 0), run(problem, 12345)
    np.testing.assert_array_equal(first.cam_from_map, other.cam_from_map)
    for a, b in zip(first.stages, other.stages, strict=True):
        for name, value in vars(a).items():
            np.testing.assert_array_equal(value, getattr(b, name))


def test_order_of_the_correspondences_changes_nothing(rng, scene_of):
    """The inliers are a set: a result that depends on the order of the rows is an accident of the file."""
    for seed in range(5):
        problem = scene_of("mei").problem(seed)
        order = rng.permutation(100)
        shuffled = Problem("shuffled", problem.camera, problem.pixels[order], problem.points[order], DOWN, DOWN)
        here, there = run(problem), run(shuffled)
        np.testing.assert_array_equal(here.inlier_mask[order], there.inlier_mask)
        np.testing.assert_allclose(here.cam_from_map, there.cam_from_map, atol=1e-6)


def test_stages_fit_together(scene_of):
    """Each stage's numbers follow from the one before: what a drawing shows is what was computed."""
    for camera in ("mei", "fisheye", "panorama"):
        problem = scene_of(camera).problem(2)
        trace = run(problem)
        yaw, translation, refinement = trace.stages
        assert isinstance(yaw, YawStage) and isinstance(translation, TranslationStage)
        assert isinstance(refinement, RefinementStage)
        assert yaw.pairs_total == 100 * 99 // 2
        lo, hi, at = yaw.lo_rad, yaw.hi_rad, yaw.yaw_rad
        covers = ((lo <= at) & (at <= hi)) | (at + 2 * np.pi <= hi)
        np.testing.assert_array_equal(yaw.clique, np.flatnonzero(covers))
        assert len(yaw.clique) == yaw.overlap.max()
        assert (hi - lo <= np.radians(60) + 1e-12).all()
        assert translation.candidates == len(yaw.clique)
        assert {tuple(pair) for pair in translation.pairs} <= {tuple(pair) for pair in yaw.pairs[yaw.clique]}
        clique = translation.clique
        distance = np.linalg.norm(translation.centres_m[clique, None] - translation.centres_m[clique], axis=2)
        assert (distance <= np.add.outer(translation.radii_m[clique], translation.radii_m[clique])).all()
        edges = {tuple(edge) for edge in translation.edges.tolist()}
        assert all((a, b) in edges for a in clique.tolist() for b in clique.tolist() if a < b)
        np.testing.assert_array_equal(translation.cam_from_map, refinement.cam_from_map[0])
        np.testing.assert_array_equal(trace.cam_from_map, refinement.cam_from_map[-1])


def test_balls_are_those_of_the_arcs(scene_of):
    """Each ball's slack is the distance from the estimated yaw to the farther end of its pair's arc."""
    problem = scene_of("fisheye").problem(2)
    trace = run(problem)
    yaw, translation = trace.stage(YawStage), trace.stage(TranslationStage)
    farther = {}
    for arc in yaw.clique:
        at = yaw.yaw_rad + (0.0 if yaw.lo_rad[arc] <= yaw.yaw_rad else 2 * np.pi)
        farther[tuple(yaw.pairs[arc])] = max(at - yaw.lo_rad[arc], yaw.hi_rad[arc] - at)
    slack = np.array([farther[tuple(pair)] for pair in translation.pairs])
    bounds = bounds_of(problem.aligned, 3.0)
    centres, radii = translation_balls(problem.aligned, bounds.radians, translation.pairs, yaw.yaw_rad, slack)
    np.testing.assert_allclose(translation.centres_m, centres, atol=1e-12)
    np.testing.assert_allclose(translation.radii_m, radii, rtol=1e-12)


def test_pairs_name_places_in_the_problem(scene_of):
    """With unusable pixels in between, indices among the usable ones would be off."""
    problem = scene_of("fisheye", outlier_rate=0.2).problem()
    pixels = problem.pixels.copy()
    pixels[::3] = -1000.0
    problem = replace(problem, pixels=pixels)
    trace = run(problem)
    yaw, translation = trace.stage(YawStage), trace.stage(TranslationStage)
    for pairs in (yaw.pairs, yaw.pairs[yaw.clique], translation.pairs, translation.pairs[translation.clique]):
        assert len(pairs) and problem.usable[pairs].all()
    assert not trace.inlier_mask[::3].any() and trace.inlier_mask.sum() > 40


def test_start_where_no_pair_has_a_root():
    """Near a double root noise leaves no exact solution: the yaw and the ball of the arc are the start."""
    camera = Equirectangular(2048, 1024)
    points = np.array([[0.3, 1.0, 1.0], [0.3, 2.01, 2.0]])
    pixels = camera.project(np.array([[0.3, 1.0, 1.0], [0.3, 2.0, 2.0]]))[0]
    problem = Problem("tangent", camera, pixels, points, DOWN, DOWN)
    assert not two_point(problem.bearings[None], problem.points[None])[2].any()
    trace = run(problem)
    translation = trace.stage(TranslationStage)
    start = translation.cam_from_map
    np.testing.assert_allclose(start[:, :3], yaw_rotation(trace.stage(YawStage).yaw_rad), atol=1e-12)
    np.testing.assert_allclose(camera_centre(start), translation.centres_m[0], atol=1e-12)
    assert trace.inlier_mask.all()


@pytest.mark.parametrize("offset_rad", [-0.05, -1e-3, 0.0, 1e-3, 0.05])
def test_yaw_at_the_seam_is_like_any_other(scene_of, offset_rad):
    """Turning the map until the yaw is +-pi, where arcs wrap, must turn the picture and change nothing else."""
    problem = scene_of("mei").problem(4)
    here = run(problem)
    turn = yaw_rotation(here.stage(YawStage).yaw_rad - np.pi + offset_rad)
    points = problem.points @ turn.T
    there = run(Problem("turned", problem.camera, problem.pixels, points, DOWN, DOWN))
    np.testing.assert_array_equal(here.inlier_mask, there.inlier_mask)
    one, other = here.stage(YawStage), there.stage(YawStage)
    assert abs(np.sin((other.yaw_rad - np.pi + offset_rad) / 2)) < 1e-9
    np.testing.assert_allclose(np.diff(one.best_rad), np.diff(other.best_rad), atol=1e-9)
    assert {tuple(pair) for pair in one.pairs[one.clique]} == {tuple(pair) for pair in other.pairs[other.clique]}
    balls, others = here.stage(TranslationStage), there.stage(TranslationStage)
    np.testing.assert_array_equal(balls.pairs, others.pairs)
    np.testing.assert_allclose(balls.radii_m, others.radii_m, rtol=1e-6)
    np.testing.assert_allclose(balls.centres_m @ turn.T, others.centres_m, atol=1e-6)


def test_inlier_pairs_hold_the_truth(scene_of):
    """Noise below the bound: every arc of two inliers that is drawn holds the true yaw or its twin does, and the balls
    of such arcs hold the true position."""
    for camera in ("mei", "fisheye", "panorama"):
        problem = scene_of(camera, noise_px=0.5, outlier_rate=0.7).problem(1)
        trace = run(problem, bound_px=4.0, max_balls=2000)
        yaw, translation = trace.stage(YawStage), trace.stage(TranslationStage)
        true_yaw = yaw_of(problem.truth_cam_from_map[:, :3])
        inlier_pair = problem.truth_inliers[yaw.pairs].all(axis=1)
        holds = (true_yaw - yaw.lo_rad) % (2 * np.pi) <= yaw.hi_rad - yaw.lo_rad
        assert inlier_pair.sum() > 100
        held = {tuple(pair) for pair in yaw.pairs[holds].tolist()}
        # A pair without the true yaw among its arcs: its arc there was wider than 60 degrees.
        missing = {tuple(pair) for pair in yaw.pairs[inlier_pair].tolist()} - held
        assert len(missing) < 0.05 * inlier_pair.sum()

        good = {tuple(pair) for pair in yaw.pairs[yaw.clique][holds[yaw.clique]].tolist()}
        centre = camera_centre(problem.truth_cam_from_map)
        balls = 0
        for pair, ball, radius in zip(
            translation.pairs.tolist(), translation.centres_m, translation.radii_m, strict=True
        ):
            if problem.truth_inliers[pair].all() and tuple(pair) in good:
                assert np.linalg.norm(ball - centre) <= radius
                balls += 1
        assert balls > 100


def test_thinning_says_what_it_did(scene_of):
    problem = scene_of("mei", outlier_rate=0.5).problem()
    every, few = (run(problem, max_balls=most).stage(TranslationStage) for most in (2000, 20))
    assert every.candidates == few.candidates == len(every.radii_m) > 500
    assert every.rule == f"All {every.candidates:,} pairs of the rotation clique."
    assert few.rule == (
        f"The 20 smallest balls of the {few.candidates:,} pairs in the rotation clique, each match used once."
    )
    assert len(np.unique(few.pairs)) == 40 and few.radii_m[0] == every.radii_m.min()
    assert "500" in run(problem).stage(TranslationStage).rule


def test_clique_of_the_thinned_balls_is_proven(scene_of):
    assert all(run(scene_of("mei").problem(seed)).stage(TranslationStage).proven for seed in range(5))


def test_bound_changes_the_arcs(scene_of):
    """A larger bound widens every arc."""
    problem = scene_of("mei").problem()
    small, large = (run(problem, bound_px=bound).stage(YawStage) for bound in (1.0, 6.0))
    assert np.median(large.hi_rad - large.lo_rad) > 3 * np.median(small.hi_rad - small.lo_rad)


def horizontal_problem(count=8):
    """All bearings exactly level and within a right angle: nothing says which way the camera looks."""
    camera = Equirectangular(1000, 500)
    pixels = np.column_stack([np.linspace(400, 600, count), np.full(count, 250.0)])
    rng = np.random.default_rng(3)
    points = rng.uniform(-5, 5, (count, 3)) * [1.0, 0.0, 1.0]
    return Problem("level", camera, pixels, points, DOWN, DOWN)


def test_level_bearings_give_a_sentence():
    trace = run(horizontal_problem())
    assert trace.cam_from_map is None and not trace.inlier_mask.any()
    assert trace.message == "No pose: none of 28 pairs fixes the yaw to within 60 degrees."
    assert trace.timings_ms["total"] >= 0


def test_one_pixel_for_all_gives_a_sentence():
    """The same bearing many times over: no pair bounds anything."""
    problem = horizontal_problem()
    same = Problem("same", problem.camera, np.tile([300.0, 200.0], (8, 1)), problem.points, DOWN, DOWN)
    trace = run(same)
    assert trace.cam_from_map is None and trace.message.startswith("No pose: ") and trace.message.endswith(".")


def test_points_on_one_vertical_line_do_not_crash():
    """Depths bound the yaw although no pair has a root."""
    problem = horizontal_problem()
    points = np.column_stack([np.ones(8), np.arange(8.0), np.full(8, 3.0)])
    pixels = problem.pixels + np.column_stack([np.zeros(8), np.linspace(-90, 90, 8)])
    trace = run(Problem("line", problem.camera, pixels, points, DOWN, DOWN))
    assert trace.message.endswith(".")


@pytest.mark.parametrize("camera", ["mei", "panorama"])
@pytest.mark.parametrize("count", [2, 3])
def test_smallest_problems(scene_of, camera, count):
    found = 0
    for seed in range(30):
        trace = run(scene_of(camera, correspondences=count, outlier_rate=0.0).problem(seed))
        found += trace.cam_from_map is not None and trace.inlier_mask.all()
        assert trace.message.endswith(".")
    assert found >= 15


def test_only_outliers(scene_of):
    """Whatever is returned, it is a sentence and no crash."""
    for seed in range(5):
        assert run(scene_of("fisheye", outlier_rate=1.0).problem(seed)).message.endswith(".")


@pytest.mark.parametrize(
    "options",
    [
        {"bound_px": 0.0},
        {"bound_px": np.nan},
        {"bound_px": None},
        {"max_balls": 0},
        {"max_balls": -1},
        {"max_balls": 1.5},
        {"max_balls": 2001},
        {"max_balls": None},
    ],
)
def test_bad_options_are_input_errors(options):
    name = next(iter(options))
    with pytest.raises(InputError, match=f"option {name} is") as caught:
        Options(**options)
    assert "\n" not in str(caught.value)


def test_huge_bound_does_not_crash(scene_of):
    """Every pair bounds nothing, or every yaw is possible."""
    for bound in (100.0, 1000.0, 9000.0):
        assert run(scene_of("fisheye").problem(), bound_px=bound).message.endswith(".")
