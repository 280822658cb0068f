"""Presses on HTML and SVG that Python put on the page; viser's own HTML, plots and images do not report presses.

The page carries a small script (``touch.js``). Any element with ``data-touch="ACTION:ARGUMENT"`` reports a press of the
mouse, or Enter where the element has the focus. With ``data-drag`` as well, dragging across it is reported too. Which
elements with ``data-view="NAME"`` are to be seen is reported as the action "views" (``seen_views``). A key presses the
element with ``data-key="KEY"`` that can be seen, unless something is being written. A link is never part of what is
pressed around it.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

MAX_LETTERS = 20_000
"""Longest report, characters; most have some hundred, links have more."""
READY = "<div data-ready></div>"
"""HTML that makes the page report presses from now on."""


@dataclass(frozen=True)
class Touch:
    """One press. Places are shares of the element's box, from its upper left corner, 0 to 1."""

    action: str
    """The part of ``data-touch`` before the colon."""
    argument: str
    """The part behind the colon. Untrusted: it must be checked."""
    x: float
    """Place at which the press ended, with ``y``."""
    y: float
    from_x: float
    """Place at which the press began, with ``from_y``; a drag ends at another place."""
    from_y: float
    extend: bool
    """Whether Shift, Ctrl or Cmd was held."""


@dataclass(frozen=True)
class SeenViews:
    """What the action "views" reports."""

    names: frozenset[str]
    """Of the views that can be seen. Untrusted, as the others."""
    of_step: str
    """The view that the page has opened last since it goes with a step."""
    of_link: str
    """That which it has opened last for a link."""
    elsewhere: str
    """The tab of the panel right of the canvas that it has opened last for a link."""


def seen_views(argument: str) -> SeenViews:
    """What the argument of the action "views" says, "NAME,NAME;VIEW OF STEP;VIEW OF LINK;TAB OF LINK"; what is missing
    is empty."""
    names, of_step, of_link, elsewhere = (argument + ";;;").split(";")[:4]
    return SeenViews(frozenset(names.split(",")), of_step, of_link, elsewhere)


Handler = Callable[[Touch], object]


class Touches:
    """The presses on one page. Handlers are called one by one on viser's event loop: they only note requests."""

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        """``failed`` is called with what a handler raises."""
        self._failed = failed
        self._handlers: dict[str, tuple[Handler, ...]] = {}

    def on(self, action: str, handler: Handler) -> None:
        """Call ``handler`` too for every press on an element of that action."""
        self._handlers[action] = (*self._handlers.get(action, ()), handler)

    def receive(self, report: Any) -> None:
        """Pass a report of the page to its handlers; anything that is not a valid report is ignored."""
        touch = parse(report)
        if touch is not None:
            self.deliver(touch)

    def deliver(self, touch: Touch) -> None:
        """Pass a press to its handlers; others are ignored: the page may still show removed elements."""
        for handler in self._handlers.get(touch.action, ()):
            try:
                handler(touch)
            except Exception as error:
                self._failed(error)


def pixels_of(touch: Touch) -> int:
    """The width that a press tells as its argument, px; 0 if that is none."""
    told = touch.argument
    return int(told) if told.isascii() and told.isdecimal() and len(told) < 6 else 0


def parse(report: Any) -> Touch | None:
    """The press of a report; None if the report is invalid."""
    try:
        if len(report) > MAX_LETTERS:
            return None
        said: Any = json.loads(report)
        action, _, argument = str(said["action"]).partition(":")
        argument.encode()  # JSON can hold lone surrogates (halves of characters), which files and databases refuse
        (x, y), (from_x, from_y) = (tuple(map(_share, said[name])) for name in ("at", "from"))
        return Touch(action, argument, x, y, from_x, from_y, said["extend"] is True)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None


def _share(value: Any) -> float:
    share = float(value)
    if not 0.0 <= share <= 1.0:
        raise ValueError(share)
    return share
