"""The run that is open, above the tabs, so that it stays in sight while something is changed and run again."""

import threading
from collections.abc import Callable
from dataclasses import replace

import viser

from spherloc.diagnosis import Diagnosis
from spherloc_viz.app.review.card import bar_html, card_html, said_html
from spherloc_viz.app.review.opened import Opened, reference_items
from spherloc_viz.app.run_request import Run, RunRequest
from spherloc_viz.layers.primitives import SceneItem


class ReviewCard:
    """Shows nothing until a recorded run is opened."""

    def __init__(self, gui: viser.GuiApi, redraw: Callable[[], None]) -> None:
        """``redraw`` has the page drawn anew."""
        self._redraw = redraw
        self._html = gui.add_html("", visible=False)
        self._opened: Opened | None = None
        self._lock = threading.Lock()
        self._where: tuple[int | None, int] = (None, 0)
        self._said = ("", False)

    @property
    def opened(self) -> Opened | None:
        """The recorded run that is open."""
        return self._opened

    def show(self, opened: Opened | None) -> None:
        """Show another run, or none."""
        with self._lock:
            self._opened = opened
        self._redraw()

    def amend(self, change: Callable[[Opened], Opened]) -> None:
        """Have the run that is open, if any, become what ``change`` makes of it."""
        with self._lock:
            before = self._opened
            self._opened = None if before is None else change(before)
        if self._opened is not before:
            self._redraw()

    def say(self, sentence: str, wrong: bool = False) -> None:
        """Show what goes on, or what went wrong, where it is seen whichever tab is in front; empty for nothing."""
        before, self._said = self._said, (sentence, wrong)
        if before != self._said:
            self._redraw()

    def became(self, asked: RunRequest, request: RunRequest) -> None:
        """The page says in its own words what it was asked for."""
        self.amend(lambda opened: replace(opened, request=request) if opened.request is asked else opened)

    def place(self, place: int | None, total: int) -> None:
        """Say where in the list the run is."""
        before, self._where = self._where, (place, total)
        if before != self._where:
            self._redraw()

    def draw(self, run: Run, diagnosis: Diagnosis | None) -> None:
        """Show what was recorded beside the run on the page."""
        opened = self._opened
        html = (
            "" if opened is None else card_html(opened, run, diagnosis, bar_html(*self._where) + said_html(*self._said))
        )
        if self._html.content != html:
            self._html.content = html
        self._html.visible = bool(html)

    def items(self, run: Run) -> tuple[SceneItem, ...]:
        """What the canvas shows beside a run."""
        opened = self._opened
        return () if opened is None else reference_items(opened, run)
