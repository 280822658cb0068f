"""Brings the list of runs up to date with the files of its folder, which other processes read."""

import contextlib
import sqlite3
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from spherloc.errors import RecordingError
from spherloc.processors import processor_count
from spherloc_viz.given_files import REVIEW_SUFFIX
from spherloc_viz.recording.index.query import put
from spherloc_viz.recording.reviews import UNREADABLE, has_review, review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import (
    AT_ONCE,
    Examiner,
    Examiners,
    Result,
    Told,
    check_name,
    examine_all,
    list_all,
)

Read = Callable[[Sequence[Path]], Iterable[tuple[Path, Result]]]
"""Reads recordings one after another: the row of each, or what is wrong with it."""
Progress = Callable[[int, int], None]
"""Is told how many of how many files are read."""
Item = TypeVar("Item")
T = TypeVar("T")

BATCH = 50
"""Rows that are written at once: others wait some milliseconds."""
MAX_WORKERS = 4
"""Processes that read recordings."""
WORTH_A_WORKER = 50
"""Recordings whose examination, at 20 ms each, pays to start another process, which takes a second."""
WORTH_A_LISTER = 5_000
"""Recordings for which that pays if they only tell of themselves, at 0.3 ms each."""
AHEAD = 2
"""Questions a process that are asked before their answers are wanted."""


def examine_side_by_side(
    paths: Sequence[Path], examiners: Examiners | None = None
) -> Generator[tuple[Path, RunRow | RecordingError], None, None]:
    """Examine recordings by several processes at once, in the order of the paths; by one where there are few paths.

    They end with this, or with their owner ``examiners``, which raises ``ExaminerError``.
    """
    yield from _side_by_side(paths, examine_all, 1, WORTH_A_WORKER, examiners or Examiners())


def list_side_by_side(
    paths: Sequence[Path], examiners: Examiners | None = None
) -> Generator[tuple[Path, Result], None, None]:
    """What recordings tell of themselves, and of those that tell nothing what their examination finds; otherwise as
    ``examine_side_by_side``."""
    yield from _side_by_side(paths, list_all, AT_ONCE, WORTH_A_LISTER, examiners or Examiners())


