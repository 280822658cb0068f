"""Pages of an audience show the presenter's run, each with a state of its own, and can do nothing on the server."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import viser

from spherloc_viz.app import audience as audience_module
from spherloc_viz.app import session as session_module
from spherloc_viz.app.audience import Audience
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.web.access import Role
from spherloc_viz.app.web.touch import Touch
from tests.test_app_sessions import KEY, House, Page
from tests.tiny_scene import write_tiny_scene
from tests.waiting import until

MAY_PRESS = {
    "define",
    "select",
    "deselect",
    "step",
    "move",
    "projector",
    "window",
    "reveal",
    "views",
    "yaw-zoom",
    "graph-cell",
    "graph-look",
    "ball-page",
    "select-bin",
    "image-pick",
    "image-reference",
    "lens",
    "match-sort",
    "match-filter",
    "match-page",
}
"""Looking, selecting, and walking through steps."""
MAY_SET = ("Timeline", "Step", "Pace", "Keys B, N, P", "View", "Yaw", "Rows")
"""Widgets that hold a value, beside switches."""


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[House]:
    monkeypatch.setattr(session_module, "QUIET_S", 0.3)
    opened = House(Catalog(write_tiny_scene(tmp_path)))
    yield opened
    opened.close()


def seat(house: House) -> tuple[Page, Audience]:
    """A page of the audience."""
    known = set(house.sessions._open)
    house.pages.append(Page(house.server.get_port(), KEY, Role.AUDIENCE))
    until(lambda: set(house.sessions._open) - known)
    (number,) = set(house.sessions._open) - known
    found = house.sessions._open[number]
    assert isinstance(found, Audience)
    return house.pages[-1], found


def drawn(page: Audience) -> Any:
    """The run that a page shows."""
    return None if page._display._shown is None else page._display._shown[0]


def title(page: Any) -> str:
    """Of the step at hand."""
    return page._display.panels.steps._choice.value.split("  ")[1]


def test_an_audience_follows_the_presenter_each_with_a_state_of_its_own(house: House) -> None:
    _, early = seat(house)
    until(lambda: audience_module.WAITING in early._status._line.content)
    presenter_page, presenter = house.visit()
    other_page, other = seat(house)
    for page in (early, other):
        until(lambda page=page: drawn(page) is presenter._run is not None)
        until(lambda page=page: "The presenter shows tiny" in page._status._line.content)
        until(lambda page=page: len(page._display.panels.steps._choice.options) > 1)
    opening, presented = title(early), title(presenter)
    for ending in ("Refinement", "Outcome"):
        steps = other._display.panels.steps
        other_page.set(steps._choice, next(name for name in steps._choice.options if name.endswith(ending)))
        until(lambda ending=ending: title(other) == ending)
    told = presenter._display.panels._diagnosis  # at the last step
    until(lambda: "Diagnosing" not in told.content and other._display.panels._diagnosis.content == told.content != "")
    assert (title(presenter), title(early)) == (presented, opening) and opening != "Outcome"
    other._touches.deliver(Touch("select", "3", 0, 0, 0, 0, False))
    until(lambda: "Match 3" in other._display.card._html.content)
    assert "Only the presenter changes matches" in other._display.card._html.content
    assert not early._display.card._panel.visible and not presenter._display.card._panel.visible

    def noisier() -> bool:
        return drawn(other) is drawn(early) is presenter._run and presenter._run.request.scene.variation.noise_px == 3.0

    presenter_page.set(presenter._controls.scene._simulation._noise, 3.0)
    until(noisier)
    # Each keeps its step; the list of the steps is put on a page after the canvas.
    until(lambda: (title(other), title(early)) == ("Outcome", opening))
    # What the presenter hides, the audience cannot see; what its own switch hides, nobody else misses.
    until(lambda: "off the truth" in other._display.panels.steps._text.content)
    presenter_page.set(presenter._controls.display._hide, True)
    until(lambda: "withheld until" in other._display.panels.steps._text.content)
    until(lambda: "tiny" not in other._status._line.content and "The presenter shows mc" in other._status._line.content)
    presenter_page.set(presenter._controls.display._hide, False)
    until(lambda: "off the truth" in other._display.panels.steps._text.content)
    house.sessions.notice("A recording was deleted.")
    assert not any(isinstance(page, Audience) for page in house.sessions._presenters())


def test_an_audience_can_do_nothing(house: House, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Neither has its page what would, nor does a changed page get anything by sending it."""
    monkeypatch.setattr(tempfile, "mkdtemp", lambda **_: pytest.fail("wrote"))
    _, presenter = house.visit()
    wire, page = seat(house)
    until(lambda: drawn(page) is presenter._run)
    gui = page._display._client.gui
    assert set(page._touches._handlers) <= MAY_PRESS
    for handle in gui._gui_input_handle_from_uuid.values():
        switch = isinstance(handle, viser.GuiCheckboxHandle)  # of what is shown
        assert switch or getattr(handle, "label", "") in MAY_SET, handle

    before = presenter._run
    monkeypatch.setattr(session_module, "estimate", lambda *_: pytest.fail("solved"))
    foreign = presenter._client.gui._gui_input_handle_from_uuid
    for uuid in list(foreign):
        for value in (True, 1, "x", 0.5):
            wire.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})
        start = {"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "t"}
        wire.send(start | {"filename": "a.csv", "mime_type": "", "part_count": 1, "size_bytes": 3})
        part = {"type": "FileTransferPart", "source_component_uuid": uuid, "transfer_uuid": "t", "part_index": 0}
        wire.send(part | {"content": b"u,v"})
    for uuid in list(presenter._client.gui._command_handle_from_uuid):
        wire.send({"type": "CommandTriggerMessage", "uuid": uuid})
    for action in presenter._touches._handlers:
        for argument in ("", "1", "a.rrd", "../../etc/passwd"):
            page._touches.deliver(Touch(action, argument, 0.5, 0.5, 0.5, 0.5, False))
    camera = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (9.0, 9.0, 9.0)}
    for name in ("/level", "/upright", "level"):
        wire.send({"type": "TransformControlsDragStartMessage", "name": name})
        wire.send({"type": "TransformControlsUpdateMessage", "name": name} | camera)
    # All of this has been read once what was sent after it has had its effect.
    wire.set(page._display.panels.steps._buttons, "Previous")
    until(lambda: title(page) != title(presenter))
    assert presenter._run is before is drawn(page)
    assert gui._current_file_upload_states == {}
    assert len(house.notes.traces) == 1 and sorted(path.name for path in tmp_path.iterdir()) == ["tiny.toml"]
