"""The search over positions: no pose of a cell beats what is said of the cell, and none at all beats the result."""

from dataclasses import replace

import networkx as nx
import numpy as np
import pytest

from benchmarks.certificate import check
from spherloc.bounds import bounds_of
from spherloc.consensus import positions
from spherloc.consensus.pair_arcs import CIRCLE, pair_arcs, turn_of
from spherloc.consensus.pose_cells import (
    AXES,
    CHARTS,
    pack_matches,
    parameters_of,
    place_cell,
    pose_of,
    whole_domain,
)
from spherloc.consensus.pose_search import CUT_BINS, FORM, cut_cell, sort_matches
from spherloc.consensus.positions import search_positions
from spherloc.consensus.stabbing import EVERYWHERE, deepest, keep_possible, scratch_for
from spherloc.geometry import pose
from spherloc.refine import inlier_counts, residuals_px
from spherloc.watch import working_s

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

BOUND_PX = 3.0
TILT_RAD = 0.06


def tilted(scene_of, seed, bound_rad, **changes):
    """A simulated problem with a gravity bound, and its true pose; both between the aligned frames."""
    given = {"correspondences": 40, "outlier_rate": 0.5, "noise_px": 1.0} | changes
    problem = scene_of(("mei", "fisheye", "panorama")[seed % 3], **given).problem(seed)
    aligned = replace(problem.aligned, gravity_bound_rad=bound_rad)
    return aligned, aligned.align_pose(problem.truth_cam_from_map)


def test_every_pose_is_in_one_of_the_charts(rng, scene_of):
    aligned, _ = tilted(scene_of, 0, TILT_RAD)
    matches = pack_matches(aligned, BOUND_PX)
    lower, upper = whole_domain(TILT_RAD)
    seen = set()
    for reach in (0.1, 1.0, 10.0, 1e5):
        for _ in range(100):
            axis = rng.standard_normal(3) * [1, 0, 1]
            inside = matches.middle + reach * matches.scale * rng.uniform(-1, 1, 3)
            at = np.array([0, 0, 0, rng.uniform(-np.pi, np.pi), *(0.7 * TILT_RAD * axis[::2] / np.linalg.norm(axis))])
            rotation = pose_of(matches, 0, at)[:, :3]
            given = pose(rotation, -rotation @ inside)
            chart, found = parameters_of(matches, given)
            assert (lower[chart] - 1e-12 <= found).all() and (found <= upper[chart] + 1e-12).all()
            np.testing.assert_allclose(found[3:], at[3:], atol=1e-9)
            back = pose_of(matches, chart, found)
            np.testing.assert_allclose(back[:, :3], rotation, atol=1e-9)
            np.testing.assert_allclose(-back[:, :3].T @ back[:, 3], inside, atol=1e-8 * reach * matches.scale)
            seen.add(chart)
    assert seen == set(range(CHARTS))


