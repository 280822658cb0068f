"""Reviewing as a person does it: find runs, open them just as they were, label them, go on by key, take them away."""

import csv
import io
import re
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playground import PATIENCE_MS, SCENE, Playground, served
from playwright.sync_api import Browser, Locator, expect

from spherloc_viz.recording.content.data import read_run_row
from spherloc_viz.recording.review_file import read_review


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("review")


@pytest.fixture(scope="module")
def own_address(folder: Path) -> Iterator[str]:
    """A server of its own, which records into a folder that is empty at first."""
    (folder / "small.toml").write_text(SCENE)
    with served(folder / "small.toml", "--recordings", folder / "recordings") as (address, _):
        yield address


@pytest.fixture
def tab(browser: Browser, own_address: str) -> Iterator[Playground]:
    page = Playground(browser, own_address)
    yield page
    page.close()


def rows(tab: Playground) -> Locator:
    """The rows of the list."""
    return tab.page.locator("[data-touch^='run-open:']").locator("visible=true")


def said(tab: Playground, words: str) -> Locator:
    """A line that has these words."""
    return tab.page.get_by_text(re.compile(words)).locator("visible=true").first


def recorded(tab: Playground, before: str = "") -> str:
    """The file that the run on the page was recorded as, once the line says so and it is another than ``before``."""
    lines = tab.page.get_by_text(re.compile(r"^Recorded as \S+\.rrd"))
    found: list[str] = []

    def is_said() -> bool:
        found[:] = re.findall(r"Recorded as (\S+\.rrd)", " ".join(lines.all_inner_texts()))
        return bool(found) and found[0] != before

    tab.until(is_said, "the run is recorded")
    return found[0]


def test_failures_are_gone_through(tab: Playground, own_address: str, folder: Path) -> None:
    recordings = folder / "recordings"
    first = recorded(tab)
    tab.slide("Outliers (%)", "End")
    second = recorded(tab, first)
    tab.until(lambda: (recordings / second).exists(), "the second run is on the disk")
    inliers = {file: read_run_row(recordings / file).inliers for file in (first, second)}
    assert inliers[first] != inliers[second]

    tab.tab("Recordings")
    expect(rows(tab)).to_have_count(2)
    tab.touch("runs-filter:outcome:failure").click()
    expect(rows(tab)).to_have_count(1)
    expect(rows(tab)).to_have_attribute("data-touch", f"run-open:{second}")
    tab.touch("runs-filter:outcome:failure").click()
    tab.entry("Search").fill("no such run")
    expect(said(tab, "No recorded run fits")).to_be_visible()
    tab.entry("Search").fill("small STREET")
    expect(rows(tab)).to_have_count(2)

    # One is opened exactly as it was.
    tabs = tab.page.get_by_role("tab", name="Recordings", exact=True)
    before = tabs.bounding_box()
    rows(tab).nth(1).click()
    expect(said(tab, f"^Opened {re.escape(first)}")).to_be_visible()
    assert tabs.bounding_box() == before, "the tabs stay under the pointer"
    expect(tab.value("inliers")).to_have_text(f"{inliers[first]} of 40")
    expect(said(tab, "2 of 2")).to_be_visible()
    tab.tab("Play")
    expect(tab.entry("Seed")).to_have_value("3")
    expect(tab.thumb("Outliers (%)")).to_have_attribute("aria-valuenow", "50")

    # Something is changed, and both are seen.
    tab.slide("Noise (px)", "Home")
    expect(said(tab, "^Changed: noise px")).to_be_visible()
    expect(tab.page.locator("table.runs-beside").locator("visible=true")).to_contain_text("as recorded")
    tab.until(lambda: tab.node("/recorded/0") is not None, "the recorded camera is drawn")
    third = recorded(tab)
    tab.until(lambda: (recordings / third).exists(), "the changed run is on the disk")
    tab.touch("run-return:").click()
    expect(said(tab, f"^Opened {re.escape(first)}")).to_be_visible()

    # It is labelled; keys that are typed into a field do nothing else.
    tab.tab("Recordings")
    expect(rows(tab)).to_have_count(3)
    tab.entry("Labels").fill("[odd], seam]")
    tab.entry("Labels").press("]")
    expect(rows(tab).last).to_contain_text("seam]]")
    tab.until(lambda: read_review(recordings / first).labels == ("[odd]", "seam]]"), "the labels are stored")
    expect(said(tab, "3 of 3")).to_be_visible()

    # On by key, whichever tab is in front.
    tab.tab("Play")
    tab.page.locator("canvas").first.focus()
    tab.page.keyboard.press("[")
    expect(said(tab, f"^Opened {re.escape(second)}")).to_be_visible()
    expect(tab.value("inliers")).to_have_text(f"{inliers[second]} of 40")
    tab.page.keyboard.press("]")
    expect(said(tab, f"^Opened {re.escape(first)}")).to_be_visible()
    tab.touch("run-close:").click()
    expect(tab.touch("run-close:")).to_have_count(0)
    assert len([path for path in recordings.glob("*.rrd") if ".review." not in path.name]) == 3, "none was made twice"
    assert tab.errors == []


def test_a_link_opens_a_recording_at_its_step(tab: Playground, own_address: str, folder: Path) -> None:
    file = recorded(tab)
    tab.until(lambda: (folder / "recordings" / file).exists(), "the run is on the disk")
    row = read_run_row(folder / "recordings" / file)
    for step, number in (("", row.key_step + 1), ("&step=bearings", 2)):
        tab.page.goto(f"{own_address}/#v=1&run={file}{step}")
        expect(tab.step).to_have_value(re.compile(f"^{number}/{row.steps} "))
        expect(tab.touch("run-close:")).to_have_count(1)
        expect(tab.page).to_have_url(re.compile(f"run={re.escape(file)}&scene="))
    tab.page.goto(f"{own_address}/#v=1&run=..%2F..%2Fgone.rrd")
    expect(said(tab, "gone.rrd: is not in the list any more")).to_be_visible()
    assert tab.errors == []


def test_runs_are_viewed_and_taken_away(tab: Playground, own_address: str, folder: Path) -> None:
    recorded(tab)
    tab.tab("Recordings")
    expect(rows(tab).first).to_be_visible()
    link = tab.page.locator("a[href^='/viewer/?run=']").locator("visible=true").first
    assert link.get_attribute("target") == "_blank" and link.get_attribute("rel") == "noopener"
    with urllib.request.urlopen(own_address + str(link.get_attribute("href")), timeout=PATIENCE_MS / 1e3) as answer:
        assert answer.status == 200 and "default-src 'none'" in answer.headers["Content-Security-Policy"]
    # The link opens the viewer and not the run around it.
    with tab.page.expect_popup() as popup:
        link.click()
    popup.value.close()
    expect(tab.touch("run-close:")).to_have_count(0)

    file = str(rows(tab).first.get_attribute("data-touch")).removeprefix("run-open:")
    tab.touch(f"run-mark:{file}").click()
    expect(said(tab, "^1 marked")).to_be_visible()
    with tab.page.expect_download() as download:
        tab.touch("runs-export:").first.click()
    with zipfile.ZipFile(download.value.path()) as archive:
        assert archive.read(f"recordings/{file}") == (folder / "recordings" / file).read_bytes()
        (row,) = csv.DictReader(io.StringIO(archive.read("runs.csv").decode()))
        page = archive.read("index.html").decode()
    assert row["file"] == file and "<script" not in page and "small street" in page
    tab.page.set_content(page)
    expect(tab.page.locator("h1")).to_have_text("1 recorded run")
    assert tab.page.locator("img").first.evaluate("image => image.naturalWidth") > 0
