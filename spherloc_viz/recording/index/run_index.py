"""The list of all runs of a folder: a database beside the recordings, which are the truth that it is made from."""

import contextlib
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

from spherloc.errors import InputError, RecordingError, show
from spherloc_viz.recording.index import file as index_file
from spherloc_viz.recording.index.query import (
    AT_ONCE,
    GROUP_KEYS,
    MAIN,
    DamagedError,
    RunQuery,
    condition,
    groups,
    order,
    put,
    rows_of,
)
from spherloc_viz.recording.index.refresher import (
    Progress,
    Read,
    Refreshed,
    Refresher,
    Which,
    examine_side_by_side,
    list_side_by_side,
    same_recording,
    stamp_of,
)
from spherloc_viz.recording.reviews import Review
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import Examiners, Result, check_name, examine

T = TypeVar("T")

MAX_TRIES = 4
"""With a database that gets damaged or set aside meanwhile."""
PAUSE_S = 0.02
"""Another process needs less to rename a database."""


@dataclass(frozen=True)
class Found:
    """A page of the runs that a query finds."""

    rows: tuple[RunRow, ...]
    """The runs in the query's order."""
    total: int
    """How many there are on all pages."""


class RunIndex:
    """The runs of one folder. Any number of threads may share one, and any number of processes the folder.

    The recordings are what counts: a database that is damaged, or not ours, is renamed and made anew from them. Every
    method raises ``RecordingError``, in one sentence, where the database cannot be used.
    """

    def __init__(self, folder: Path, on_notice: Callable[[str], None] | None = None) -> None:
        """``folder`` is made if it is missing; ``on_notice`` gets a sentence where a database was set aside.

        No recording is read: call ``refresh`` for that, which may take a while.
        """
        self.folder = Path(folder)
        self.path = self.folder / index_file.FILE_NAME
        self.stale = True
        """Whether there may be recordings that it does not know: ``refresh`` has not looked for them yet."""
        self._notice = on_notice or (lambda sentence: None)
        self._lock, self._refreshing = threading.RLock(), threading.Lock()
        self._connection: sqlite3.Connection | None = None
        self._file: tuple[int, int] | None = None
        self._place: tuple[int, int] | None = None
        """Which folder cannot be written, while the list is in memory; None if there was none."""
        self._closed = False
        self._opened = 0
        """How often; rises when the database has become another one."""
        self.examiners = Examiners()
        """Once they are closed, a refresh raises ``RecordingError``."""
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
        self._read(lambda connection: None)

    def add(self, row: RunRow) -> None:
        """Add a run whose recording was written or examined here, or replace the one of the same file."""
        self.add_all([row])

    def add_all(self, rows: Sequence[RunRow]) -> None:
        """Add runs in one go; all of them or none."""
        stamps = [stamp_of(self.folder / check_name(row.file)) for row in rows]

        def work(connection: sqlite3.Connection) -> None:
            for row, stamp in zip(rows, stamps, strict=True):
                put(connection, row, stamp, examined=True)

        self._write(work)

    def remove(self, file: str) -> None:
        """Forget a run, as after its file was deleted."""
        self._write(lambda connection: connection.execute("DELETE FROM runs WHERE file = ?", (file,)))

    def get(self, file: str) -> RunRow | None:
        """The run of a file, if it is known."""

        def work(connection: sqlite3.Connection) -> RunRow | None:
            ids = [run for (run,) in connection.execute("SELECT id FROM runs WHERE file = ?", (file,))]
            return next(iter(rows_of(connection, ids)), None)

        return self._read(work)

    def examined(self, file: str) -> RunRow | None:
        """The run of a file whose whole content has been examined, or was written here, and is still the same."""
        sql = "SELECT id, stamp FROM runs WHERE file = ? AND examined"

        def work(connection: sqlite3.Connection) -> tuple[RunRow, str] | None:
            found = connection.execute(sql, (file,)).fetchone()
            return None if found is None else (rows_of(connection, [found[0]])[0], found[1])

        found = self._read(work)
        return found[0] if found is not None and same_recording(found[1], stamp_of(self.folder / file)) else None

    def of_files(self, files: Sequence[str]) -> tuple[RunRow, ...]:
        """The runs of these files, in their order, without those that are not known."""

        def work(connection: sqlite3.Connection) -> tuple[RunRow, ...]:
            ids: dict[str, int] = {}
            for start in range(0, len(files), AT_ONCE):
                some = files[start : start + AT_ONCE]
                places = ", ".join("?" * len(some))
                ids |= dict(connection.execute(f"SELECT file, id FROM runs WHERE file IN ({places})", some))
            return rows_of(connection, [ids[file] for file in files if file in ids])

        return self._read(work)

    def find(self, query: RunQuery, limit: int | None = 50, offset: int = 0) -> Found:
        """The runs that a query finds, from ``offset`` on and at most ``limit``; None for all."""
        where, values = condition(query)

        def work(connection: sqlite3.Connection) -> Found:
            (total,) = connection.execute(f"SELECT count(*) FROM runs WHERE {where}", values).fetchone()
            page = [-1 if limit is None else max(0, limit), max(0, offset)]
            select = f"SELECT id FROM runs WHERE {where} ORDER BY {order(query)} LIMIT ? OFFSET ?"
            ids = [run for (run,) in connection.execute(select, [*values, *page])]
            return Found(rows_of(connection, ids), total)

        return self._read(work)

    def columns(self, names: Sequence[str]) -> tuple[dict[str, tuple[Any, ...]], dict[str, str]]:
        """Columns of all runs, the oldest first, as the database has them, and the notes of those that have one.

        ``names`` are columns that filters may look at; labels are JSON.
        """
        assert set(names) <= set(MAIN)

        def work(connection: sqlite3.Connection) -> tuple[dict[str, tuple[Any, ...]], dict[str, str]]:
            rows = connection.execute(f"SELECT {', '.join(names)} FROM runs ORDER BY created, file").fetchall()
            columns = list(zip(*rows, strict=True)) if rows else [()] * len(names)
            notes = "SELECT file, note FROM runs JOIN details ON details.id = runs.id WHERE note != ''"
            return dict(zip(names, columns, strict=True)), dict(connection.execute(notes))

        return self._read(work)

    def same_run(
        self, source: str, problem_key: str, estimator: str, options: str, seed: int, inliers: int
    ) -> str | None:
        """The file of the newest run from this source that did the very same with as many inliers, if there is one."""
        select = (
            "SELECT file FROM runs JOIN details ON details.id = runs.id WHERE problem_key = ? AND source = ? "
            "AND estimator = ? AND options = ? AND seed = ? AND inliers = ? ORDER BY created DESC LIMIT 1"
        )
        values = (problem_key, source, estimator, options, seed, inliers)
        found = self._read(lambda connection: connection.execute(select, values).fetchone())
        return None if found is None else found[0]

    def groups(self, query: RunQuery, by: str = "diagnosis") -> tuple[tuple[str, int], ...]:
        """Values of ``by``, one of ``GROUP_KEYS``, and how many of the found runs have each, most of them first.

        A run counts once for each of its labels.
        """
        if by not in GROUP_KEYS:
            raise InputError(f"runs cannot be grouped by {show(by)}: choose one of {', '.join(GROUP_KEYS)}.")
        sql, values = groups(query, by)
        return tuple(self._read(lambda connection: connection.execute(sql, values).fetchall()))

    def bytes(self) -> int:
        """Size of all recordings together."""
        sql = "SELECT coalesce(sum(size_bytes), 0) FROM runs"
        return self._read(lambda connection: connection.execute(sql).fetchone()[0])

    def old_page_runs(self, keep: int) -> tuple[RunRow, ...]:
        """Runs that pages made, all but the ``keep`` newest ones, the oldest first; none that has labels or a note."""
        sql = (
            "SELECT id FROM runs JOIN details USING (id) WHERE source = 'page' AND labels = '[]' AND note = '' "
            "ORDER BY created DESC, file DESC LIMIT -1 OFFSET ?"
        )

        def work(connection: sqlite3.Connection) -> tuple[RunRow, ...]:
            return rows_of(connection, [run for (run,) in connection.execute(sql, (keep,))][::-1])

        return self._read(work)

    def oldest_successes(self, limit: int = 100) -> tuple[RunRow, ...]:
        """Runs that may be deleted to make room, the oldest first.

        These are runs that are right or, where the truth is unknown, not doubtful; that have no labels and no note; and
        that are not of the gallery.
        """
        sql = (
            "SELECT id FROM runs JOIN details USING (id) "
            "WHERE (outcome = 'success' OR outcome = 'unknown') AND doubtful IS NOT TRUE "
            "AND (outcome = 'success' OR doubtful IS FALSE) "
            "AND labels = '[]' AND note = '' AND source <> 'gallery' ORDER BY created, file LIMIT ?"
        )

        def work(connection: sqlite3.Connection) -> tuple[RunRow, ...]:
            return rows_of(connection, [run for (run,) in connection.execute(sql, (limit,))])

        return self._read(work)

    def set_review(self, file: str, labels: Sequence[str], note: str) -> Review:
        """Store labels and a note with a run, in its review file and here, and return them as they are stored.

        Of two pages that do so at once the last one wins. Raises ``RecordingError`` if there is no such run or the
        review cannot be written, ``InputError`` if it is too long.
        """
        # Here, since it imports rerun, which takes a quarter of a second: a page should not wait for it.
        from spherloc_viz.recording.review_file import write_review

        path = self.folder / check_name(file)

        def work(connection: sqlite3.Connection) -> Review | None:
            sql = "SELECT id, run_id, stamp, examined FROM runs WHERE file = ?"
            found = connection.execute(sql, (file,)).fetchone()
            if found is None or not path.is_file():
                raise RecordingError(f"{path}: there is no such run; spherloc runs lists those that there are.")
            if not same_recording(found[2], stamp_of(path)):
                return None
            # Written while we alone may write, so that file and database agree on which change was the last.
            review = write_review(path, labels, note, run_id=found[1])
            (before,) = rows_of(connection, [found[0]])
            put(connection, replace(before, labels=review.labels, note=review.note), stamp_of(path), found[3])
            return review

        for _ in range(MAX_TRIES):
            if (review := self._write(work)) is not None:
                return review
            # Another run lies there than the one that is listed.
            self.add(replace(examine(path), file=file))
        raise RecordingError(f"{path}: another program keeps changing the file; end it and try again.")

    def refresh(self, progress: Progress | None = None, read: Read | None = None) -> Refreshed:
        """List new and changed recordings of the folder, and forget those that are gone.

        Of a file its start is read, where it says what is listed. ``progress`` is told how many of how many are read.
        Files that are not runs are skipped and named in the answer.
        """
        return self._refresh("new", progress, read or (lambda paths: list_side_by_side(paths, self.examiners)))

    def examine(self, progress: Progress | None = None, read: Read | None = None) -> Refreshed:
        """Refresh the list, and read the recordings wholly of which only the start has been read."""
        return self._refresh("unexamined", progress, read or self._examine)

    def rebuild(self, progress: Progress | None = None, read: Read | None = None) -> Refreshed:
        """Read all recordings of the folder wholly, after a check of the database."""
        with self._lock:
            if self._read(lambda connection: connection.execute("PRAGMA quick_check(1)").fetchone()) != ("ok",):
                self._set_aside("is damaged", self._file)
        return self._refresh("all", progress, read or self._examine)

    def _examine(self, paths: Sequence[Path]) -> Iterable[tuple[Path, Result]]:
        return examine_side_by_side(paths, self.examiners)

    def _refresh(self, which: Which, progress: Progress | None, read: Read) -> Refreshed:
        refresher = Refresher(self.folder, self._write, read)
        with self._refreshing:
            for _ in range(MAX_TRIES):
                self._read(lambda connection: None)
                opened = self._opened
                refreshed = refresher.refresh(which, progress or (lambda done, total: None))
                if self._opened == opened:  # a database that is set aside takes the rows with it
                    self.stale = False
                    return refreshed
                which = "new"
        raise self._damaged_again()

    def close(self) -> None:
        """Close the database; nothing else works after that."""
        self.examiners.close()
        with self._lock:
            self._closed = True
            self._drop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _read(self, work: Callable[[sqlite3.Connection], T]) -> T:
        """Run ``work`` on one state of the database."""
        return self._do("BEGIN", work)

    def _write(self, work: Callable[[sqlite3.Connection], T]) -> T:
        """Run ``work`` while no other process writes; all of it counts, or nothing."""
        return self._do("BEGIN IMMEDIATE", work)

    def _do(self, begin: str, work: Callable[[sqlite3.Connection], T]) -> T:
        with self._lock:
            for tries_left in reversed(range(MAX_TRIES)):
                began = time.monotonic()
                try:
                    result = self._transact(begin, work)
                except sqlite3.DatabaseError as error:
                    if index_file.is_damage(error):
                        self._set_aside("is damaged", self._file)
                    elif tries_left and index_file.may_pass(error, time.monotonic() - began):
                        self._drop()
                        time.sleep(PAUSE_S)
                    else:
                        raise RecordingError(index_file.sentence(self.path, error)) from error
                    continue
                # What was written to a file that another process has just set aside must be written again.
                if self._file is None or self._file == index_file.identity(self.path):
                    return result
        raise self._damaged_again()

    def _damaged_again(self) -> RecordingError:
        return RecordingError(f"{self.path}: the list of runs gets damaged again and again; check the disk.")

    def _transact(self, begin: str, work: Callable[[sqlite3.Connection], T]) -> T:
        connection = self._connected()
        connection.execute(begin)
        try:
            result = work(connection)
            connection.execute("COMMIT")
            return result
        except UnicodeDecodeError as error:
            raise DamagedError("bytes that are not text") from error
        except (OverflowError, UnicodeError) as error:
            raise RecordingError(f"{self.path}: cannot list or find a text or number ({error}).") from error
        finally:
            if connection.in_transaction:
                connection.rollback()

    def _connected(self) -> sqlite3.Connection:
        """The database, opened again where its file is another one now: somebody has set ours aside."""
        if self._closed:
            raise RecordingError(f"{self.path}: the list of runs has been closed.")
        if self._connection is not None and self._is_current():
            return self._connection
        self._drop()
        self.stale = True
        self._opened += 1
        for _ in range(MAX_TRIES):
            before = index_file.identity(self.path)
            try:
                connection = index_file.connect(self.path)
            except index_file.UnfitError as error:
                self._set_aside(str(error), before)
                continue
            except PermissionError:
                self._place = index_file.identity(self.folder)
                self._connection = index_file.memory(self.path)
                self._notice(f"{self.path}: cannot be written, so changes of the list of runs are kept in memory only.")
                return self._connection
            self._connection, self._file = connection, index_file.identity(self.path)
            if before in (None, self._file):
                return connection
            self._drop()  # it was set aside while it was opened
        raise self._damaged_again()

    def _is_current(self) -> bool:
        """Whether the database, or the folder if the database is in memory only, has not been replaced."""
        place, known = (self.folder, self._place) if self._file is None else (self.path, self._file)
        return known == index_file.identity(place)

    def _set_aside(self, reason: str, file: tuple[int, int] | None) -> None:
        """Rename the database, unless another process has done so: it must still be that file."""
        self._drop()
        if aside := index_file.set_aside(self.path, file):
            self._notice(
                f"{self.path} {reason}; it is kept as {aside.name} and the list is made anew from the recordings."
            )

    def _drop(self) -> None:
        connection, self._connection, self._file = self._connection, None, None
        if connection is not None:
            connection.close()
