"""What a newcomer is told: the glossary, the introduction, and where a page opens."""

import json
import re
from collections.abc import Iterator
from html import unescape

import numpy as np
import pytest
import viser
from pressed_page import Page
from recording_samples import scene_problem

from spherloc.estimators import estimate
from spherloc.registry import names
from spherloc_viz.app.glossary import linked
from spherloc_viz.app.introduction import MOMENTS, introduction_html, opening_step
from spherloc_viz.app.plots.residual_view import ResidualView
from spherloc_viz.app.plots.yaw_view import YawView
from spherloc_viz.app.review.filters import Counts, Look, filters_html
from spherloc_viz.app.text import step_html, table_html
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.outcome import outcome_table


def test_terms_are_marked_where_they_first_stand() -> None:
    html = linked("Two arcs and an arc; a maximum clique of balls <b>, & the yaw ring of bearings.")
    marked = re.findall(r'data-define="([^"]+)"[^>]*>([^<]+)</span>', html)
    assert marked == [
        ("arc", "arcs"), ("maximum clique", "maximum clique"), ("ball", "balls"), ("yaw ring", "yaw ring"),
        ("bearing", "bearings"),
    ]  # fmt: skip
    assert "&lt;b&gt;, &amp; the" in html and "<b>" not in html
    assert unescape(re.sub(r"<[^>]+>", "", html)) == unescape(html_text(html))


def html_text(html: str) -> str:
    return re.sub(r"<[^>]+>", "", html)


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = start_viser("a key of this test")
    yield server
    stop_viser(server)


def test_views_tell_what_their_words_mean(server: viser.ViserServer) -> None:
    trace, page = estimate(scene_problem("mei_outliers_80"), "ransac-2p"), Page()
    kept = np.arange(len(trace.problem))
    yaw = YawView(server.gui, page.touches, page.changed)
    residuals = ResidualView(server.gui, page.touches, page.changed, lambda chosen: None)
    yaw.draw(trace, "outcome", (), kept)
    residuals.draw(trace, (), kept)
    assert 'aria-label="What is arc?"' in yaw._html.content
    assert all(f'aria-label="What is {term}?"' in residuals._html.content for term in ("residual", "RANSAC"))


@pytest.mark.parametrize("estimator", names("estimators"))
def test_every_run_opens_at_its_ring_and_has_four_moments(estimator: str) -> None:
    trace = estimate(scene_problem("mei_outliers_80"), estimator)
    headings = steps(trace)
    key = headings[opening_step(headings)].key
    has_ring = any(item.layer == "yaw ring" for item in paint(trace, opening_step(headings)).scene)
    assert has_ring == any(heading.key in ("yaw-clique", "consensus-bound") for heading in headings)
    assert has_ring or key == "outcome"
    found = re.fullmatch(r'<div hidden data-introduction="([^"]*)"></div>', introduction_html(headings, key))
    assert found is not None
    told = json.loads(unescape(found[1]))
    shown = [moment["step"] for moment in told["moments"]]
    assert len(shown) == len(MOMENTS) == len(set(shown)) and told["end"] == key
    assert set(shown) <= {heading.key for heading in headings}


def test_captions_define_the_great_words() -> None:
    """Arc, ball and clique are marked in the captions that first use them."""
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    captions = [linked(paint(trace, k).step.caption) for k in range(len(steps(trace)))]
    marked = [set(re.findall(r"data-define=\"([^\"]+)", caption)) for caption in captions]
    for term in ("arc", "ball", "maximum clique", "edge", "inlier"):
        assert any(term in here for here in marked), term


def test_words_of_notes_tables_and_filters_are_defined(server: viser.ViserServer) -> None:
    """Those that a newcomer asked for."""
    trace = estimate(scene_problem("mei_outliers_80"), "mc-exact")
    last = paint(trace, len(steps(trace)) - 1)
    words = step_html(last.step, linked) + table_html(outcome_table(trace), linked)
    words += filters_html(Look(), Counts(2, (("failure", 1), ("success", 1)), (("ok", 1),), 1))
    asked = {"NFA", "certificate", "estimator", "precision", "recall", "F1", "suspect"}
    assert asked <= set(re.findall(r'data-define="([^"]+)"', words))
    guessed = linked("The front end expects about 90 % to be wrong.")
    assert 'data-define="front end"' in guessed
