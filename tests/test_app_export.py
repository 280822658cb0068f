"""What is taken from the page elsewhere is what the page shows, and asking for it never blocks."""

import base64
import io
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
import zstandard
from PIL import Image

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc_viz.app.panels import export_panel
from spherloc_viz.app.panels.export_panel import CANVAS, ExportPanel, Shown, code_html, file_stem, picture_png
from spherloc_viz.app.stage.still_page import Still, still_html
from spherloc_viz.layers import paint, steps
from spherloc_viz.recording.content.data import read_recording
from tests.connected_page import KEY, ConnectedPage
from tests.waiting import until

EVIL = '</script><img src=x onerror="alert(1)">&'


@pytest.fixture(scope="module")
def shown(scene_of: Callable[..., SyntheticScene]) -> Shown:
    trace = estimate(scene_of("panorama", correspondences=25, outlier_rate=0.4).problem(1), "mc")
    picture = paint(trace, len(steps(trace)) - 1)
    return Shown(trace, picture.scene, None, "Small street, 40 %", "mc on 25 matches", None, dark=True)


@pytest.fixture
def page(server: viser.ViserServer) -> Iterator[ConnectedPage]:
    page = ConnectedPage(server, KEY)
    yield page
    page.close()


def press(panel: ExportPanel, job: Callable[[], None]) -> str:
    """What the panel says at the end."""
    panel._background.ask(job)
    until(lambda: not panel._background._busy)
    return panel._status.content


def still(shown: Shown, **changes: Any) -> Still:
    values = {
        "title": shown.title,
        "note": shown.note,
        "items": shown.items,
        "backdrop": None,
        "aligned_from_map": np.eye(3),
        "position": np.array([3.0, -4.0, 5.0]),
        "target": np.array([1.0, 2.0, 3.0]),
        "up": np.array([0.0, -1.0, 0.0]),
        "field_of_view_rad": 0.7,
        "dark": True,
    }
    return Still(**values | changes)


def embedded(html: str) -> list[dict[str, Any]]:
    """The messages that draw the scene in a file, as viser's page reads them."""
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', html)
    assert found is not None
    data = base64.b64decode(found[1])
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = int.from_bytes(inner[:8], "little")
    return [message for _, message in msgspec.msgpack.decode(inner[8 : 8 + length])["messages"]]


def test_the_file_holds_what_is_drawn_and_from_where(shown: Shown) -> None:
    html = still_html(still(shown))
    messages = embedded(html)
    nodes = {message["name"] for message in messages if "props" in message and "name" in message}
    for item in shown.items:
        assert any(name == f"/{item.name}" or name.startswith(f"/{item.name}/") for name in nodes), item.name
    by_type = {message["type"]: message for message in messages}
    assert by_type["SetCameraPositionMessage"]["position"] == [3.0, -4.0, 5.0]
    assert by_type["SetCameraLookAtMessage"]["look_at"] == [1.0, 2.0, 3.0]
    assert by_type["SetCameraFovMessage"]["fov"] == 0.7
    assert "Small street, 40 %" in html and "maximum clique" in html and "mc on 25 matches" in html
    assert "RunJavascriptMessage" not in by_type


def test_the_file_needs_and_allows_no_network(shown: Shown) -> None:
    html = still_html(still(shown, title=EVIL, note=EVIL))
    assert EVIL not in html and "&lt;img src=x onerror=&quot;alert(1)&quot;&gt;&amp;" in html
    policy = re.search(r'<head><meta http-equiv="Content-Security-Policy" content="([^"]+)">', html)
    assert policy is not None, "the policy stands before everything that it is about"
    rules = dict(rule.split(" ", 1) for rule in policy[1].split("; "))
    assert rules["default-src"] == "'none'" and rules["connect-src"] == "data: blob:"
    assert "unsafe-inline" not in rules["script-src"] and "http" not in policy[1]
    shell = re.sub(r"<script\b[^>]*>.*?</script>", "", html, flags=re.DOTALL)
    assert not re.search(r"""(src|href)=["'](https?:)?//""", shell), "nothing is fetched from elsewhere"


def test_dark_and_light_are_kept(shown: Shown) -> None:
    for dark in (True, False):
        assert f"darkMode:{str(dark).lower()}" in still_html(still(shown, dark=dark))


def test_code_is_escaped_and_copied_whole() -> None:
    html = code_html("Python", f'print("{EVIL}")\n')
    assert EVIL not in html and "<img" not in html
    copied = re.search(r'data-copy="([^"]*)"', html)
    assert copied is not None and "&quot;" in copied[1] and "\n" in copied[1]


@pytest.mark.parametrize(
    "title, stem",
    [
        ("Small street, 40 %", "spherloc-small-street-40-mc"),
        ("uploaded: ../../x\0.csv", "spherloc-uploaded-x-csv-mc"),
        ("", "spherloc-mc"),
        ("x" * 300, "spherloc-" + "x" * 71),
    ],
)
def test_file_names_are_plain(shown: Shown, title: str, stem: str) -> None:
    assert file_stem(replace(shown, title=title)) == stem


