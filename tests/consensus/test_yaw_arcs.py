"""Yaw arcs bound: the true yaw is never outside, the arcs are what the conditions say, and no wider than need be."""

import numpy as np
import pytest
from pair_samples import aligned_problem, sample, unit

from spherloc.consensus.pair_sinusoids import chord, pair_sinusoids
from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.geometry import yaw_rotation
from spherloc.solvers.two_point import two_point

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

BOUNDS = (1e-6, 1e-4, 1e-3, 1e-2, 0.05, 0.2, 0.6)
TWO_PI = 2 * np.pi


def covered(yaw, lo, hi):
    """Whether closed arcs cover a yaw, which may be given with any number of turns."""
    offset = (yaw - lo) % TWO_PI
    return (offset <= hi - lo) | (offset >= TWO_PI - 1e-13)


def pair_number(pairs, count):
    return pairs[:, 0].astype(np.int64) * count + pairs[:, 1]


@pytest.mark.parametrize("bound", BOUNDS)
def test_true_yaw_is_never_outside(rng, bound):
    """Over 10^6 pairs in all, half of the errors exactly on the bound: an arc that excludes the truth is a lie."""
    checked = 0
    while checked < 1_000_000 / len(BOUNDS):
        s = sample(rng, bound)
        pairs, lo, hi = yaw_arcs(s.aligned, s.bound_rad)
        count = len(s.bound_rad)
        true = np.zeros(count * count, dtype=bool)
        true[pair_number(pairs[covered(s.yaw, lo, hi)], count)] = True
        every = s.pairs
        missed = every[~true[pair_number(every, count)] & ~s.bounds_nothing(every)]
        assert len(missed) == 0, f"pairs {missed.tolist()} exclude the true yaw {s.yaw}"
        checked += len(every) - np.count_nonzero(s.bounds_nothing(every))


@pytest.mark.parametrize("bound", BOUNDS)
def test_depth_bounds_hold(rng, bound):
    """The upper bounds S on the true depths, tau on |f|, and the measured depths, each against its definition."""
    for _ in range(10):
        s = sample(rng, bound)
        v, p, eps = s.aligned.bearings, s.aligned.points, s.bound_rad
        at = np.array([np.cos(s.yaw), np.sin(s.yaw), 1.0])
        pairs = s.pairs
        pairs = pairs[rng.choice(len(pairs), 150, replace=False)]
        for (i, j), hopeless in zip(pairs, s.bounds_nothing(pairs), strict=True):
            chords, sines = chord(eps[[i, j]]), np.sin(eps[[i, j]])
            sine, *waves = pair_sinusoids(v[i], v[j], p[i], p[j], *chords, *sines)
            assert (sine == 0.0) == hopeless
            if hopeless:
                continue
            f, si, sj, most_i, most_j, tau = np.array(waves) @ at
            w = yaw_rotation(s.yaw) @ (p[i] - p[j])
            normal = np.cross(v[i], v[j])
            depths = np.linalg.lstsq(np.column_stack([v[i], -v[j]]), w, rcond=None)[0]
            size = np.linalg.norm(w)
            assert sine == pytest.approx(np.linalg.norm(normal))
            assert abs(f - normal @ w) <= 1e-12 * size
            np.testing.assert_allclose([si, sj], depths, atol=1e-11 * size / sine**2)
            assert s.true_depths[i] <= most_i * (1 + 1e-9) and s.true_depths[j] <= most_j * (1 + 1e-9)
            assert abs(f) <= tau * (1 + 1e-9) + 1e-13 * size


def conditions(v, p, eps, grid):
    """min over the four conditions (pairs, yaws), in units of the points' distance, from their definitions."""
    w = np.einsum("gab,pb->pga", np.array([yaw_rotation(yaw) for yaw in grid]), p[:, 0] - p[:, 1])
    normal = np.cross(v[:, 0], v[:, 1])
    sine = np.linalg.norm(normal, axis=1)
    f = np.einsum("pa,pga->pg", normal, w)
    dual_i = np.cross(v[:, 1], normal) / sine[:, None] ** 2
    dual_j = np.cross(v[:, 0], normal) / sine[:, None] ** 2
    si, sj = np.einsum("pa,pga->pg", dual_i, w), np.einsum("pa,pga->pg", dual_j, w)
    g = (2 * np.sin(eps / 2) / sine[:, None])[..., None]
    gi, gj = g[:, 0], g[:, 1]
    most_i = ((1 - gj) * si + gj * sj) / (1 - gi - gj)
    most_j = ((1 - gi) * sj + gi * si) / (1 - gi - gj)
    tau = sine[:, None] * (np.sin(eps[:, :1]) * most_i + np.sin(eps[:, 1:]) * most_j)
    return np.min([tau - f, tau + f, most_i, most_j], axis=0) / np.linalg.norm(p[:, 0] - p[:, 1], axis=1)[:, None]


