"""What a hand changes on the page arrives, all of it, and no older value of the server takes its place.

This is what the page's script (``changes.js``) presumes of viser's client: a new viser that works otherwise fails here.
"""

import asyncio
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import viser
from playground import BLIND, PATIENCE_MS, SIZE
from playwright.sync_api import Browser, Locator, Page, expect
from viser import _messages

from spherloc_viz.app.web.access import Access, open_socket
from spherloc_viz.app.web.downloads import Downloads
from spherloc_viz.app.web.front_door import FrontDoor
from spherloc_viz.app.web.viser_internals import (
    ANSWERS,
    at_once,
    follow_changes,
    guard_callbacks,
    put,
    put_handle,
    start_viser,
    stop_viser,
)
from tests.connected_page import KEY
from tests.waiting import LIMIT_S

HANDLE = "/handle"


class Desk:
    """The widgets of one page, and what they told."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self.failures: list[Exception] = []
        guard_callbacks(client, self.failures.append)
        self.client, self.changes = client, follow_changes(client, self._touch)
        gui = client.gui
        self.pressed: list[str] = []
        self.boxes = [gui.add_checkbox(f"Box {k}", False) for k in range(3)]
        self.number = gui.add_number("Number", 1000)
        self.text = gui.add_text("Text", "")
        self.slider = gui.add_slider("Slider", 0, 100, 1, 50)
        self.choice = gui.add_dropdown("Choice", ("one", "two", "three"))
        self.buttons = gui.add_button_group("Buttons", ("A", "B"))
        self.buttons.on_click(at_once(lambda event: self.pressed.append(f"{event.target.value} {self.number.value}")))
        self.handle = client.scene.add_transform_controls(HANDLE)
        self._mark = gui.add_html("mark 0")
        self._marks = 0

    def _touch(self, report: Any) -> None:
        self.pressed.append(f"{report} {self.number.value}")

    def mark(self, page: Page) -> None:
        """Wait until the page shows whatever was sent before."""
        self._marks += 1
        self._mark.content = f"mark {self._marks}"
        expect(page.get_by_text(f"mark {self._marks}", exact=True)).to_be_visible()


class Stage:
    """viser, and the front door before it."""

    def __init__(self) -> None:
        self.desks: list[Desk] = []
        self._server = start_viser(KEY)
        self._server.on_client_connect(lambda client: self.desks.append(Desk(client)))
        self._loop, self._leaving, self._open = asyncio.new_event_loop(), asyncio.Event(), threading.Event()
        self.address = ""
        self._thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._serve()))
        self._thread.start()
        assert self._open.wait(PATIENCE_MS / 1000)

    async def _serve(self) -> None:
        with open_socket("127.0.0.1", 0) as listener:
            self.address = f"http://127.0.0.1:{listener.getsockname()[1]}"
            door = FrontDoor("127.0.0.1", self._server.get_port(), KEY, Access(False), Downloads())
            runner = await door.start(listener)
            self._open.set()
            await self._leaving.wait()
            await runner.cleanup()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._leaving.set)
        self._thread.join(LIMIT_S)
        self._loop.close()
        stop_viser(self._server)


@pytest.fixture
def stage() -> Iterator[Stage]:
    stage = Stage()
    yield stage
    stage.close()


@pytest.fixture(scope="module")
def only_page(browser: Browser) -> Iterator[Page]:
    """One for all tests: a new one costs twice the time."""
    context = browser.new_context(viewport=SIZE)  # pyright: ignore[reportArgumentType]
    context.add_init_script(BLIND)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    yield page
    context.close()


@pytest.fixture
def page(only_page: Page, stage: Stage) -> Iterator[Page]:
    only_page.goto(stage.address)
    expect(only_page.get_by_text("mark 0", exact=True)).to_be_visible()
    yield only_page
    only_page.goto("about:blank")


def field(page: Page, handle: Any) -> Locator:
    """Where a widget is typed into or clicked."""
    name = page.locator(f"label[for='{handle._impl.uuid}']")
    flex = name.locator("xpath=ancestor::*[contains(@class, 'Flex-root')][1]")
    return flex.locator("input:not([type='hidden'])")


def until(page: Page, condition: Any, what: str) -> None:
    for _ in range(PATIENCE_MS // 50):
        if condition():
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"waited in vain until {what}")


def send(desk: Desk, handle: Any, value: Any, answers: int) -> None:
    """A value from the server that answers the changes up to a number, and is on its way whatever Python has."""
    update = _messages.GuiUpdateMessage(handle._impl.uuid, {"value": value, ANSWERS: answers})
    desk.client._websock_connection.queue_message(update)


def test_nothing_is_lost_that_is_changed_at_once(page: Page, stage: Stage) -> None:
    """viser's page would send one of these, and the last of those within 50 ms."""
    (desk,) = stage.desks
    buttons = [page.get_by_role("button", name=name, exact=True).element_handle() for name in "AB"]
    boxes = [field(page, box).element_handle() for box in desk.boxes]
    page.evaluate("all => all.forEach(one => one.click())", [*boxes, buttons[0], boxes[0], *buttons])
    until(page, lambda: len(desk.pressed) == 3, "all presses arrive")
    assert desk.pressed == ["A 1000", "A 1000", "B 1000"]
    assert [box.value for box in desk.boxes] == [False, True, True]
    field(page, desk.number).fill("5")
    page.evaluate("one => { one.click(); window.spherlocReport('touch'); }", buttons[1])
    until(page, lambda: len(desk.pressed) == 5, "the presses arrive")
    assert desk.pressed[-2:] == ["B 5", "touch 5"], "what was typed before arrives before"
    assert not desk.failures


