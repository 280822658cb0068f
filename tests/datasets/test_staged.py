"""Staged problems have the matches that they say, and are wrong in what they say and in nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from spherloc.cameras.base import in_image
from spherloc.datasets.failures import PLACES
from spherloc.datasets.staged import GROUP_KINDS, NEAR_M, Group, StagedScene
from spherloc.errors import InputError
from spherloc.geometry import DOWN, camera_centre, transform
from spherloc.refine import residuals_px

ALL = (Group("right", 12), Group("agreeing", 9), Group("near", 6), Group("doubled", 5), Group("random", 20))


@pytest.fixture(params=["mei", "fisheye", "panorama"])
def staged(scene_of, request):
    return StagedScene("staged", scene_of(request.param).camera, ALL, seed=3)


def test_counts_and_labels(staged):
    problem = staged.problem()
    assert problem.truth_inliers is not None and problem.truth_cam_from_map is not None
    assert len(problem) == 12 + 9 + 6 + 2 * 5 + 20 and np.count_nonzero(problem.truth_inliers) == 12 + 5
    assert in_image(problem.camera, problem.pixels).all() and problem.usable.all()
    errors = residuals_px(problem.aligned, problem.truth_cam_from_map)
    assert errors[problem.truth_inliers].max() < 5.0
    assert np.median(errors[~problem.truth_inliers]) > 20.0
    assert problem.scene == "staged: 12 right, 9 agreeing, 6 near, 5 doubled, 20 random"


def test_it_follows_from_its_fields(staged):
    one, two = staged.problem(), staged.problem(seed=7)
    np.testing.assert_array_equal(one.pixels, two.pixels)
    other = replace(staged, seed=4).problem()
    assert not np.array_equal(one.pixels, other.pixels)
    quiet = replace(staged, noise_px=0.0, groups=(Group("right", 10),)).problem()
    assert residuals_px(quiet.aligned, quiet.truth_cam_from_map).max() < 1e-6


def test_nearly_right_ones_agree_with_a_pose_beside(staged):
    """Half a metre off, they are wrong, but by less than what agrees with a pose elsewhere."""
    only = replace(staged, noise_px=0.0, groups=(Group("right", 1), Group("near", 40)))
    problem = only.problem()
    rays = transform(problem.truth_cam_from_map, problem.points)
    wrong = ~problem.truth_inliers
    cosines = np.einsum("ni,ni->n", rays / np.linalg.norm(rays, axis=1)[:, None], problem.bearings)
    off = np.arccos(np.clip(cosines[wrong], -1.0, 1.0))
    distance = np.linalg.norm(problem.points - camera_centre(problem.truth_cam_from_map), axis=1)[wrong]
    assert (off > 1e-3).mean() > 0.9
    most = np.radians(5.0) + np.arcsin(np.minimum(1.0, NEAR_M / distance))
    assert (off <= most + 1e-6).all()


def test_gravity_is_off_by_what_is_said(staged):
    problem = replace(staged, gravity_off_deg=4.0, gravity_bound_deg=1.0).problem()
    assert np.degrees(np.arccos(problem.gravity_camera @ DOWN)) == pytest.approx(4.0)
    assert np.degrees(problem.gravity_bound_rad) == pytest.approx(1.0)


def test_a_wrong_focal_length_changes_the_calibration_alone(scene_of):
    right = StagedScene("staged", scene_of("mei").camera, ALL)
    wrong = replace(right, focal_off=0.05)
    one, two = right.problem(), wrong.problem()
    np.testing.assert_array_equal(one.pixels, two.pixels)
    assert two.camera.fx == pytest.approx(1.05 * one.camera.fx) and two.camera.cx == one.camera.cx
    with pytest.raises(InputError, match="has no focal length"):
        StagedScene("staged", scene_of("panorama").camera, ALL, focal_off=0.05)


@pytest.mark.parametrize("place", PLACES)
def test_places(scene_of, place):
    camera = scene_of("panorama" if place in ("below", "behind") else "fisheye").camera
    problem = StagedScene("staged", camera, (Group("right", 30, place), Group("random", 5, place))).problem()
    points = problem.points[problem.truth_inliers]
    rays = transform(problem.truth_cam_from_map, points)
    sizes = np.ptp(points, axis=0)
    true = {
        "line": sizes[[0, 2]].max() < 0.05 and sizes[1] > 0.5,
        "spot": sizes.max() < 0.1,
        "far": np.linalg.norm(rays, axis=1).min() > 1000.0,
        "below": (rays[:, 1] > 1.4).all() and np.hypot(rays[:, 0], rays[:, 2]).max() < 0.05,
        "behind": (rays[:, 2] < -2.9).all(),
    }
    assert true[place]
    columns = problem.pixels[problem.truth_inliers, 0]
    if place in ("below", "behind"):
        assert np.ptp(columns) > 0.8 * camera.width, "stretched at the pole, or split by the seam"


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: Group("left", 3), "kind is 'left'; give one of " + ", ".join(GROUP_KINDS)),
        (lambda: Group("right", 0), "count is 0"),
        (lambda: Group("right", 10**6), "count is 1000000"),
        (lambda: Group("right", 3, "mars"), "place is 'mars'"),
        (lambda: Group("agreeing", 3, "far"), "place is 'far'"),
    ],
)
def test_wrong_groups_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


@pytest.mark.parametrize(
    "field, value", [("seed", -1), ("noise_px", np.nan), ("gravity_off_deg", 91), ("focal_off", 2)]
)
def test_wrong_numbers_are_refused(staged, field, value):
    with pytest.raises(InputError, match=f"{field} is"):
        replace(staged, **{field: value})
