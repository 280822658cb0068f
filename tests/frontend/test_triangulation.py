"""Triangulation of synthetic observations, exact and spoilt."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.frontend.triangulation import triangulated
from spherloc.geometry import pose, so3_exp, transform

CAMERAS = (
    KannalaBrandt(640, 480, 240.0, 241.0, 317.0, 237.0, (-0.02, 0.1, -0.07, 0.01)),
    Mei(700, 700, 660.0, 660.0, 350.0, 351.0, 2.2, (0.02, 1.5, 0.0004, 0.0004)),
    Equirectangular(1024, 512),
)
BOUND_PX, PARALLAX_RAD = 2.0, np.radians(1.0)


def looking_around(random, cameras, count=200, baseline_m=0.5):
    """Cameras near the map's origin, points around them, and all observations."""
    poses = []
    for _ in cameras:
        rotation = so3_exp(random.normal(scale=0.2, size=3))
        poses.append(pose(rotation, -rotation @ random.normal(scale=baseline_m, size=3)))
    points = random.normal(size=(count, 3)) * (2.0, 2.0, 1.0) + (0.0, 0.0, 6.0)
    pixels = [camera.project(transform(one, points))[0] for camera, one in zip(cameras, poses, strict=True)]
    return points, np.stack(poses), np.stack(pixels)


@settings(max_examples=40)
@given(st.permutations(range(3)), st.integers(2, 3), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 5e6]))
def test_exact_observations_give_exact_points(order, views, seed, far_origin):
    """Whatever the mixture of cameras, and in maps with coordinates of thousands of kilometres."""
    cameras = [CAMERAS[index] for index in order[:views]]
    points, poses, pixels = looking_around(np.random.default_rng(seed), cameras)
    shift = np.full(3, far_origin)
    poses[:, :, 3] -= poses[:, :, :3] @ shift
    found = triangulated(cameras, poses, pixels, BOUND_PX, PARALLAX_RAD)
    known = np.isfinite(found).all(axis=1)
    assert np.allclose(found[known], points[known] + shift, atol=1e-6 if far_origin else 1e-8)
    if views == 3:
        assert known.mean() > 0.8


def test_little_parallax_gives_no_point(rng):
    """Far points by a short baseline: known just where the rays of some pair are a degree apart."""
    points, poses, pixels = looking_around(rng, CAMERAS[:2], 400)
    points[:200, 2] += 100.0
    pixels = np.stack([camera.project(transform(one, points))[0] for camera, one in zip(CAMERAS, poses, strict=False)])
    found = triangulated(CAMERAS[:2], poses, pixels, BOUND_PX, PARALLAX_RAD)
    centres = np.stack([-one[:, :3].T @ one[:, 3] for one in poses])
    rays = points[None] - centres[:, None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    parallax = np.arccos((rays[0] * rays[1]).sum(axis=1))
    seen = np.isfinite(pixels).all(axis=(0, 2))
    assert np.array_equal(np.isfinite(found[:, 0]), seen & (parallax >= PARALLAX_RAD))
    assert 0 < np.isfinite(found[:, 0]).sum() < 400


def test_wrong_matches_give_no_point_and_are_outvoted(rng):
    """In one of three views, every match is wrong: the other two say where the points are."""
    points, poses, pixels = looking_around(rng, CAMERAS)
    pixels[1] = np.roll(pixels[1], 7, axis=0)
    found = triangulated(CAMERAS, poses, pixels, BOUND_PX, PARALLAX_RAD)
    known = np.isfinite(found).all(axis=1)
    error = np.linalg.norm(found - points, axis=1)
    assert known.mean() > 0.8
    assert (error[known] < 1e-6).mean() > 0.95
    alone = triangulated(CAMERAS[:2], poses[:2], pixels[:2], BOUND_PX, PARALLAX_RAD)
    assert np.isfinite(alone[:, 0]).mean() < 0.1


def test_noise_within_the_bound_is_averaged(rng):
    """Three views place a point better than the best two of them."""
    points, poses, pixels = looking_around(rng, CAMERAS, 600)
    pixels = pixels + rng.normal(scale=0.4, size=pixels.shape)

    def error(views):
        part = [CAMERAS[view] for view in views]
        found = triangulated(part, poses[views], pixels[views], BOUND_PX, PARALLAX_RAD)
        return np.nanmedian(np.linalg.norm(found - points, axis=1))

    assert error([0, 1, 2]) < min(error([0, 1]), error([0, 2])) < 0.2


def test_points_behind_a_camera_are_refused(rng):
    """Rays that meet behind both cameras: mirrored bearings obey every epipolar plane."""
    camera = CAMERAS[2]
    points = rng.normal(size=(100, 3)) + np.array([0.0, 0.0, 5.0])
    poses = np.stack([pose(np.eye(3), np.zeros(3)), pose(np.eye(3), np.array([-1.0, 0.0, 0.0]))])
    pixels = np.stack([camera.project(-transform(one, points))[0] for one in poses])
    assert np.isnan(triangulated([camera, camera], poses, pixels, BOUND_PX, PARALLAX_RAD)).all()


@pytest.mark.parametrize("same", [True, False])
def test_cameras_at_one_place_give_no_point(rng, same):
    """A camera that only turned sees no parallax, with or without noise."""
    points, poses, _ = looking_around(rng, CAMERAS[:2], 50)
    poses[1] = poses[0] if same else pose(so3_exp(np.array([0.0, 0.3, 0.0])) @ poses[0][:, :3], poses[0][:, 3])
    if not same:
        poses[1][:, 3] = so3_exp(np.array([0.0, 0.3, 0.0])) @ poses[0][:, 3]
    pixels = np.stack([camera.project(transform(one, points))[0] for camera, one in zip(CAMERAS, poses, strict=False)])
    pixels += rng.normal(scale=0.0 if same else 0.3, size=pixels.shape)
    assert np.isnan(triangulated(CAMERAS[:2], poses, pixels, BOUND_PX, PARALLAX_RAD)).all()


def test_one_view_or_no_features_give_no_point(rng):
    _, poses, pixels = looking_around(rng, CAMERAS)
    assert np.isnan(triangulated(CAMERAS[:1], poses[:1], pixels[:1], BOUND_PX, PARALLAX_RAD)).all()
    assert triangulated(CAMERAS, poses, pixels[:, :0], BOUND_PX, PARALLAX_RAD).shape == (0, 3)
    pixels[1:] = np.nan
    assert np.isnan(triangulated(CAMERAS, poses, pixels, BOUND_PX, PARALLAX_RAD)).all()
