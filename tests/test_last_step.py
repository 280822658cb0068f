"""The last step: truncated squares and their minimum, the noise it adapts to, and real images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spherloc.bounds import bounds_of
from spherloc.datasets import load_scene
from spherloc.estimators import estimate
from spherloc.gauss_newton import Noise, tilt_of
from spherloc.geometry import DOWN, camera_centre, pose, so3_exp
from spherloc.last_step import conclude
from spherloc.metrics import rotation_error_deg, translation_error_m
from spherloc.narrowing import PRIOR_FINE, PRIOR_STATED, search_nearby, share_of_fine, truncated_squares
from spherloc.problem import Problem
from spherloc.refine import RefinementOptions, matches_of, refine, residuals_px
from tests.needs import real_data

BOUND_PX = 3.0


def squares(aligned, state):
    limits = np.full(len(aligned.points), BOUND_PX)
    return truncated_squares(matches_of(aligned), limits, state, Noise(1.0, aligned.gravity_sd_rad), np.inf)


def errors(problem, state):
    """Degrees and metres of an aligned pose."""
    found, truth = problem.aligned.unalign_pose(state), problem.truth_cam_from_map
    return rotation_error_deg(truth, found), translation_error_m(truth, found)


def moved(aligned, state, turn_rad, shift_m):
    """Turned about the camera, then shifted."""
    centre = camera_centre(state) + shift_m
    rotation = so3_exp(np.asarray(turn_rad)) @ state[:, :3]
    return pose(rotation, -rotation @ centre)


def with_noise(problem, noise_px):
    """The right matches of a simulation without noise, moved by ``noise_px`` (K, 2); wrong ones stay."""
    pixels = problem.pixels.copy()
    pixels[np.flatnonzero(problem.truth_inliers)] += noise_px
    return replace(problem, pixels=pixels)


@pytest.mark.parametrize("sd", [0.0, 0.01, np.inf])
def test_truncated_squares_are_what_they_say(rng, scene_of, sd):
    aligned = scene_of("mei", gravity_error_deg=1.0).problem(3).aligned
    limits = rng.uniform(1.0, 9.0, len(aligned.points))
    state = moved(aligned, aligned.align_pose(scene_of("mei").problem(3).truth_cam_from_map), [0.02, 0.0, 0.01], 0.01)
    expected = np.sum(np.minimum(residuals_px(aligned, state), limits) ** 2) / 0.7**2
    if 0.0 < sd < np.inf:
        expected += (tilt_of(state) / sd) ** 2
    found = truncated_squares(matches_of(aligned), limits, state, Noise(0.7, sd), np.inf)
    assert found == pytest.approx(expected, rel=1e-12)
    early = truncated_squares(matches_of(aligned), limits, state, Noise(0.7, sd), 0.5 * expected)
    assert 0.5 * expected < early <= expected


@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_as_good_as_from_the_truth(scene_of, camera):
    """From a level pose, whose gravity is off by up to 4 degrees, to what is found from the true one."""
    options, reached = RefinementOptions(), 0
    for seed in range(500, 512):
        scene = scene_of(camera, correspondences=120, outlier_rate=0.6, gravity_error_deg=1.5)
        problem = scene.problem(seed)
        aligned, bounds = problem.aligned, bounds_of(problem.aligned, BOUND_PX)
        truth = aligned.align_pose(problem.truth_cam_from_map)
        level, _, _ = refine(aligned, truth, bounds, RefinementOptions(gravity_sd_deg=0.0))
        best = squares(aligned, conclude(aligned, [truth], bounds, options)[0])
        found = conclude(aligned, [level], bounds, options)[0]
        reached += squares(aligned, found) <= best + 5.0
        # Never more than what plain refinement of the same start leaves, but for the noise that is adapted to.
        assert squares(aligned, found) <= squares(aligned, refine(aligned, level, bounds, options)[0]) + 16.8
    assert reached >= 11


def test_a_rival_with_fewer_inliers_can_win(scene_of):
    """Among starts the truncated squares decide, not the order."""
    problem = scene_of("mei", correspondences=150, outlier_rate=0.3, noise_px=0.3).problem(4)
    aligned, bounds = problem.aligned, bounds_of(problem.aligned, BOUND_PX)
    truth = aligned.align_pose(problem.truth_cam_from_map)
    near = moved(aligned, truth, [0.0, 0.004, 0.0], [0.02, 0.0, 0.0])
    for starts in ([truth, near], [near, truth]):
        found, inliers, stage = conclude(aligned, starts, bounds, RefinementOptions())
        assert errors(problem, found)[0] < 0.03
        np.testing.assert_array_equal(inliers, residuals_px(aligned, found) <= BOUND_PX)
        np.testing.assert_array_equal(stage.cam_from_map[-1], aligned.unalign_pose(found))
        assert stage.inlier_counts[-1] == np.count_nonzero(inliers)


def test_exact_gravity_stays_exact(scene_of):
    for seed in range(3):
        problem = scene_of("panorama", outlier_rate=0.5).problem(seed)
        aligned, bounds = problem.aligned, bounds_of(problem.aligned, BOUND_PX)
        start = moved(aligned, aligned.align_pose(problem.truth_cam_from_map), [0.0, 0.01, 0.0], [0.02, 0.0, 0.01])
        found, _, stage = conclude(aligned, [start], bounds, RefinementOptions())
        assert stage.dof == 4 and tilt_of(found) == 0.0


@pytest.mark.parametrize("sharp", [0.0, 0.3, 0.8])
def test_share_of_fine_noise(rng, sharp):
    """Recovered to a few percent from a thousand residuals; normal noise is seen as such."""
    sds = np.where(rng.random(1000) < sharp, 0.3, 1.0) * 0.8
    distance = np.hypot(*(rng.normal(size=(2, 1000)) * sds))
    limits = np.full(1000, 2.4)
    near = distance <= limits
    share = share_of_fine(distance, near, limits, 0.8, 0.1, 200, np.zeros(1000))
    assert share == pytest.approx(sharp, abs=0.06)


def test_share_of_fine_noise_is_the_priors_without_evidence():
    limits = np.full(3, 3.0)
    nothing = share_of_fine(np.full(3, 9.0), np.zeros(3, bool), limits, 1.0, 0.5, 5, np.zeros(3))
    assert nothing == pytest.approx(PRIOR_FINE / (PRIOR_STATED + PRIOR_FINE))


def test_adapts_to_sharp_matches_and_loses_little_on_normal_noise(rng, scene_of):
    """Mean squared errors over held-out seeds, against least squares on the same inliers."""
    ratios = {}
    for kind in ("normal", "mixed"):
        sums = np.zeros((2, 2))
        for seed in range(700, 740):
            problem = scene_of("mei", correspondences=120, outlier_rate=0.4, noise_px=0.0).problem(seed)
            count = int(np.count_nonzero(problem.truth_inliers))
            sd = np.ones(count) if kind == "normal" else np.where(rng.random(count) < 0.7, 0.2, 1.1)
            problem = with_noise(problem, sd[:, None] * rng.normal(size=(count, 2)))
            aligned, bounds = problem.aligned, bounds_of(problem.aligned, BOUND_PX)
            start = aligned.align_pose(problem.truth_cam_from_map)
            for row, robust in enumerate(("adaptive", "none")):
                found = conclude(aligned, [start], bounds, RefinementOptions(robust=robust))[0]
                sums[row] += np.square(errors(problem, found))
        ratios[kind] = sums[0] / sums[1]
    assert (ratios["normal"] < 1.1).all(), ratios
    assert (ratios["mixed"] < 0.5).all(), ratios


def test_two_correspondences_are_left_alone(scene_of):
    problem = scene_of("panorama", correspondences=2, outlier_rate=0.0, noise_px=0.0).problem(1)
    aligned, bounds = problem.aligned, bounds_of(problem.aligned, BOUND_PX)
    found, inliers, _ = conclude(aligned, [aligned.align_pose(problem.truth_cam_from_map)], bounds, RefinementOptions())
    assert inliers.all() and max(errors(problem, found)) < 1e-6


def test_search_nearby_never_loses(rng, scene_of):
    """What it returns has the squares it says, no more than before; drawn alike in every call."""
    for seed in range(5):
        problem = scene_of("fisheye", outlier_rate=0.5, gravity_error_deg=1.0).problem(seed)
        aligned = problem.aligned
        start = moved(aligned, aligned.align_pose(problem.truth_cam_from_map), rng.normal(0, 0.01, 3), 0.02)
        limits, wide = np.full(len(aligned.points), BOUND_PX), np.full(len(aligned.points), 15.0)
        noise = Noise(1.0, aligned.gravity_sd_rad)
        before, results = squares(aligned, start), []
        for _ in range(2):
            best = start.copy()
            least = search_nearby(matches_of(aligned), wide, limits, start.copy(), noise, best, before)
            assert least <= before and squares(aligned, best) == pytest.approx(least, rel=1e-12)
            results.append(best)
        np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e7])
def test_strange_data_give_finite_poses(rng, scale):
    """Random matches, all points in one place or on a line, at any scale: no NaN, and a rotation."""
    camera = load_scene(Path(__file__).resolve().parents[1] / "scenes" / "panorama_outliers_80.toml").camera
    for shape in range(3):
        count = 12
        pixels = rng.uniform((0, 0), (camera.width, camera.height), (count, 2))
        points = scale * rng.normal(size=(count, 3))
        if shape:
            points = points[:1] + (shape == 2) * np.outer(rng.normal(size=count), points[1])
        for sd in (0.0, 0.02, np.inf):
            problem = Problem("any", camera, pixels, points, DOWN, DOWN, gravity_bound_rad=0.05, gravity_sd_rad=sd)
            start = pose(so3_exp(rng.normal(size=3) * (sd > 0)), scale * rng.normal(size=3))
            aligned = problem.aligned
            found, _, stage = conclude(aligned, [start, start], bounds_of(aligned, 20.0), RefinementOptions())
            assert np.isfinite(found).all() and np.isfinite(stage.cam_from_map).all()
            np.testing.assert_allclose(found[:, :3] @ found[:, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_real_images_with_gravity_known_to_three_degrees(estimator):
    """All within 1 degree and 10 cm; the median is that of the best 6-DoF peer on the same matches, or less."""
    rows = []
    for path in sorted(real_data("aria_gen2").glob("*.toml")):
        problem = load_scene(path).problem()
        found = estimate(problem, estimator).cam_from_map
        truth = problem.truth_cam_from_map
        rows.append((rotation_error_deg(truth, found), translation_error_m(truth, found)))
    degrees, metres = np.array(rows).T
    assert len(rows) == 12 and (degrees < 1.0).all() and (metres < 0.1).all()
    assert np.median(degrees) <= 0.12 and np.median(metres) <= 0.005
