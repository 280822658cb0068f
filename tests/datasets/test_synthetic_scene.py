"""The simulation: what a seed keeps, what a rate or noise changes, and that what it says is true."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.cameras.base import in_image
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import load_scene
from spherloc.datasets.outliers import second_pose
from spherloc.errors import InputError
from spherloc.geometry import DOWN, camera_centre, transform, yaw_of, yaw_rotation

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERAS = ("mei", "fisheye", "panorama")
SEEDS = range(12)
FEW = range(5)


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


def share_kept(one, two):
    """Share of the correspondences whose point, at the same number, is the same."""
    return np.mean((one.points == two.points).all(axis=1))


CHANGES = [
    {"field_of_view_deg": 110.0},
    {"true_camera": (30.0, 1.0, 0.0, 2.0)},
    {"outlier_kind": "coherent"},
    {"outlier_kind": "repeated"},
    {"cloud_height_m": 3.0},
]


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: next(iter(change)))
def test_what_is_still_seen_keeps_its_number_noise_and_label(scene_of, camera, change):
    """Neither the choice of outliers nor the noise, but that it is turned inwards at the border of the image."""
    equal = []
    for seed in FEW:
        labels = [scene_of(camera, outlier_rate=0.5, **more).problem(seed).truth_inliers for more in ({}, change)]
        np.testing.assert_array_equal(*labels)
        problems = [scene_of(camera, outlier_rate=0.0, **more).problem(seed) for more in ({}, change)]
        before, after = (
            problem.pixels - problem.camera.project(transform(problem.truth_cam_from_map, problem.points))[0]
            for problem in problems
        )
        same = (problems[0].points == problems[1].points).all(axis=1)
        before, after = before[same], after[same]
        np.testing.assert_allclose(before[:, 0] * after[:, 1], before[:, 1] * after[:, 0], atol=1e-6)
        equal += list(np.abs(before - after).max(axis=1) < 1e-9)
    assert "cloud_height_m" in change or (len(equal) > 40 and np.mean(equal) > 0.9)


@pytest.mark.parametrize("camera", CAMERAS)
def test_most_points_stay_when_the_camera_is_moved_a_little(scene_of, camera):
    for seed in FEW:
        scene = scene_of(camera, outlier_rate=0.5)
        start = scene.problem(seed)
        x, y, z = camera_centre(start.truth_cam_from_map)
        yaw = np.degrees(yaw_of(start.truth_cam_from_map[:, :3]))
        same, moved, turned = (
            replace(scene, true_camera=placed).problem(seed)
            for placed in ((yaw, x, y, z), (yaw, x + 0.05, y, z), (yaw + 1.0, x, y, z))
        )
        assert share_kept(start, same) == 1 and share_kept(start, moved) > 0.9 and share_kept(start, turned) > 0.9
        np.testing.assert_allclose(same.truth_cam_from_map, start.truth_cam_from_map, atol=1e-12)
        np.testing.assert_allclose(camera_centre(moved.truth_cam_from_map), [x + 0.05, y, z], atol=1e-12)
        assert np.degrees(yaw_of(turned.truth_cam_from_map[:, :3] @ start.truth_cam_from_map[:, :3].T)) == (
            pytest.approx(1.0)
        )


def agreeing(problem, cam_from_map, limit_px=6.0):
    """Mask of the correspondences that agree with a pose."""
    pixels, valid = problem.camera.project(transform(cam_from_map, problem.points))
    return valid & (np.linalg.norm(np.nan_to_num(pixels - problem.pixels, nan=1e9), axis=1) < limit_px)


@pytest.mark.parametrize("camera", CAMERAS)
def test_coherent_outliers_agree_with_one_wrong_level_pose(scene_of, camera):

    for seed in FEW:
        problem = scene_of(camera, outlier_kind="coherent", outlier_rate=0.6, noise_px=0.5).problem(seed)
        other = second_pose(np.random.default_rng([seed, 5]), problem.truth_cam_from_map, 360.0)
        shift = np.linalg.norm(camera_centre(other) - camera_centre(problem.truth_cam_from_map))
        yaw = np.degrees(yaw_of(other[:, :3] @ problem.truth_cam_from_map[:, :3].T))
        assert 1.5 <= shift <= 3.1 and 20 <= abs(yaw) <= 60
        np.testing.assert_array_equal(agreeing(problem, other) & ~problem.truth_inliers, ~problem.truth_inliers)
        assert np.count_nonzero(agreeing(problem, problem.truth_cam_from_map) & ~problem.truth_inliers) <= 2


@pytest.mark.parametrize("camera", CAMERAS)
def test_repeated_structure_agrees_with_poses_shifted_along_it(scene_of, camera):
    """Every wrong match is right for a camera one or two steps of 2 m away; the nearer ones are more."""
    counts = np.zeros(4)
    for seed in FEW:
        problem = scene_of(camera, outlier_kind="repeated", outlier_rate=0.6, noise_px=0.5).problem(seed)
        truth, explained = problem.truth_cam_from_map, np.zeros(len(problem), dtype=int)
        for number, steps in enumerate((-2, -1, 1, 2)):
            shifted = np.column_stack([truth[:, :3], truth[:, 3] - truth[:, :3] @ [2.0 * steps, 0.0, 0.0]])
            agree = agreeing(problem, shifted) & ~problem.truth_inliers
            explained += agree
            counts[number] += np.count_nonzero(agree)
        assert (explained[~problem.truth_inliers] >= 1).all() and agreeing(problem, truth)[problem.truth_inliers].all()
    assert counts[1:3].min() > counts[[0, 3]].max() and counts.min() > 10


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("kind", ["random", "coherent", "repeated"])
@pytest.mark.parametrize("field_of_view_deg", [20.0, 60.0, 120.0])
def test_nothing_is_seen_outside_the_field_of_view(scene_of, camera, kind, field_of_view_deg):
    """And there is a problem for every seed, also where the drawn camera looks out of the cube."""
    changes = {"outlier_kind": kind, "field_of_view_deg": field_of_view_deg}
    for seed in FEW:
        problem = scene_of(camera, correspondences=60, **changes).problem(seed)
        assert len(problem) == 60 and problem.usable.all() and in_image(problem.camera, problem.pixels).all()
        assert np.degrees(np.arccos(problem.bearings[:, 2])).max() <= field_of_view_deg / 2 + 1e-6


@pytest.mark.parametrize("height", [0.0, 0.2, 4.0])
def test_a_flat_cloud_lies_at_the_drawn_cameras_height(scene_of, height):
    for seed in FEW:
        scene = scene_of("panorama", cloud_height_m=height, noise_px=0.0, outlier_rate=0.0)
        problem = scene.problem(seed)
        y = problem.points[:, 1] - camera_centre(problem.truth_cam_from_map)[1]
        assert np.abs(y).max() <= height / 2 + 1e-12 and np.abs(y).max() >= 0.45 * height
        full = replace(scene, cloud_height_m=10.0).problem(seed)
        np.testing.assert_array_equal(problem.points[:, [0, 2]], full.points[:, [0, 2]])


def test_a_camera_far_from_the_cube_still_sees_points(scene_of):
    """The true camera can be dragged anywhere; what it sees is then in front of it."""
    for camera in CAMERAS:
        placed = (120.0, 40.0, -3.0, 60.0)
        problem = scene_of(camera, true_camera=placed, outlier_rate=0.0).problem(1)
        away = np.linalg.norm(problem.points - np.array(placed[1:]), axis=1)
        assert camera == "panorama" or (away < 100).all()
        assert agreeing(problem, problem.truth_cam_from_map, 8.0).all()


TOML = """kind = "synthetic"
name = "little"
[camera]
model = "equirectangular"
width = 200
height = 100
[simulation]
correspondences = 10
outlier_rate = 0.3
noise_px = 0.5
seed = 4
"""


def test_a_scene_file_says_all_of_it(tmp_path):
    path = tmp_path / "scene.toml"
    more = 'outlier_kind = "repeated"\nfield_of_view_deg = 120\ncloud_height_m = 4.5\ntrue_camera = [30, 1, 0, 2.5]\n'
    path.write_text(TOML + more)
    scene, plain = load_scene(path), tmp_path / "plain.toml"
    plain.write_text(TOML)
    placed = (30.0, 1.0, 0.0, 2.5)
    assert scene == replace(
        load_scene(plain),  # type: ignore[type-var]
        outlier_kind="repeated",
        field_of_view_deg=120.0,
        cloud_height_m=4.5,
        true_camera=placed,
    )
    problem = scene.problem()
    np.testing.assert_allclose(camera_centre(problem.truth_cam_from_map), placed[1:], atol=1e-12)
    assert np.degrees(yaw_of(problem.truth_cam_from_map[:, :3])) == pytest.approx(placed[0])
    assert "repeated" in problem.scene and "120 deg" in problem.scene and "4.5 m" in problem.scene


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ('outlier_kind = "bad"', "outlier_kind is 'bad'; give one of random, coherent, repeated"),
        ("outlier_kind = 3", "key 'outlier_kind' must be a text"),
        ("field_of_view_deg = 5", "field_of_view_deg is 5; give a number from 10 to 360"),
        ("field_of_view_deg = true", "field_of_view_deg is True"),
        ("cloud_height_m = -1.0", "cloud_height_m is -1.0; give a number from 0 to 10"),
        ("cloud_height_m = nan", "cloud_height_m is nan"),
        ("true_camera = [1, 2, 3]", "true_camera must hold 4 finite numbers"),
        ("true_camera = [1, 2, 3, inf]", "true_camera must hold 4 finite numbers"),
        ("true_camera = [1, 2, 300, 4]", "true_camera is .* give its yaw from -360 to 360"),
        ("outlier_sort = 1", "unknown key 'outlier_sort'"),
    ],
)
def test_wrong_keys_of_a_scene_file_are_sentences(tmp_path, line, sentence):
    path = tmp_path / "scene.toml"
    path.write_text(TOML + line + "\n")
    with pytest.raises(InputError, match=sentence) as error:
        load_scene(path)
    assert str(path) in str(error.value)
