"""The core of a bin's graph against an exact one; bounds of bins hold, and their poses explain what they say."""

import networkx as nx
import numpy as np
import pytest
from small_problems import explained, good_poses, tight_problem

from spherloc.consensus.level_pose import bounded_matches, empty_list
from spherloc.consensus.pair_arcs import pair_arcs, turn_of
from spherloc.consensus.yaw_bins import BIN_TURN, BINS, core_graph, degree_bounds, largest_bin_cliques, sort_into_bins
from spherloc.watch import Watch

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def adjacency_of(rows):
    count = len(rows)
    return np.unpackbits(rows.view(np.uint8).reshape(count, -1), axis=1, bitorder="little")[:, :count].astype(bool)


@pytest.mark.parametrize("count, densities", [(5, (0.3, 0.8)), (20, (0.1, 0.6)), (64, (0.05, 0.2)), (65, (0.3,))])
def test_core_graph_keeps_every_larger_clique(rng, count, densities):
    """Whatever it leaves out, nodes or edges, is in no clique of more than the least, and it invents nothing."""
    thinner = 0
    for density in densities:
        every = np.column_stack(np.triu_indices(count, 1))
        edges = every[rng.random(len(every)) < density].astype(np.uint16)
        graph = nx.empty_graph(count)
        graph.add_edges_from(edges.tolist())
        given = nx.to_numpy_array(graph).astype(bool)
        before = edges.copy()
        for least in (1, 2, 3, 4, 6, count):
            nodes, rows = core_graph(count, edges, least, Watch().board)
            assert rows.shape == (len(nodes), (len(nodes) + 63) // 64)
            left = np.zeros((count, count), dtype=bool)
            if len(nodes):
                left[np.ix_(nodes, nodes)] = adjacency_of(rows)
            assert not (left & ~given).any()
            assert set(nodes.tolist()) <= set(nx.k_core(graph, least).nodes)
            for clique in nx.find_cliques(graph):
                if len(clique) > least:
                    assert set(clique) <= set(nodes.tolist())
                    assert (left[np.ix_(clique, clique)] | np.eye(len(clique), dtype=bool)).all()
            thinner += len(nodes) < count
        np.testing.assert_array_equal(edges, before)
    assert thinner > 0


def test_two_arcs_of_a_pair_are_one_edge(rng):
    """They may keep a node that has too few edges, which costs time; the edge itself is there once."""
    edges = np.array([[0, 1], [0, 1], [1, 2]], np.uint16)
    nodes, rows = core_graph(3, edges, 1, Watch().board)
    inside = adjacency_of(rows)[np.ix_(np.argsort(nodes), np.argsort(nodes))]
    np.testing.assert_array_equal(inside, [[0, 1, 0], [1, 0, 1], [0, 1, 0]])


def run(problem, floor):
    """Bounds of the bins before and after a largest_bin_cliques that knows nothing, and what it found."""
    aligned, bounds = problem.aligned, problem.bounds
    count, board = len(aligned.bearings), Watch().board
    pairs, lo, hi = pair_arcs(aligned, bounds.radians)
    starts, edges = sort_into_bins(pairs, lo, hi, board)
    before = degree_bounds(count, starts, edges, board)
    bound = before.copy()
    best = empty_list(8, count)
    order = np.argsort(-bound, kind="stable")
    largest_bin_cliques(bounded_matches(aligned, bounds), starts, edges, bound, order, floor, best, board)
    known = int(best.known[0])
    return before, bound, best.poses[:known], best.supports[:known], best.masks[:known]


@pytest.mark.parametrize("floor", [0, 2, 4])
@pytest.mark.parametrize("outliers", [0, 5, 9])
def test_bounds_hold_and_poses_explain_what_they_say(rng, outliers, floor):
    """Inliers on the edge of their bounds at the true pose: the bin of the true yaw must allow for all of them."""
    found_all, trials = 0, 4
    for _ in range(trials):
        problem = tight_problem(rng, 14, outliers, rng.choice([1.0, 5.0]), share=rng.choice([0.7, 0.999]))
        before, bound, poses, supports, masks = run(problem, floor)
        assert (bound <= before).all()
        yaws, centres = good_poses(problem.aligned, problem.bounds)
        yaws, centres = np.append(yaws, problem.yaw), np.vstack([centres, problem.centre])
        most = explained(problem.aligned, problem.bounds, yaws, centres).sum(axis=1)
        bins = np.floor(turn_of(yaws) / BIN_TURN).astype(int) % BINS
        assert (most <= bound[bins]).all(), "a pose explains more than the bound of its bin"
        assert (np.diff(supports) <= 0).all()
        mine = explained(problem.aligned, problem.bounds, np.arctan2(poses[:, 1], poses[:, 0]), poses[:, 2:])
        np.testing.assert_array_equal(mine, masks)
        np.testing.assert_array_equal(masks.sum(axis=1), supports)
        found_all += len(supports) > 0 and supports[0] >= 0.7 * problem.inliers.sum()
    if floor < 14 - outliers:
        assert found_all >= trials // 2


def test_nothing_is_looked_for_below_the_floor(rng):
    problem = tight_problem(rng, 12, 6, 2.0)
    before, bound, poses, _, _ = run(problem, 12)
    assert len(poses) == 0
    np.testing.assert_array_equal(bound, before)