@pytest.mark.parametrize("bound", (1e-3, 1e-2, 0.05, 0.2, 0.6))
def test_arcs_are_where_the_conditions_hold(rng, bound):
    """The closed form against a fine grid of yaws: wrong roots, lost arcs, bad wrapping and double cover show here."""
    grid = np.linspace(-np.pi, np.pi, 2001)
    arcs_a_pair, wraps = [], 0
    for yaw in (None, None, np.pi):
        s = sample(rng, bound, 30, yaw)
        pairs, lo, hi = yaw_arcs(s.aligned, s.bound_rad)
        assert (-np.pi <= lo).all() and (lo < np.pi).all() and (lo <= hi).all() and (hi <= lo + TWO_PI).all()
        every = s.pairs[~s.bounds_nothing(s.pairs)]
        assert {tuple(pair) for pair in pairs} <= {tuple(pair) for pair in every}
        value = conditions(s.aligned.bearings[every], s.aligned.points[every], s.bound_rad[every], grid)
        for pair, holds in zip(every, value, strict=True):
            mine = (pairs == pair).all(axis=1)
            times = covered(grid[:, None], lo[mine], hi[mine]).sum(axis=1)
            clear = np.abs(holds) > 1e-9
            np.testing.assert_array_equal(times[clear], holds[clear] > 0, err_msg=f"pair {pair}")
            arcs_a_pair.append(int(mine.sum()))
        wraps += np.count_nonzero(hi > np.pi)
    assert wraps > 100
    assert {1, 2} <= set(arcs_a_pair)


def test_every_number_of_arcs_occurs(rng):
    """None (impossible pair), one joined over a double root, one around each root, and the full circle."""
    seen = set()
    for _ in range(2000):
        v, p = unit(rng.normal(size=(2, 3))), rng.uniform(-5, 5, (2, 3))
        _, lo, hi = yaw_arcs(aligned_problem(v, p), np.full(2, 0.1))
        seen.add("full" if (hi - lo >= TWO_PI).any() else len(lo))
    assert {0, 1, 2} <= seen
    # Seen from between the points, their rays hold for every yaw if both look along the axis.
    tilt = unit(np.array([[0.05, 1.0, 0.0], [0.0, -1.0, 0.05]]))
    _, lo, hi = yaw_arcs(aligned_problem(tilt, np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])), np.full(2, 0.04))
    np.testing.assert_allclose(hi - lo, TWO_PI)


@pytest.mark.parametrize("bound, most", [(1e-4, 1.001), (1e-3, 1.01), (1e-2, 1.05)])
def test_arcs_are_not_needlessly_wide(rng, bound, most):
    """Median ratio to the range of yaws that bearings moved by the bound really reach, found by sampling."""
    circle = np.linspace(0, TWO_PI, 16, endpoint=False)
    ratios = []
    while len(ratios) < 300:
        v, depths = unit(rng.normal(size=(2, 3))), rng.uniform(1, 10, (2, 1))
        yaw = rng.uniform(-np.pi, np.pi)
        p = (depths * v) @ yaw_rotation(yaw)
        _, lo, hi = yaw_arcs(aligned_problem(v, p), np.full(2, bound))
        mine = np.flatnonzero(covered(yaw, lo, hi))
        assert len(mine) == 1
        lo, hi = lo[mine[0]], hi[mine[0]]
        normal = unit(np.cross(v[0], v[1]))
        moved = []
        for bearing in v:
            side = np.cross(bearing, normal)
            away = np.cos(circle)[:, None] * normal + np.sin(circle)[:, None] * side
            moved.append(np.cos(bound) * bearing + np.sin(bound) * away)
        batch = np.stack([np.repeat(moved[0], 16, axis=0), np.tile(moved[1], (16, 1))], axis=1)
        yaws, _, valid = two_point(batch, np.broadcast_to(p, (256, 2, 3)))
        offset = (yaws[valid] - lo) % TWO_PI
        inside = offset <= hi - lo
        if hi - lo > 0.2 or not inside.any():
            continue
        ratios.append((hi - lo) / np.ptp(offset[inside]))
    assert min(ratios) > 1 - 1e-6
    assert np.median(ratios) < most


def test_widest_leaves_out_wide_arcs_only(rng):
    s = sample(rng, 0.05)
    pairs, lo, hi = yaw_arcs(s.aligned, s.bound_rad)
    narrow = hi - lo <= 0.5
    assert narrow.any() and not narrow.all()
    for got, expected in zip(yaw_arcs(s.aligned, s.bound_rad, 0.5), (pairs, lo, hi), strict=True):
        np.testing.assert_array_equal(got, expected[narrow])


def test_coincident_bearings_and_points_give_no_arcs(rng):
    """They say nothing; a division by zero would show as NaN ends or as a warning."""
    v, p = unit(rng.normal(size=(4, 3))), rng.uniform(-5, 5, (4, 3))
    v[1], p[3] = v[0], p[2]
    pairs, lo, hi = yaw_arcs(aligned_problem(v, p), np.full(4, 1e-3))
    assert np.isfinite(lo).all() and np.isfinite(hi).all()
    found = {tuple(map(int, pair)) for pair in pairs}
    assert not found & {(0, 1), (2, 3)}
    opposite = aligned_problem(np.array([v[0], -v[0]]), p[:2])
    assert len(yaw_arcs(opposite, np.full(2, 1e-3))[0]) == 0
    assert len(yaw_arcs(aligned_problem(v[:1], p[:1]), np.full(1, 1e-3))[0]) == 0
