"""The simulation beyond the paper: kinds of outliers, field of view, flat clouds and a camera that is placed."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.cameras.base import in_image
from spherloc.datasets import load_scene
from spherloc.datasets.point_cloud import second_pose
from spherloc.errors import InputError
from spherloc.geometry import camera_centre, transform, yaw_of

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CAMERAS = ("mei", "fisheye", "panorama")
FEW = range(5)


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
