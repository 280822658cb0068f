"""The triage desk in a browser: what is brushed is what is listed, keys label, bulk work is undone, nights compared."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from playground import BLIND, PATIENCE_MS, SCENE, served
from playwright.sync_api import Browser, Page, expect
from test_accessibility import RULES

from spherloc.datasets import load_scene
from spherloc.estimators import default_options, estimate
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.review_file import read_review
from tests.waiting import until

WRONG = (0, 3, 4, 5)
"""Seeds of problems for which three samples give a wrong pose."""
SEEDS = len(WRONG)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs on the same problems by mc, which is right, and by RANSAC with three samples, which is wrong."""
    folder = tmp_path_factory.mktemp("night")
    scene = folder / "small.toml"
    scene.write_text(SCENE)
    for seed in WRONG:
        problem = load_scene(scene).problem(seed)
        write_recording(estimate(problem, "mc"), folder / f"mc-{seed}.rrd", Origin("sweep", str(scene), seed))
        few = replace(default_options("ransac-2p", problem), iterations=3)
        path = folder / f"ransac-{seed}.rrd"
        write_recording(estimate(problem, "ransac-2p", few, 5), path, Origin("sweep", str(scene), seed))
    return folder


@pytest.fixture(scope="module")
def home(folder: Path) -> Iterator[str]:
    """A server with these runs."""
    with served(folder / "small.toml", "--recordings", folder) as (address, _):
        yield address


class Desk:
    """An open desk that remembers what went wrong."""

    def __init__(self, browser: Browser, home: str, path: str = "/desk") -> None:
        size: Any = {"width": 1280, "height": 720}
        context = browser.new_context(viewport=size, accept_downloads=True)
        context.add_init_script(BLIND)  # of the playground that a run opens in
        self.page: Page = context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.errors: list[str] = []
        self.page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(home + path)
        expect(self.page.locator('body[data-state="open"]')).to_be_attached(timeout=PATIENCE_MS)

    def listed(self, count: int) -> None:
        """Wait until so many runs are listed."""
        expect(self.page.locator(f'body[data-listed="{count}"]')).to_be_attached(timeout=PATIENCE_MS)

    def files(self) -> list[str]:
        """Files of the rows, from the top."""
        rows = self.page.locator("#rows .row").all()
        return [row.get_attribute("data-file") or "" for row in rows]

    def chip(self, words: str) -> None:
        """Press a filter."""
        self.page.locator("#chips button", has_text=re.compile(rf"^{words}")).first.click()

    def drag(self, canvas: str, *spots: tuple[float, float]) -> None:
        """Drag over a canvas, by shares of its width and height."""
        target = self.page.locator(canvas)
        target.scroll_into_view_if_needed()
        box = target.bounding_box()
        assert box is not None
        places = [(box["x"] + u * box["width"], box["y"] + v * box["height"]) for u, v in spots]
        self.page.mouse.move(*places[0])
        self.page.mouse.down()
        for place in places[1:]:
            self.page.mouse.move(*place, steps=4)
        self.page.mouse.up()


@pytest.fixture
def desk(browser: Browser, home: str) -> Iterator[Desk]:
    """A desk that must not complain."""
    found = Desk(browser, home)
    found.listed(2 * SEEDS)
    yield found
    found.page.context.close()
    assert found.errors == []


def test_filters_groups_and_order(desk: Desk) -> None:
    expect(desk.page.locator("#right")).not_to_be_visible()  # the table has its room until a run is chosen
    desk.chip("failure")
    desk.listed(SEEDS)
    assert all(file.startswith("ransac") for file in desk.files())
    link = desk.page.url
    desk.page.keyboard.press("Escape")
    desk.listed(2 * SEEDS)
    desk.page.goto(link)
    desk.page.reload()
    desk.listed(SEEDS)
    desk.page.locator("#clear").click()
    desk.listed(2 * SEEDS)
    head = desk.page.get_by_role("columnheader", name=re.compile("^estimator"))
    head.click()
    until(lambda: desk.files()[0].startswith("mc"))
    head.click()
    until(lambda: desk.files()[0].startswith("ransac"))
    desk.page.locator("#search").fill("mc-3")
    desk.listed(1)
    desk.page.locator("#search").fill("")
    desk.listed(2 * SEEDS)
    row = desk.page.locator('#matrix tr[data-group="ok"]')
    assert int(row.locator("td").first.inner_text()) >= SEEDS
    row.locator(".fold").click()
    expect(desk.page.locator("#matrix .examples img").first).to_be_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_desk_is_accessible(desk: Desk, scheme: Any) -> None:
    desk.page.emulate_media(color_scheme=scheme)
    desk.chip("failure")
    desk.listed(SEEDS)
    desk.page.keyboard.press("ArrowDown")
    expect(desk.page.locator("#evidence li").first).to_contain_text("agree")
    desk.page.locator("#matrix .fold").first.click()
    desk.page.locator("#columns-menu summary").click()
    found = Axe().run(desk.page, options=RULES).response["violations"]
    assert [f"{one['id']}: {node['html'][:200]}" for one in found for node in one["nodes"]] == []


