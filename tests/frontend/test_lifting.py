"""Lifting against worlds whose geometry is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import InputError
from spherloc.frontend.lifting import DepthLift, PointCloudLift, SfmLift
from spherloc.geometry import pose, so3_exp, transform

FISHEYE = KannalaBrandt(320, 240, 110.0, 112.0, 161.0, 118.0, (0.02, -0.01, 0.003, -0.0005))
MEI = Mei(320, 240, 230.0, 228.0, 158.0, 121.0, 1.2, (0.05, -0.02, 0.0003, -0.0002))
PANORAMA = Equirectangular(360, 180)
CAMERAS = pytest.mark.parametrize("camera", [FISHEYE, MEI, PANORAMA], ids=lambda camera: camera.model)
POSE = pose(so3_exp(np.array([0.1, -0.4, 0.2])), np.array([3.0, -1.0, 0.5]))


def pixel_centres(camera):
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.column_stack([columns.ravel(), rows.ravel()])


def room_ranges(bearings, half=(4.0, 2.0, 5.0)):
    """Distance to the walls of a box around the camera, along unit bearings (N, 3)."""
    with np.errstate(divide="ignore"):
        return (np.array(half) / np.abs(bearings)).min(axis=1)


def range_map(camera, ranges_of):
    bearings, _ = camera.unproject(pixel_centres(camera))
    return ranges_of(bearings).reshape(camera.height, camera.width)


def some_pixels(camera, rng, count=400):
    pixels = rng.uniform((0, 0), (camera.width, camera.height), (count, 2))
    return pixels[camera.unproject(pixels)[1]]


@CAMERAS
def test_depth_gives_the_walls_of_a_room(camera, rng):
    pixels = some_pixels(camera, rng)
    lift = DepthLift(lambda: range_map(camera, room_ranges), camera, POSE, "ray")
    points, known = lift(pixels)
    assert known.all()
    bearings = camera.unproject(pixels)[0]
    truth = bearings * room_ranges(bearings)[:, None]
    # Bilinear on a smooth wall; half a pixel of range beside the edges of the room.
    error = np.linalg.norm(transform(POSE, points) - truth, axis=1)
    assert np.median(error) < 1e-3 and error.max() < 0.2


def test_depth_along_the_axis(rng):
    pixels = some_pixels(FISHEYE, rng)
    depth = range_map(FISHEYE, lambda bearings: np.where(bearings[:, 2] > 0.1, 3.0, 0.0))
    points, known = DepthLift(lambda: depth, FISHEYE, POSE, along="z")(pixels)
    assert 100 < known.sum() < len(pixels)
    assert np.allclose(transform(POSE, points[known])[:, 2], 3.0, atol=1e-6)
    assert np.isnan(points[~known]).all()


def test_no_point_floats_between_two_surfaces(rng):
    """A near block before a far wall: every lifted range is one of the two, to its own side of the edge."""
    depth = np.full((240, 320), 9.0)
    depth[:, 100:200] = 2.0
    pixels = np.column_stack([rng.uniform(90, 210, 500), rng.uniform(60, 180, 500)])
    points, known = DepthLift(lambda: depth, FISHEYE, POSE, "ray")(pixels)
    assert known.all()
    ranges = np.linalg.norm(transform(POSE, points), axis=1)
    inside = (pixels[:, 0] >= 100) & (pixels[:, 0] < 200)
    assert np.allclose(ranges, np.where(inside, 2.0, 9.0), rtol=1e-6)


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf, -1.0, -np.inf])
def test_holes_have_no_depth(nothing):
    depth = np.full((240, 320), 4.0)
    depth[100:120, 100:120] = nothing
    points, known = DepthLift(lambda: depth, FISHEYE, POSE, "ray")(
        np.array([[110.0, 110.0], [99.8, 110.0], [60.0, 60.0]])
    )
    assert known.tolist() == [False, True, True]
    assert np.isnan(points[0]).all()
    assert np.allclose(np.linalg.norm(transform(POSE, points[1:]), axis=1), 4.0)


def test_pixels_outside_have_no_depth():
    asked = np.array([[-0.1, 10.0], [320.0, 10.0], [10.0, 240.0], [np.nan, 3.0], [161.0, 118.0]])
    _, known = DepthLift(lambda: np.full((240, 320), 4.0), FISHEYE, POSE, "ray")(asked)
    assert known.tolist() == [False, False, False, False, True]


def test_depth_is_interpolated_across_the_seam():
    """Range that depends on longitude alone, smooth there: the seam's columns are neighbours."""
    depth = range_map(PANORAMA, lambda bearings: 5.0 + bearings[:, 0])
    pixels = np.array([[0.0, 90.0], [0.25, 90.0], [359.75, 90.0], [180.0, 90.0]])
    points, known = DepthLift(lambda: depth, PANORAMA, POSE, "ray")(pixels)
    assert known.all()
    expected = 5.0 + PANORAMA.unproject(pixels)[0][:, 0]
    assert np.allclose(np.linalg.norm(transform(POSE, points), axis=1), expected, atol=1e-4)


def test_depth_is_read_once_and_only_when_asked():
    reads = []

    def load():
        reads.append(1)
        return np.full((240, 320), 4.0)

    lift = DepthLift(load, FISHEYE, POSE, "ray")
    assert not reads
    for _ in range(3):
        lift(np.array([[160.0, 120.0]]))
    assert len(reads) == 1


def test_depth_of_another_size_is_refused():
    with pytest.raises(InputError, match=r"shape \(240, 319\), its image 240 rows of 320"):
        DepthLift(lambda: np.ones((240, 319)), FISHEYE, POSE, "ray")(np.array([[1.0, 1.0]]))


