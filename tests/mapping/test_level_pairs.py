"""Two level cameras from three matches: against known poses, with few right matches, and when all are wrong."""

import numpy as np
import pytest

from spherloc.geometry import pose, rotation_angle, so3_exp, transform, yaw_rotation
from spherloc.mapping.two_view.level_pairs import chance_of_fit, fitting, level_pair, log10_nfa


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def two_cameras(rng, matches, right, noise_rad=0.002):
    """Bearings of ``matches`` in two tilted cameras, ``right`` of which are right, down in both, and the pose."""
    points = rng.normal(size=(matches, 3)) * [3.0, 1.0, 3.0]
    level = pose(yaw_rotation(rng.uniform(-np.pi, np.pi)), unit(rng.normal(size=3) * [1.0, 0.1, 1.0]))
    tilts = [so3_exp(0.1 * rng.normal(size=3)) for _ in range(2)]
    second = transform(level, points)
    second[right:] = second[right:][rng.permutation(matches - right)]
    rays = [unit(rows @ tilt.T) for rows, tilt in zip((points, second), tilts, strict=True)]
    rays = [unit(one + noise_rad * rng.normal(size=one.shape)) for one in rays]
    down = tuple(unit(tilt[:, 1] + 0.003 * rng.normal(size=3)) for tilt in tilts)
    order = rng.permutation(matches)
    turn = tilts[1] @ level[:, :3] @ tilts[0].T
    return rays[0][order], rays[1][order], down, turn, unit(tilts[1] @ level[:, 3]), order < right


def test_a_tenth_of_right_matches_is_enough(rng):
    """Of 400 matches 40 are right."""
    found = 0
    for _ in range(20):
        first, second, down, turn, direction, right = two_cameras(rng, 400, 40)
        pair = level_pair(first, second, down, np.radians(1.0))
        if rotation_angle(pair.rotation @ turn.T) < np.radians(3.0) and pair.direction @ direction > np.cos(0.25):
            found += 1
            assert pair.fits[right].mean() > 0.6 and pair.fits[~right].mean() < 0.05
    assert found >= 17


def test_what_fits_is_near_its_plane_and_in_front(rng):
    first, second, _, turn, direction, right = two_cameras(rng, 300, 150, noise_rad=0.0)
    fits = fitting(first, second, turn, direction, 1e-6)
    assert fits[right].all() and not fits[~right].any()
    assert not fitting(first, second, turn, -direction, 1e-6).any()  # behind both
    # By hand: the angle of the second bearing to the plane of the first and the direction.
    bound = np.radians(2.0)
    normals = unit(np.cross(direction, first @ turn.T))
    planes = unit(np.cross(direction, second))
    off = np.maximum(
        np.abs(np.arcsin(np.sum(normals * second, axis=1))),
        np.abs(np.arcsin(np.sum(planes * (first @ turn.T), axis=1))),
    )
    assert not fitting(first, second, turn, direction, bound)[off > 1.01 * bound].any()


def test_chance_is_counted_over_all_pairings(rng):
    first, second, _, turn, direction, _ = two_cameras(rng, 60, 60)
    bound = np.radians(1.0)
    all_pairs = [
        fitting(np.repeat(first[i : i + 1], 60, axis=0), second, turn, direction, bound).sum() for i in range(60)
    ]
    assert chance_of_fit(first, second, turn, direction, bound) == pytest.approx((sum(all_pairs) + 1) / 3601)


def test_wrong_matches_fit_no_pose_beyond_chance(rng):
    """Without a right match the best pose is chance; with forty right ones it is not."""
    for right, believed in ((0, False), (40, True)):
        for _ in range(5):
            first, second, down, *_ = two_cameras(rng, 200, right)
            bound = np.radians(1.0)
            pair = level_pair(first, second, down, bound)
            chance = chance_of_fit(first, second, pair.rotation, pair.direction, bound)
            assert (log10_nfa(200, int(pair.fits.sum()), chance) < -1.0) == believed


def test_too_few_matches_have_no_pose():
    rays = unit(np.ones((2, 3)))
    assert level_pair(rays, rays, (np.array([0.0, 1.0, 0.0]),) * 2, 0.01) is None
    assert log10_nfa(200, 4, 0.01) == np.inf