def random_cell(rng, seed, matches, truth, bound_rad):
    """Chart, ends (6,) each, and the pose's parameters (6,) that it lies around: a third anywhere, others the truth."""
    chart, at = parameters_of(matches, truth)
    at[4:] = np.clip(at[4:], -bound_rad / 2, bound_rad / 2)
    if seed % 3 == 0:  # any cell; the others are around a pose that explains much
        chart = int(rng.integers(CHARTS))
        domain = whole_domain(bound_rad)
        at = rng.uniform(domain[0][chart], domain[1][chart])
    half = 10.0 ** rng.uniform(-4.0, -0.3, AXES)
    half[4:] = np.minimum(half[4:], bound_rad) if bound_rad else 0.0
    middle = at + rng.uniform(-1, 1, AXES) * half
    lower, upper = middle - half, middle + half
    if chart:
        lower[(chart - 1) // 2] = max(lower[(chart - 1) // 2], 1e-6)
        upper[(chart - 1) // 2] = max(upper[(chart - 1) // 2], 2e-6)
    return chart, lower, upper, at


@pytest.mark.parametrize("bound_rad", [0.0, TILT_RAD])
def test_many_poses_obey_the_bounds_of_their_cells(rng, scene_of, bound_rad):
    """What a cell excludes no pose of it explains, what it is sure of each explains, yaws are in their intervals."""
    checked = decided = cut = better = 0
    for seed in range(48):
        aligned, truth = tilted(scene_of, seed % 12, bound_rad)
        matches, count = pack_matches(aligned, BOUND_PX), len(aligned.points)
        chart, lower, upper, at = random_cell(rng, seed, matches, truth, bound_rad)
        cell, reach, spread, kept = np.empty(16), np.empty(6), np.empty(2), np.empty(count, np.int32)
        place_cell(chart, lower, upper, cell)
        everybody = np.arange(count, dtype=np.int32)
        axis = (chart - 1) // 2 if chart else -1
        forms = np.empty((count, FORM))
        sure, undecided, _ = sort_matches(matches, cell, axis, everybody, kept, forms, -1, reach)
        open_ones = np.isin(everybody, kept[:undecided])
        known = pose_of(matches, chart, np.clip(at, lower, upper))
        cutoff = max(0, np.count_nonzero(open_ones & (residuals_px(aligned, known) <= BOUND_PX)) - 1)
        left_lower, left_upper, steps = lower.copy(), upper.copy(), np.empty(CUT_BINS + 1, np.int32)
        most, share = cut_cell(forms[:undecided], left_lower, left_upper, steps, cutoff, reach)
        cut += share < 0.5
        scratch = scratch_for(count)
        possible = np.empty(count, np.int32)
        many, free = keep_possible(matches, cell, everybody, possible, scratch, -1, spread)
        starts, ends = scratch.starts[:many].copy(), scratch.ends[:many].copy()
        depth = deepest(scratch, many, free, -1, np.full(256, count, np.int32))
        decided += count - undecided
        mates = []
        for k in range(90):
            share = rng.uniform(0, 1, AXES) if k % 3 else rng.integers(0, 2, AXES)
            here = np.minimum(lower + share * (upper - lower), upper)
            if k % 5 == 0 and (lower <= at).all() and (at <= upper).all():
                here = at
            explained = residuals_px(aligned, pose_of(matches, chart, here)) <= BOUND_PX
            mates.append(explained)
            assert np.count_nonzero(explained) <= min(sure + undecided, depth)
            if np.count_nonzero(explained[open_ones]) > cutoff:
                better += 1
                assert np.count_nonzero(explained[open_ones]) <= most
                assert (left_lower <= here).all() and (here <= left_upper).all(), "a pose that explains more is cut off"
            checked += count
            turn = turn_of(here[3:4])[0]
            inside = (turn - starts) % CIRCLE <= np.where(ends < EVERYWHERE, (ends - starts) % CIRCLE, CIRCLE) + 1e-12
            assert np.isin(np.flatnonzero(explained), possible[:many][inside]).all()
        always = np.all(mates, axis=0) & ~open_ones
        assert np.count_nonzero(always) >= sure, "what is surely explained is not"
        assert not np.any(np.any(mates, axis=0) & ~open_ones & ~always), "what is surely not explained is"
    assert checked >= 140_000 and decided >= 140 and cut >= 5 and better >= 50, (cut, better)


def most_of_cell(matches, chart, lower, upper):
    """What no pose of a cell exceeds: the smaller of the bounds by derivatives and by intervals of yaw."""
    count = len(matches.rows)
    everybody, kept, scratch = np.arange(count, dtype=np.int32), np.empty(count, np.int32), scratch_for(count)
    cell, axis = np.empty(16), (chart - 1) // 2 if chart else -1
    place_cell(chart, lower, upper, cell)
    sure, undecided, _ = sort_matches(matches, cell, axis, everybody, kept, np.empty((count, FORM)), -1, np.empty(6))
    many, free = keep_possible(matches, cell, everybody, kept, scratch, -1, np.empty(2))
    return min(sure + undecided, deepest(scratch, many, free, -1, np.full(256, count, np.int32)))


def poses_of(matches, chart, at):
    """``pose_of`` of many parameters (K, 6): poses (K, 3, 4)."""
    (cy, ca, cc), (sy, sa, sc) = np.cos(at[:, 3:].T), np.sin(at[:, 3:].T)
    turns = np.empty((len(at), 3, 3))
    turns[:, 0] = np.column_stack([cc * cy, -sc, cc * sy])
    turns[:, 1] = np.column_stack([ca * sc * cy + sa * sy, ca * cc, ca * sc * sy - sa * cy])
    turns[:, 2] = np.column_stack([sa * sc * cy - ca * sy, sa * cc, sa * sc * sy + ca * cy])
    c, scale = at[:, :3].copy(), np.ones(len(at))
    if chart:
        axis = (chart - 1) // 2
        scale, c[:, axis] = at[:, axis], 1.0 if chart % 2 else -1.0
    centres = matches.middle + matches.scale * c / scale[:, None]
    return np.concatenate([turns, -turns @ centres[:, :, None]], axis=2)


@pytest.mark.parametrize("bound_rad", [0.0, TILT_RAD])
def test_no_pose_explains_more_than_its_cell_allows(rng, scene_of, bound_rad):
    """Over a million random poses in all, with exact and with uncertain gravity: in the middle, at corners, and near a
    pose that explains much."""
    problems = [tilted(scene_of, seed, bound_rad) for seed in range(12)]
    packed = [pack_matches(aligned, BOUND_PX) for aligned, _ in problems]
    checked = seed = telling = reached = 0
    while checked < 510_000:
        (aligned, truth), matches = problems[seed % 12], packed[seed % 12]
        chart, lower, upper, at = random_cell(rng, seed, matches, truth, bound_rad)
        inside = lower + rng.uniform(0, 1, (1000, AXES)) * (upper - lower)
        inside[::4] = np.where(rng.random((250, AXES)) < 0.5, lower, upper)
        near = at + 10.0 ** rng.uniform(-4, 0, (500, 1)) * (inside[::2] - at)
        inside[1::2] = np.clip(near, lower, upper)
        # A cell's bounds are about poses within the gravity bound.
        inside = inside[np.cos(inside[:, 4]) * np.cos(inside[:, 5]) >= matches.least_cosine]
        if len(inside):
            poses = poses_of(matches, chart, inside)
            np.testing.assert_allclose(poses[0], pose_of(matches, chart, inside[0]), rtol=1e-12, atol=1e-12)
            explained = inlier_counts(aligned, poses, BOUND_PX)
            most = most_of_cell(matches, chart, lower, upper)
            assert explained.max() <= most
            telling += most < len(aligned.points)
            reached += 1 < explained.max() == most
        checked, seed = checked + len(inside), seed + 1
    assert telling >= 0.5 * seed and reached >= 50, (telling, reached, seed)


@pytest.mark.parametrize("seed", [0, 3, 9, 13, 17, 19, 26, 30, 31, 33, 36, 44])
def test_against_brute_force(seed):
    """Exact and uncertain gravity, seven kinds of geometry: nothing beats what is proven."""
    one = check(seed)
    assert one.found <= one.upper_bound and one.lower_bound <= one.upper_bound
    assert one.found <= one.lower_bound or one.lower_bound < one.upper_bound


@pytest.mark.parametrize("seed", [1052, 1178, 1346, 1388])
def test_near_vertical_bearings_do_not_use_up_the_effort(seed):
    """Yaw hardly moves them, and so their bounds must not be wide where only yaw is."""
    one = check(seed)
    assert one.found <= one.lower_bound == one.upper_bound


@pytest.mark.parametrize("seed", [1376, 1983])
def test_a_start_that_is_far_too_low_is_replaced(seed):
    """The first guess explains 2 of the 12 and of the 5 that one pose explains; the search alone does not get there."""
    one = check(seed)
    assert one.found <= one.lower_bound == one.upper_bound


def everything(aligned, start=None, effort=10**9):
    return search_positions(aligned, pack_matches(aligned, BOUND_PX), start, effort, working_s() + 600.0)


@pytest.mark.parametrize(("bound_rad", "size", "rate"), [(0.0, 30, 0.8), (0.005, 10, 0.6)])
def test_no_larger_than_the_largest_clique_of_pairs(scene_of, bound_rad, size, rate):
    """What one pose explains agrees in pairs, wherever the camera is and however it is tilted."""
    for seed in range(20):
        aligned, _ = tilted(scene_of, seed, bound_rad, correspondences=size, outlier_rate=rate)
        found = everything(aligned)
        pairs, _, _ = pair_arcs(aligned, bounds_of(aligned, BOUND_PX).radians)
        largest = max(len(clique) for clique in nx.find_cliques(nx.Graph(pairs.tolist())))
        assert found.finished and found.support <= largest
        assert np.count_nonzero(residuals_px(aligned, found.pose) <= BOUND_PX) == found.support


def test_the_start_and_the_threads_do_not_matter(scene_of, monkeypatch):
    """Rounds of small tasks, one thread or four: the same pose; from the truth: the same bound."""
    monkeypatch.setattr(positions, "FIRST_EFFORT", 2000)
    monkeypatch.setattr(positions, "TASK_EFFORT", 3000)
    monkeypatch.setattr(positions, "TASK_ROUNDS", 1)
    aligned, truth = tilted(scene_of, 1, 0.01, correspondences=60, outlier_rate=0.6)
    results = []
    for threads in (1, 4):
        monkeypatch.setattr(positions, "threads_to_use", lambda threads=threads: threads)
        results.append(everything(aligned))
    first, second = results
    assert first.finished and (first.support, first.upper, first.effort) == (
        second.support,
        second.upper,
        second.effort,
    )
    np.testing.assert_array_equal(first.pose, second.pose)
    level = parameters_of(pack_matches(aligned, BOUND_PX), truth)
    level[1][4:] = 0.0
    start = pose_of(pack_matches(aligned, BOUND_PX), *level)
    explained = int(np.count_nonzero(residuals_px(aligned, start) <= BOUND_PX))
    again = everything(aligned, (start, explained))
    assert again.finished and again.upper == first.upper


def test_a_search_that_stops_says_what_is_left(scene_of):
    aligned, _ = tilted(scene_of, 2, 0.02, correspondences=80, outlier_rate=0.8)
    full = everything(aligned)
    uppers = []
    for effort in (1, 10_000, 100_000, 1_000_000):
        part = everything(aligned, effort=effort)
        assert part.upper >= full.support >= part.support
        assert part.pose is None or np.count_nonzero(residuals_px(aligned, part.pose) <= BOUND_PX) == part.support
        uppers.append(part.upper)
    assert uppers[0] == len(aligned.points)
    late = search_positions(aligned, pack_matches(aligned, BOUND_PX), None, 10**9, working_s() - 1.0)
    assert late.upper == len(aligned.points) and late.pose is None
