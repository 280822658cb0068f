"""Balls bound: the true camera position is never outside, and their centres are the paper's Eq. 27."""

import numpy as np
import pytest
from pair_samples import aligned_problem, sample, unit

from spherloc.consensus.translation_balls import (
    edges_of,
    overlapping,
    share_of_each,
    smallest_balls,
    spread_balls,
    translation_balls,
)
from spherloc.consensus.yaw_arcs import deepest_yaw, yaw_arcs
from spherloc.geometry import yaw_rotation

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.mark.parametrize("bound", (1e-6, 1e-4, 1e-3, 1e-2, 0.05, 0.2))
@pytest.mark.parametrize("slack", (0.0, 1e-3, 0.03, 0.5))
def test_true_position_is_never_outside(rng, bound, slack):
    """Over 4 * 10^5 pairs in all, at the true yaw and at yaws within the slack, ends included."""
    for _ in range(20):
        s = sample(rng, bound)
        pairs = s.pairs.astype(np.int32)
        mine = slack * rng.uniform(0.3, 1.0)
        yaw = s.yaw + mine * rng.choice([-1.0, 1.0, rng.uniform(-1, 1)])
        centres, radii = translation_balls(s.aligned, s.bound_rad, pairs, yaw, np.full(len(pairs), mine))
        assert not np.isnan(centres).any() and (radii >= 0).all()
        hopeless = s.bounds_nothing(pairs)
        np.testing.assert_array_equal(np.isinf(radii), hopeless)
        distance = np.linalg.norm(centres - s.centre, axis=1)
        outside = ~hopeless & (distance > radii * (1 + 1e-9) + 1e-9)
        assert not outside.any(), f"{pairs[outside].tolist()}: {distance[outside]} m off, radii {radii[outside]} m"


def test_each_pair_has_its_own_slack(rng):
    """Growing one pair's slack grows its ball and no other."""
    s = sample(rng, 1e-3, 12)
    pairs = s.pairs.astype(np.int32)
    pairs = pairs[~s.bounds_nothing(pairs)]
    slack = np.full(len(pairs), 1e-3)
    _, before = translation_balls(s.aligned, s.bound_rad, pairs, s.yaw, slack)
    slack[5] = 2e-3
    _, after = translation_balls(s.aligned, s.bound_rad, pairs, s.yaw, slack)
    assert (after != before).nonzero()[0].tolist() == [5] and after[5] > before[5]


@pytest.mark.parametrize("slack", (0.0, 1e-3))
def test_balls_are_not_needlessly_large(rng, slack):
    """Median radius against the largest error that noise on the bound and a yaw at the end of the slack produce."""
    ratios = []
    pairs, times = np.array([[0, 1]], np.int32), 100
    apart = np.arange(2 * times, dtype=np.int32).reshape(-1, 2)
    for _ in range(200):
        v, depths = unit(rng.normal(size=(2, 3))), rng.uniform(1, 10, (2, 1))
        p, bounds = depths * v, np.full(2, 1e-3)
        centres = np.empty((0, 3))
        for yaw in (-slack, slack):
            away = unit(np.cross(np.tile(v, (times, 1)), rng.normal(size=(2 * times, 3))))
            moved = unit(np.cos(1e-3) * np.tile(v, (times, 1)) + np.sin(1e-3) * away)
            moved = aligned_problem(moved, np.tile(p, (times, 1)))
            found, _ = translation_balls(moved, np.full(2 * times, 1e-3), apart, yaw, np.zeros(times))
            centres = np.vstack([centres, found])
        radius = translation_balls(aligned_problem(v, p), bounds, pairs, 0.0, np.full(1, slack))[1][0]
        ratios.append(radius / np.linalg.norm(centres, axis=1).max())
    assert min(ratios) > 0.98  # smaller: noise of twice the bound was needed to leave the ball
    assert np.median(ratios) < 1.2


def paper_eq_25_to_27(v, p, yaw):
    """The paper's least squares for t; its H loses rank for horizontal bearings."""
    c, s = np.cos(yaw), np.sin(yaw)
    H, b = [], []
    for (xc, yc, zc), (x, y, z) in zip(v, p, strict=True):
        H += [[yc, -xc, 0.0], [0.0, -zc, yc]]
        b += [y * xc - yc * x * c - yc * z * s, y * zc - yc * z * c + yc * x * s]
    return np.linalg.lstsq(np.array(H), np.array(b), rcond=None)[0]


def test_centre_is_the_position_of_eq_27_without_noise(rng):
    for _ in range(200):
        v, yaw, centre = unit(rng.normal(size=(2, 3))), rng.uniform(-np.pi, np.pi), rng.uniform(-5, 5, 3)
        p = centre + (rng.uniform(1, 10, (2, 1)) * v) @ yaw_rotation(yaw)
        pairs = np.array([[0, 1]], np.int32)
        found = translation_balls(aligned_problem(v, p), np.full(2, 1e-9), pairs, yaw, np.zeros(1))[0][0]
        t = paper_eq_25_to_27(v, p, yaw)
        np.testing.assert_allclose(found, -yaw_rotation(yaw).T @ t, atol=1e-7)
        np.testing.assert_allclose(found, centre, atol=1e-10 / np.linalg.norm(np.cross(*v)) ** 2)