def test_what_is_brushed_is_what_is_listed(desk: Desk) -> None:
    desk.page.locator("#plot-x").select_option("seed")
    desk.drag("#scatter", (0.6, 0.05), (0.97, 0.9))
    desk.listed(SEEDS)
    assert all(file.startswith("ransac") for file in desk.files()), "seed 5 is right of the middle"
    desk.page.locator("#scatter").click(position={"x": 90, "y": 100})
    desk.listed(2 * SEEDS)
    desk.drag("#map", (0.02, 0.02), (0.98, 0.02), (0.98, 0.98), (0.02, 0.98))
    expect(desk.page.locator("#chips", has_text="lasso")).to_be_visible()
    desk.page.go_back()
    expect(desk.page.locator("#chips", has_text="lasso")).to_have_count(0)
    desk.drag("#parallel", (0.86, 0.1), (0.86, 0.5))
    expect(desk.page.locator("#chips", has_text="rotation error")).to_be_visible()


def test_a_wide_screen_shows_all_larger_and_brushes_the_same(desk: Desk) -> None:
    desk.page.locator("#plot-x").select_option("seed")
    ranges = []
    for width_px, zoom in ((1280, 1.0), (3600, 2.0)):
        desk.page.set_viewport_size({"width": width_px, "height": 800})
        desk.page.wait_for_function("width => document.querySelector('#scatter').width > 0.2 * width", arg=width_px)
        plot = desk.page.locator("#scatter")
        box = plot.bounding_box()
        assert box is not None and plot.evaluate("one => one.width") == pytest.approx(box["width"], abs=6)
        left, right = 46.0 * zoom, 10.0 * zoom  # margins
        low, high = ((left + share * (box["width"] - left - right)) / box["width"] for share in (0.4, 0.6))
        desk.drag("#scatter", (low, 0.02), (high, 0.98))
        chip = desk.page.locator("#chips", has_text="seed:")
        expect(chip).to_be_visible()
        ranges.append([float(word) for word in re.findall(r"seed: (\S+) to (\S+)", chip.inner_text())[0]])
        desk.page.get_by_role("button", name="Clear all filters").click()
        desk.listed(2 * SEEDS)
    np.testing.assert_allclose(*ranges, atol=0.02 * SEEDS)


def test_cells_stand_below_their_titles_and_a_phone_shows_the_runs_first(desk: Desk) -> None:
    lefts = "name => [...document.querySelectorAll(`#table [role=${name}]`)].map(one => one.getBoundingClientRect().x)"
    for width_px in (2400, 1000, 390):
        desk.page.set_viewport_size({"width": width_px, "height": 800})
        desk.listed(2 * SEEDS)
        titles, cells = (desk.page.evaluate(lefts, name) for name in ("columnheader", "gridcell"))
        assert len(titles) > 8 and np.allclose(titles, cells[: len(titles)], atol=0.5)
        assert desk.page.evaluate("document.documentElement.scrollWidth") <= width_px
    runs, groups = (desk.page.locator(name).bounding_box() for name in ("#table", "#matrix"))
    assert runs is not None and groups is not None and runs["y"] + runs["height"] <= groups["y"]


def test_unknown_values_can_be_brushed(desk: Desk) -> None:
    desk.page.locator("#plot-x").select_option("certificate_gap")  # which mc does not have
    box = desk.page.locator("#scatter").bounding_box()
    assert box is not None
    left, right = 46.0, 10.0  # margins of the plot, whose first 8 % are for what is unknown
    strip_end = (left + 0.07 * (box["width"] - left - right)) / box["width"]
    desk.drag("#scatter", (0.02, 0.02), (strip_end, 0.98))
    desk.listed(SEEDS)
    assert all(file.startswith("mc") for file in desk.files())
    expect(desk.page.locator("#chips")).to_contain_text("certificate gap: unknown")
    desk.page.reload()
    desk.listed(SEEDS)
    assert all(file.startswith("mc") for file in desk.files())


