"""What is changed about viser itself."""

import sys
import threading
import time
from collections.abc import Iterator

import pytest
import viser
from viser import _messages

from spherloc_viz.app.web.viser_internals import (
    at_once,
    guard_callbacks,
    sent_at_once,
    start_viser,
    stop_viser,
)
from tests.connected_page import HELLO, KEY, ConnectedPage
from tests.waiting import until

THREADS, ROUNDS, MESSAGES = 4, 30, 20


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = start_viser(KEY)
    yield server
    stop_viser(server)


@pytest.fixture
def pages(server: viser.ViserServer) -> Iterator[list[ConnectedPage]]:
    """Two pages that wait for messages."""
    pages = [ConnectedPage(server, KEY) for _ in range(2)]
    yield pages
    for page in pages:
        page.close()


@pytest.fixture
def hasty() -> Iterator[None]:
    """Threads take turns as often as can be."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def test_threads_that_queue_messages_at_once_neither_fail_nor_lose_one(
    server: viser.ViserServer, pages: list[ConnectedPage], hasty: None
) -> None:
    """After every round all messages arrive without another that would wake whoever sends them."""
    heard: list[set[str]] = [set(), set()]
    for page, names in zip(pages, heard, strict=True):
        page.answer = lambda message, names=names: names.add(message.get("uuid", ""))
    ways = [server._websock_server, *(page.handle._websock_connection for page in pages)]
    failures: list[Exception] = []

    def queue(number: int, turn: int) -> None:
        try:
            for k in range(MESSAGES):
                for way, name in zip(ways, ("all", "0", "1"), strict=True):
                    message = _messages.GuiUpdateMessage(f"{name}.{turn}.{number}.{k}", {"value": k})
                    way.queue_message(message)
        except Exception as error:
            failures.append(error)

    for turn in range(ROUNDS):
        threads = [threading.Thread(target=queue, args=(number, turn)) for number in range(THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not failures
        for page, names in enumerate(heard):
            marks = [f"{turn}.{number}.{k}" for number in range(THREADS) for k in range(MESSAGES)]
            wanted = {f"{way}.{mark}" for way in ("all", page) for mark in marks}
            until(lambda wanted=wanted, names=names: wanted <= names)


def test_nobody_is_woken_on_a_thread_of_ours(server: viser.ViserServer, pages: list[ConnectedPage]) -> None:
    ways = [server._websock_server, *(page.handle._websock_connection for page in pages)]
    for way in ways:
        event = way.get_message_buffer().message_event
        until(lambda event=event: len(event._waiters) > 0 and not event.is_set())
        event.set()
        assert not event.is_set()


def test_what_is_sent_at_once_comes_together_even_if_the_drawing_fails(pages: list[ConnectedPage]) -> None:
    """Nothing is sent before the end, and nothing is left waiting for a message that comes later."""
    page = pages[0]
    heard: list[str] = []
    page.answer = lambda message: heard.append(message.get("uuid", ""))
    buffer = page.handle._websock_connection.get_message_buffer()
    with pytest.raises(ZeroDivisionError), sent_at_once(page.handle):
        for name in ("first", "second"):
            page.handle._websock_connection.queue_message(_messages.GuiUpdateMessage(name, {"value": 1}))
        buffer.flush()
        time.sleep(0.2)
        assert "first" not in heard
        raise ZeroDivisionError
    until(lambda: "second" in heard)
    assert [name for name in heard if name in ("first", "second")] == ["first", "second"]
    assert buffer.atomic_counter == 0


def test_what_is_to_be_done_at_once_is_done_on_the_loop_in_order_and_its_failures_are_told(
    server: viser.ViserServer, pages: list[ConnectedPage]
) -> None:
    """Each message is dealt with before the next one, which changes the widget's value, is read."""
    failures: list[Exception] = []
    client = pages[0].handle
    guard_callbacks(client, failures.append)
    field = client.gui.add_number("Number", 0)
    heard: list[tuple[object, float, str]] = []

    @at_once
    def hear(event: viser.GuiEvent) -> None:
        heard.append((event.client_id, event.target.value, threading.current_thread().name))
        if event.target.value == ROUNDS:
            raise ValueError("the last")

    field.on_update(hear)
    for value in range(1, ROUNDS + 1):
        pages[0].send({"type": "GuiUpdateMessage", "uuid": field._impl.uuid, "updates": {"value": value}})
    until(lambda: failures)
    assert [(number, value) for number, value, _ in heard] == [(client.client_id, k + 1) for k in range(ROUNDS)]
    assert len({thread for _, _, thread in heard}) == 1 and str(failures[0]) == "the last"
    field.value = 0
    assert heard[-1] == (None, 0, threading.current_thread().name), "and where Python sets it, right there"


def test_where_nobody_can_stand_a_page_does_not_stand(server: viser.ViserServer, pages: list[ConnectedPage]) -> None:
    """viser keeps whatever a page says, and raises when the viewer is moved from there."""
    page, camera, nan = pages[0], pages[0].handle.camera, float("nan")
    for wrong in (
        {"position": (nan, 0.0, 0.0)},
        {"look_at": (1e308, 1e308, 1e308), "position": (-1e308, -1e308, -1e308)},
        {"look_at": HELLO["position"]},
        {"up_direction": (0.0, 0.0, 0.0)},
        {"wxyz": (1.0, 0.0)},
        {"look_at": "ab"},
    ):
        page.send(HELLO | wrong)
    page.send(HELLO | {"fov": 0.5})
    until(lambda: camera.fov == 0.5)
    camera.position = (1.0, 2.0, 3.0)
    assert tuple(camera.look_at) == (1.0, 2.0, 6.0)
