"""The loops that kernels share do what numpy does."""

import numpy as np
import pytest

from spherloc.small_arrays import elements, indices_of_true, mark_within, sort_between, sum_of_squares


@pytest.mark.parametrize("distinct", [1, 3, 10_000])
def test_numbers_are_sorted(distinct: int) -> None:
    """Few distinct ones and sorted ones are where a quicksort goes wrong."""
    rng = np.random.default_rng(distinct)
    for count in [*range(50), 500, 3000]:
        values = rng.integers(0, distinct, count).astype(float)
        for given in (values, np.sort(values), -np.sort(values)):
            expected = np.sort(given)
            sort_between(given, 0, count - 1)
            np.testing.assert_array_equal(given, expected)


def test_infinite_numbers_are_sorted() -> None:
    values = np.array([np.inf, 1.0, -np.inf, 0.0] * 20)
    expected = np.sort(values)
    sort_between(values, 0, len(values) - 1)
    np.testing.assert_array_equal(values, expected)


def test_masks_and_indices() -> None:
    rng = np.random.default_rng(0)
    for count in range(20):
        errors, limits, mask = rng.random(count), rng.random(count), np.empty(count, np.bool_)
        assert mark_within(errors, limits, mask) == np.count_nonzero(errors <= limits)
        np.testing.assert_array_equal(mask, errors <= limits)
        assert sum_of_squares(errors, mask) == pytest.approx(np.sum(errors[mask] ** 2))
        np.testing.assert_array_equal(indices_of_true(mask), np.flatnonzero(mask))
        np.testing.assert_array_equal(elements(np.arange(count) * 3, indices_of_true(mask)), np.flatnonzero(mask) * 3)