def _side_by_side(
    paths: Sequence[Path],
    read: Callable[[Sequence[Path], Examiner], Sequence[tuple[Path, T]]],
    at_once: int,
    worth_a_worker: int,
    examiners: Examiners,
) -> Generator[tuple[Path, T], None, None]:
    workers = max(1, min(MAX_WORKERS, processor_count(), len(paths) // worth_a_worker))
    answers: deque[Future[Sequence[tuple[Path, T]]]] = deque()
    with ThreadPoolExecutor(workers) as threads, examiners.start(workers) as started:
        # After an early exit, such as by Ctrl-C, the processes are ended first, without waiting for a file.
        for number, start in enumerate(range(0, len(paths), at_once)):
            answers.append(threads.submit(read, paths[start : start + at_once], started[number % workers]))
            if len(answers) > AHEAD * workers:
                yield from answers.popleft().result()
        while answers:
            yield from answers.popleft().result()


@dataclass(frozen=True)
class Refreshed:
    """What reading the files has changed."""

    read: int
    """Runs that are new, or read again."""
    removed: int
    """Runs whose files are gone."""
    skipped: tuple[tuple[str, str], ...]
    """Files that are not runs, or whose labels cannot be read, each with a sentence that says why; those found at an
    earlier time too."""


def stamp_of(path: Path) -> str:
    """Which version of a recording and its review lies there; empty if there is none."""
    parts = []
    for file in (path, review_path(path)):
        try:
            status = file.stat()
        except OSError:
            parts.append("")
        else:
            parts.append(f"{status.st_mtime_ns}:{status.st_size}")
    return " ".join(parts) if parts[0] else ""


def files_of(folder: Path) -> dict[str, str]:
    """Every recording of the folder and of its gallery, by name, with its stamp. Raises ``OSError``."""
    found: dict[str, str] = {}
    for place in ("", "gallery/"):
        inside = folder / place
        if place and not inside.is_dir():
            continue
        for path in inside.iterdir():
            name = path.name.lower()
            if name.endswith(".rrd") and not name.endswith(REVIEW_SUFFIX) and (stamp := stamp_of(path)):
                found[place + path.name] = stamp
    return found


def same_recording(stamp: str, other: str) -> bool:
    """Whether two stamps are of the same recording, whatever labels it has."""
    return stamp.partition(" ")[0] == other.partition(" ")[0] != ""


Which = Literal["new", "unexamined", "all"]
"""Which files of a folder are meant; new ones are among the unexamined ones too."""


class Write(Protocol):
    """Runs something in a transaction of its own."""

    def __call__(self, work: Callable[[sqlite3.Connection], T], /) -> T: ...


class Refresher:
    """Brings the tables up to date with the files of a folder."""

    def __init__(self, folder: Path, write: Write, read: Read) -> None:
        self._folder = folder
        self._write = write
        self._read = read

    def refresh(self, which: Which, progress: Progress) -> Refreshed:
        """Read what is new or has changed, beside it what has not been examined, or all; the list stays usable.

        Raises ``RecordingError`` if the folder cannot be read.
        """
        try:
            files = files_of(self._folder)
        except OSError as error:
            reason = error.strerror or error
            raise RecordingError(f"{self._folder}: the folder cannot be read ({reason}); check it.") from error
        known = self._write(_known)
        removed = self._write(lambda connection: self._forget(connection, known.keys() - files.keys()))
        done_with = {
            file
            for file, (stamp, examined) in known.items()
            if files.get(file) == stamp and (which == "new" or examined)
        }
        new = sorted(files if which == "all" else files.keys() - done_with)
        wanted = [file for file in new if _misnamed(file) is None]
        misnamed = [(file, error) for file in new if (error := _misnamed(file)) is not None]
        self._write(lambda connection: self._store(connection, misnamed, files))
        read = done = 0
        progress(done, len(wanted))
        results = self._read([self._folder / file for file in wanted])
        with contextlib.closing(results) if isinstance(results, Generator) else contextlib.nullcontext():
            for batch in _batches(zip(wanted, (result for _, result in results), strict=True)):
                read += self._write(lambda connection, batch=batch: self._store(connection, batch, files))
                done += len(batch)
                progress(done, len(wanted))
        return Refreshed(read, removed, self._write(_skipped))

    def _forget(self, connection: sqlite3.Connection, files: Iterable[str]) -> int:
        """Forget files that are gone, and return how many of them were runs."""
        # A file may have come since the folder was looked at, and its writer has listed it.
        gone = [(file,) for file in files if _misnamed(file) is not None or not (self._folder / file).exists()]
        connection.executemany("DELETE FROM skipped WHERE file = ?", gone)
        return connection.executemany("DELETE FROM runs WHERE file = ?", gone).rowcount if gone else 0

    def _store(
        self,
        connection: sqlite3.Connection,
        batch: Sequence[tuple[str, Result]],
        stamps: Mapping[str, str],
    ) -> int:
        """Store what was found in some files, and return how many of them are runs."""
        runs = 0
        for file, result in batch:
            path, stamp = self._folder / file, stamps[file]
            if stamp_of(path) != stamp:
                continue  # rewritten, labelled or deleted meanwhile, by somebody who has listed that
            if isinstance(result, RecordingError):
                name = file.encode(errors="backslashreplace").decode()  # on a disk it need not be Unicode
                connection.execute("DELETE FROM runs WHERE file = ?", (name,))
                _skip(connection, name, stamp, str(result))
                continue
            row = result.row if isinstance(result, Told) else result
            put(connection, replace(row, file=file), stamp, examined=row is result)
            runs += 1
            if has_review(path) and not row.labels and not row.note:
                _skip(connection, file, stamp, f"{review_path(path)}: {UNREADABLE}")
        return runs


def _misnamed(file: str) -> RecordingError | None:
    """What is wrong with the name of a file, if it cannot be that of a recording."""
    try:
        check_name(file)
    except RecordingError as error:
        return error
    return None


def _known(connection: sqlite3.Connection) -> dict[str, tuple[str, int]]:
    """Files that were read before, with their stamps, and whether they were examined."""
    sql = "SELECT file, stamp, TRUE FROM skipped UNION ALL SELECT file, stamp, examined FROM runs"
    return {file: (stamp, examined) for file, stamp, examined in connection.execute(sql)}


def _skip(connection: sqlite3.Connection, file: str, stamp: str, sentence: str) -> None:
    connection.execute("INSERT OR REPLACE INTO skipped VALUES (?, ?, ?)", (file, stamp, sentence))


def _skipped(connection: sqlite3.Connection) -> tuple[tuple[str, str], ...]:
    return tuple(connection.execute("SELECT file, sentence FROM skipped ORDER BY file"))


def _batches(items: Iterable[Item]) -> Iterator[list[Item]]:
    remaining = iter(items)
    while batch := list(islice(remaining, BATCH)):
        yield batch
