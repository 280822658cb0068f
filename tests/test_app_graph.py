"""The graph: its nodes and edges are the run's own, they stay where they are, and a clique is a block of the matrix."""

import base64
import re
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from recording_samples import scene_problem

from spherloc.bounds import bounds_of
from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.estimators import estimate
from spherloc.trace import ConsensusStage, Trace, TranslationStage
from spherloc_viz import style
from spherloc_viz.app.plots.ball_list import ball_list_html, selected_rows
from spherloc_viz.app.plots.graph_view import MAX_EDGES, cell_nodes, edges_of, graph_html, graph_note, matrix_png
from spherloc_viz.layers import graph_begins, paint, steps
from spherloc_viz.layers.ball_set import BallSet
from spherloc_viz.layers.graph_nodes import MAX_NODES, ball_nodes, graph_at
from spherloc_viz.layers.primitives import Graph


@pytest.fixture(scope="module")
def mc() -> Trace:
    return estimate(scene_problem("mei_outliers_80"), "mc")


@pytest.fixture(scope="module")
def exact() -> Trace:
    return estimate(scene_problem("mei_outliers_80"), "mc-exact")


def graphs(trace: Trace) -> dict[str, Graph]:
    found = {heading.key: paint(trace, index).graph for index, heading in enumerate(steps(trace))}
    return {key: graph for key, graph in found.items() if graph is not None}


def test_the_graph_grows_and_its_nodes_stay(mc: Trace) -> None:
    found = graphs(mc)
    assert next(iter(found)) == graph_begins(mc) == "balls-pair" and "outcome" in found
    assert len({id(graph.nodes) for graph in found.values()}) == 1, "one layout a run"
    counts = [int(graph.shown.sum()) for graph in found.values()]
    assert counts[0] == 1 and counts == sorted(counts)
    stage = mc.stage(TranslationStage)
    assert stage is not None and counts[-1] == len(stage.radii_m)
    places = found["clique"].nodes.places
    assert (np.linalg.norm(places, axis=1) <= 1.0).all() and len(np.unique(places.round(6), axis=0)) == len(places)


def test_edges_are_the_overlaps_and_the_clique_is_a_block(mc: Trace) -> None:
    stage, graph = mc.stage(TranslationStage), graphs(mc)["clique"]
    assert stage is not None
    nodes = graph.nodes
    apart = np.linalg.norm(stage.centres_m[nodes.number][:, None] - stage.centres_m[nodes.number], axis=2)
    reach = stage.radii_m[nodes.number][:, None] + stage.radii_m[nodes.number]
    brute = (apart <= reach + 1e-12) & ~np.eye(len(reach), dtype=bool)
    np.testing.assert_array_equal(nodes.agrees, brute)
    assert nodes.clique == len(stage.clique) and graph.marked.sum() == nodes.clique
    assert set(nodes.number[: nodes.clique]) == set(stage.clique)
    assert (nodes.agrees | np.eye(len(brute), dtype=bool))[: nodes.clique, : nodes.clique].all()
    assert edges_of(graph).total == len(stage.edges)
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(matrix_png(graph)), np.uint8), cv2.IMREAD_UNCHANGED)
    gold = (pixels[..., :3] == np.array(style.CLIQUE[::-1])).all(axis=2)
    assert gold[: nodes.clique, : nodes.clique].all() and gold.sum() == nodes.clique**2


def test_every_graph_of_balls_leads_to_the_clique(mc: Trace, exact: Trace) -> None:
    kept = np.arange(len(mc.problem))
    for key, graph in graphs(mc).items():
        at_clique = graph.color == style.CLIQUE
        assert ('data-touch="step:clique"' in graph_html(graph, (), kept)) != at_clique, key
        assert "step:clique" not in graph_html(graph, (), kept, hidden=True)
    found = graphs(mc)
    assert found["clique"].color == style.CLIQUE != found["balls-pair"].color
    assert not any("step:clique" in graph_html(graph, (), kept) for graph in graphs(exact).values())


def test_matches_that_agree_have_an_arc_over_the_yaw(exact: Trace) -> None:
    stage, graph = exact.stage(ConsensusStage), graphs(exact)["consensus-clique"]
    assert stage is not None
    aligned, nodes = exact.problem.aligned, graph.nodes
    pairs, lo, hi = yaw_arcs(aligned, bounds_of(aligned, exact.options.bound_px).radians)
    over = (lo <= stage.yaw_rad) & (stage.yaw_rad <= hi) | (stage.yaw_rad + 2 * np.pi <= hi)
    place = np.argsort(np.searchsorted(aligned.index, nodes.matches[:, 0]))
    for a, b in pairs[over]:
        assert nodes.agrees[place[a], place[b]]
    assert set(nodes.matches[: nodes.clique, 0]) == set(stage.clique.tolist())


def test_a_match_a_ball_and_a_node_light_up_together(mc: Trace) -> None:
    graph = graphs(mc)["clique"]
    pair = tuple(graph.nodes.matches[5].tolist())
    assert 5 in graph.nodes.lit(pair) and all(set(graph.nodes.matches[k]) == set(pair) for k in graph.nodes.lit(pair))
    with_one = graph.nodes.lit(pair[:1])
    assert len(with_one) > 1 and all(pair[0] in graph.nodes.matches[k] for k in with_one)
    assert not len(graph.nodes.lit(()))
    kept = np.arange(len(mc.problem)) + 1000
    html = graph_html(graph, pair, kept)
    assert f'data-touch="select:{pair[0] + 1000},{pair[1] + 1000}"' in html
    assert (
        style.css(style.SELECTED) in html
        and style.css(style.SELECTED) not in graph_html(graph, (), kept).split("<image")[1]
    )
    overlaps, others = np.count_nonzero(graph.nodes.agrees[5]), len(graph.shown) - 1
    member = " and is in the clique" if graph.nodes.clique > 5 else ""
    named = (
        f"the ball of matches {pair[0] + 1000} and {pair[1] + 1000} overlaps {overlaps} of the other {others}{member}"
    )
    assert named in html and "Selected" not in graph_html(graph, (), kept)
    often = int(np.bincount(graph.nodes.matches.ravel()).argmax())
    assert f"Selected, violet: {len(graph.nodes.lit((often,)))} balls." in graph_html(graph, (often,), kept)
    cell = (5.5 / len(graph.shown), 7.5 / len(graph.shown))
    assert cell_nodes(graph, *cell).tolist() == [5, 7]
    assert (
        cell_nodes(graphs(mc)["balls-pair"], 0.99, 0.0).tolist()
        == np.flatnonzero(graphs(mc)["balls-pair"].shown).tolist()
    )


