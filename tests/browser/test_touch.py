"""What a person touches: a match in any view lights up in all of them, and can be spoiled, mended and hidden."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from playground import SCENE, SELECTED, Playground
from playwright.sync_api import expect

from spherloc.estimators import estimate
from spherloc.trace import Trace
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.layers.matches import match_rows


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Trace:
    """The run that a page starts with."""
    path = tmp_path_factory.mktemp("touch") / "small.toml"
    path.write_text(SCENE)
    return estimate(Catalog(path).scenes["small street"].problem(), "mc", seed=3)


def marked_rows(tab: Playground) -> list[int]:
    """Numbers of the rows that are marked in the table, which must be open."""
    rows = tab.page.locator("tr[data-touch^='select:'][style*='background']")
    return [int(row.split(":")[1]) for row in rows.evaluate_all("rows => rows.map(row => row.dataset.touch)")]


def ringed(tab: Playground) -> list[int]:
    """Numbers beside the rings on the image, whose tab must be open."""
    numbers = tab.page.locator(f"svg text[fill='{SELECTED}']")
    return sorted(map(int, numbers.evaluate_all("all => all.map(text => text.textContent)")))


def chosen_arcs(tab: Playground) -> set[str]:
    """Pairs whose arcs are brought out in the yaw view, which must be open."""
    arcs = tab.page.locator(f"path.yaw-arc[stroke='{SELECTED}']")
    return set(arcs.evaluate_all("arcs => arcs.map(arc => arc.dataset.touch.split(':')[1])"))


def expect_lit(tab: Playground, *numbers: int) -> None:
    """These matches and no others are lit on the card, on the canvas, and in the views."""
    tab.expect_card(*numbers)
    tab.until(lambda: tab.lit() == list(numbers), f"the canvas shows {numbers}")
    tab.tab("Images")
    tab.until(lambda: ringed(tab) == list(numbers), f"the image has rings around {numbers}")
    tab.tab("Matches")
    tab.until(lambda: rows_are_marked(tab, numbers), f"only rows of {numbers} are marked, and the first is on the page")
    tab.tab("Yaw")
    tab.until(lambda: arcs_are_chosen(tab, numbers), f"only arcs of {numbers} are brought out")
    tab.tab("Residuals")
    expect(tab.page.locator("svg path.chosen:not(.yaw-second)")).to_have_count(2 if numbers else 0)


def rows_are_marked(tab: Playground, numbers: tuple[int, ...]) -> bool:
    marked = marked_rows(tab)
    return set(marked) <= set(numbers) and bool(marked) == bool(numbers)


def arcs_are_chosen(tab: Playground, numbers: tuple[int, ...]) -> bool:
    """Arcs of one match with any other, or of several among themselves; a wrong match has none near the peak."""
    pairs = [set(map(int, pair.split(","))) for pair in chosen_arcs(tab)]
    return all(pair <= set(numbers) if len(numbers) > 1 else pair & set(numbers) for pair in pairs)


def test_a_match_that_is_selected_anywhere_lights_up_everywhere(tab: Playground, trace: Trace, address: str) -> None:
    tab.tab("Matches")
    tab.row(3).click()
    expect_lit(tab, 3)
    tab.tab("Yaw")
    tab.until(lambda: bool(chosen_arcs(tab)), "the arcs of an inlier are brought out")
    number, x, y = tab.lonely_dots("/selection/map/points")[-1]
    tab.page.mouse.click(x, y)
    expect_lit(tab, number)
    assert number not in (3, 4)

    tab.tab("Images")
    sheet = tab.still(lambda: tab.touch("image-pick:query").bounding_box(), "the image stands still")
    assert sheet is not None
    shares = trace.problem.pixels / [trace.problem.camera.width, trace.problem.camera.height]
    places = shares * [sheet["width"], sheet["height"]] + [sheet["x"], sheet["y"]]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e3 * np.eye(len(places))
    other = int(np.argmax(np.where(np.arange(len(places)) == number, 0.0, apart.min(axis=1))))
    tab.page.mouse.click(*places[other] + [2.0, -2.0])
    expect_lit(tab, other)

    tab.page.locator("[title='Next match']").click()
    expect_lit(tab, (other + 1) % 40)
    tab.touch("deselect:").click()
    expect_lit(tab)
    bins_arcs_and_rectangles_select_several(tab, trace)
    tab.expect_quiet(address)


def bins_arcs_and_rectangles_select_several(tab: Playground, trace: Trace) -> None:
    tab.tab("Residuals")
    bins = tab.page.locator("rect.bin[data-touch*=':px:']")
    expect(bins.first).to_be_visible()
    tips = [re.search(r"(\d+) inliers.*, (\d+) outliers", bin.text_content() or "") for bin in bins.all()]
    counts = [int(tip[1]) + int(tip[2]) for tip in tips if tip]
    assert sum(counts) == 40 and len(counts) == bins.count()
    place = next(k for k in np.argsort(counts)[::-1].tolist() if counts[k] <= 8)
    below = sum(counts[:place])
    expected = sorted(np.argsort(match_rows(trace).px)[below : below + counts[place]].tolist())
    bins.nth(place).click()
    expect_lit(tab, *expected)

    tab.tab("Yaw")
    arc = tab.page.locator("path.yaw-arc").first
    pair = sorted(map(int, (arc.get_attribute("data-touch") or "").split(":")[1].split(",")))
    arc.click()
    expect_lit(tab, *pair)

    tab.tab("Matches")
    tab.page.keyboard.press("Escape")
    tab.expect_card()
    tab.row(1).click()
    tab.expect_card(1)
    tab.row(4).click(modifiers=["Shift"])
    tab.expect_card(1, 4)
    tab.row(1).click(modifiers=["Shift"])
    tab.expect_card(4)

    lonely = tab.lonely_dots("/selection/map/points")
    # Below the card, and away from the edges, which are handles of the panels.
    x, y = next((x, y) for _, x, y in lonely if 440 < x < 740 and 420 < y < 600)
    low, high = np.array([x - 25.0, y - 25.0]), np.array([x + 60.0, y + 60.0])
    both = [tab.dots(name) for name in ("/map/points", "/sphere/bearings")]
    inside = sorted({k for dots in both for k in np.flatnonzero(((dots > low) & (dots < high)).all(axis=1)).tolist()})
    tab.page.keyboard.down("Shift")
    tab.page.mouse.move(*low)
    tab.page.mouse.down()
    tab.page.mouse.move(*((low + high) / 2), steps=3)
    tab.page.mouse.move(*high, steps=3)
    tab.page.mouse.up()
    tab.page.keyboard.up("Shift")
    tab.until(lambda: tab.lit() == inside, f"the rectangle selects {inside}")


def outcome(tab: Playground) -> dict[str, str]:
    """What the outcome says, but for how long it took, once the pose is judged: that follows the picture."""
    script = """cell => [...cell.closest("table").rows].filter(row => row.cells.length === 2)
        .map(row => [row.cells[0].textContent, row.cells[1].textContent])"""
    said: dict[str, str] = {}

    def judged() -> bool:
        said.clear()
        said.update(tab.value("outcome").evaluate(script))
        return "…" not in said.values()

    tab.until(judged, "the pose is judged")
    return {name: words for name, words in said.items() if name not in ("solved in", "this time")}


def expect_outcome(tab: Playground, words: dict[str, str]) -> None:
    tab.until(lambda: outcome(tab) == words, f"the outcome says {words}")


def changed_outcome(tab: Playground, change: Callable[[], None]) -> dict[str, str]:
    """What the outcome says after a change of it."""
    before = outcome(tab)
    change()
    tab.until(lambda: outcome(tab) != before, "the outcome changes")
    return outcome(tab)


def test_matches_are_spoiled_mended_hidden_and_all_is_undone(tab: Playground, trace: Trace, address: str) -> None:
    first = outcome(tab)
    assert first["inliers"] == f"{int(trace.inlier_mask.sum())} of 40" and "camera position" in first
    inlier, outlier = (int(np.flatnonzero(trace.inlier_mask == kept)[1]) for kept in (True, False))
    by_hand = tab.page.get_by_text(re.compile("^Matches by hand:"))
    count = int(trace.inlier_mask.sum())
    tab.tab("Matches")
    tab.row(inlier).click()
    spoiled = changed_outcome(tab, tab.touch("spoil:").click)
    assert spoiled["inliers"] == f"{count - 1} of 40"
    expect(by_hand).to_contain_text("1 made wrong")
    mended = changed_outcome(tab, tab.touch("mend:").click)
    assert mended["inliers"] == f"{count} of 40" and mended != first
    expect(by_hand).to_contain_text("1 made right")

    tab.press("Undo")
    expect_outcome(tab, spoiled)
    tab.press("Undo")
    expect_outcome(tab, first)
    expect(by_hand).to_have_count(0)
    tab.press("Redo")
    expect_outcome(tab, spoiled)
    tab.page.mouse.click(420, 650)
    tab.page.keyboard.press("Control+z")
    expect_outcome(tab, first)

    tab.row(outlier).click()
    tab.expect_card(outlier)
    assert changed_outcome(tab, tab.touch("mend:").click)["inliers"] == f"{count + 1} of 40"
    tab.touch("unedit:").click()
    expect_outcome(tab, first)
    assert outcome(tab) == first

    hidden = changed_outcome(tab, tab.touch("hide:").click)
    assert hidden["inliers"] == f"{count} of 39"
    tab.expect_card()
    expect(tab.row(outlier)).to_have_count(0)
    number = outlier + 1
    tab.row(number).click()
    tab.expect_card(number)
    tab.until(lambda: tab.lit() == [number - 1], "the numbers of the others stay, though the hidden one is gone")
    tab.touch("unhide:").click()
    expect_outcome(tab, first)
    tab.until(lambda: tab.lit() == [number], "the selection stays")
    tab.expect_quiet(address)
