"""A recording in the real Rerun viewer: at its step, paused, whole, and without a word to any other server."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from playground import PATIENCE_MS, SCENE
from playwright.sync_api import Browser, Page, expect

from spherloc.datasets import load_scene
from spherloc.estimators import estimate
from spherloc_viz import style
from spherloc_viz.app.web.viewer import viewer_link
from spherloc_viz.recording.content.data import read_run_row
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.run_row import RunRow
from tests.waiting import until

SIZE = {"width": 1000, "height": 600}
PAUSED = 1
OPENING_MS = 200_000
"""The viewer compiles 43 MB and then its shaders, in software."""
VIOLATIONS = "addEventListener('securitypolicyviolation', e => (window.refused ??= []).push(e.blockedURI))"
REACH_OUT = """() => new Promise(done => {
    const request = new XMLHttpRequest();
    request.onload = () => done("answered");
    request.onerror = () => done(window.refused);
    request.open("GET", "http://127.0.0.1:9/");
    request.send();
})"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, recordings: Path) -> Path:
    """With a run that has labels and a note."""
    scene = tmp_path_factory.mktemp("scene") / "small.toml"
    scene.write_text(SCENE)
    trace = estimate(load_scene(scene).problem(None), "mc")
    write_recording(trace, recordings / "good.rrd")
    write_review(recordings / "good.rrd", ["seam"], "Look at the left edge.")
    return recordings


@pytest.fixture(scope="module")
def row(folder: Path) -> RunRow:
    """What a list knows of the run."""
    return read_run_row(folder / "good.rrd")


@pytest.fixture(scope="module")
def home(folder: Path, address: str) -> str:
    """Address of the playground that records into the folder."""
    return address


class Tab:
    """A tab that remembers what it asked for and what went wrong."""

    def __init__(self, browser: Browser) -> None:
        self.page: Page = browser.new_context(viewport=SIZE).new_page()  # pyright: ignore[reportArgumentType]
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.add_init_script(VIOLATIONS)
        self.errors: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda socket: self.asked.append(socket.url))

    def state(self) -> dict[int, list[Any]]:
        """What the viewer says that it shows: GetStateResponse of its control service."""
        script = "() => JSON.stringify([...window.spherlocViewer.viewer_state()])"
        return message(bytes(json.loads(self.page.evaluate(script))))


def message(data: bytes) -> dict[int, list[Any]]:
    """The fields of a protobuf message by their numbers: integers, and bytes of what has a length."""
    fields: dict[int, list[Any]] = {}
    at = 0

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at, value, shift = at + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    while at < len(data):
        key = number()
        assert key & 7 in (0, 2), "only integers and what has a length are expected"
        value: Any = number()
        if key & 7:
            at, value = at + value, data[at : at + value]
        fields.setdefault(key >> 3, []).append(value)
    return fields


@pytest.fixture
def tab(browser: Browser) -> Iterator[Tab]:
    tab = Tab(browser)
    yield tab
    tab.page.context.close()


def test_it_opens_at_the_step_and_stays_at_home(tab: Tab, home: str, row: RunRow) -> None:
    step = row.key_step + 1
    tab.page.goto(home + viewer_link("good.rrd", step))
    expect(tab.page).to_have_title(f"small street, mc, seed 0: step {step} - spherloc")
    expect(tab.page.locator("body")).to_have_attribute("data-state", "open", timeout=OPENING_MS)
    state = tab.state()

    (recording,) = [message(each) for each in state[3]]
    assert recording[1] == [f"Recording:spherloc:{row.run_id}".encode()], "run and review are one recording"
    (timeline,) = [message(each) for each in recording[2]]
    assert message(timeline[3][0])[2] == [row.steps], "all steps are there"
    cursor = message(recording[3][0])
    assert message(cursor[1][0])[1] == [b"step"] and message(cursor[3][0])[1] == [step]
    assert recording[5] == [PAUSED]

    def views() -> list[dict[int, list[Any]]]:
        return [message(each) for each in tab.state()[5]]

    # The layout is ours; until it is read the viewer shows one of its own.
    until(lambda: {b"Scene", b"Step"} <= {view[3][0] for view in views()} or tab.page.wait_for_timeout(100))
    assert not [view for view in views() if 6 in view], "and no view reports a problem"

    tab.page.wait_for_function("() => !document.querySelector('#said').textContent")
    wait_until_drawn(tab.page)
    assert {url.split("/")[2] for url in tab.asked if not url.startswith(("blob:", "data:"))} == {home.split("/")[2]}
    assert [url for url in tab.asked if url.endswith("good.review.rrd")], "labels and note come along"
    assert tab.errors == [] and tab.page.evaluate("() => window.refused ?? []") == [], "nor did it try more"
    assert tab.page.evaluate(REACH_OUT) == ["http://127.0.0.1:9/"], "what would try is refused"


def wait_until_drawn(page: Page) -> None:
    """Wait until the true camera is seen in the scene."""
    truth = np.array(style.TRUTH[::-1])

    def is_drawn() -> bool:
        picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return np.count_nonzero(np.abs(picture.astype(int) - truth).max(axis=2) < 12) > 20

    until(lambda: is_drawn() or page.wait_for_timeout(500))


@pytest.mark.parametrize(
    "query, words",
    [
        ("?run=unknown.rrd&step=0", "no such recording"),
        ("?run=../../etc/passwd", "not the name of a recording"),
        ("?run=..%2F..%2Fetc%2Fpasswd", "not the name of a recording"),
        ("?run=good.rrd&step=abc", "step"),
        ("?run=good.rrd&step=4000", "there is no step 4000"),
    ],
)
def test_what_cannot_be_opened_is_one_sentence(tab: Tab, home: str, query: str, words: str) -> None:
    tab.page.goto(f"{home}/viewer/{query}")
    expect(tab.page.locator("p")).to_contain_text(words)
    assert tab.page.evaluate("() => window.refused ?? []") == []
    assert tab.page.locator("script").count() == 0


def test_a_recording_that_has_gone_is_one_sentence(tab: Tab, home: str, folder: Path) -> None:
    """Retention may delete it between the page and its data: no blank viewer then."""
    tab.page.route("**/viewer/data/good.rrd", lambda route: route.fulfill(status=404, body="good.rrd: it is gone."))
    tab.page.goto(home + viewer_link("good.rrd", 1))
    expect(tab.page.locator("#said")).to_have_text("good.rrd: it is gone.")
    expect(tab.page.locator("canvas")).to_be_hidden()
    tab.page.route("**/viewer/data/good.rrd", lambda route: route.abort())
    tab.page.reload()
    expect(tab.page.locator("#said")).to_contain_text("The server does not answer")


def test_a_browser_that_cannot_draw_is_told(tab: Tab, home: str) -> None:
    tab.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    tab.page.goto(home + viewer_link("good.rrd", 1))
    expect(tab.page.locator("#said")).to_contain_text("cannot start in this browser")
    expect(tab.page.locator("canvas")).to_be_hidden()