def test_drawings_are_small_and_well_formed(mc: Trace, exact: Trace) -> None:
    for trace in (mc, exact):
        for key, graph in graphs(trace).items():
            edges, html = edges_of(graph), graph_html(graph, (0,), np.arange(len(trace.problem)))
            assert max(len(edges.marked), len(edges.others)) <= MAX_EDGES and len(html) < 60_000, key
            assert ElementTree.fromstring(html).tag == "div"
            assert len(re.findall("<circle", html)) == graph.shown.sum()


def test_more_nodes_are_thinned_evenly(mc: Trace) -> None:
    stage = mc.stage(TranslationStage)
    assert stage is not None
    rng = np.random.default_rng(4)
    count = 900
    centres, radii = rng.normal(size=(count, 3)), rng.uniform(0.1, 0.4, count)
    apart = np.linalg.norm(centres[:, None] - centres, axis=2) <= radii[:, None] + radii
    edges = np.argwhere(np.triu(apart, 1)).astype(np.int32)
    pairs = np.column_stack([np.arange(count), np.arange(count) + 1]).astype(np.int32)
    large = TranslationStage(**{**vars(stage), "pairs": pairs, "centres_m": centres, "radii_m": radii, "edges": edges})
    balls = BallSet(large)
    nodes = ball_nodes(balls)
    assert len(nodes.number) == MAX_NODES == len(set(nodes.number.tolist())) and nodes.total == count
    np.testing.assert_array_equal(
        nodes.agrees, apart[np.ix_(nodes.number, nodes.number)] & ~np.eye(MAX_NODES, dtype=bool)
    )
    # A step of few balls has them all, so that its graph has the overlaps that its caption counts.
    for size in (10, 30, 300):
        first = balls.order[:size]
        graph = graph_at(lambda: nodes, first, np.zeros(0, dtype=np.int64), style.CLIQUE, "")
        edges, whole = edges_of(graph), len(balls.edges_within(balls.mask(first)))
        assert (graph.shown.sum() == size and edges.total == whole) == (size <= 30)
        assert (f"{graph.shown.sum()} of 300 balls are drawn" in graph_note(graph, edges)) == (size == 300)


def test_the_note_is_true_of_one_node_and_of_few(mc: Trace) -> None:
    found = graphs(mc)
    notes = {key: graph_note(graph, edges_of(graph)) for key, graph in found.items()}
    assert notes["balls-pair"].startswith("One ball: no edge yet, and a matrix of one cell.")
    for key, graph in found.items():
        shown, total = int(graph.shown.sum()), edges_of(graph).total
        if shown > 1:
            assert f"each of the {shown:,} nodes." in notes[key]
            assert ("no edge" in notes[key]) == (total == 0)
        assert "All 0" not in notes[key] and "All 1 " not in notes[key]
    stage = mc.stage(TranslationStage)
    assert stage is not None
    assert f"of {len(np.unique(stage.pairs[stage.clique]))} matches, which the Matches tab lists" in notes["clique"]
    assert notes["clique"].startswith("The list, a button above, has the balls of the clique first.")


def test_all_balls_are_listed_with_the_clique_first(mc: Trace) -> None:
    stage, found = mc.stage(TranslationStage), graphs(mc)
    assert stage is not None
    listed = {key: graph.list_balls() for key, graph in found.items() if graph.list_balls is not None}
    assert listed.keys() == found.keys()
    rows, size = listed["clique"], len(stage.clique)
    pairs = [tuple(pair) for pair in stage.pairs.tolist()]
    order = [pairs.index(tuple(pair)) for pair in rows.pairs.tolist()]
    assert sorted(order) == list(range(len(stage.radii_m))) and rows.marked == size
    assert set(order[:size]) == set(stage.clique.tolist())
    for part in (order[:size], order[size:]):
        assert (np.diff(stage.radii_m[part]) >= 0.0).all()
    assert rows.overlaps.tolist() == np.bincount(stage.edges.ravel(), minlength=len(order))[order].tolist()
    for key, graph in found.items():
        assert len(listed[key].pairs) == graph.count and listed[key].overlaps.sum() == 2 * edges_of(graph).total, key

    kept = np.arange(len(mc.problem)) + 1000
    lit = selected_rows(rows, tuple(rows.pairs[3].tolist()))
    html = ball_list_html(rows, 0, lit, kept, style.CLIQUE, "in the clique")
    a, b = (rows.pairs[3] + 1000).tolist()
    assert f'data-touch="select:{a},{b}"' in html and html.count("data-reveal") == 1 and f"ball-{a}-{b}" in html
    assert html.count(">yes<") == min(size, 25) and ElementTree.fromstring(f"<div>{html}</div>").tag == "div"
    often = int(rows.pairs[3, 0])
    assert len(selected_rows(rows, (often,))) == np.count_nonzero(stage.pairs == often)
