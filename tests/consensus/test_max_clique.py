"""The maximum clique search against an exact solver, and its limit, which must never lie."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spherloc.consensus.max_clique import max_clique
from spherloc.consensus.translation_balls import overlapping

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def random_graph(rng, count, density):
    upper = np.triu(rng.random((count, count)) < density, 1)
    return upper | upper.T


def is_clique(adjacency, nodes):
    return all(adjacency[a, b] for a in nodes for b in nodes if a != b)


def clique_number(adjacency):
    graph = nx.from_numpy_array(adjacency.astype(int))
    return nx.max_weight_clique(graph, weight=None)[1] if len(adjacency) else 0


def check(adjacency):
    found = max_clique(adjacency)
    nodes = found.nodes.tolist()
    assert found.proven
    assert nodes == sorted(set(nodes)) and is_clique(adjacency, nodes)
    assert len(nodes) == clique_number(adjacency)
    return found


@pytest.mark.parametrize("density", [0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0])
def test_random_graphs(rng, density):
    for count in range(41):
        check(random_graph(rng, count, density))


@given(st.integers(0, 12), st.sets(st.tuples(st.integers(0, 11), st.integers(0, 11))))
def test_any_small_graph(count, edges):
    adjacency = np.zeros((12, 12), dtype=bool)
    for a, b in edges:
        adjacency[a, b] = adjacency[b, a] = a != b
    check(adjacency[:count, :count].copy())


@pytest.mark.parametrize("count", [63, 64, 65, 127, 128, 129, 200])
def test_word_boundaries(rng, count):
    """Nodes 63, 64 and 65 lie in different words of the bitsets: one clique right across them."""
    adjacency = random_graph(rng, count, 0.1)
    planted = np.arange(count - 15, count)
    adjacency[np.ix_(planted, planted)] = True
    np.fill_diagonal(adjacency, False)
    assert check(adjacency).nodes.tolist() == planted.tolist()


def test_complete_and_empty_graphs_of_many_nodes():
    full = max_clique(np.ones((500, 500), dtype=bool))
    assert full.proven and full.nodes.tolist() == list(range(500))
    assert len(check(np.zeros((300, 300), dtype=bool)).nodes) == 1


def test_planted_clique_in_a_geometric_graph(rng):
    """The use it is made for: many balls scattered, and a crowd of them around one position."""
    for _ in range(6):
        scattered = rng.uniform(-5, 5, (300, 3))
        scattered = scattered[np.linalg.norm(scattered, axis=1) > 1.5]
        centres = np.vstack([scattered, rng.normal(0, 0.02, (40, 3))])
        order = rng.permutation(len(centres))
        found = check(overlapping(centres[order], np.full(len(centres), 0.4)))
        assert found.nodes.tolist() == np.flatnonzero(order >= len(scattered)).tolist()


def test_diagonal_is_ignored_and_the_input_kept(rng):
    adjacency = random_graph(rng, 20, 0.5)
    with_loops = adjacency | np.eye(20, dtype=bool)
    before = with_loops.copy()
    np.testing.assert_array_equal(max_clique(with_loops).nodes, max_clique(adjacency).nodes)
    np.testing.assert_array_equal(with_loops, before)


@pytest.mark.parametrize("limit", [1, 2, 10, 100])
def test_limit_gives_a_clique_and_does_not_call_it_proven(rng, limit):
    """A hard graph: the limit is reached, and what is returned is still a clique, of at least one node."""
    adjacency = random_graph(rng, 150, 0.8)
    found = max_clique(adjacency, effort_limit=limit)
    assert not found.proven
    assert is_clique(adjacency, found.nodes) and len(found.nodes) >= 1


def test_larger_limits_never_give_smaller_cliques_and_end_proven(rng):
    adjacency = random_graph(rng, 60, 0.7)
    sizes = []
    for limit in (100, 1000, 10_000, 200_000):
        found = max_clique(adjacency, effort_limit=limit)
        sizes.append(len(found.nodes))
    assert sizes == sorted(sizes)
    assert found.proven and sizes[-1] == clique_number(adjacency)


def test_same_graph_same_clique(rng):
    """Of many cliques of the same size always the same one."""
    adjacency = random_graph(rng, 80, 0.5)
    first = max_clique(adjacency).nodes
    for _ in range(3):
        np.testing.assert_array_equal(max_clique(adjacency.copy()).nodes, first)
