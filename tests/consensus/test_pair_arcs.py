"""Arcs of the exact search: the true yaw is never outside, they hold the arcs of ``yaw_arcs``, and turns are yaws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pair_samples import aligned_problem, sample, unit

from spherloc.consensus import pair_rows
from spherloc.consensus.arc_block import BLOCK
from spherloc.consensus.pair_arcs import CIRCLE, direction_of_turn, pair_arcs, turn_of, yaws_between
from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.watch import Cancelled, Watch

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

BOUNDS = (1e-4, 1e-3, 1e-2, 0.05, 0.2)
yaws = st.floats(-np.pi, np.pi)
turns = st.floats(0.0, CIRCLE, exclude_max=True)


def covered(turn, lo, hi, slack=0.0):
    """Whether arcs cover a turn."""
    offset = (turn - lo) % CIRCLE
    return (offset <= hi - lo + slack) | (offset >= CIRCLE - slack)


def by_pair(pairs, count):
    return pairs[:, 0].astype(np.int64) * count + pairs[:, 1]


def check_ends(pairs, lo, hi):
    assert np.isfinite(lo).all() and np.isfinite(hi).all()
    assert ((lo >= 0) & (lo < CIRCLE) & (lo <= hi) & (hi <= lo + CIRCLE)).all()
    assert (pairs[:, 0] < pairs[:, 1]).all()


@pytest.mark.parametrize("bound", BOUNDS)
def test_true_yaw_is_never_outside(rng, bound):
    """Over a million pairs in all; bounded errors of every direction, half of them as large as may be."""
    checked = 0
    while checked < 1_050_000 / len(BOUNDS):
        s = sample(rng, bound, 60, rng.choice([None, 0.0, np.pi, 0.5 * np.pi]))
        pairs, lo, hi = pair_arcs(s.aligned, s.bound_rad)
        check_ends(pairs, lo, hi)
        count = len(s.bound_rad)
        # No slack: where rounding decides, the arcs must be the wider ones.
        held = np.unique(by_pair(pairs[covered(turn_of(np.array(s.yaw)), lo, hi, 4e-15)], count))
        missed = np.setdiff1d(by_pair(s.pairs, count), held)
        assert len(missed) == 0, f"pairs {[divmod(int(k), count) for k in missed]} exclude the true yaw {s.yaw}"
        checked += len(s.pairs)


def moved(rng, bearings, bound):
    """Bearings turned by exactly the bound."""
    away = np.cross(bearings, rng.normal(size=bearings.shape))
    return unit(np.cos(bound) * bearings + np.sin(bound) * unit(away))


@pytest.mark.parametrize("bound", BOUNDS)
@pytest.mark.parametrize("kind", ["level", "vertical", "nearly parallel", "near", "one above the other"])
def test_true_yaw_is_inside_where_pairs_are_special(rng, kind, bound):
    """The cases in which roots meet, sinusoids have no amplitude, or depths nearly vanish."""
    for _ in range(40):
        yaw, count = rng.uniform(-np.pi, np.pi), 24
        bearings, depths = unit(rng.normal(size=(count, 3))), rng.uniform(0.5, 20, (count, 1))
        if kind == "level":
            bearings[:, 1] *= rng.choice([0.0, 1e-9, 1e-4])
        elif kind == "vertical":
            bearings[:, ::2] *= rng.choice([0.0, 1e-9, 1e-3])
            bearings[: count // 2] += rng.normal(0, 0.3, (count // 2, 3))
        elif kind == "nearly parallel":
            bearings = rng.choice([-1, 1], (count, 1)) * bearings[0] + rng.uniform(1.0, 6.0) * bound * bearings
        elif kind == "near":
            depths *= 1e-4
        bearings = unit(bearings)
        s, c = np.sin(yaw), np.cos(yaw)
        points = (depths * bearings) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        if kind == "one above the other":
            points[1::2, ::2] = points[::2, ::2]
            bearings = unit(points @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T)
        pairs, lo, hi = pair_arcs(aligned_problem(moved(rng, bearings, bound), points), np.full(count, bound))
        check_ends(pairs, lo, hi)
        held = np.unique(by_pair(pairs[covered(turn_of(np.array(yaw)), lo, hi, 4e-15)], count))
        assert len(held) == count * (count - 1) // 2


@pytest.mark.parametrize("arcs_of", [pair_arcs, yaw_arcs])
def test_threads_change_nothing(rng, monkeypatch, arcs_of):
    s = sample(rng, 1e-2, 60)
    monkeypatch.setattr(pair_rows, "processor_count", lambda: 1)
    watch = Watch()
    alone = arcs_of(s.aligned, s.bound_rad, watch=watch)
    monkeypatch.setattr(pair_rows, "processor_count", lambda: 3)
    monkeypatch.setattr(pair_rows, "MIN_PAIRS", 0)
    assert len(alone[0]) > 300
    for one, other in zip(alone, arcs_of(s.aligned, s.bound_rad), strict=True):
        np.testing.assert_array_equal(one, other)
    watch.cancel()
    with pytest.raises(Cancelled):
        arcs_of(s.aligned, s.bound_rad, watch=watch)


@pytest.mark.parametrize("bound", BOUNDS)
def test_they_hold_the_arcs_in_radians(rng, bound):
    """``yaw_arcs`` has the same conditions and cuts its arcs where a depth changes its sign: never outside these."""
    checked = 0
    for _ in range(12):
        s = sample(rng, bound, 40)
        count = len(s.bound_rad)
        pairs, lo, hi = pair_arcs(s.aligned, s.bound_rad)
        by = by_pair(pairs, count)
        exact_pairs, exact_lo, exact_hi = yaw_arcs(s.aligned, s.bound_rad)
        # Points along each arc, its ends included: all of them must lie in one of the pair's arcs.
        along = exact_lo[:, None] + np.linspace(0, 1, 9) * (exact_hi - exact_lo)[:, None]
        inside = np.zeros(along.shape, dtype=bool)
        for shift in range(2):
            order = np.argsort(by, kind="stable")
            place = np.searchsorted(by[order], by_pair(exact_pairs, count)) + shift
            mine = order[np.minimum(place, len(order) - 1)]
            same = (place < len(order)) & (by[mine] == by_pair(exact_pairs, count))
            inside |= same[:, None] & covered(turn_of(along), lo[mine, None], hi[mine, None], 1e-12)
        assert inside.all(), f"{np.argwhere(~inside).shape[0]} of {inside.size} yaws lie outside"
        checked += len(exact_pairs)
    assert checked > 2000


@pytest.mark.parametrize("bound", [1e-4, 1e-3, 1e-2])
def test_arcs_are_hardly_wider(rng, bound):
    """Arcs of the whole circle would pass every other test."""
    s = sample(rng, bound, 60)
    usable = s.pairs[~s.bounds_nothing(s.pairs)]
    width = np.zeros((2, 60, 60))
    for k, arcs in enumerate((pair_arcs(s.aligned, s.bound_rad), yaw_arcs(s.aligned, s.bound_rad))):
        np.add.at(width[k], tuple(arcs[0].T), arcs[2] - arcs[1])
    # A radian is between half a turn and one.
    ratio = width[0][tuple(usable.T)] / width[1][tuple(usable.T)]
    assert 0.5 <= np.median(ratio) <= 1.0
    assert np.mean(ratio <= 1.001) > 0.9


def test_pairs_that_no_yaw_explains_have_no_arc(rng):
    s = sample(rng, 1e-3, 60)
    wrong = aligned_problem(s.aligned.bearings, rng.permutation(s.aligned.points))
    found = [{tuple(pair) for pair in arcs(wrong, s.bound_rad)[0].tolist()} for arcs in (pair_arcs, yaw_arcs)]
    hopeless = {tuple(pair) for pair in s.pairs[s.bounds_nothing(s.pairs)].tolist()}
    assert found[1] <= found[0]
    assert len(found[0] - found[1] - hopeless) < 0.05 * len(s.pairs)
    assert len(found[0]) < 0.8 * len(s.pairs)


def test_pairs_that_bound_nothing_have_the_whole_circle(rng):
    v, p = unit(rng.normal(size=(4, 3))), rng.uniform(-5, 5, (4, 3))
    v[1], p[3] = v[0], p[2]
    pairs, lo, hi = pair_arcs(aligned_problem(v, p), np.full(4, 1e-3))
    for pair in ((0, 1), (2, 3)):
        mine = (pairs == pair).all(axis=1)
        assert mine.sum() == 1 and lo[mine][0] == 0.0 and hi[mine][0] == CIRCLE
    assert len(pair_arcs(aligned_problem(v[:1], p[:1]), np.full(1, 1e-3))[0]) == 0


@given(yaws)
def test_turn_and_back(yaw):
    turn = float(turn_of(np.array(yaw)))
    assert 0.0 <= turn < CIRCLE
    c, s = direction_of_turn(turn)
    assert c == pytest.approx(np.cos(yaw), abs=8e-15) and s == pytest.approx(np.sin(yaw), abs=8e-15)


@given(turns, st.integers(-2, 2))
def test_direction_and_back(turn, circles):
    """Ends of arcs may lie beyond the circle."""
    c, s = direction_of_turn(turn + circles * CIRCLE)
    assert c * c + s * s == pytest.approx(1.0, abs=1e-14)
    apart = (float(turn_of(np.arctan2(s, c))) - turn + 2.0) % CIRCLE - 2.0
    assert abs(apart) < 1e-14


@given(st.lists(st.floats(0.0, 2 * np.pi, exclude_max=True), min_size=2, max_size=20))
def test_turns_grow_with_yaw(angles):
    values = np.sort(np.array(angles))
    assert (np.diff(turn_of(values)) >= -1e-15).all() or np.ptp(values) > 6.28318
    clear = np.diff(values) > 1e-12
    assert (np.diff(turn_of(values))[clear] > 0).all() or values[-1] > 6.283185


def test_turns_at_the_corners_of_the_square():
    angles = np.array([0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi, 0.25 * np.pi])
    np.testing.assert_allclose(turn_of(angles), [0.0, 1.0, 2.0, 3.0, 0.5], atol=1e-15)
    assert (np.array([turn_of(np.array(yaw)) for yaw in (-1e-17, -1e-300, 2 * np.pi)]) < CIRCLE).all()


@given(st.floats(-np.pi, np.pi), st.floats(1e-9, 3.0))
def test_middle_holds_all_of_the_arc(start, width):
    """Half width, rad, must reach both ends, across the seam too."""
    lo, hi = float(turn_of(np.array(start))), float(turn_of(np.array(start + width)))
    hi += CIRCLE if hi < lo else 0.0
    c, s, half = yaws_between(lo, hi)
    middle = np.arctan2(s, c)
    for yaw in (start, start + width):
        assert abs((yaw - middle + np.pi) % (2 * np.pi) - np.pi) <= half + 2e-15
    assert half == pytest.approx(0.5 * width, abs=1e-11)


def test_arcs_of_a_pair_do_not_depend_on_the_other_matches(rng):
    """Pairs are done in blocks, the last of a row a shorter one."""
    count = 2 * BLOCK + 9
    s = sample(rng, 1e-2, count)
    v, p = s.aligned.bearings, rng.permutation(s.aligned.points)
    pairs, lo, hi = pair_arcs(aligned_problem(v, p), s.bound_rad)
    numbers = set()
    for i, j in [(0, 1), (0, BLOCK), (0, BLOCK + 1), (count - 2, count - 1), *rng.integers(0, count, (200, 2))]:
        if i < j:
            _, *ends = pair_arcs(aligned_problem(v[[i, j]], p[[i, j]]), s.bound_rad[[i, j]])
            mine = (pairs == (i, j)).all(axis=1)
            np.testing.assert_array_equal([lo[mine], hi[mine]], ends)
            numbers.add(int(mine.sum()))
    assert numbers == {0, 1, 2}