@pytest.mark.parametrize("title", ["Street", "", "τ − σ", "word " * 400, "x" * 400])
def test_a_picture_lies_on_the_colour_of_the_page_above_its_words(title: str) -> None:
    pixels = np.zeros((480, 640, 4), np.uint8)
    pixels[100:300, 200:400] = (200, 40, 60, 255)
    picture = np.array(Image.open(io.BytesIO(picture_png(pixels, title, "Outcome", dark=True))))
    assert picture.shape[1:] == (640, 3) and 500 < len(picture) < 560
    assert np.all(picture[100:300, 200:400] == (200, 40, 60)) and np.all(picture[:100] == CANVAS[True])
    drawn = (picture[480:] > 100).any(axis=2)
    assert drawn[len(drawn) // 2 :].any() and drawn[: len(drawn) // 2].any() == bool(title)
    assert not drawn[:, -10:].any(), "a long title is cut"


def test_words_below_a_picture_are_told_apart() -> None:
    def below(note: str) -> bytes:
        picture = Image.open(io.BytesIO(picture_png(np.zeros((480, 640, 4), np.uint8), "Street", note, dark=False)))
        return np.array(picture)[480:].tobytes()

    assert len({below(note) for note in ("Outcome", "Matches", "τ", "−")}) == 4, "a letter that the font lacks"


def test_the_picture_is_what_the_browser_draws(page: ConnectedPage, shown: Shown) -> None:
    drawn = np.zeros((72, 128, 4), np.uint8)
    drawn[:, 60:] = (10, 200, 30, 255)

    def answer(message: dict[str, Any]) -> dict[str, Any] | None:
        if message["type"] != "GetRenderRequestMessage":
            return None
        assert (message["height"], message["width"]) == (72, 128)
        out = io.BytesIO()
        Image.fromarray(drawn).save(out, "PNG")
        reply = {"type": "GetRenderResponseMessage", "payload": out.getvalue()}
        return reply | {"render_uuid": message["render_uuid"]}

    page.answer = answer
    panel = ExportPanel(page.handle.gui, page.handle, lambda: shown)
    assert "spherloc-small-street-40-mc.png" in press(panel, panel._picture)
    until(lambda: "spherloc-small-street-40-mc.png" in page.files)
    picture = np.array(Image.open(io.BytesIO(page.files["spherloc-small-street-40-mc.png"])))
    assert np.all(picture[:72, 60:] == (10, 200, 30)) and np.all(picture[:72, :60] == CANVAS[True])
    assert len(picture) > 90, "scene and step stand below"


def test_a_browser_that_draws_nothing_is_waited_for_in_vain(
    page: ConnectedPage, shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export_panel, "PATIENCE_S", 0.2)
    panel = ExportPanel(page.handle.gui, page.handle, lambda: shown)
    assert "keep its tab in front and try again" in press(panel, panel._picture)


def test_the_scene_is_sent_as_a_file(page: ConnectedPage, shown: Shown) -> None:
    panel = ExportPanel(page.handle.gui, page.handle, lambda: shown)
    press(panel, panel._page)
    until(lambda: "spherloc-small-street-40-mc.html" in page.files)
    until(lambda: page.files["spherloc-small-street-40-mc.html"].endswith(b"</html>\n"))
    position = {m["type"]: m for m in embedded(page.files["spherloc-small-street-40-mc.html"].decode())}
    assert np.allclose(position["SetCameraPositionMessage"]["position"], page.handle.camera.position)


def test_the_recording_of_the_run_is_sent(page: ConnectedPage, shown: Shown, tmp_path: Path) -> None:
    panel = ExportPanel(page.handle.gui, page.handle, lambda: shown)
    press(panel, panel._recording)
    until(lambda: "spherloc-small-street-40-mc.rrd" in page.files)
    path = tmp_path / "run.rrd"
    path.write_bytes(page.files.pop("spherloc-small-street-40-mc.rrd"))
    again = read_recording(path)
    assert np.array_equal(again.problem.pixels, shown.trace.problem.pixels)
    path.write_bytes(b"recorded before")
    known = replace(shown, recorded=path)
    panel = ExportPanel(page.handle.gui, page.handle, lambda: known)
    press(panel, panel._recording)
    until(lambda: page.files.get("spherloc-small-street-40-mc.rrd") == b"recorded before")


def test_nothing_to_export_and_gone_recordings_are_said(page: ConnectedPage, shown: Shown) -> None:
    panel = ExportPanel(page.handle.gui, page.handle, lambda: None)
    assert "There is nothing to export yet" in press(panel, panel._page)
    panel.draw("a = 1", "spherloc run x")
    before = panel._text.content
    panel.draw("a = 1", "spherloc run x")
    assert panel._text.content is before and "spherloc run x" in before
    panel.close()
    panel._background.ask(lambda: pytest.fail("a closed panel does nothing more"))