def cloud_of(camera, rng, ranges_of, count=60_000):
    """Map points scattered over what a camera sees of a surface."""
    bearings = rng.normal(size=(count, 3))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    points = bearings * ranges_of(bearings)[:, None]
    return (points - POSE[:, 3]) @ POSE[:, :3]


@CAMERAS
def test_cloud_gives_the_walls_of_a_room(camera, rng):
    """The plane fit makes up for the gaps between points, on slanted walls too."""
    cloud = cloud_of(camera, rng, room_ranges)
    pixels = some_pixels(camera, rng)
    points, known = PointCloudLift(lambda: cloud, camera, POSE)(pixels)
    bearings = camera.unproject(pixels)[0]
    truth = bearings * room_ranges(bearings)[:, None]
    error = np.linalg.norm(transform(POSE, points) - truth, axis=1)[known]
    assert known.mean() > 0.85
    assert np.median(error) < 2e-3 and np.quantile(error, 0.95) < 0.1


def test_far_ground_seen_at_a_grazing_angle_is_exact(rng):
    """A road 1.5 m below, 15 to 25 m ahead: ranges of neighbours differ by a third, yet they are one plane."""
    x, z = rng.uniform(-10, 10, 40_000), rng.uniform(3, 60, 40_000)
    cloud = (np.column_stack([x, np.full_like(x, 1.5), z]) - POSE[:, 3]) @ POSE[:, :3]
    truth = np.column_stack([rng.uniform(-4, 4, 200), np.full(200, 1.5), rng.uniform(15, 25, 200)])
    points, known = PointCloudLift(lambda: cloud, FISHEYE, POSE)(FISHEYE.project(truth)[0])
    error = np.linalg.norm(transform(POSE, points) - truth, axis=1)[known]
    assert known.mean() > 0.9
    assert np.median(error) < 0.02 and np.quantile(error, 0.9) < 0.5


@CAMERAS
def test_nothing_is_seen_through_a_near_surface(camera, rng):
    """A sparse near screen before a dense far wall: no pixel on the screen gets a point of the wall."""
    near = rng.uniform((-1, -1, 2), (1, 1, 2), (2500, 3))
    far = rng.uniform((-12, -12, 8), (12, 12, 8), (120_000, 3))
    cloud = (np.vstack([near, far]) - POSE[:, 3]) @ POSE[:, :3]
    screen = rng.uniform((-0.9, -0.9, 2), (0.9, 0.9, 2), (300, 3))
    points, known = PointCloudLift(lambda: cloud, camera, POSE)(camera.project(screen)[0])
    assert known.mean() > 0.3
    assert np.allclose(transform(POSE, points[known])[:, 2], 2.0, atol=0.15)
    wall = np.array([[6.5, -6.0, 8.0], [-7.0, 3.0, 8.0]])
    points, known = PointCloudLift(lambda: cloud, camera, POSE)(camera.project(wall)[0])
    assert known.all() and np.allclose(transform(POSE, points), wall, atol=0.02)


def test_cloud_across_the_seam(rng):
    cloud = cloud_of(PANORAMA, rng, room_ranges)
    pixels = np.column_stack([np.tile([0.0, 0.3, 359.6], 20), np.repeat(np.linspace(40, 140, 20), 3)])
    points, known = PointCloudLift(lambda: cloud, PANORAMA, POSE)(pixels)
    bearings = PANORAMA.unproject(pixels)[0]
    truth = bearings * room_ranges(bearings)[:, None]
    assert known.mean() > 0.7
    assert np.median(np.linalg.norm(transform(POSE, points) - truth, axis=1)[known]) < 5e-3


@pytest.mark.parametrize("cloud", [np.empty((0, 3)), np.full((5, 3), np.nan), np.full((4, 3), 1e30)])
def test_empty_and_broken_clouds_give_no_point(cloud):
    points, known = PointCloudLift(lambda: cloud, replace(FISHEYE), POSE)(np.array([[160.0, 120.0]]))
    assert points.shape == (1, 3)
    assert not known.any() or not np.isnan(points[known]).any()


def test_a_cloud_of_wrong_shape_is_refused():
    with pytest.raises(InputError, match=r"shape \(4, 2\)"):
        PointCloudLift(lambda: np.ones((4, 2)), FISHEYE, POSE)(np.array([[1.0, 1.0]]))


@settings(max_examples=60)
@given(st.integers(0, 12), st.integers(1, 12), st.floats(0.1, 50.0), st.integers(0, 2**32 - 1))
def test_sfm_takes_the_nearest_keypoint(known, asked, radius_px, seed):
    """Against all distances."""
    random = np.random.default_rng(seed)
    pixels, points = random.uniform(0, 100, (known, 2)), random.normal(size=(known, 3))
    wanted = random.uniform(0, 100, (asked, 2))
    lifted, has = SfmLift(pixels, points, radius_px)(wanted)
    distance = np.linalg.norm(wanted[:, None] - pixels[None], axis=2).reshape(asked, known)
    assert has.tolist() == (distance < radius_px).any(axis=1).tolist()
    if has.any():
        assert np.array_equal(lifted[has], points[distance[has].argmin(axis=1)])
    assert np.isnan(lifted[~has]).all()


def test_sfm_leaves_out_points_that_are_not_finite():
    lift = SfmLift(np.array([[5.0, 5.0], [6.0, 5.0]]), np.array([[np.nan, 0, 0], [1.0, 2, 3]]))
    points, has = lift(np.array([[5.0, 5.0], [np.nan, 1.0]]))
    assert has.tolist() == [True, False] and points[0].tolist() == [1.0, 2.0, 3.0]
