"""The list of recordings on one page: what is filtered, sorted, turned and marked by presses."""

import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from functools import partial
from html import escape

import viser

from spherloc.errors import SpherlocError
from spherloc_viz.app.review.filters import EXACT, OUTLIERS, Look, filters_html, pill
from spherloc_viz.app.review.rows import rows_html
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.text import DIM, begun, box, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import put, update_widget
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.recording.index.query import MAX_TEXT

FOLLOW_S = 1.5
"""While the list is seen, new runs are looked for this often."""
TYPED_S = 0.25
"""What is typed is searched for when no letter has come for this long."""
MAX_MARKED = 1000


class RunList:
    """Draws on a thread that lives only while the list is seen or asked for something."""

    def __init__(
        self, gui: viser.GuiApi, touches: Touches, library: RunLibrary, name: str, drawn: Callable[[], object]
    ) -> None:
        """``drawn`` is called, on a thread of the list, whenever it may have become another one."""
        self._drawn = drawn
        self._library = library
        self._lock = threading.Lock()
        self._look = Look()
        self._marked: tuple[str, ...] = ()
        self._opened: str | None = None
        self._seen = self._hidden = self._untold = False
        self._due = threading.Event()
        self._background = BackgroundWorker(f"spherloc-runs-{name}", self._fail)
        self._search = gui.add_text("Search", "", hint="Words in the name, the message, the note, labels …")
        self._range = gui.add_text("Outliers", "", visible=False, hint="A range of shares: >0.9, 0.5..0.9 or <=0.3.")
        self._filters = gui.add_html("")
        self._problem = gui.add_html("", visible=False)
        self._rows = gui.add_html("")
        self._bar = gui.add_html("", visible=False)
        for widget in self.widgets:
            widget.on_update(self._type)
        self._listen(touches)

    @property
    def widgets(self) -> tuple[viser.GuiTextHandle, viser.GuiTextHandle]:
        """All that hold a value."""
        return (self._search, self._range)

    @property
    def look(self) -> Look:
        """What is shown now."""
        return self._look.untold() if self._untold else self._look

    @property
    def marked(self) -> tuple[str, ...]:
        """Files of the marked runs, in the order in which they were marked."""
        return self._marked

    def see(self, seen: bool) -> None:
        """Whether the list can be seen, and so follows what is recorded."""
        before, self._seen = self._seen, seen
        if seen and not before:
            self.ask()
        elif not seen:
            self._due.set()

    def show(self, opened: str | None, place: int | None = None) -> None:
        """Point out the run that is open, on the page of the list that it is on."""
        self._opened = opened
        if place is not None:
            self._change(lambda look: look.at(place))
        else:
            self.ask()

    def ask(self, after_s: float = 0.0) -> None:
        """Have the list drawn anew, if it is seen."""
        with self._lock:
            before, self._due = self._due, threading.Event()
            due = self._due
        before.set()
        if self._seen:
            self._background.ask(partial(self._follow, due, after_s))

    def hide(self, hidden: bool) -> None:
        """Make room for something else, or show the list again."""
        self._hidden = hidden
        for widget in (self._search, self._filters, self._rows):
            widget.visible = not hidden
        self._show_parts()
        self._problem.visible = False

    def hide_answers(self, hidden: bool) -> None:
        """Hide the answers of the runs, or show them again."""
        self._untold = hidden
        self.ask()

    def close(self) -> None:
        """End it; does not wait."""
        self._seen = False
        self._background.close()
        self._due.set()

    def _listen(self, touches: Touches) -> None:
        touches.on("runs-filter", self._filter)
        touches.on("runs-unfold", lambda touch: self._change(lambda look: look.unfold(touch.argument)))
        touches.on("runs-sort", lambda touch: self._change(lambda look: look.sorted(touch.argument)))
        touches.on("runs-page", lambda touch: self._change(lambda look: look.turn(touch.argument)))
        touches.on("runs-clear", self._clear)
        touches.on("runs-pages", lambda touch: self._change(lambda look: replace(look, pages=not look.pages, page=0)))
        touches.on("run-mark", self._mark)
        touches.on("runs-unmark", lambda touch: self._set_marked(()))

    def _change(self, change: Callable[[Look], Look]) -> None:
        with self._lock:
            self._look = change(self._look)
        self.ask()

    def _filter(self, touch: Touch) -> None:
        name, _, value = touch.argument.partition(":")
        if name in EXACT and len(value) > 10 * MAX_TEXT:
            return
        self._change(lambda look: look.choose(name, value))
        if name == "outliers":
            put(self._range, OUTLIERS[value] if self._look.outliers == value else "")

    def _clear(self, touch: Touch) -> None:
        put(self._search, "")
        put(self._range, "")
        self._change(lambda look: look.cleared())

    def _mark(self, touch: Touch) -> None:
        file = touch.argument
        rest = tuple(other for other in self._marked if other != file)
        self._set_marked(rest if file in self._marked else (*rest, file)[-MAX_MARKED:])

    def _set_marked(self, marked: tuple[str, ...]) -> None:
        self._marked = marked
        self.ask()

    def _type(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        with self._lock:
            typed = self._range.value.strip() or None
            known = next((name for name, range_ in OUTLIERS.items() if range_ == typed), typed)
            self._look = replace(self._look, text=self._search.value, outliers=known, page=0)
        self.ask(TYPED_S)

    def _follow(self, due: threading.Event, after_s: float) -> None:
        """Draw the list, and again whenever runs have come, until something else is asked."""
        if due.wait(after_s):
            return
        version: tuple[int, ...] | None = None
        while self._seen:
            newest = self._library.version()
            if newest != version:
                version = newest
                try:
                    self._draw()
                except SpherlocError as error:  # the error may be temporary
                    self._fail(str(error))
            if due.wait(FOLLOW_S):
                return

    def _draw(self) -> None:
        with self._lock:
            look, marked, opened, hidden = self.look, self._marked, self._opened, self._untold
        found, look = self._library.page(look)
        counts = self._library.counts(look, found.total)
        now = datetime.now().astimezone()
        parts = (
            (self._filters, filters_html(look, counts, hidden)),
            (self._rows, rows_html(found.rows, frozenset(marked), opened, found.total, look, now, hidden)),
            (self._bar, bar_html(marked)),
        )
        for widget, html in parts:
            update_widget(widget, content=html)
        self._problem.visible = False
        self._show_parts()
        self._drawn()

    def _show_parts(self) -> None:
        """Show what is needed now and then, if the list is not hidden."""
        self._range.visible = not self._hidden and self.look.unfolded == "outliers"
        self._bar.visible = not self._hidden and bool(self._marked)

    def _fail(self, sentence: str) -> None:
        self._problem.content = status_html(begun(sentence), wrong=True)
        self._problem.visible = not self._hidden


def bar_html(marked: tuple[str, ...]) -> str:
    """What can be done with the marked runs; it stays in sight (``touch.css``) while more are looked for."""
    ways = []
    if len(marked) == 2:
        ways.append(pill("compare", "runs-compare:", False, "Side by side, and both cameras on the canvas"))
    ways.append(pill("zip", "runs-export:", False, "The recordings, a table and a page to read"))
    ways.append(pill("unmark", "runs-unmark:", False, "Mark none"))
    hint = "" if len(marked) != 1 else f'<span style="{DIM}">mark another to compare</span>'
    words = f'<b style="font-weight:600">{escape(f"{len(marked):,} marked")}</b>'
    css = "display:flex;flex-wrap:wrap;gap:.5em;align-items:center"
    row = f'<div class="marked-bar" style="{css}">{words}{"".join(ways)}{hint}</div>'
    return box(row, "font-size:12px;padding-top:.5em")
