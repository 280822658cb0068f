"""Proofs by duality and by cells must never deny what a pose of the region explains."""

import numpy as np
import pytest
from small_problems import explained, fit, tight_problem

from spherloc.consensus import region_proof
from spherloc.consensus.level_pose import bounded_matches
from spherloc.consensus.pair_arcs import YawInterval
from spherloc.consensus.region_proof import FOUND, IMPOSSIBLE, UNKNOWN, LawsonState, Region, prove_none
from spherloc.geometry import yaw_rotation
from spherloc.watch import Watch

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

BOARD = Watch().board


def region_around(rng, problem, wide):
    """A region that holds the true pose, often at its edge."""
    slack, radius = wide * 10 ** rng.uniform(-2.5, -1), wide * 10 ** rng.uniform(-2.5, -0.5)
    edge = rng.choice([0.0, 0.7, 0.999])
    away = rng.normal(size=3)
    yaw = problem.yaw + edge * slack * rng.choice([-1, 1])
    ball = np.array([*(problem.centre + edge * radius * away / np.linalg.norm(away)), radius])
    return Region(YawInterval(np.cos(yaw), np.sin(yaw), slack), ball)


def matches_of(problem):
    return bounded_matches(problem.aligned, problem.bounds)


def most_in_region(rng, problem, region):
    """The largest consensus found inside by sampling, and by fits to what good samples explain; the truth is one."""
    (c, s, slack), ball = region
    middle = np.arctan2(s, c)
    yaws = middle + slack * rng.uniform(-1, 1, 600)
    away = rng.normal(size=(600, 3))
    away *= (rng.random((600, 1)) ** (1 / 3)) / np.linalg.norm(away, axis=1, keepdims=True)
    yaws, centres = np.append(yaws, problem.yaw), np.vstack([ball[:3] + ball[3] * away, problem.centre])
    masks = explained(problem.aligned, problem.bounds, yaws, centres)
    first = np.argsort(-masks.sum(axis=1), kind="stable")[:20]
    first = first[masks[first].sum(axis=1) >= 2]
    more = fit(problem.aligned, problem.bounds, yaws[first], centres[first], masks[first], 8)
    yaws, centres = np.append(yaws, more[0]), np.vstack([centres, more[1]])
    turned = np.abs((yaws - middle + np.pi) % (2 * np.pi) - np.pi)
    inside = (turned <= slack) & (np.linalg.norm(centres - ball[:3], axis=1) <= ball[3])
    assert inside[600]
    return int(explained(problem.aligned, problem.bounds, yaws[inside], centres[inside]).sum(axis=1).max())


def explained_by(problem, here, everybody):
    assert here[0] ** 2 + here[1] ** 2 == pytest.approx(1.0, abs=1e-9)
    mask = explained(problem.aligned, problem.bounds, np.array([np.arctan2(here[1], here[0])]), here[None, 2:])[0]
    return int(mask[everybody].sum())


@pytest.mark.parametrize("bound_px", [0.5, 4.0, 30.0])
@pytest.mark.parametrize("wide", [0.1, 1.0, 3.0])
def test_never_denies_what_a_pose_explains(rng, wide, bound_px):
    """Inliers with residuals just within their bounds, the pose at the region's edge: the least slack there can be."""
    answers = {FOUND: 0, IMPOSSIBLE: 0, UNKNOWN: 0}
    for _ in range(30):
        count = int(rng.integers(4, 15))
        problem = tight_problem(rng, count, int(rng.integers(0, count // 2 + 1)), bound_px)
        region = region_around(rng, problem, wide)
        best = most_in_region(rng, problem, region)
        everybody = np.arange(count)
        for floor in range(max(0, best - 2), count):
            found = np.full(5, np.nan)
            answer, effort = prove_none(matches_of(problem), region, everybody, floor, found, BOARD)
            assert effort > 0
            if answer == IMPOSSIBLE:
                assert best <= floor, f"a pose explains {best}, which was proven to be {floor} at most"
            if answer == FOUND:
                assert explained_by(problem, found, everybody) > floor
            answers[answer] += 1
    # A proof that never proves anything would be sound too.
    assert answers[FOUND] > 10 and (wide > 1.0 or answers[IMPOSSIBLE] > 50), answers


def test_only_those_asked_for_count(rng):
    """``everybody`` may be any of them, in any order."""
    proven = 0
    for _ in range(60):
        problem = tight_problem(rng, 14, 5, 3.0)
        region = region_around(rng, problem, 0.3)
        everybody = rng.permutation(14)[:8]
        inside = int(problem.inliers[everybody].sum())
        for floor in range(8):
            found = np.full(5, np.nan)
            answer, _ = prove_none(matches_of(problem), region, everybody, floor, found, BOARD)
            assert answer != IMPOSSIBLE or inside <= floor
            assert answer != FOUND or explained_by(problem, found, everybody) > floor
            proven += answer == IMPOSSIBLE
    assert proven > 50


def test_what_linear_residuals_neglect_is_bounded(rng):
    """Of one correspondence in regions of all sizes: its true residual is off the linear one by the bound at most."""
    shares = []
    for _ in range(120):
        problem = tight_problem(rng, 4, 0, 3.0, nearest=0.5)
        (c, s, slack), ball = region_around(rng, problem, 10 ** rng.uniform(-1, 0.7))
        matches = matches_of(problem)
        points = matches.points
        possible = np.array([c, s, slack, *ball])
        yaw0 = np.arctan2(s, c)
        for k in range(4):
            state = LawsonState(np.array([c, s, *ball[:3]]), np.ones(1), np.empty(1))
            _, cost, _, neglected = region_proof._normal_equations(
                matches, np.array([k]), possible, state, np.empty((4, 4)), np.empty(4)
            )
            if cost == 0.0:
                continue  # too near to say anything

            def at(yaws, centres, k=k, problem=problem, points=points):
                rays = np.array([yaw_rotation(y) @ (points[k] - x) for y, x in zip(yaws, centres, strict=True)])
                rays /= np.linalg.norm(rays, axis=1, keepdims=True)
                return rays @ problem.aligned.pixel_from_bearing[k].T

            side = rng.normal(size=(40, 3))
            shift = ball[3] * side / np.linalg.norm(side, axis=1, keepdims=True)
            turn = slack * rng.choice([-1, 1], 40)
            tiny = 1e-6
            plus = at(yaw0 + tiny * turn, ball[:3] + tiny * shift)
            minus = at(yaw0 - tiny * turn, ball[:3] - tiny * shift)
            linear = at([yaw0], [ball[:3]]) + (plus - minus) / (2 * tiny)
            off = np.linalg.norm(at(yaw0 + turn, ball[:3] + shift) - linear, axis=1).max()
            assert off <= np.sqrt(neglected) * (1 + 1e-6) + 1e-6
            shares.append(off / np.sqrt(neglected))
    assert len(shares) > 200 and max(shares) > 0.5


def test_no_spare_and_no_correspondences_within_reach(rng):
    """As many as there are cannot be exceeded; and points inside the region bound nothing."""
    problem = tight_problem(rng, 6, 0, 3.0)
    region = region_around(rng, problem, 0.3)
    found = np.full(5, np.nan)
    assert prove_none(matches_of(problem), region, np.arange(6), 6, found, BOARD)[0] != FOUND
    region.ball[3] = 1e3
    assert prove_none(matches_of(problem), region, np.arange(6), 6, found, BOARD)[0] == UNKNOWN
