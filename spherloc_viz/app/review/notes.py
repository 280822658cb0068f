"""Labels and a note of the run that is open: stored a moment after the last letter, and at the press of a label."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from html import escape

import viser

from spherloc.errors import SpherlocError
from spherloc_viz.app.review.filters import pill
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.text import box
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import at_once, changes_of, put, update_widget
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.recording.reviews import Review, checked_review
from spherloc_viz.recording.run_row import RunRow

PAUSE_S = 0.7
"""What is typed is stored when no letter has come for this long."""
SEPARATOR = ","


@dataclass(eq=False)
class _Fields:
    """What is typed into, and the run that it is about."""

    labels: viser.GuiTextHandle
    note: viser.GuiTextHandle
    file: str | None = None
    known: Review = field(default_factory=Review)
    """What the fields were last set to, or was stored from them."""

    def read(self) -> Review:
        return Review(_split(self.labels.value), self.note.value)

    def write(self, review: Review) -> None:
        self.known = review
        put(self.labels, f"{SEPARATOR} ".join(review.labels))
        put(self.note, review.note)


class Notes:
    """Two fields, and the labels that were used before.

    There are two pairs of them, which take turns: what is typed while another run opens, and arrives when that run is
    open, is about the run that it was typed for.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        library: RunLibrary,
        name: str,
        stored: Callable[[RunRow], None],
        failed: Callable[[str], None],
    ) -> None:
        """``stored`` is called, on a thread of this part, with the row as it is by then."""
        self._library, self._stored, self._failed = library, stored, failed
        self._changes = changes_of(gui)
        hint = "Words that tell what kind of run it is, with commas between them."
        labels = [gui.add_text("Labels", "", visible=False, hint=hint) for _ in range(2)]
        self._chips = gui.add_html("", visible=False)
        notes = [gui.add_text("Note", "", visible=False, multiline=True, hint="Stored with the run.") for _ in range(2)]
        self._fields, self._others = map(_Fields, labels, notes)
        self._lock = threading.Lock()
        self._file: str | None = None
        self._hidden = self._offers = False
        self._pending: dict[str, tuple[Review, Review]] = {}
        """What the fields said before, and what they say now."""
        self._storing: str | None = None
        self._typed, self._closed = threading.Event(), False
        self._background = BackgroundWorker(f"spherloc-notes-{name}", failed)
        for widget in (*labels, *notes):
            widget.on_update(self._type)
        touches.on("run-label", self._toggle)

    @property
    def widgets(self) -> tuple[viser.GuiTextHandle, viser.GuiTextHandle]:
        """The fields of the run that is open."""
        return (self._fields.labels, self._fields.note)

    def show(self, row: RunRow | None, used: tuple[str, ...]) -> None:
        """Show what was said of a run, or nothing; ``used`` are labels that are offered.

        What is being typed is left alone; else the fields follow what other pages say of the run.
        """
        moment = self._changes.now()
        with self._lock, self._changes.as_of(moment):
            file = None if row is None else row.file
            if row is not None:
                review = Review(row.labels, row.note)
                if file != self._fields.file:
                    self._turn()
                if file != self._fields.file:
                    self._fields.file = file
                    self._fields.write(review)
                elif review != self._fields.known and not self._is_typed(file):
                    self._fields.write(review)
            self._file = file
            own = () if row is None else row.labels
            self._draw(tuple(dict.fromkeys((*own, *used))) if row is not None else (), own)
            for widget in self.widgets:
                widget.visible = row is not None and not self._hidden

    def _turn(self) -> None:
        """Take the other fields, for another run."""
        for widget in self.widgets:
            widget.visible = False
        self._fields, self._others = self._others, self._fields

    def hide(self, hidden: bool) -> None:
        """Make room for something else, or show again what is said of the run."""
        with self._lock:
            self._hidden = hidden
            for widget in self.widgets:
                widget.visible = self._file is not None and not hidden
            self._chips.visible = self._offers and not hidden

    def refresh(self, row: RunRow, used: tuple[str, ...]) -> None:
        """The run's row has changed; shown if it is still open."""
        if row.file == self._file:
            self.show(row, used)

    def close(self) -> None:
        """Store what waits; does not wait for it."""
        with self._lock:
            self._closed = True
            self._typed.set()

    def _draw(self, offered: tuple[str, ...], own: tuple[str, ...]) -> None:
        chips = "".join(pill(escape(label), f"run-label:{label}", label in own, label) for label in offered)
        html = box(f'<div style="display:flex;flex-wrap:wrap;gap:.3em">{chips}</div>', "font-size:12px")
        update_widget(self._chips, content=html)
        self._offers = bool(offered)
        self._chips.visible = self._offers and not self._hidden

    @at_once
    def _type(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        with self._lock:
            about = self._fields if event.target in self.widgets else self._others
            self._note_down(about, PAUSE_S)

    def _toggle(self, touch: Touch) -> None:
        label = touch.argument.strip()
        with self._lock:
            if self._file is None:
                return
            labels = self._fields.read().labels
            rest = tuple(other for other in labels if other != label)
            put(self._fields.labels, f"{SEPARATOR} ".join(rest if label in labels else (*labels, label)))
            self._note_down(self._fields, 0.0)

    def _note_down(self, fields: _Fields, pause_s: float) -> None:
        """Have what fields say stored; the lock is held."""
        if fields.file is None:
            return
        base, _ = self._pending.get(fields.file, (fields.known, None))
        self._pending[fields.file] = base, fields.read()
        self._typed.set()
        self._typed = threading.Event()
        self._background.ask(partial(self._store, self._typed, pause_s))

    def _store(self, typed: threading.Event, pause_s: float) -> None:
        """Store all that waits, unless more is typed meanwhile: what comes then is stored by the next job."""
        if typed.wait(pause_s) and not self._closed:
            return
        while True:
            with self._lock:
                if not self._pending:
                    return
                file, (before, now) = next(iter(self._pending.items()))
                del self._pending[file]
                self._storing, known = file, before
                about = next((one for one in (self._fields, self._others) if one.file == file), None)
                if about is not None:
                    about.known = now
            try:
                row = self._library.review(file, before, now)
                stored = Review(row.labels, row.note)
                known = stored if stored == checked_review(now.labels, now.note) else now
            except SpherlocError as error:  # what was said of other runs is stored all the same
                self._failed(str(error))
            finally:
                with self._lock:
                    self._storing = None
                    if about is not None and about.known is now:
                        about.known = known
                    if file in self._pending and self._pending[file][0] is now:  # typed while this was being stored
                        self._pending[file] = known, self._pending[file][1]
            if known is not before:
                self._stored(row)

    def _is_typed(self, file: str | None) -> bool:
        """Whether the fields say of a run what is not stored yet."""
        return file in self._pending or file == self._storing


def _split(text: str) -> tuple[str, ...]:
    """The labels in a text."""
    return tuple(dict.fromkeys(word for word in (" ".join(part.split()) for part in text.split(SEPARATOR)) if word))
