"""Bins of yaw: each lists just the arcs that touch it, and its bound is none below the clique number."""

import networkx as nx
import numpy as np
import pytest
from pair_samples import sample

from spherloc.consensus.pair_arcs import CIRCLE, pair_arcs
from spherloc.consensus.yaw_bins import BIN_TURN, BINS, degree_bounds, sort_into_bins
from spherloc.watch import Watch

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

BOARD = Watch().board


def touched(lo, hi):
    """(A, BINS) whether some turn of the arc, which may go round, lies in the half-open bin."""
    start = np.arange(2 * BINS) * BIN_TURN
    meets = (lo[:, None] < start + BIN_TURN) & (hi[:, None] >= start)
    return meets[:, :BINS] | meets[:, BINS:]


def numbered(lo, hi):
    """The bins' arcs by number: arc k is the only one of the pair (k, k + 1)."""
    number = np.arange(len(lo), dtype=np.int32)
    starts, edges = sort_into_bins(np.column_stack([number, number + 1]), lo, hi, BOARD)
    assert edges.shape == (starts[-1], 2)
    np.testing.assert_array_equal(edges[:, 1], edges[:, 0] + 1)
    return starts, edges[:, 0]


def check(lo, hi):
    starts, arcs = numbered(lo, hi)
    assert starts[0] == 0 and starts[-1] == len(arcs)
    expected = touched(lo, hi)
    for b in range(BINS):
        mine = arcs[starts[b] : starts[b + 1]]
        assert len(set(mine)) == len(mine), "an arc is listed twice"
        np.testing.assert_array_equal(np.sort(mine), np.flatnonzero(expected[:, b]), err_msg=f"bin {b}")


def test_random_arcs(rng):
    lo = rng.uniform(0, CIRCLE, 400)
    check(lo, lo + CIRCLE * rng.random(400) ** 3)


def test_ends_on_the_edges_of_bins(rng):
    """An arc that ends where a bin begins has a yaw in it; one that begins there has none in the bin before."""
    lo = rng.integers(0, BINS, 300) * BIN_TURN
    width = rng.choice([0, 1, 2, BINS - 1, BINS, BINS // 2], 300) * BIN_TURN
    check(lo, lo + width)
    nearly = np.nextafter(lo + BIN_TURN, 0.0)
    check(nearly, nearly + width)
    check(lo, np.nextafter(lo + BIN_TURN, 0.0))


def test_seam_and_whole_circles():
    lo = np.array([np.nextafter(CIRCLE, 0), 3.999, 0.0, 1.3, 3.9999, 0.0])
    hi = np.array([CIRCLE, 4.001, CIRCLE, 1.3 + CIRCLE, 7.9999, 0.0])
    check(lo, hi)
    starts, arcs = numbered(lo, hi)
    assert all({2, 3, 4} <= set(arcs[starts[b] : starts[b + 1]].tolist()) for b in range(BINS))


def test_no_arcs():
    starts, arcs = numbered(np.empty(0), np.empty(0))
    assert (starts == 0).all() and len(arcs) == 0


@pytest.mark.parametrize("count, bound", [(4, 0.01), (12, 0.01), (12, 0.2), (25, 0.05), (40, 0.02)])
def test_bounds_are_none_below_the_clique_number(rng, count, bound):
    """Every bin's whole graph, against an exact solver; two arcs of a pair in a bin are one edge."""
    s = sample(rng, bound, count)
    pairs, lo, hi = pair_arcs(s.aligned, s.bound_rad)
    starts, edges = sort_into_bins(pairs, lo, hi, BOARD)
    bounds = degree_bounds(count, starts, edges, BOARD)
    slack = []
    for b in range(0, BINS, 4):
        graph = nx.empty_graph(count)
        graph.add_edges_from(edges[starts[b] : starts[b + 1]].tolist())
        number = nx.max_weight_clique(graph, weight=None)[1]
        assert number <= bounds[b] <= count
        slack.append(bounds[b] - number)
    assert np.median(slack) <= 0.3 * count


def test_bounds_of_known_graphs():
    """All pairs, none, one, a star: its centre has many edges but its cliques have two nodes."""
    count = 9
    every = np.column_stack(np.triu_indices(count, 1)).astype(np.int32)
    star = every[every[:, 0] == 0]
    for pairs, expected in ((every, count), (every[:0], 1), (every[:1], 2), (star, 2)):
        starts, edges = sort_into_bins(pairs, np.zeros(len(pairs)), np.full(len(pairs), CIRCLE), BOARD)
        assert (degree_bounds(count, starts, edges, BOARD) == expected).all()
