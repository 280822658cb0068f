"""From a clique to a pose: what it claims to explain, fits that lose nothing, and the list of different poses."""

import numpy as np
import pytest
from small_problems import explained, tight_problem

from spherloc.consensus.level_pose import (
    bounded_matches,
    empty_list,
    explain_more,
    improve,
    mark_support,
    residual,
    verify,
)
from spherloc.geometry import pose, yaw_rotation
from spherloc.refine import residuals_px

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def data_of(problem):
    return bounded_matches(problem.aligned, problem.bounds)


def here_of(yaw, centre):
    return np.array([np.cos(yaw), np.sin(yaw), *centre])


def marked(problem, here):
    return explained(problem.aligned, problem.bounds, np.array([np.arctan2(here[1], here[0])]), here[None, 2:])[0]


def test_residuals_are_those_of_refinement(rng):
    """Within the angular bound; beyond it a correspondence is explained by no residual, however small."""
    for _ in range(20):
        problem = tight_problem(rng, 30, 15, 8.0)
        yaw, centre = problem.yaw + rng.normal(0, 0.02), problem.centre + rng.normal(0, 0.05, 3)
        turn, here = yaw_rotation(yaw), here_of(yaw, centre)
        expected = residuals_px(problem.aligned, pose(turn, -turn @ centre))
        mine = np.array([residual(data_of(problem), k, here, data_of(problem).least_cos[k]) for k in range(30)])
        ray = (problem.aligned.points - centre) @ turn.T
        cosine = np.sum(ray * problem.aligned.bearings, axis=1) / np.linalg.norm(ray, axis=1)
        inside = np.arccos(np.clip(cosine, -1, 1)) <= problem.bounds.radians
        np.testing.assert_allclose(mine[inside], expected[inside], rtol=1e-9)
        assert np.isinf(mine[~inside]).all() and 0 < inside.sum() < 30
        mask = np.empty(30, np.bool_)
        assert mark_support(data_of(problem), here, mask) == np.count_nonzero(mask)
        np.testing.assert_array_equal(mask, marked(problem, here))


def test_opposite_points_are_not_explained(rng):
    """The residual of a ray just behind the camera is as small as that of one in front."""
    problem = tight_problem(rng, 12, 0, 2.0, share=0.5)
    behind = 2 * problem.centre - problem.aligned.points
    behind.setflags(write=False)
    data = data_of(problem)._replace(points=behind)
    mask = np.ones(12, np.bool_)
    assert mark_support(data, here_of(problem.yaw, problem.centre), mask) == 0 and not mask.any()


def test_fits_never_lose(rng):
    """What is returned explains what its mask says, and never less than the start or than the members can have."""
    gained = 0
    for _ in range(100):
        problem = tight_problem(rng, 14, 4, 3.0, share=0.95, nearest=1.0)
        start = here_of(problem.yaw + rng.normal(0, 0.003), problem.centre + rng.normal(0, 0.02, 3))
        first, here, mask = marked(problem, start).sum(), start.copy(), np.empty(14, np.bool_)
        support = explain_more(data_of(problem), np.flatnonzero(problem.inliers), here, mask)
        np.testing.assert_array_equal(mask, marked(problem, here))
        assert support == mask.sum() >= first
        gained += support > first
        assert here[:2] @ here[:2] == pytest.approx(1.0, abs=1e-12)
    assert gained > 50


def test_members_near_their_bounds_are_squeezed_in(rng):
    """Least squares leaves some of them outside though the true pose explains all; Lawson's iteration gets them in."""
    whole, flat = 0, 0
    for _ in range(80):
        problem = tight_problem(rng, 12, 0, 3.0, share=0.95, nearest=1.0)
        here = here_of(problem.yaw + 0.002, problem.centre + 0.01)
        whole += explain_more(data_of(problem), np.arange(12), here, np.empty(12, np.bool_)) == 12
        least_squares = explain_more(
            data_of(problem), np.empty(0, np.int64), here_of(problem.yaw, problem.centre + 0.01), np.empty(12, np.bool_)
        )
        flat += least_squares == 12
    assert flat < 40, "the problems are too easy to tell"
    assert whole >= 68, f"{whole} of 80"


def test_members_are_squeezed_in_after_a_long_climb(rng):
    """Where the inliers still grow in the last round of least squares, those left out get their turn as well."""
    whole = 0
    for _ in range(300):
        problem = tight_problem(rng, 40, 0, 3.0, share=0.6, nearest=1.0)
        here = here_of(problem.yaw + rng.normal(0, 0.02), problem.centre + rng.normal(0, 0.1, 3))
        support = explain_more(data_of(problem), np.arange(40), here, np.empty(40, np.bool_))
        again = explain_more(data_of(problem), np.arange(40), here.copy(), np.empty(40, np.bool_))
        whole += support == again
    assert whole >= 294, f"{300 - whole} of 300 stopped too early"


def test_clique_of_inliers_gives_its_pose(rng):
    for _ in range(30):
        problem = tight_problem(rng, 16, 8, 2.0, share=0.5, nearest=1.0)
        best = empty_list(8, 16)
        verify(data_of(problem), np.flatnonzero(problem.inliers), best)
        assert best.known[0] == 1 and best.supports[0] >= problem.inliers.sum()
        np.testing.assert_array_equal(best.masks[0], marked(problem, best.poses[0]))


def test_clique_without_a_pose_adds_nothing(rng):
    """Two points seen in exchanged directions straight up and down: no yaw puts both in front."""
    problem = tight_problem(rng, 12, 0, 2.0)
    bearings = np.tile([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], (6, 1))
    points = np.tile([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]], (6, 1))
    for array in (bearings, points):
        array.setflags(write=False)
    best = empty_list(8, 12)
    verify(data_of(problem)._replace(bearings=bearings, points=points), np.array([0, 1]), best)
    assert best.known[0] == 0 and (best.supports == 0).all()


def test_list_keeps_the_best_of_clearly_different_poses(rng):
    """Against its rules: falling supports, true masks, the best never lost."""
    kept = []
    for _ in range(20):
        problem = tight_problem(rng, 40, 30, 20.0, nearest=1.0)
        found, known, best = empty_list(4, 40), 0, 0
        supports = found.supports
        for _ in range(60):
            clique = rng.choice(40, 3, replace=False)
            before = known
            verify(data_of(problem), clique, found)
            known = int(found.known[0])
            assert before <= known <= 4
            assert (np.diff(supports[:known]) <= 0).all()
            assert supports[:known].sum() == 0 or supports[0] >= best
            best = max(best, int(supports[0]))
        for k in range(known):
            np.testing.assert_array_equal(found.masks[k], marked(problem, found.poses[k]))
            assert found.masks[k].sum() == supports[k]
        kept.append(known)
    assert np.mean(kept) > 3


def test_list_replaces_a_pose_by_a_better_one_of_the_same_consensus(rng):
    problem = tight_problem(rng, 12, 0, 3.0, share=0.5, nearest=1.0)
    best, data, nothing = empty_list(8, 12), data_of(problem), np.empty(0, np.int64)
    far = here_of(problem.yaw, problem.centre + 0.05)
    improve(data, nothing, far.copy(), best)
    first = best.supports[0]
    improve(data, nothing, here_of(problem.yaw, problem.centre), best)
    assert best.known[0] == 1 and best.supports[0] == 12 >= first
    # And a worse one of the same set changes nothing.
    improve(data, nothing, far, best)
    assert best.known[0] == 1 and best.supports[0] == 12
