"""The card and the table of the matches: what they show and what a press means."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import viser
from pressed_page import Page

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.app.matches.image_panel import ImagePanel
from spherloc_viz.app.matches.match_card import MatchCard
from spherloc_viz.app.matches.match_table import PAGE, MatchTablePanel
from spherloc_viz.layers import paint

SceneOf = Callable[..., SyntheticScene]


@pytest.fixture
def page() -> Page:
    return Page()


@pytest.fixture(scope="module")
def trace(scene_of: SceneOf) -> Trace:
    return estimate(scene_of("fisheye", correspondences=60, outlier_rate=0.5).problem(), "mc")


# The card -----------------------------------------------------------------------------------------------------------


def test_the_card_is_there_while_something_is_selected(server: viser.ViserServer, trace: Trace) -> None:
    card, kept = MatchCard(server.gui), np.arange(60) + 40
    card.draw(trace, (), kept)
    assert not card._panel.visible
    number = int(np.argmax(trace.inlier_mask))
    card.draw(trace, (number,), kept)
    content = card._html.content
    assert card._panel.visible and f"Match {number + 40}" in content and "Kept, rightly" in content
    for action in ("spoil:", "mend:", "hide:", "deselect:", f"select:{number + 41}"):
        assert f'data-touch="{action}"' in content
    assert "<img" not in content, "there is no image to cut from"
    assert card._more.visible and "pairs that agree" in card._details.content
    card.draw(trace, (number, number + 1), kept)
    assert "2 matches" in card._html.content and not card._more.visible
    card.draw(trace, (), kept)
    assert not card._panel.visible


def test_the_walk_goes_round(server: viser.ViserServer, trace: Trace) -> None:
    card = MatchCard(server.gui)
    kept = np.delete(np.arange(61), 30)
    card.draw(trace, (0,), kept)
    assert 'data-touch="select:60"' in card._html.content and 'data-touch="select:1"' in card._html.content
    card.draw(trace, (29,), kept)
    assert 'data-touch="select:31"' in card._html.content, "a hidden match is passed over"


def test_the_card_names_pairs_that_can_be_selected(server: viser.ViserServer, trace: Trace) -> None:
    card = MatchCard(server.gui)
    number = int(np.argmin(trace.inlier_mask))
    card.draw(trace, (number,), np.arange(60) + 5)
    others = re.findall(rf'data-touch="select:{number + 5},(\d+)"[^>]*>(\d+)<', card._details.content)
    assert others and all(one == other and 5 <= int(one) < 65 for one, other in others)


def test_what_cannot_be_mended_says_why(server: viser.ViserServer, trace: Trace) -> None:
    card = MatchCard(server.gui)
    blind = replace(trace, problem=replace(trace.problem, truth_cam_from_map=None, truth_inliers=None))
    card.draw(blind, (4,), np.arange(60))
    assert 'data-touch="mend:"' not in card._html.content and "The true pose is unknown" in card._html.content
    assert "residual" in card._details.content and ">truth<" not in card._details.content
    card.draw(trace, (4,), np.arange(60))
    assert ">truth<" in card._details.content


def test_the_card_follows_run_and_rival(server: viser.ViserServer, trace: Trace) -> None:
    card, kept = MatchCard(server.gui), np.arange(60)
    number = int(np.argmax(trace.inlier_mask))
    blind = replace(trace.problem, truth_cam_from_map=None, truth_inliers=None)
    elsewhere = np.column_stack([np.eye(3), [1.0, 0.0, 5.0]])
    failed = replace(trace, problem=blind, cam_from_map=elsewhere, inlier_mask=np.zeros(60, dtype=bool))
    card.draw(trace, (number,), kept)
    assert "Kept" in card._html.content
    card.draw(failed, (number,), kept)
    assert "Rejected" in card._html.content and "another pose" not in card._html.content
    card.draw(failed, (number,), kept, trace.cam_from_map)
    assert "It agrees with another pose" in card._html.content


# The table ----------------------------------------------------------------------------------------------------------


def numbers(table: MatchTablePanel) -> list[int]:
    return [int(number) for number in re.findall(r'<tr tabindex="0" data-touch="select:(\d+)"', table._html.content)]


def test_pages_filters_and_sorting(server: viser.ViserServer, page: Page, trace: Trace) -> None:
    table, kept = MatchTablePanel(server.gui, page.touches, page.changed), np.arange(60) + 10

    def press(action: str) -> list[int]:
        page.press(action)
        table.draw(trace, (), kept)
        return numbers(table)

    table.draw(trace, (), kept)
    assert numbers(table) == list(range(10, 10 + PAGE)) and "1–25 of 60" in table._html.content
    assert press("match-page:2") == list(range(60, 70)) and "51–60 of 60" in table._html.content
    assert press("match-page:99") == list(range(60, 70)), "there is no page beyond the last"
    inliers = press("match-filter:inliers")
    assert inliers == (np.flatnonzero(trace.inlier_mask)[:PAGE] + 10).tolist()
    assert press("match-filter:wrongly kept") == [] and "none" in table._html.content
    press("match-filter:all")
    ascending = press("match-sort:px")
    assert set(ascending[:20]) <= set((np.flatnonzero(trace.inlier_mask) + 10).tolist())
    assert press("match-sort:px")[0] != ascending[0] and "> 90°" in table._html.content
    kept_count = np.count_nonzero(trace.inlier_mask)
    assert (
        f"agrees /{kept_count}</th>" in table._html.content
        and f"With how many of {kept_count} inliers" in table._html.content
    )
    assert ("maximum clique of balls" in table._html.content) == (trace.estimator == "mc")
    for nonsense in ("match-sort:evil", "match-filter:evil", "match-page:-1", "match-page:x"):
        before = page.redraws
        press(nonsense)
        assert page.redraws == before


def test_selected_rows_are_marked_and_brought_up(server: viser.ViserServer, page: Page, trace: Trace) -> None:
    table, kept = MatchTablePanel(server.gui, page.touches, page.changed), np.arange(60)
    table.draw(trace, (55,), kept)
    mark = f"background:{style.css(style.SELECTED)}"
    assert 55 in numbers(table) and table._html.content.count(mark) == 1
    assert table._html.content.count("data-reveal") == 1 and 'data-reveal="match-55"' in table._html.content
    page.press("match-page:0")
    table.draw(trace, (55,), kept)
    assert numbers(table)[0] == 0, "turning the page is not undone"
    assert "data-reveal" not in table._html.content
    table.draw(trace, (3, 8, 55), kept)
    assert re.findall(r'data-reveal="([^"]*)"', table._html.content) == ["match-3"]
    table.draw(trace, (3, 55), kept)
    assert numbers(table)[0] == 0 and table._html.content.count(mark) == 1


def test_without_truth_there_is_no_wrong_or_right(server: viser.ViserServer, page: Page, trace: Trace) -> None:
    table = MatchTablePanel(server.gui, page.touches, page.changed)
    blind = replace(trace, problem=replace(trace.problem, truth_cam_from_map=None, truth_inliers=None))
    table.draw(blind, (), np.arange(60))
    assert "wrongly" not in table._html.content and "–" in table._html.content


def test_a_run_without_a_pose_still_lists_its_matches(server: viser.ViserServer, page: Page, trace: Trace) -> None:
    table, view, card = (
        MatchTablePanel(server.gui, page.touches, page.changed),
        ImagePanel(server.gui, page.touches, page.changed),
        MatchCard(server.gui),
    )
    nothing = replace(trace, cam_from_map=None, inlier_mask=np.zeros(60, dtype=bool), stages=())
    table.draw(nothing, (2,), np.arange(60))
    view.draw(nothing, paint(trace, 0), (2,), np.arange(60))
    card.draw(nothing, (2,), np.arange(60))
    assert len(numbers(table)) == PAGE and ">2</text>" in view._drawing.content
    assert "Not judged" in card._html.content
