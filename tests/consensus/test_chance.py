"""What chance explains: the formulas against counting, and the rate against bearings that are really drawn."""

from math import comb, inf

import numpy as np
import pytest

from spherloc.consensus.chance import chance_rate, least_size, nfa

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("rate", [1e-4, 0.03, 0.5, 1.0])
def test_nfa_is_the_formula(rate):
    for count in (2, 3, 10, 30):
        for size in range(2, count + 1):
            expected = comb(count, size) * rate ** (size - 2)
            assert nfa(count, size, rate) == pytest.approx(expected, rel=1e-9)


def test_less_than_two_fix_no_pose():
    assert nfa(7, 1, 0.1) == 7.0
    assert nfa(7, 0, 0.1) == 7.0


def test_huge_numbers_stay_finite():
    assert np.isfinite(nfa(10_000, 5000, 1.0))
    assert nfa(10_000, 5000, 1e-300) == 0.0


def test_more_chance_with_a_higher_rate_and_more_correspondences():
    for size in (3, 6, 12):
        by_rate = [nfa(40, size, rate) for rate in (1e-5, 1e-3, 0.1, 1.0)]
        by_count = [nfa(count, size, 0.01) for count in (12, 20, 50, 400)]
        assert by_rate == sorted(by_rate) and len(set(by_rate)) == 4
        assert by_count == sorted(by_count) and len(set(by_count)) == 4


def test_larger_sets_are_less_likely_where_chance_is_small():
    values = [nfa(100, size, 1e-3) for size in range(2, 60)]
    assert values == sorted(values, reverse=True)


@pytest.mark.parametrize("expected", [1e-6, 1.0, 1000.0])
def test_least_size_is_the_first_that_is_rare_enough(expected):
    for count, rate in ((10, 0.01), (100, 1e-3), (100, 0.05), (3000, 1e-4)):
        size = least_size(count, rate, expected)
        assert nfa(count, size, rate) <= expected
        assert all(nfa(count, smaller, rate) > expected for smaller in range(2, size))


def test_least_size_of_what_chance_always_explains():
    assert least_size(50, 1.0, 1e-6) == 50
    assert least_size(50, 0.1, inf) == 2


def met(rng, bearings, bounds, trials):
    """How often a bearing drawn from among all falls within the bound of another one."""
    a, b = rng.integers(0, len(bearings), (2, trials))
    keep = a != b
    cosine = np.sum(bearings[a] * bearings[b], axis=1)[keep]
    return np.mean(cosine >= np.cos(bounds[a][keep]))


@pytest.mark.parametrize("bound", [0.01, 0.05, 0.2])
def test_rate_of_bearings_all_around(rng, bound):
    """The area of the cap over that of the sphere, which is also how often they meet."""
    bearings = unit(rng.normal(size=(4000, 3)))
    rates = [chance_rate(bearings[rng.permutation(4000)], np.full(4000, bound)) for _ in range(20)]
    assert np.mean(rates) == pytest.approx(0.5 * (1 - np.cos(bound)), rel=0.1)
    assert np.mean(rates) == pytest.approx(met(rng, bearings, np.full(4000, bound), 4_000_000), rel=0.15)


def test_rate_of_bearings_in_a_corner_of_the_image(rng):
    """Ten times as near to each other, a hundred times as often by chance."""
    bearings = unit(np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.3, 0.3, (2000, 3)) * [1, 1, 0])
    bounds = rng.uniform(0.01, 0.05, 2000)
    around = chance_rate(unit(rng.normal(size=(2000, 3))), bounds)
    assert chance_rate(bearings, bounds) > 20 * around
    assert chance_rate(bearings, bounds) == pytest.approx(met(rng, bearings, bounds, 4_000_000), rel=0.25)


def test_rate_is_a_probability_and_never_zero(rng):
    """Two bearings far apart say nothing about the density, and a rate of 0 would make its logarithm a warning."""
    apart = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert 0.0 < chance_rate(apart, np.full(2, 0.01)) < 1.0
    assert chance_rate(apart, np.full(2, 1e-9)) > 0.0
    same = np.repeat(apart[:1], 10, axis=0)
    assert chance_rate(same, np.full(10, 1.0)) == 1.0
