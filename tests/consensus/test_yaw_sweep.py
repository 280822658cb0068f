"""The sweep against counting by brute force, on arcs that wrap, touch, coincide, and cover the circle."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from spherloc.consensus.yaw_arcs import BINS, deepest_yaw

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

TWO_PI = 2 * np.pi
STEP = 2.0**-5
"""Ends on this lattice are exact numbers, so that arcs touch exactly."""


def turned_ends(lo, hi):
    """Ends brought below pi, exactly (hi - 2 pi is exact for pi <= hi <= 4 pi)."""
    return np.where(hi >= np.pi, hi - TWO_PI, hi)


def depths_at(yaws, lo, hi):
    """How many closed arcs cover each yaw of [-pi, pi]; both ends of that range are one yaw."""
    yaws = np.where(np.asarray(yaws) >= np.pi, -np.pi, yaws)[:, None]
    end = turned_ends(lo, hi)
    split = hi >= np.pi
    covers = np.where(split, (yaws >= lo) | (yaws <= end), (lo <= yaws) & (yaws <= end))
    return (covers | (hi - lo >= TWO_PI)).sum(axis=1)


def greatest_depth(lo, hi):
    """By trying every end: a closed arc's depth is greatest at some start."""
    return depths_at(np.concatenate([lo, turned_ends(lo, hi), [-np.pi]]), lo, hi).max()


def check(lo, hi):
    """Everything that ``deepest_yaw`` promises, by brute force."""
    found = deepest_yaw(lo, hi)
    assert found is not None
    greatest = greatest_depth(lo, hi)
    assert depths_at([found.yaw_rad], lo, hi)[0] == greatest
    covering = [k for k in range(len(lo)) if depths_at([found.yaw_rad], lo[[k]], hi[[k]])[0]]
    assert found.clique.tolist() == covering
    assert len(found.clique) == greatest

    first, last = found.interval_rad
    assert first <= last
    wrapped = (np.linspace(first, last, 9) + np.pi) % TWO_PI - np.pi
    wrapped[[0, -1]] = [end if end < np.pi else end - TWO_PI for end in (first, last)]
    assert (depths_at(wrapped, lo, hi) == greatest).all()

    edges = -np.pi + TWO_PI / BINS * np.arange(BINS + 1)
    within = edges[:-1, None] + TWO_PI / BINS * np.linspace(0.01, 0.99, 5)
    least = depths_at(within.ravel(), lo, hi).reshape(BINS, 5).max(axis=1)
    assert (found.overlap >= least).all()
    # Greatest depth of the closed bin: at a start or end in it, or anywhere if there is none.
    ends = np.concatenate([lo, turned_ends(lo, hi), [-np.pi, np.pi]])
    at_ends = depths_at(ends, lo, hi)
    most = least.copy()
    for slack in (-1e-12, 1e-12):
        place = np.clip(np.floor((ends + np.pi + slack) / TWO_PI * BINS).astype(int), 0, BINS - 1)
        np.maximum.at(most, place, at_ends)
    assert (found.overlap <= most).all()
    assert found.overlap.max() == greatest


def random_arcs(rng, count, widest):
    lo = rng.uniform(-np.pi, np.pi, count)
    return lo, lo + rng.uniform(0, widest, count)


@pytest.mark.parametrize("widest", [0.0, 0.02, 0.5, 3.0, 6.28])
@pytest.mark.parametrize("count", [1, 2, 7, 60])
def test_random_arcs(rng, count, widest):
    for _ in range(20):
        check(*random_arcs(rng, count, widest))


def lattice_arcs():
    """Arcs that touch, coincide and wrap; widths below the full circle."""
    steps = st.integers(-int(np.pi / STEP), int(np.pi / STEP))
    widths = st.sampled_from([0, 1, 2, 7, 30, 100, 180])
    return st.lists(st.tuples(steps, widths), min_size=1, max_size=12)


