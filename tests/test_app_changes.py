"""Numbers of changes: however messages cross and threads linger, page and server end with the newest value of each
widget, and a value that a hand set is never replaced by one that did not know it."""

from collections import deque
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc_viz.app.web.changes import Changes

WIDGETS = ("a", "b")


@dataclass
class World:
    """A page, a server and what is on its way between them. Values tell who made them."""

    changes: Changes = field(default_factory=Changes)
    number: int = 0
    page: dict[str, str] = field(default_factory=lambda: dict.fromkeys(WIDGETS, ""))
    newest: dict[str, int] = field(default_factory=lambda: dict.fromkeys(WIDGETS, 0))
    server: dict[str, str] = field(default_factory=lambda: dict.fromkeys(WIDGETS, ""))
    wanted: dict[str, str] = field(default_factory=lambda: dict.fromkeys(WIDGETS, ""))
    """What the person asked for last."""
    sent: deque = field(default_factory=deque)
    told: deque = field(default_factory=deque)
    jobs: deque = field(default_factory=deque)

    def type(self, name: str) -> None:
        """A hand changes a widget."""
        self.number += 1
        self.page[name] = self.wanted[name] = f"hand {self.number}"
        self.newest[name] = self.number
        self.sent.append((name, self.number, self.page[name]))

    def press(self, name: str) -> None:
        """A hand presses what sets a widget."""
        self.number += 1
        self.wanted[name] = f"press {self.number}"
        self.sent.append((name, self.number, self.wanted[name]))

    def hear(self, name: str) -> None:
        """The server gets the next message."""
        if self.sent:
            name, number, value = self.sent.popleft()
            if value.startswith("press"):
                with self.changes.hearing("", number):
                    self.write(name, value)
            else:
                with self.changes.hearing(name, number):
                    self.server[name] = value

    def write(self, name: str, value: str) -> None:
        with self.changes.writing(name) as number:
            if number is not None and self.server[name] != value:
                self.server[name] = value
                self.told.append((name, number, value))

    def begin(self, name: str) -> None:
        """A thread begins: it reads a widget, to write back later what it has read."""
        now = self.changes.now()
        self.jobs.append((name, now, self.server[name]))

    def finish(self, name: str) -> None:
        if self.jobs:
            name, now, value = self.jobs.popleft()
            with self.changes.as_of(now):
                self.write(name, value)

    def show(self, name: str) -> None:
        """The page gets a value."""
        if self.told:
            name, answers, value = self.told.popleft()
            if answers >= self.newest[name]:
                assert not value.startswith("hand") or int(value.split()[1]) >= self.newest[name], "an older one"
                self.page[name] = value


EVENTS = ("type", "press", "hear", "begin", "finish", "show")


@settings(max_examples=400)
@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.sampled_from(WIDGETS)), max_size=40))
def test_page_and_server_end_with_what_the_person_asked_for_last(events: list[tuple[str, str]]) -> None:
    world = World()
    for event, name in events:
        getattr(world, event)(name)
        for widget in WIDGETS:
            if world.wanted[widget].startswith("hand"):
                assert world.page[widget] == world.wanted[widget], "what was typed last is on the page all the time"
    while world.sent or world.jobs or world.told:
        for event in ("hear", "finish", "show"):
            getattr(world, event)("")
    assert world.page == world.server == world.wanted


def test_what_a_thread_knows_is_what_it_said_and_of_its_own_page() -> None:
    one, other = Changes(), Changes()
    with one.hearing("a", 5):
        assert one.moment() == 5 and other.moment() == 0
    assert one.now() == one.of("a") == 5 and one.of("b") == 0
    with one.as_of(3), other.as_of(2):
        assert one.moment() == 5, "the last that was said is of another page"
        with one.as_of(3), one.writing("a") as number:
            assert number is None
    with pytest.raises(ValueError), one.hearing("a", None):
        raise ValueError
    assert one.now() == 6, "also if a callback fails"