def test_centre_is_where_the_rays_come_closest(rng):
    """With noise and at a wrong yaw: the least squares of both distances, horizontal bearings included."""
    s = sample(rng, 0.05, 20)
    yaw = s.yaw + 0.1
    pairs = s.pairs.astype(np.int32)
    pairs = pairs[~s.bounds_nothing(pairs)]
    centres, _ = translation_balls(s.aligned, s.bound_rad, pairs, yaw, np.zeros(len(pairs)))
    for (i, j), centre in zip(pairs, centres, strict=True):
        rays = s.aligned.bearings[[i, j]] @ yaw_rotation(yaw)
        projectors = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        points = s.aligned.points[[i, j]]
        b = np.einsum("kab,kb->ka", projectors, points)
        expected = np.linalg.lstsq(np.vstack(projectors), b.ravel(), rcond=None)[0]
        scale = np.linalg.norm(points[0] - points[1]) / np.linalg.norm(np.cross(*rays)) ** 2
        np.testing.assert_allclose(centre, expected, atol=1e-11 * scale)


@pytest.mark.parametrize("most", [1, 2, 17, 100, 5000])
@pytest.mark.parametrize("bound", [1e-3, 0.02])
def test_smallest_balls_are_the_first_of_all_balls_sorted(rng, bound, most):
    """Against all balls and a stable sort; every correspondence is there twice, so that balls are equal in fours."""
    s = sample(rng, bound, 40)
    twice = aligned_problem(np.repeat(s.aligned.bearings, 2, axis=0), np.repeat(s.aligned.points, 2, axis=0))
    bounds = np.repeat(s.bound_rad, 2)
    pairs, lo, hi = yaw_arcs(twice, bounds)
    found = deepest_yaw(lo, hi)
    assert found is not None and len(found.clique) > 200
    covering, yaw = found.clique, found.yaw_rad
    at = np.where(lo[covering] <= yaw, yaw, yaw + 2 * np.pi)
    slack = np.maximum(at - lo[covering], hi[covering] - at)
    for array in (lo, hi, covering):
        array.setflags(write=False)
    centres, radii = translation_balls(twice, bounds, pairs[covering], yaw, slack)
    first = np.argsort(radii, kind="stable")[:most]
    small, small_centres, small_radii = smallest_balls(twice, bounds, (pairs, lo, hi), covering, yaw, most)
    np.testing.assert_array_equal(small, pairs[covering][first])
    np.testing.assert_array_equal(small_centres, centres[first])
    np.testing.assert_array_equal(small_radii, radii[first])


@pytest.mark.parametrize("most", [3, 25, 60, 5000])
def test_spread_balls_are_the_smallest_that_leave_room_for_others(rng, most):
    """Against a plain loop over all balls; what is taken is taken in the order of size."""
    s = sample(rng, 0.01, 60)
    pairs, lo, hi = yaw_arcs(s.aligned, s.bound_rad)
    found = deepest_yaw(lo, hi)
    assert found is not None
    arcs, data = (pairs, lo, hi), (s.aligned, s.bound_rad)
    for array in (lo, hi, found.clique):
        array.setflags(write=False)
    every, centres, radii = smallest_balls(*data, arcs, found.clique, found.yaw_rad, 10**6)
    share = share_of_each(60, most)
    kept, kept_centres, kept_radii, bounded = spread_balls(*data, arcs, found.clique, found.yaw_rad, most, share)
    used, expected = np.zeros(60, int), []
    for place, pair in enumerate(every):
        if len(every) <= most or (len(expected) < most and (used[pair] < share).all()):
            used[pair] += 1
            expected.append(place)
    assert bounded == len(every) > 60
    np.testing.assert_array_equal(kept, every[expected])
    np.testing.assert_array_equal(kept_centres, centres[expected])
    np.testing.assert_array_equal(kept_radii, radii[expected])


def test_each_has_a_larger_share_where_there_are_few():
    assert [share_of_each(count, 500) for count in (50, 100, 200, 400, 500, 800, 5000)] == [200, 50, 13, 4, 2, 1, 1]


def test_smallest_balls_leave_out_pairs_that_bound_nothing(rng):
    """Two equal bearings have no ball, whatever arc they are given."""
    v, p = unit(rng.normal(size=(3, 3))), rng.uniform(-5, 5, (3, 3))
    v[1] = v[0]
    pairs = np.array([[0, 1], [0, 2], [1, 2]], np.int32)
    arcs, every = (pairs, np.full(3, -0.1), np.full(3, 0.1)), np.arange(3, dtype=np.int32)
    for array in (*arcs[1:], every):
        array.setflags(write=False)
    small, _, radii = smallest_balls(aligned_problem(v, p), np.full(3, 1e-3), arcs, every, 0.0, 10)
    assert sorted(map(tuple, small.tolist())) == [(0, 2), (1, 2)] and np.isfinite(radii).all()
    none = smallest_balls(aligned_problem(v, p), np.full(3, 1e-3), arcs, every[:1], 0.0, 10)
    assert [len(part) for part in none] == [0, 0, 0]


@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_edges_are_the_upper_triangle(rng, count):
    matrix = overlapping(rng.uniform(-3, 3, (count, 3)), rng.uniform(0, 2, count))
    edges = edges_of(matrix)
    assert edges.dtype == np.int32 and edges.shape[1:] == (2,)
    np.testing.assert_array_equal(edges, np.argwhere(np.triu(matrix)))


@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_overlapping_by_brute_force(rng, count):
    centres, radii = rng.uniform(-3, 3, (count, 3)), rng.uniform(0, 2, count)
    matrix = overlapping(centres, radii)
    assert matrix.shape == (count, count) and matrix.dtype == bool
    for a in range(count):
        for b in range(count):
            touch = bool(np.linalg.norm(centres[a] - centres[b]) <= radii[a] + radii[b])
            assert matrix[a, b] == (a != b and touch)


def test_balls_that_touch_overlap():
    """Eq. 38 is closed."""
    centres = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 2.25, 0.0]])
    np.testing.assert_array_equal(
        overlapping(centres, np.array([1.0, 2.0, 0.125])),
        [[False, True, False], [True, False, False], [False, False, False]],
    )