def test_a_press_counts_for_what_it_met_though_the_page_moves_beneath_it(page: Page, stage: Stage) -> None:
    """As when a progress bar comes or goes above: a browser makes no click where a press and its end meet others."""
    (desk,) = stage.desks
    choice, number = field(page, desk.choice), field(page, desk.number)

    def press(place: Locator) -> None:
        at, pressed = place.bounding_box(), place.element_handle()
        assert at is not None
        page.mouse.move(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
        page.mouse.down()
        pressed.evaluate("one => { one.style.transform = 'translate(0, 200px)'; }")
        page.mouse.up()
        pressed.evaluate("one => { one.style.transform = ''; }")

    choice.click()
    press(page.get_by_role("option", name="three", exact=True))
    expect(choice).to_have_value("three")
    press(field(page, desk.boxes[1]))
    press(page.get_by_role("button", name="B", exact=True))
    until(page, lambda: bool(desk.pressed), "the last press arrives")
    assert desk.pressed == ["B 1000"] and desk.choice.value == "three"
    assert [box.value for box in desk.boxes] == [False, True, False]
    # Who goes on elsewhere at once keeps what is typed there: only the list that was chosen from is left.
    choice.click()
    page.get_by_role("option", name="two", exact=True).evaluate(
        "(one, field) => { one.click(); field.focus(); return new Promise(done => setTimeout(done, 200)); }",
        number.element_handle(),
    )
    assert number.evaluate("one => one === document.activeElement")


def test_an_older_value_is_dropped_and_an_answer_is_shown(page: Page, stage: Stage) -> None:
    (desk,) = stage.desks
    number, text, choice = (field(page, handle) for handle in (desk.number, desk.text, desk.choice))
    number.fill("10000000")
    text.fill("typed")
    choice.click()
    page.get_by_role("option", name="two", exact=True).click()
    page.keyboard.press("Tab")
    until(page, lambda: desk.choice.value == "two", "the choice arrives")
    assert (desk.number.value, desk.text.value) == (10_000_000, "typed")
    newest = desk.changes.now()
    for handle, value in ((desk.number, 1000), (desk.text, "old"), (desk.choice, "three")):
        send(desk, handle, value, desk.changes.of(handle._impl.uuid) - 1)
        with desk.changes.as_of(desk.changes.of(handle._impl.uuid) - 1):
            put(handle, value)
    desk.mark(page)
    expect(number).to_have_value("10000000")
    expect(text).to_have_value("typed")
    expect(choice).to_have_value("two")
    assert (desk.number.value, desk.text.value, desk.choice.value) == (10_000_000, "typed", "two")
    with desk.changes.as_of(newest):
        for handle, value in ((desk.number, 7), (desk.text, "new"), (desk.choice, "one")):
            put(handle, value)
    expect(number).to_have_value("7")
    expect(text).to_have_value("new")
    expect(choice).to_have_value("one")
    number.fill("8")
    until(page, lambda: desk.number.value == 8, "the change after it arrives")
    assert not desk.failures


def test_a_value_that_waits_for_a_frame_is_dropped_if_the_hand_is_faster(page: Page, stage: Stage) -> None:
    (desk,) = stage.desks
    box = field(page, desk.boxes[0])
    left = page.evaluate(
        """([box, uuid]) => {
            const queue = window.__viserMutable.messageQueue;
            queue.push({type: "GuiUpdateMessage", uuid, updates: {value: false}});
            document.getElementById(box).click();
            return queue.filter(one => one.uuid === uuid).length;
        }""",
        [box.get_attribute("id"), desk.boxes[0]._impl.uuid],
    )
    assert left == 0
    until(page, lambda: desk.boxes[0].value, "the change arrives")
    expect(box).to_be_checked()


def test_what_is_typed_and_not_told_yet_stays_until_the_field_is_left(page: Page, stage: Stage) -> None:
    (desk,) = stage.desks
    number, slider = field(page, desk.number), field(page, desk.slider)
    for box, handle, shown in ((number, desk.number, "42"), (slider, desk.slider, "43")):
        box.click()
        box.press("ControlOrMeta+a")
        box.press("-")
        put(handle, int(shown))
        desk.mark(page)
        expect(box).not_to_have_value(shown)
        box.blur()
        expect(box).to_have_value(shown)
    number.click()
    number.press("ControlOrMeta+a")
    number.press("-")
    put(desk.number, 1)
    desk.mark(page)
    number.press("5")
    number.blur()
    until(page, lambda: desk.number.value == -5, "what is typed in the end counts")
    desk.mark(page)
    expect(number).to_have_value("-5")


def test_what_cannot_be_taken_over_is_put_right_on_the_page(page: Page, stage: Stage) -> None:
    """Such as an entry that is no longer in a list when the choice arrives."""
    (desk,) = stage.desks
    choice = field(page, desk.choice)
    choice.click()
    desk.choice._impl.props.options = ("one", "two")
    page.get_by_role("option", name="three", exact=True).click()
    page.keyboard.press("Tab")
    until(page, lambda: desk.changes.now() > 0, "the choice arrives")
    expect(choice).to_have_value("one")
    assert desk.choice.value == "one"


def test_a_handle_stays_where_it_was_dragged(page: Page, stage: Stage) -> None:
    (desk,) = stage.desks
    told: list[float] = []
    desk.handle.on_update(at_once(lambda event: told.append(float(event.target.position[0]))))
    read = "name => Array.from(window.__viserMutable.nodePoseData[name].position)"
    until(page, lambda: page.evaluate("() => Boolean(window.__viserMutable?.nodePoseData['/handle'])"), "it is there")
    drag = """([name, x]) => {
        const message = {type: "TransformControlsUpdateMessage", name, wxyz: [1, 0, 0, 0], position: [x, 0, 0]};
        window.__viserMutable.sendMessage({...message, owner: OWNER});
        window.__viserMutable.nodePoseData[name].position = [x, 0, 0];
    }""".replace("OWNER", repr(desk.client.scene._owner_id))
    page.evaluate(drag, [HANDLE, 3.0])
    until(page, lambda: told == [3.0], "the drag arrives")
    assert desk.changes.of(HANDLE) == desk.changes.now() > 0
    with desk.changes.as_of(0):
        put_handle(desk.handle, (1, 0, 0, 0), (9.0, 0, 0))
        assert desk.handle.position[0] == 3.0
        desk.handle.position = (8.0, 0, 0)
    desk.mark(page)
    assert page.evaluate(read, HANDLE) == [3.0, 0, 0]
    put_handle(desk.handle, (1, 0, 0, 0), (4.0, 0, 0))
    until(page, lambda: page.evaluate(read, HANDLE) == [4.0, 0, 0], "an answer moves it")


def test_a_viewer_that_moves_sees_in_the_same_frame_what_was_sent_with_it(page: Page, stage: Stage) -> None:
    """Without a graphics card a frame takes a second, in which the old objects would stand in the new view."""
    (desk,) = stage.desks
    page.evaluate(
        """() => {
            const {scene, nodeRefFromName} = window.__viserMutable;
            window.__frames = [];
            scene.onBeforeRender = (renderer, drawn, camera) => {
                let corners = 0;
                const count = one => { corners ||= one.geometry?.attributes.position.count ?? 0; };
                nodeRefFromName["/thing"]?.traverse(count);
                window.__frames.push([Math.round(camera.position.length()), corners]);
            };
        }"""
    )
    for size in range(5, 15):
        corners, camera = np.random.default_rng(size).normal(size=(size, 3)), desk.client.camera
        with desk.client.atomic():
            camera.position, camera.look_at = (0.0, 0.0, -float(size)), (0.0, 0.0, 0.0)
            desk.client.scene.add_mesh_simple("/thing", corners.astype(np.float32), np.array([[0, 1, 2]], np.uint32))
        until(page, lambda size=size: page.evaluate("window.__frames.at(-1)") == [size, size], f"view {size} is drawn")
    frames = page.evaluate("window.__frames")
    assert [frame for frame in frames if frame[1] != frame[0] > 5] == []
