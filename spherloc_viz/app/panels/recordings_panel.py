"""The tab for reviewing: the list of recordings, the gallery, what is said of the open run, and what is compared."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import viser

from spherloc.errors import RecordingError
from spherloc.types import FloatArray
from spherloc_viz.app.catalog import RunRequest
from spherloc_viz.app.review.card import comparison_html
from spherloc_viz.app.review.export import Exporter
from spherloc_viz.app.review.filters import KEPT, pill
from spherloc_viz.app.review.gallery_list import GalleryList
from spherloc_viz.app.review.notes import Notes
from spherloc_viz.app.review.opened import Opened
from spherloc_viz.app.review.reviewer import ReviewCard, Reviewer, Reviewing
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.review.run_list import RunList
from spherloc_viz.app.text import WITHHELD, begun, box, status_html
from spherloc_viz.app.web.downloads import Downloads
from spherloc_viz.app.web.touch import Touch, Touches, seen_views
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.recording.replay import Reopened
from spherloc_viz.recording.run_row import RunRow

RUNS, GALLERY = "runs", "gallery"
VIEW = "Recordings"
"""Name by which the page reports whether the tab is visible."""


@dataclass(frozen=True)
class RecordingsPage:
    """What the panel asks of its page."""

    roots: tuple[Path, ...]
    """Folders that scenes may be opened from."""
    enter: Callable[[Reopened], RunRequest]
    """Makes a reopened scene known to the page, and gives the request for its run."""
    open: Callable[[RunRequest], None]
    """Asks for a run."""
    open_recorded: Callable[[RunRequest, Path, FloatArray | None], None]
    """Asks for a run that is recorded already, as this file and with this pose (3, 4)."""
    downloads: Downloads
    """Files that pages may fetch."""


class RecordingsPanel:
    """One page's. Without a folder of recordings it has the gallery only."""

    def __init__(
        self,
        gui: viser.GuiApi,
        client: viser.ClientHandle,
        touches: Touches,
        library: RunLibrary | None,
        card: ReviewCard,
        page: RecordingsPage,
    ) -> None:
        name = str(client.client_id)
        self._library, self._page = library, page
        self._switch = gui.add_html(_switch_html(RUNS if library is not None else GALLERY))
        self._status = gui.add_html("", visible=False)
        self._parts: list[RunList | Notes | Reviewer | Exporter | GalleryList] = []
        self._runs: RunList | None = None
        # Apart, as it may take minutes to take in a thousand new recordings.
        self._preparing = BackgroundWorker(f"spherloc-runs-preparing-{name}", self._complain)
        self._keeping, self._kept = BackgroundWorker(f"spherloc-runs-keeping-{name}", self._complain), deque[str]()
        self._comparing = BackgroundWorker(f"spherloc-runs-comparing-{name}", self._complain)
        if library is None:
            self._say("Runs are not recorded: start the playground without --no-record to review them here.")
        else:
            self._build(gui, client, touches, library, card)
        self._gallery = GalleryList(gui, touches, library, name, self._open_file, self._open_scene)
        self._parts.append(self._gallery)
        self._withheld = gui.add_html(status_html(WITHHELD), visible=False)
        self._shown, self._seen = RUNS if library is not None else GALLERY, False
        self._untold = False
        """Whether answers are hidden."""
        touches.on("recordings", self._choose)
        touches.on("views", self._see)

    def _build(
        self, gui: viser.GuiApi, client: viser.ClientHandle, touches: Touches, library: RunLibrary, card: ReviewCard
    ) -> None:
        name, page = str(client.client_id), self._page
        self._notes = Notes(gui, touches, library, name, self._stored, self._complain)
        self._comparison = gui.add_html("", visible=False)
        self._compared: tuple[str, ...] = ()
        self._runs = RunList(gui, touches, library, name, self._renew)

        def say(words: str) -> None:
            self._say(words)
            card.say(words)

        def complain(sentence: str) -> None:
            self._complain(sentence)
            card.say(begun(sentence), wrong=True)

        reviewing = Reviewing(library, page.roots, card, page.enter, page.open_recorded, say, complain, self._follow)
        self._reviewer = Reviewer(touches, self._runs, reviewing, name)
        exporter = Exporter(gui, name, touches, library, page.downloads, self._runs, self._say, self._complain)
        self._parts += [self._notes, self._runs, self._reviewer, exporter]
        touches.on("run-keep", self._keep)
        touches.on("runs-compare", lambda touch: self._comparing.ask(self._compare))
        touches.on("runs-uncompare", lambda touch: self._uncompare())

    def close(self) -> None:
        """End what goes on; does not wait."""
        for part in self._parts:
            part.close()
        self._preparing.close()
        self._comparing.close()
        self._keeping.close()

    def _see(self, touch: Touch) -> None:
        """Other tabs are open now."""
        before, self._seen = self._seen, VIEW in seen_views(touch.argument).names
        if self._seen and not before and self._library is not None:
            self._preparing.ask(self._library.prepare)
        self._show()

    def hide_answers(self, hidden: bool) -> None:
        """Tell no more of the runs than how they were made, or tell all again."""
        if hidden != self._untold:
            self._untold = hidden
            if self._runs is not None:
                self._runs.hide_answers(hidden)
            self._show()

    def _choose(self, touch: Touch) -> None:
        if touch.argument in (RUNS, GALLERY):
            self._shown = touch.argument
            self._switch.content = _switch_html(self._shown)
            self._say("")
            self._show()

    def _show(self) -> None:
        """Show the runs or the gallery, and draw them if they can be seen."""
        gallery = self._shown == GALLERY
        if self._runs is not None:
            self._runs.hide(gallery)
            self._notes.hide(gallery or self._untold)
            self._comparison.visible = bool(self._compared) and not gallery and not self._untold
            self._runs.see(self._seen and not gallery)
        self._gallery.show(gallery and self._seen and not self._untold)
        self._withheld.visible = gallery and self._untold

    def _compare(self) -> None:
        """Put the two marked runs side by side."""
        assert self._library is not None and self._runs is not None
        rows = self._library.rows(self._runs.marked)
        if len(rows) != 2:
            raise RecordingError("one of the marked runs is not in the list any more; mark two others.")
        self._compared = rows[0].file, rows[1].file
        self._comparison.content, self._comparison.visible = comparison_html(*rows), not self._untold
        self._reviewer.compare(*rows)

    def _uncompare(self) -> None:
        self._compared, self._comparison.visible = (), False
        self._reviewer.uncompare()

    def _follow(self, row: RunRow | None) -> None:
        """Another run is open, or none."""
        assert self._library is not None
        self._notes.show(row, () if row is None else self._library.labels())
        if row is not None and row.file not in self._compared:
            self._compared, self._comparison.visible = (), False

    def _renew(self) -> None:
        """The list may have become another one: where in it the open run is, and what other pages say of that run."""
        assert self._library is not None
        self._reviewer.locate()
        row = self._reviewer.news()
        if row is not None:
            self._notes.refresh(row, self._library.labels())

    def _stored(self, row: RunRow) -> None:
        """A run was labelled."""
        assert self._library is not None and self._runs is not None
        self._reviewer.relabelled(row)
        self._notes.refresh(row, self._library.labels())
        self._runs.ask()

    def _keep(self, touch: Touch) -> None:
        """A run that a page made is to stay, and to be listed with the others."""
        self._kept.append(touch.argument)
        self._keeping.ask(self._keep_all)

    def _keep_all(self) -> None:
        assert self._library is not None
        while self._kept:
            file = self._kept.popleft()
            self._library.relabel(file, [KEPT], [], None)
            self._say(f"Kept{'' if self._untold else f' {file}'}, with the label “{KEPT}”.")
            self._stored(self._library.row(file))

    def open_linked(self, file: str) -> Opened:
        """Open a recording to which a link leads; raises ``RecordingError`` if it cannot be."""
        if self._library is None:
            raise RecordingError("runs are not recorded here, so that no recording can be opened.")
        return self._reviewer.follow(file)

    def _open_file(self, file: str) -> None:
        self._reviewer.ask(file)

    def _open_scene(self, got: Reopened, beside: bool) -> None:
        if not beside and self._runs is not None:
            self._reviewer.leave()
        self._page.open(self._page.enter(got))

    def _say(self, words: str) -> None:
        self._status.content, self._status.visible = status_html(words), bool(words)

    def _complain(self, sentence: str) -> None:
        self._status.content, self._status.visible = status_html(begun(sentence), wrong=True), True


def _switch_html(shown: str) -> str:
    """Whether the runs or the gallery are shown."""
    words = ((RUNS, "Runs", "All recorded runs"), (GALLERY, "Gallery", "Failures worth seeing, with their stories"))
    chips = "".join(pill(word, f"recordings:{name}", name == shown, hint) for name, word, hint in words)
    return box(f'<div style="display:flex;gap:.4em">{chips}</div>', "font-size:12px;padding-bottom:.2em")
