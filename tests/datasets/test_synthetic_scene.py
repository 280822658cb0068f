"""The simulation: what a seed keeps, what a rate or noise changes, and that what it says is true."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.cameras.base import in_image
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import InputError
from spherloc.geometry import DOWN, camera_centre, transform, yaw_of, yaw_rotation

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERAS = ("mei", "fisheye", "panorama")
SEEDS = range(12)


def geometry_of(problem):
    return np.concatenate([problem.points.ravel(), problem.truth_cam_from_map.ravel()])


@pytest.mark.parametrize("camera", CAMERAS)
def test_same_seed_same_problem(scene_of, camera):
    for seed in SEEDS:
        one, two = (scene_of(camera).problem(seed) for _ in range(2))
        np.testing.assert_array_equal(one.pixels, two.pixels)
        np.testing.assert_array_equal(geometry_of(one), geometry_of(two))
        np.testing.assert_array_equal(scene_of(camera, seed=seed).problem().pixels, one.pixels)


@pytest.mark.parametrize("camera", CAMERAS)
def test_different_seeds_differ(scene_of, camera):
    """In pose, points, noise and the choice of outliers."""
    problems = [scene_of(camera).problem(seed) for seed in SEEDS]
    for name in ("pixels", "points", "truth_cam_from_map", "truth_inliers"):
        assert len({getattr(problem, name).tobytes() for problem in problems}) == len(problems), name


@pytest.mark.parametrize("camera", CAMERAS)
def test_outlier_rate_keeps_points_pose_and_noise(scene_of, camera):
    """Outliers are nested: turning the rate up only adds to them, so that a slider shows one change at a time."""
    for seed in SEEDS:
        before = scene_of(camera, outlier_rate=0.0).problem(seed)
        for rate in (0.1, 0.33, 0.5, 0.9, 1.0):
            after = scene_of(camera, outlier_rate=rate).problem(seed)
            np.testing.assert_array_equal(geometry_of(before), geometry_of(after))
            assert not (after.truth_inliers & ~before.truth_inliers).any()
            kept = after.truth_inliers | ~before.truth_inliers
            np.testing.assert_array_equal(after.pixels[kept], before.pixels[kept])
            assert (after.pixels[~kept] != before.pixels[~kept]).any(axis=1).all()
            before = after


@pytest.mark.parametrize("camera", CAMERAS)
def test_noise_keeps_points_pose_and_outliers(scene_of, camera):
    """The noise slider must not replace the points: also not those near the border of the image."""
    changed = []
    for seed in SEEDS:
        clean, noisy = (scene_of(camera, noise_px=noise, outlier_rate=0.5).problem(seed) for noise in (0.0, 3.0))
        np.testing.assert_array_equal(clean.truth_inliers, noisy.truth_inliers)
        if not np.array_equal(geometry_of(clean), geometry_of(noisy)):
            changed.append(seed)
            continue
        outliers = ~clean.truth_inliers
        np.testing.assert_array_equal(clean.pixels[outliers], noisy.pixels[outliers])
    assert changed == [], f"the points of {len(changed)} of {len(SEEDS)} seeds depend on the noise"


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("noise", [0.0, 1.0, 5.0])
def test_every_pixel_is_visible(scene_of, camera, noise):
    """In the image and valid for the model, outliers included."""
    for seed in SEEDS:
        problem = scene_of(camera, noise_px=noise).problem(seed)
        assert problem.usable.all() and in_image(problem.camera, problem.pixels).all()


@pytest.mark.parametrize("camera", CAMERAS)
def test_truth_is_true(scene_of, camera):
    """Without noise every inlier projects exactly onto its pixel, and an outlier does not."""
    for seed in SEEDS:
        problem = scene_of(camera, noise_px=0.0, outlier_rate=0.4).problem(seed)
        pixels, valid = problem.camera.project(transform(problem.truth_cam_from_map, problem.points))
        assert valid[problem.truth_inliers].all()
        off = np.linalg.norm(pixels - problem.pixels, axis=1)
        assert off[problem.truth_inliers].max() < 1e-9
        assert np.median(off[~problem.truth_inliers]) > 20


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_noise_has_the_stated_size(scene_of, noise):
    """Standard deviation a coordinate, not of the length."""
    shifts = []
    for seed in SEEDS:
        problem = scene_of("mei", noise_px=noise, outlier_rate=0.0, correspondences=500).problem(seed)
        shifts.append(problem.pixels - problem.camera.project(transform(problem.truth_cam_from_map, problem.points))[0])
    shifts = np.concatenate(shifts)
    np.testing.assert_allclose(shifts.std(axis=0), noise, rtol=0.05)
    np.testing.assert_allclose(shifts.mean(axis=0), 0.0, atol=0.05 * noise)


@pytest.mark.parametrize("count, rate", [(100, 0.8), (7, 0.5), (3, 0.5), (2, 0.25), (11, 0.95), (100, 0.0), (100, 1.0)])
def test_outlier_count_is_rounded(scene_of, count, rate):
    for seed in range(3):
        problem = scene_of("panorama", correspondences=count, outlier_rate=rate).problem(seed)
        assert len(problem) == count
        assert np.count_nonzero(~problem.truth_inliers) == round(rate * count)


def test_outliers_are_anywhere_in_the_order(scene_of):
    """An estimator must not be able to gain from the position of a row."""
    labels = np.array([scene_of("panorama", outlier_rate=0.5).problem(seed).truth_inliers for seed in range(60)])
    assert abs(labels.mean() - 0.5) < 1e-9
    assert np.abs(labels.mean(axis=0) - 0.5).max() < 0.3


def test_world_is_the_papers(scene_of):
    """Points in [-5, 5]^3, a level camera of any yaw, positions all over the cube."""
    problems = [scene_of("panorama").problem(seed) for seed in range(200)]
    points = np.concatenate([problem.points for problem in problems])
    assert np.abs(points).max() <= 5 and np.abs(points).max(axis=0).min() > 4.9
    poses = np.array([problem.truth_cam_from_map for problem in problems])
    yaws = [yaw_of(rotation) for rotation in poses[:, :, :3]]
    np.testing.assert_allclose([yaw_rotation(yaw) for yaw in yaws], poses[:, :, :3], atol=1e-15)
    assert min(yaws) < -3 and max(yaws) > 3
    assert np.abs(poses[:, :, 3]).max() <= 5 and np.abs([camera_centre(pose) for pose in poses]).max() < 8
    assert all((p.gravity_camera == DOWN).all() and (p.gravity_map == DOWN).all() for p in problems)


def test_panorama_has_points_on_both_sides_of_the_seam(scene_of):
    u = np.concatenate([scene_of("panorama", outlier_rate=0.0).problem(seed).pixels[:, 0] for seed in range(100)])
    assert (u < 4).sum() > 5 and (u > 2044).sum() > 5


def test_gravity_error_changes_only_what_is_known_of_gravity(scene_of):
    """The camera stays level; the problem's gravity is off, by no more than it says."""
    for seed in SEEDS:
        exact, off = (scene_of("mei", gravity_error_deg=error).problem(seed) for error in (0.0, 0.5))
        np.testing.assert_array_equal(exact.pixels, off.pixels)
        np.testing.assert_array_equal(geometry_of(exact), geometry_of(off))
        np.testing.assert_array_equal(exact.gravity_map, off.gravity_map)
        assert exact.gravity_bound_rad == 0.0 and exact.aligned.gravity_sd_rad == 0.0
        assert 0.0 < np.arccos(off.gravity_camera @ DOWN) <= off.gravity_bound_rad
        assert off.gravity_bound_rad == pytest.approx(np.radians(1.5))
        assert off.gravity_sd_rad == pytest.approx(np.radians(0.5))


