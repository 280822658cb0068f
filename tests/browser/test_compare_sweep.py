"""What takes its time: comparisons, sweeps in processes of their own, and slow runs. All show how far they are and end."""

import csv
import io
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from playground import SCENE, Playground, served
from playwright.sync_api import Browser, Locator, expect

from spherloc.estimators import estimate
from spherloc.problem import Problem
from spherloc_viz.app.catalog import Catalog, SceneWish
from spherloc_viz.layers.comparison import Entry, comparison_table

EXACT, MC, RANSAC = "mc-exact (exact, certified)", "mc (the paper's)", "ransac-2p (two points)"
COMPARED = ("mc-exact", "mc", "ransac-2p")
MOST_ITERATIONS = "1000000000"
"""Takes minutes."""

pytestmark = [pytest.mark.browser, pytest.mark.timeout(280)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def server(scene: Path) -> Iterator[tuple[str, int]]:
    """Address and process of a playground of this file's own, so that its processes can be counted."""
    with served(scene, "--no-record") as (address, process):
        yield address, process.pid


@pytest.fixture
def page(browser: Browser, server: tuple[str, int]) -> Iterator[Playground]:
    tab = Playground(browser, server[0])
    yield tab
    tab.close()


def go_to(tab: Playground, name: str) -> None:
    tab.page.get_by_role("tab", name=name, exact=True).click()


def chip(tab: Playground, kind: str, estimator: str) -> Locator:
    return tab.page.locator(f"[data-touch='{kind}:{estimator}']")


def tick_only(tab: Playground, kind: str, wanted: tuple[str, ...]) -> None:
    """Press the chips of a panel until just these estimators are ticked."""
    for one in tab.page.locator(f"[data-touch^='{kind}:']").all():
        name = str(one.get_attribute("aria-label"))
        if (one.get_attribute("aria-checked") == "true") != (name in wanted):
            chip(tab, kind, name).click()
            expect(chip(tab, kind, name)).to_have_attribute("aria-checked", str(name in wanted).lower())


def compared_rows(tab: Playground) -> dict[str, tuple[list[str], str]]:
    """The comparison's table: by estimator its rotation, position, inliers and F1, and what is said below."""
    texts = [row.locator("td").all_inner_texts() for row in tab.page.locator("tr[data-touch^='use:']").all()]
    return {
        numbers[0].strip(): (numbers[1:5], below[0].strip())
        for numbers, below in zip(texts[::2], texts[1::2], strict=True)
    }


def expected_rows(problem: Problem, seed: int) -> dict[str, list[str]]:
    """What the table must say, computed here."""
    table = comparison_table([Entry(estimate(problem, name, seed=seed)) for name in COMPARED])
    places = [table.columns.index(name) for name in ("rotation", "position", "inliers", "F1")]
    return {row[0]: [row[place] for place in places] for row in table.rows}


def shows(tab: Playground, expected: dict[str, list[str]]) -> bool:
    return {name: numbers for name, (numbers, _) in compared_rows(tab).items()} == expected


def test_compare(page: Playground, scene: Path) -> None:
    tab, catalog = page, Catalog(scene)
    go_to(tab, "Compare")
    tick_only(tab, "compare", COMPARED)
    tab.press("Compare")
    first = expected_rows(catalog.problem(SceneWish("small street", 3)), 3)
    tab.until(lambda: shows(tab, first), f"the table says {first}")
    tab.until(lambda: not any("…" in below for _, below in compared_rows(tab).values()), "all are diagnosed")
    for name, (_, below) in compared_rows(tab).items():
        assert below.startswith("success · 100 % precision · 100 % recall"), below
        assert ("optimal" in below) == (name == "mc-exact")
        tab.until(
            lambda name=name: bool((tab.node(f"/comparison/{name}") or {}).get("visible")),
            f"the camera of {name} is shown",
        )
    expect(tab.page.get_by_role("img", name=re.compile("residual", re.I)).first).to_be_visible()
    expect(tab.page.get_by_role("button", name="Compare", exact=True)).to_be_visible()

    tab.page.locator("tr[data-touch='use:ransac-2p']").first.click()
    expect(tab.value("estimator")).to_have_text("ransac-2p")

    # A change makes the comparison old; live, it follows by itself.
    old = tab.page.get_by_text(re.compile("^The problem has changed since"))
    tab.press("New seed")
    expect(old).to_be_visible()
    tab.until(lambda: tab.node("/comparison/mc-exact") is None, "cameras of another problem are gone")
    assert shows(tab, first)
    tab.page.get_by_label("Live", exact=True).check()
    second = expected_rows(catalog.problem(SceneWish("small street", 4)), 4)
    assert second != first
    tab.until(lambda: shows(tab, second), f"the table says {second}")
    expect(old).to_have_count(0)
    tab.press("New seed")
    third = expected_rows(catalog.problem(SceneWish("small street", 5)), 5)
    tab.until(lambda: shows(tab, third), f"the table says {third}")
    tab.until(lambda: tab.node("/comparison/mc-exact") is not None, "the cameras are there again")
    assert tab.errors == []


def make_slow(tab: Playground) -> None:
    """Have ransac-2p draw so many samples that it takes minutes."""
    tab.choose("Estimator", RANSAC)
    expect(tab.value("estimator")).to_have_text("ransac-2p")
    tab.choose("Confidence", "draw them all")
    tab.entry("Iterations").fill(MOST_ITERATIONS)
    tab.entry("Iterations").press("Enter")


def progress(tab: Playground) -> float:
    return float(tab.page.get_by_role("progressbar").first.get_attribute("aria-valuenow") or 0.0)


def test_a_slow_run_shows_progress_and_gives_way(page: Playground) -> None:
    tab = page
    cancel = tab.page.get_by_role("button", name="Cancel", exact=True)
    make_slow(tab)
    expect(cancel).to_be_visible()
    start = progress(tab)
    tab.until(lambda: progress(tab) > start, "the bar moves")
    count = tab.step.input_value().split("/")[1].split()[0]
    tab.press("Previous")
    expect(tab.step).to_have_value(re.compile(rf"^{int(count) - 1}/"))
    expect(tab.value("outcome")).to_have_text("success")
    expect(cancel).to_be_visible()

    cancel.click()
    expect(cancel).to_be_hidden()
    expect(tab.page.get_by_text("Cancelled; the page still shows the run before.")).to_be_visible()
    assert tab.entry("Iterations").input_value().replace(",", "") == MOST_ITERATIONS
    expect(tab.value("outcome")).to_have_text("success")

    # What is asked for during a slow run does not wait for it.
    tab.press("New seed")
    expect(cancel).to_be_visible()
    tab.choose("Estimator", MC)
    expect(tab.value("estimator")).to_have_text("mc")
    expect(cancel).to_be_hidden()
    expect(tab.value("outcome")).to_have_text("success")
    assert tab.errors == []
