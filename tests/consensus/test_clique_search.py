"""The kernel of every clique search, against exact solvers, and its promises about floors and limits."""

import networkx as nx
import numpy as np
import pytest

from spherloc.consensus import max_clique
from spherloc.consensus.max_clique import (
    all_nodes,
    clear_edge,
    colour_bound,
    larger_clique,
    lowest_bit,
    popcount,
    set_edge,
    subgraph,
)
from spherloc.watch import Watch

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

NO_LIMIT = 10**9
BOARD = Watch().board


def random_graph(rng, count, density):
    upper = np.triu(rng.random((count, count)) < density, 1)
    return upper | upper.T


def rows_of(adjacency):
    """Rows of 64-bit words, packed by numpy."""
    count = len(adjacency)
    words = (count + 63) // 64
    bits = np.zeros((count, 64 * words), dtype=np.uint8)
    bits[:, :count] = adjacency
    return np.packbits(bits, axis=1, bitorder="little").view(np.uint64).reshape(count, words).copy()


def adjacency_of(rows):
    count = len(rows)
    return np.unpackbits(rows.view(np.uint8).reshape(count, -1), axis=1, bitorder="little")[:, :count].astype(bool)


def clique_number(adjacency):
    return nx.max_weight_clique(nx.from_numpy_array(adjacency.astype(int)), weight=None)[1]


def check_clique(adjacency, nodes):
    assert len(set(nodes.tolist())) == len(nodes)
    assert all(adjacency[a, b] for a in nodes for b in nodes if a != b)


def check_floors(adjacency, number):
    rows = rows_of(adjacency)
    assert colour_bound(rows) >= number
    for floor in {0, 1, number // 2, number - 2, number - 1}:
        if 0 <= floor < number:
            nodes, _, exact = larger_clique(rows, floor, NO_LIMIT, BOARD)
            assert exact and len(nodes) == number
            check_clique(adjacency, nodes)
    for floor in (number, number + 1, len(adjacency), len(adjacency) + 1):
        nodes, _, exact = larger_clique(rows, floor, NO_LIMIT, BOARD)
        assert exact and len(nodes) == 0
    np.testing.assert_array_equal(rows, rows_of(adjacency))


@pytest.mark.parametrize("density", [0.1, 0.3, 0.5, 0.7, 0.9, 0.95])
def test_random_graphs_and_floors(rng, density):
    """Something is found if and only if the clique number exceeds the floor."""
    for count in (*range(1, 31), 40):
        adjacency = random_graph(rng, count, density)
        check_floors(adjacency, clique_number(adjacency))


@pytest.mark.parametrize("count", [63, 64, 65, 70, 127, 128, 129])
def test_word_borders(rng, count):
    """A clique right across the words, among others of every density."""
    for density in (0.1, 0.5):
        adjacency = random_graph(rng, count, density)
        planted = np.arange(count - 12, count)
        adjacency[np.ix_(planted, planted)] = True
        np.fill_diagonal(adjacency, False)
        check_floors(adjacency, clique_number(adjacency))


@pytest.mark.parametrize("count", [63, 64, 65])
def test_complete_graphs_less_a_matching(count):
    """Dense ones, of known number: of every pair that is no edge, one."""
    adjacency = ~np.eye(count, dtype=bool)
    for k in range(10):
        adjacency[2 * k, 2 * k + 1] = adjacency[2 * k + 1, 2 * k] = False
    check_floors(adjacency, count - 10)
    check_floors(~np.eye(count, dtype=bool), count)
    check_floors(np.zeros((count, count), dtype=bool), 1)


def test_limit_is_kept_and_confessed(rng):
    """What was found when the effort ran out is a clique larger than the floor, and not called exact."""
    adjacency = random_graph(rng, 120, 0.8)
    rows = rows_of(adjacency)
    sizes, stopped = [], 0
    for limit in (1, 300, 3000, 30_000, 300_000):
        for floor in (0, 10):
            nodes, effort, exact = larger_clique(rows, floor, limit, BOARD)
            check_clique(adjacency, nodes)
            assert len(nodes) == 0 or len(nodes) > floor
            assert exact or effort >= limit
            # One more node may be coloured after the last look at the limit.
            assert effort <= limit + 121 * 2
            stopped += not exact
        sizes.append(len(nodes))
    assert stopped >= 4
    assert sizes == sorted(sizes)


def test_an_answer_that_is_exact_does_not_depend_on_the_limit(rng):
    """The limit only ends a search: with enough of it the number is right, with less it may not be called exact."""
    for _ in range(30):
        adjacency = random_graph(rng, 25, 0.6)
        rows, number = rows_of(adjacency), clique_number(adjacency)
        for limit in (1, 20, 50, 100, 200, 400, NO_LIMIT):
            nodes, _, exact = larger_clique(rows, 2, limit, BOARD)
            assert not exact or len(nodes) == number


def test_empty_graph():
    rows = np.zeros((0, 0), np.uint64)
    assert colour_bound(rows) == 0
    nodes, _, exact = larger_clique(rows, 0, NO_LIMIT, BOARD)
    assert exact and len(nodes) == 0


def test_bits(rng):
    """Every position alone, and words at random."""
    for bit in range(64):
        word = np.uint64(1) << np.uint64(bit)
        assert popcount(word) == 1 and lowest_bit(word) == bit
        assert popcount(~word) == 63
        assert lowest_bit(word | (np.uint64(1) << np.uint64(63))) == bit
    assert popcount(np.uint64(0)) == 0 and popcount(~np.uint64(0)) == 64
    for word in rng.integers(1, 2**64, 300, dtype=np.uint64, endpoint=False):
        assert popcount(word) == int(word).bit_count()
        assert lowest_bit(word) == (int(word) & -int(word)).bit_length() - 1


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 130])
def test_edges_and_node_sets(rng, count):
    rows = np.zeros((count, (count + 63) // 64), np.uint64)
    expected = np.zeros((count, count), dtype=bool)
    for _ in range(300 if count > 1 else 0):
        a, b = rng.choice(count, 2, replace=False)
        keep = rng.random() < 0.7
        (set_edge if keep else clear_edge)(rows, a, b)
        expected[a, b] = expected[b, a] = keep
    np.testing.assert_array_equal(adjacency_of(rows), expected)
    assert sum(popcount(word) for word in all_nodes(count)) == count


@pytest.mark.parametrize("count", [1, 20, 64, 100])
def test_subgraph(rng, count):
    adjacency = random_graph(rng, count, 0.4)
    for size in {0, 1, count // 2, count}:
        nodes = rng.permutation(count)[:size].astype(np.int64)
        small, old = subgraph(rows_of(adjacency), nodes)
        assert sorted(old) == sorted(nodes)
        if size:
            inside = adjacency[np.ix_(old, old)]
            np.testing.assert_array_equal(adjacency_of(small), inside)
            assert (np.diff(inside.sum(axis=0)) <= 0).all(), "not by falling degree"


def test_colours_listed_are_a_proper_colouring(rng):
    """Nodes of one colour share no edge, and every node has a colour."""
    adjacency = random_graph(rng, 90, 0.6)
    order, bound = np.empty(90, np.int32), np.empty(90, np.int32)
    listed = max_clique.colour(all_nodes(90), rows_of(adjacency), 0, order, bound)
    assert listed == 90 and sorted(order) == list(range(90)) and (np.diff(bound) >= 0).all()
    for shade in np.unique(bound):
        same = order[bound == shade]
        assert not adjacency[np.ix_(same, same)].any()