def test_gravity_error_has_the_stated_size(scene_of):
    """In roll and in pitch, and never beyond the bound, so that 3 sd are a true bound."""
    scene = scene_of("panorama", correspondences=2, outlier_rate=0.0, gravity_error_deg=2.0)
    known = np.array([scene.problem(seed).gravity_camera for seed in range(2000)])
    roll_pitch = np.degrees(known[:, [0, 2]])
    np.testing.assert_allclose(roll_pitch.std(axis=0), 2.0, rtol=0.07)
    np.testing.assert_allclose(roll_pitch.mean(axis=0), 0.0, atol=0.15)
    assert 5.0 < np.degrees(np.arccos(known @ DOWN)).max() <= 6.0


def test_larger_gravity_error_tilts_the_same_way(scene_of):
    """So that a slider shows one change at a time."""
    small, large = (scene_of("mei", gravity_error_deg=error).problem(3).gravity_camera for error in (1.0, 3.0))
    assert np.cross(small, large) @ np.cross(DOWN, small) > 0
    np.testing.assert_allclose(np.arccos(large @ DOWN), 3.0 * np.arccos(small @ DOWN), rtol=1e-9)


def test_camera_that_sees_nothing_is_an_input_error(scene_of):
    """A telescope: the search for visible points must end, in a sentence."""
    narrow = KannalaBrandt(10, 10, 1e6, 1e6, 5.0, 5.0, (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="points are visible"):
        replace(scene_of("mei"), camera=narrow).problem()


BAD = [("correspondences", 1), ("correspondences", 10_001), ("outlier_rate", -0.1), ("outlier_rate", np.nan)]
BAD += [("gravity_error_deg", -0.1), ("gravity_error_deg", 10.1), ("gravity_error_deg", np.nan)]
BAD += [("noise_px", -1.0), ("noise_px", np.inf), ("seed", -1)]


@pytest.mark.parametrize("name, value", BAD)
def test_values_out_of_range_are_input_errors(scene_of, name, value):
    with pytest.raises(InputError, match=f"{name} is"):
        scene_of("mei", **{name: value})


def test_negative_seed_is_an_input_error(scene_of):
    with pytest.raises(InputError, match="seed is"):
        scene_of("mei").problem(-1)
