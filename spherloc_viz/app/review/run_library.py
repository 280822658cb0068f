"""The recordings that all pages of a server review: the folder, its index, and single runs read safely."""

import contextlib
import threading
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from spherloc.errors import RecordingError
from spherloc_viz.app.review.filters import EXACT, JUDGED, PAGE, Counts, Look
from spherloc_viz.recording.index.query import MAX_TEXT, RunQuery
from spherloc_viz.recording.index.run_index import Found, RunIndex
from spherloc_viz.recording.recorded_run import RecordedRun
from spherloc_viz.recording.reviews import Review
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine, resolve_inside

NEAR = 50
"""A run that was at some place of the list is looked for among so many around it."""
STRETCH = 500
"""Runs that are looked through at once where it is elsewhere."""
MAX_LABELS = 12
"""Labels that are offered, those used most."""


class RunLibrary:
    """Thread-safe. A call may take seconds, so only background workers call it."""

    def __init__(self, index: RunIndex) -> None:
        self._index = index
        self._reviewing = threading.Lock()

    @property
    def folder(self) -> Path:
        """Folder of the recordings."""
        return self._index.folder

    def version(self) -> tuple[int, ...]:
        """Another one whenever runs have come or changed, whichever process did it; costs next to nothing."""
        state: list[int] = []
        for path in (self._index.path, self._index.path.with_name(f"{self._index.path.name}-wal")):
            with contextlib.suppress(OSError):
                status = path.stat()
                state += (status.st_mtime_ns, status.st_size)
        return tuple(state)

    def _query(self, look: Look) -> RunQuery:
        """What to ask the index for; runs that pages made are left out, unless there are no others."""
        query = look.query(datetime.now(UTC))
        return query if query.pages is None or self._has_others() else replace(query, pages=None)

    def _has_others(self) -> bool:
        return any(source != "page" for source, _ in self._index.groups(RunQuery(), "source"))

    def page(self, look: Look) -> tuple[Found, Look]:
        """The rows of a page, and the look with a page that exists."""
        query = self._query(look)
        found = self._index.find(query, PAGE, PAGE * look.page)
        if found.rows or not look.page:
            return found, look
        look = replace(look, page=max(0, -(-found.total // PAGE) - 1))
        return self._index.find(query, PAGE, PAGE * look.page), look

    def counts(self, look: Look, total: int) -> Counts:
        """How many runs each filter would leave."""
        outcome, diagnosis = self._groups(look, "outcome"), self._groups(look, "diagnosis")
        unfolded = self._groups(look, look.unfolded) if look.unfolded in EXACT else ()
        doubtful = self._index.find(self._query(replace(look, judged=JUDGED[0])), 0).total
        pages = self._index.find(RunQuery(pages=True), 0).total if self._has_others() else None
        return Counts(total, outcome, diagnosis, doubtful, unfolded, pages)

    def _groups(self, look: Look, name: str) -> Sequence[tuple[str, int]]:
        """How many runs there are of each value, if this filter were not set."""
        return self._index.groups(self._query(replace(look, **{name: None})), name)

    def labels(self) -> tuple[str, ...]:
        """Those that were given to any run, the most used first."""
        return tuple(label for label, _ in self._index.groups(RunQuery(), "label") if label)[:MAX_LABELS]

    def row(self, file: str) -> RunRow:
        """The run of a file; raises ``RecordingError`` if the list does not have it."""
        row = self._index.get(file)
        if row is None:
            raise RecordingError(f"{file}: is not in the list any more; choose another run.")
        return row

    def rows(self, files: Sequence[str]) -> tuple[RunRow, ...]:
        """The runs of these files, in their order, without those that the list does not have any more."""
        return self._index.of_files(files)

    def read(self, file: str) -> tuple[RecordedRun, Path]:
        """A recording that another process has found safe to be read; raises ``RecordingError`` if it is not."""
        path = resolve_inside(self.folder, file)
        examine(path)
        # Here, since it imports rerun, which takes a quarter of a second: a page should not wait for it.
        from spherloc_viz.recording.content.data import read_recording

        return read_recording(path), path

    def prepare(self) -> None:
        """Take in recordings that the index does not know, and start the process that reads them first: both take
        seconds, and are better done before they are needed."""
        if self._index.stale:
            self._index.refresh()
        newest = self._index.find(RunQuery(), 1).rows
        if newest:
            with contextlib.suppress(RecordingError):
                examine(resolve_inside(self.folder, newest[0].file))

    def place(self, look: Look, file: str, near: int) -> tuple[int | None, int]:
        """Where a run is in the list, counted from 0, and how long the list is; looked for around ``near`` first."""
        query = self._query(look)
        found, at = self._search(query, file, max(0, near - NEAR), 2 * NEAR + 1)
        if at is not None or len(found.rows) == found.total:
            return at, found.total
        # Most runs that are not near are not in the list at all.
        words = f"{query.text or ''} {file}".strip()
        if len(words) <= MAX_TEXT and not self._index.find(replace(query, text=words), 0).total:
            return None, found.total
        for first in range(0, found.total, STRETCH):
            _, at = self._search(query, file, first, STRETCH)
            if at is not None:
                break
        return at, found.total

    def _search(self, query: RunQuery, file: str, first: int, count: int) -> tuple[Found, int | None]:
        """A stretch of the list, and where in the list a run is if it is there."""
        found = self._index.find(query, count, first)
        return found, next((place for place, row in enumerate(found.rows, first) if row.file == file), None)

    def at(self, look: Look, place: int) -> RunRow | None:
        """The run at a place of the list, if there is one."""
        return next(iter(self._index.find(self._query(look), 1, place).rows), None) if place >= 0 else None

    def all(self, look: Look, most: int) -> Found:
        """The first ``most`` runs of the list, from all pages."""
        return self._index.find(self._query(look), most)

    def columns(self, names: Sequence[str]) -> tuple[dict[str, tuple[Any, ...]], dict[str, str]]:
        """Columns of all runs and the notes, see ``RunIndex.columns``."""
        return self._index.columns(names)

    def relabel(self, file: str, add: Sequence[str], remove: Sequence[str], note: str | None) -> tuple[Review, Review]:
        """Add and remove labels of a run, and replace its note if one is given; returns what was said of it before and
        what is now."""
        with self._reviewing:
            row = self.row(file)
            kept = [label for label in row.labels if label not in remove]
            now = self._index.set_review(file, [*kept, *add], row.note if note is None else note)
            return Review(row.labels, row.note), now

    def review(self, file: str, before: Review, now: Review) -> RunRow:
        """Store what a reviewer changed of what is said of a run; returns its row as it is then.

        What another page has said since ``before`` was read stays, unless it is the note and both have changed it.
        """
        with self._reviewing:
            row = self.row(file)
            new = merged(Review(row.labels, row.note), before, now)
            self._index.set_review(file, new.labels, new.note)
            return self.row(file)


def merged(stored: Review, before: Review, now: Review) -> Review:
    """What is stored, with what was changed between ``before`` and ``now``."""
    if stored == before:
        return now
    kept = (label for label in stored.labels if label in now.labels or label not in before.labels)
    added = (label for label in now.labels if label not in before.labels)
    return Review(tuple(dict.fromkeys((*kept, *added))), stored.note if now.note == before.note else now.note)
