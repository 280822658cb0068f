"""Cells of yaw and position: they must never deny what a pose of the region explains, and settle small regions."""

import numpy as np
import pytest
from small_problems import tight_problem
from test_dual_proof import explained_by, most_in_region, region_around

from spherloc.consensus.level_pose import bounded_matches
from spherloc.consensus.pair_arcs import YawInterval
from spherloc.consensus.region_proof import FOUND, IMPOSSIBLE, UNKNOWN, Region, search_region

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def matches_of(problem):
    return bounded_matches(problem.aligned, problem.bounds)


@pytest.mark.parametrize("bound_px", [0.5, 4.0, 30.0])
@pytest.mark.parametrize("wide", [0.03, 0.3, 3.0])
def test_never_denies_what_a_pose_explains(rng, wide, bound_px):
    answers = {FOUND: 0, IMPOSSIBLE: 0, UNKNOWN: 0}
    for _ in range(25):
        count = int(rng.integers(4, 13))
        problem = tight_problem(rng, count, int(rng.integers(0, count // 2 + 1)), bound_px)
        region = region_around(rng, problem, wide)
        best = most_in_region(rng, problem, region)
        everybody = rng.permutation(count)
        before = everybody.copy()
        for floor in range(max(0, best - 2), count):
            found = np.full(5, np.nan)
            answer, cells = search_region(matches_of(problem), region, everybody, floor, 1500, found)
            assert 0 < cells <= 1500
            if answer == IMPOSSIBLE:
                assert best <= floor, f"a pose explains {best}, which was proven to be {floor} at most"
            if answer == FOUND:
                assert explained_by(problem, found, everybody) > floor
            answers[answer] += 1
        np.testing.assert_array_equal(everybody, before)
    assert answers[FOUND] > 20 and answers[IMPOSSIBLE] > 10, answers


def test_a_region_next_to_the_truth_is_no_region_with_it(rng):
    """Points around at known distances, the camera a metre off: proven, however the region's cells are split."""
    for _ in range(10):
        problem = tight_problem(rng, 10, 0, 0.5, nearest=3.0)
        yaw, shift = problem.yaw + 0.2, np.array([1.0, 0.0, 0.0])
        yaws = YawInterval(np.cos(yaw), np.sin(yaw), 0.02)
        region = Region(yaws, np.array([*(problem.centre + shift), 0.1]))
        found = np.full(5, np.nan)
        assert search_region(matches_of(problem), region, np.arange(10), 6, 4000, found)[0] == IMPOSSIBLE


def test_limit_of_cells_is_kept_and_confessed(rng):
    """An answer that few cells give is that of many; where they do not suffice nothing is claimed."""
    unknown = 0
    for _ in range(10):
        problem = tight_problem(rng, 10, 1, 4.0)
        region = region_around(rng, problem, 1.0)
        found = np.full(5, np.nan)
        answers = []
        for limit in (1, 10, 100, 4000):
            answer, cells = search_region(matches_of(problem), region, np.arange(10), 8, limit, found)
            assert cells <= limit
            answers.append(answer)
        known = {answer for answer in answers if answer != UNKNOWN}
        assert len(known) <= 1
        unknown += answers.count(UNKNOWN)
    assert unknown > 5
