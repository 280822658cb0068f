"""What a person presses in HTML and SVG that Python put on the page; viser's own HTML, plots and images are one-way.

The page carries a small script (``touch.js``). Any element with ``data-touch="ACTION:ARGUMENT"`` reports a press of the
mouse, or Enter where the element has the focus. With ``data-drag`` as well, dragging across it is reported too. Which
elements with ``data-view="NAME"`` are to be seen is reported as the action "views" with the names as its argument. A
key presses the element with ``data-key="KEY"`` that can be seen, unless something is being written. A link is never
part of what is pressed around it.
"""

import json
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import Any

MOST_BYTES = 4096
"""A report is some hundred bytes."""


@dataclass(frozen=True)
class Touch:
    """One press. Places are shares of the element's box, from its upper left corner, 0 to 1."""

    action: str
    """What stands before the colon."""
    argument: str
    """What stands behind it; whatever the page sent, so it must be checked."""
    x: float
    """Where the press ended."""
    y: float
    from_x: float
    """Where it began: elsewhere if it was a drag."""
    from_y: float
    extend: bool
    """Whether Shift, Ctrl or Cmd was held."""


Handler = Callable[[Touch], object]


class Touches:
    """The presses on one page. Handlers are called on some thread, maybe several at once; they only note wishes."""

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        """``failed`` is called with what a handler raises."""
        self.token = secrets.token_urlsafe(24)
        """Tells this page from others; no other page can know it."""
        self._failed = failed
        self._handlers: dict[str, tuple[Handler, ...]] = {}

    def on(self, action: str, handler: Handler) -> None:
        """Call ``handler`` too for every press on an element of that action."""
        self._handlers[action] = (*self._handlers.get(action, ()), handler)

    def html(self) -> str:
        """What must stand somewhere on the page for its presses to find their way here."""
        return f'<div data-session="{escape(self.token)}"></div>'

    def deliver(self, touch: Touch) -> None:
        """Hand a press to its handlers; an unknown action is ignored, since the page may show what is gone by now."""
        for handler in self._handlers.get(touch.action, ()):
            try:
                handler(touch)
            except Exception as error:
                self._failed(error)


class TouchDesk:
    """Hands reports to the page's own ``Touches``."""

    def __init__(self) -> None:
        self._open: dict[str, Touches] = {}
        self._lock = threading.Lock()

    def add(self, touches: Touches) -> None:
        """Begin to hand over what this page reports."""
        with self._lock:
            self._open[touches.token] = touches

    def remove(self, touches: Touches) -> None:
        """End it."""
        with self._lock:
            self._open.pop(touches.token, None)

    def deliver(self, body: bytes) -> bool:
        """Whether the report is well formed and its page is known; if so, it has been handled."""
        report = _parse(body)
        if report is None:
            return False
        token, touch = report
        with self._lock:
            touches = self._open.get(token)
        if touches is None:
            return False
        touches.deliver(touch)
        return True


def _parse(body: bytes) -> tuple[str, Touch] | None:
    """Token and press of a report, or None if it is none."""
    try:
        report: Any = json.loads(body)
        action, _, argument = str(report["action"]).partition(":")
        argument.encode()  # JSON can say halves of characters, which no file and no database takes
        (x, y), (from_x, from_y) = (tuple(map(_share, report[name])) for name in ("at", "from"))
        return str(report["session"]), Touch(action, argument, x, y, from_x, from_y, report["extend"] is True)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None


def _share(value: Any) -> float:
    share = float(value)
    if not 0.0 <= share <= 1.0:
        raise ValueError(share)
    return share