def test_keys_label_move_and_undo(desk: Desk, folder: Path) -> None:
    page = desk.page
    first, second = desk.files()[:2]
    page.keyboard.press("ArrowDown")
    expect(page.locator(".row.chosen")).to_have_attribute("data-file", first)
    expect(page.locator("#evidence li").first).to_contain_text("agree")
    page.keyboard.press("2")
    until(lambda: read_review(folder / first).labels == ("bad map",))
    page.keyboard.press("s")
    expect(page.locator(".row.chosen")).to_have_attribute("data-file", second)
    until(lambda: read_review(folder / first).labels == ("bad map", "seen"))
    page.keyboard.press("u")
    until(lambda: read_review(folder / first).labels == ("bad map",))
    page.keyboard.press("u")
    until(lambda: read_review(folder / first).labels == ())
    for _ in range(3):  # given, taken away and given again, however quickly
        page.keyboard.press("9")
    until(lambda: read_review(folder / second).labels == ("ignore",))
    page.keyboard.press("u")
    page.keyboard.press("u")
    until(lambda: read_review(folder / second).labels == ("ignore",))
    page.keyboard.press("u")
    until(lambda: read_review(folder / second).labels == ())
    page.keyboard.press("n")
    page.keyboard.type("2 of these, 1 by one")
    page.keyboard.press("Escape")
    until(lambda: read_review(folder / second).note == "2 of these, 1 by one")
    assert read_review(folder / second).labels == (), "digits of a note are no keys"
    page.keyboard.press("u")
    until(lambda: read_review(folder / second).note == "")


def test_many_are_labelled_at_once_and_become_a_set(desk: Desk, folder: Path) -> None:
    page = desk.page
    desk.chip("failure")
    desk.listed(SEEDS)
    page.locator("#mark-all").click()
    expect(page.locator("#listed")).to_have_text(f"{SEEDS} runs marked")
    page.keyboard.press("1")
    wrong = [folder / f"ransac-{seed}.rrd" for seed in WRONG]
    until(lambda: all(read_review(path).labels == ("real failure",) for path in wrong))
    page.locator("#undo").click()
    until(lambda: all(read_review(path).labels == () for path in wrong))
    page.locator("#sets-menu summary").click()
    page.locator("#sets input").fill("wrong ones")
    page.locator("#sets button").click()
    stored = folder / "sets" / "wrong ones.txt"
    until(lambda: stored.is_file() and len(stored.read_text().split()) == SEEDS)
    expect(page.locator("#news")).to_contain_text("spherloc rerun")
    page.locator("#views-menu summary").click()
    page.locator("#views input").press_sequentially("fail")
    page.evaluate("drawSaved()")  # as when an answer of the server comes meanwhile
    page.keyboard.type("ures")
    page.keyboard.press("Enter")
    expect(page.locator("#views .entry", has_text="failures")).to_be_visible()
    page.keyboard.press("Escape")
    page.locator("h1").click()
    page.locator("#clear").click()
    desk.listed(2 * SEEDS)
    page.locator("#views-menu summary").click()
    page.locator("#views .entry button", has_text="failures").first.click()
    desk.listed(SEEDS)


def test_nights_are_compared_and_sent(desk: Desk) -> None:
    page = desk.page
    page.locator("#compare-open").click()
    page.locator("#before").select_option(label="estimator mc")
    page.locator("#after").select_option(label="estimator ransac-2p")
    page.locator("#compare-do").click()
    expect(page.locator("#verdict")).to_have_text(f"{SEEDS} new failures, 0 mended")
    with page.expect_download() as saved:
        page.get_by_role("link", name="Save the report").click()
    assert f"{SEEDS} new failures, 0 mended" in saved.value.path().read_text()
    page.get_by_role("button", name=re.compile("new failures$")).click()
    desk.listed(SEEDS)
    with page.expect_download() as saved:
        page.locator("#report").click()
    html = saved.value.path().read_text()
    assert f"{SEEDS} recorded runs" in html and html.count("data:image/png") == SEEDS


def test_a_run_opens_at_the_step_where_it_was_decided(desk: Desk) -> None:
    page = desk.page
    desk.page.locator("#search").fill("ransac-3")
    desk.listed(1)
    page.locator("h1").click()
    page.keyboard.press("ArrowDown")
    link = page.locator("#right .actions a").first
    number = re.findall(r"\d+", link.inner_text())[0]
    rerun = page.locator("#right .actions a").nth(1)
    assert f"step={number}" in (rerun.get_attribute("href") or ""), "the same number in Rerun"
    with page.context.expect_page() as opened:
        link.click()
    tab = opened.value
    tab.set_default_timeout(PATIENCE_MS)
    expect(tab.locator(".review-card")).to_contain_text("ransac-2p", timeout=PATIENCE_MS)
    expect(tab.get_by_role("textbox", name="Timeline")).to_have_value(number, timeout=PATIENCE_MS)
