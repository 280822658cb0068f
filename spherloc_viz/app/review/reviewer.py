"""Opens recorded runs in the playground, one after another, and two of them side by side."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import viser

from spherloc.diagnosis import Diagnosis
from spherloc.types import FloatArray
from spherloc_viz.app.catalog import Run, RunRequest
from spherloc_viz.app.review.card import NAMES, bar_html, card_html, said_html, same_problem, untold_html
from spherloc_viz.app.review.filters import PAGE
from spherloc_viz.app.review.opened import AS_RECORDED, Opened, Recorded, reference_items
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.review.run_list import RunList
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.layers.primitives import SceneItem
from spherloc_viz.recording.replay import Reopened, reopen
from spherloc_viz.recording.run_row import RunRow


class ReviewCard:
    """Shows nothing until a recorded run is opened. It stands in every tab of a panel, of which one is seen: above the
    tabs it would move them when it comes."""

    def __init__(self, redraw: Callable[[], None]) -> None:
        """``redraw`` has the page drawn anew."""
        self._redraw = redraw
        self._places: list[viser.GuiHtmlHandle] = []
        self._opened: Opened | None = None
        self._lock = threading.Lock()
        self._where: tuple[int | None, int] = (None, 0)
        self._said = ("", False)
        self._reached: Path | None = None
        """File of the recorded run that the page has shown."""

    def stand(self, gui: viser.GuiApi) -> None:
        """Stand here too, in the container that is built."""
        self._places.append(gui.add_html("", visible=False))

    @property
    def opened(self) -> Opened | None:
        """The recorded run that is open."""
        return self._opened

    def show(self, opened: Opened | None) -> None:
        """Show another run, or none."""
        with self._lock:
            self._opened, self._reached = opened, None
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
        """The page has brought the request of the open run into its own form."""
        self.amend(lambda opened: replace(opened, request=request) if opened.request is asked else opened)

    def place(self, place: int | None, total: int) -> None:
        """Say where in the list the run is."""
        before, self._where = self._where, (place, total)
        if before != self._where:
            self._redraw()

    def draw(self, run: Run, diagnosis: Diagnosis | None, hidden: bool = False) -> None:
        """Show what was recorded beside the run on the page; if ``hidden``, only what the recorded run is of."""
        opened, html = self._opened, ""
        if opened is not None:
            bar = bar_html(*self._where) + said_html(*self._said)
            if run.request == opened.request:
                self._reached = opened.path
            reached = self._reached == opened.path
            html = untold_html(opened, run, bar) if hidden else card_html(opened, run, diagnosis, bar, reached)
        for widget in self._places:
            update_widget(widget, content=html, visible=bool(html))

    def items(self, run: Run) -> tuple[SceneItem, ...]:
        """What the canvas shows beside a run."""
        opened = self._opened
        return () if opened is None else reference_items(opened, run)


@dataclass(frozen=True)
class Reviewing:
    """What ``Reviewer`` needs of the page."""

    library: RunLibrary
    roots: tuple[Path, ...]
    """Folders that scenes may be opened from."""
    card: ReviewCard
    enter: Callable[[Reopened], RunRequest]
    """Makes a reopened scene known to the page, and gives the request for the run."""
    open: Callable[[RunRequest, Path, FloatArray | None], None]
    """Asks for a run that is recorded already, as this file and with this pose (3, 4)."""
    say: Callable[[str], None]
    """Shows a sentence about what goes on; an empty one for nothing."""
    complain: Callable[[str], None]
    """Shows what went wrong."""
    changed: Callable[[RunRow | None], None]
    """Another run is open, or none, or it was labelled."""


class Reviewer:
    """One page's. Presses only note what is to be opened; a background worker opens it."""

    def __init__(self, touches: Touches, runs: RunList, reviewing: Reviewing, name: str) -> None:
        self._runs, self._has = runs, reviewing
        self._background = BackgroundWorker(f"spherloc-reviewer-{name}", reviewing.complain)
        self._lock = threading.Lock()
        self._steps, self._place = 0, 0
        touches.on("run-open", lambda touch: self.ask(touch.argument))
        touches.on("run-step", self._step)
        touches.on("run-close", lambda touch: self.leave())
        touches.on("run-return", lambda touch: self._return())

    def ask(self, file: str) -> None:
        """Have a recording opened."""
        with self._lock:
            self._steps, self._place = 0, PAGE * self._runs.look.page
        self._background.ask(partial(self._open_file, file))

    def follow(self, file: str) -> Opened:
        """Open a recording whose run the page asks for by itself; raises ``RecordingError`` if it cannot be."""
        library = self._has.library
        if not library.rows([file]):
            library.prepare()
        opened = self._read(file)
        self._present(opened)
        return opened

    def compare(self, one: RunRow, other: RunRow) -> None:
        """Have the first opened and, if both are of one problem, the second one drawn beside it."""
        if same_problem(one, other):
            self._background.ask(partial(self._open_both, one.file, other.file))

    def leave(self) -> None:
        """Take the recorded run away; the page stays as it is."""
        self._has.card.show(None)
        self._runs.show(None)
        self._has.changed(None)

    def uncompare(self) -> None:
        """Take the second camera away."""
        self._has.card.amend(_alone)

    def relabelled(self, row: RunRow) -> None:
        """Take over what was said of the run that is open."""

        def change(opened: Opened) -> Opened:
            is_it = opened.recorded.row.file == row.file
            return replace(opened, recorded=replace(opened.recorded, row=row)) if is_it else opened

        self._has.card.amend(change)

    def news(self) -> RunRow | None:
        """Take over what others have said of the run that is open; its row, or None if there is nothing new."""
        opened = self._has.card.opened
        if opened is None:
            return None
        row = next(iter(self._has.library.rows([opened.recorded.row.file])), None)
        if row is None or row == opened.recorded.row:
            return None
        self.relabelled(row)
        return row

    def locate(self) -> int | None:
        """Find, and say, where in the list the run that is open is by now: None if it is not there."""
        opened = self._has.card.opened
        if opened is None:
            return None
        at, total = self._has.library.place(self._runs.look, opened.recorded.row.file, self._place)
        self._place = self._place if at is None else at
        self._has.card.place(at, total)
        return at

    def close(self) -> None:
        """Open nothing more; does not wait."""
        self._background.close()

    def _step(self, touch: Touch) -> None:
        by = {"1": 1, "-1": -1}.get(touch.argument, 0)
        with self._lock:
            self._steps += by
        self._background.ask(self._walk)

    def _walk(self) -> None:
        """Go on by as many runs as were asked for meanwhile; runs that are passed on the way are not opened."""
        with self._lock:
            by, self._steps = self._steps, 0
        look, opened = self._runs.look, self._has.card.opened
        if by == 0:
            return
        if opened is None:
            goal = look.page * PAGE + by - 1
        else:
            at, _ = self._has.library.place(look, opened.recorded.row.file, self._place)
            # A run that no longer fits the filter has left its place to the next one.
            goal = at + by if at is not None else self._place + by - (by > 0)
        row = self._has.library.at(look, goal)
        if row is None:
            self._has.say("This is the last run of the list." if by > 0 else "This is the first run of the list.")
            return
        self._place = goal
        self._open_file(row.file)

    def _open_file(self, file: str) -> None:
        self._show(self._read(file))

    def _open_both(self, one: str, other: str) -> None:
        opened = self._read(one)
        run, _ = self._has.library.read(other)
        beside = Recorded(self._has.library.row(other), run.cam_from_map, NAMES[1])
        self._show(replace(opened, recorded=replace(opened.recorded, name=NAMES[0]), other=beside))

    def _read(self, file: str) -> Opened:
        """Read a recording and open its scene."""
        row = self._has.library.row(file)
        self._has.say("Opening the recording …")
        run, path = self._has.library.read(file)
        got = reopen(run, path, self._has.roots)
        story = "" if run.origin is None else run.origin.story
        recorded = Recorded(row, run.cam_from_map)
        request = self._has.enter(got)
        return Opened(recorded, path, request, run.problem.truth_cam_from_map, got.sentence, story)

    def _show(self, opened: Opened) -> None:
        self._present(opened)
        self._has.open(opened.request, opened.path, opened.recorded.cam_from_map)

    def _present(self, opened: Opened) -> None:
        """Show what is recorded."""
        row = opened.recorded.row
        self._has.card.show(opened)
        self._runs.show(row.file, self.locate())
        self._has.changed(row)
        self._has.say("")

    def _return(self) -> None:
        opened = self._has.card.opened
        if opened is not None:
            self._has.open(opened.request, opened.path, opened.recorded.cam_from_map)


def _alone(opened: Opened) -> Opened:
    """The run without the one that it is compared with."""
    if opened.other is None:
        return opened
    return replace(opened, recorded=replace(opened.recorded, name=AS_RECORDED), other=None)