@given(lattice_arcs(), st.booleans())
@example([(0, 30), (30, 30), (30, 0), (60, 1)], False)
@example([(5, 7)] * 6, True)
@example([(90, 100), (95, 100), (100, 2)], True)
def test_touching_and_coinciding_arcs(arcs, touch_wrapped):
    """Closed ends: arcs that only touch still share a yaw."""
    lo = np.array([start * STEP for start, _ in arcs])
    hi = lo + np.array([width * STEP for _, width in arcs])
    if touch_wrapped and (hi > np.pi).any():
        ends = turned_ends(lo, hi)[hi > np.pi]
        lo, hi = np.concatenate([lo, ends]), np.concatenate([hi, ends + 2 * STEP])
    check(lo, hi)


def test_no_arcs():
    assert deepest_yaw(np.empty(0), np.empty(0)) is None


def test_arcs_beside_a_point(rng):
    """A dense crowd of wide arcs must not hide a single deepest point of zero width."""
    lo, hi = random_arcs(rng, 50, 0.5)
    point = lo[np.argmax([depths_at([x], lo, hi)[0] for x in lo])]
    lo, hi = np.append(lo, point), np.append(hi, point)
    check(lo, hi)


def test_longest_interval_wins():
    """Of equally deep intervals the longest is taken; the first one would be an accident of the sweep."""
    found = deepest_yaw(np.array([-2.0, -1.9, 1.0, 1.5]), np.array([-1.8, -1.7, 2.0, 3.0]))
    assert found is not None
    assert found.interval_rad == (1.5, 2.0) and found.yaw_rad == 1.75
    assert found.clique.tolist() == [2, 3]


@pytest.mark.parametrize("start", [-np.pi, -1.0, 0.0, 2.0])
def test_full_circle_arc_counts_once(rng, start):
    """An arc of 2 pi ends where it starts: it must not count twice there."""
    check(np.array([start]), np.array([start + TWO_PI]))
    lo, hi = random_arcs(rng, 10, 1.0)
    check(np.append(lo, [start, start]), np.append(hi, [start + TWO_PI, start + TWO_PI]))


def test_arcs_that_touch_at_the_seam():
    """-pi and pi are one yaw: an arc that ends at pi touches one that starts at -pi."""
    check(np.array([2.0, -np.pi]), np.array([np.pi, -2.0]))


def test_interval_across_the_seam_is_one():
    """The deepest interval is the same when everything turns; cut at the seam it would be half as long."""
    lo, hi = np.array([-0.5, -0.4, 1.0, 1.05]), np.array([0.5, 0.4, 1.5, 1.6])
    here = deepest_yaw(lo, hi)
    turned = (lo + np.pi + np.pi) % TWO_PI - np.pi
    there = deepest_yaw(turned, turned + hi - lo)
    assert here is not None and there is not None
    assert here.interval_rad == (-0.4, 0.4)
    assert np.subtract(*there.interval_rad[::-1]) == pytest.approx(0.8)
    assert abs(there.yaw_rad) == pytest.approx(np.pi)


def test_clique_is_a_maximum_clique_of_the_rotation_graph(rng):
    """On a line (no arc wraps) the arcs over the deepest yaw are a maximum clique, by an exact solver."""
    for _ in range(60):
        count = int(rng.integers(1, 25))
        lo = np.round(rng.uniform(-3, 2, count), 1)
        hi = np.minimum(lo + np.round(rng.uniform(0, 2, count), 1), 3.1)
        graph = nx.Graph()
        graph.add_nodes_from(range(count))
        graph.add_edges_from((a, b) for a in range(count) for b in range(a) if lo[a] <= hi[b] and lo[b] <= hi[a])
        found = deepest_yaw(lo, hi)
        assert found is not None
        assert len(found.clique) == nx.max_weight_clique(graph, weight=None)[1]
        assert all(graph.has_edge(a, b) for a in found.clique for b in found.clique if a != b)
