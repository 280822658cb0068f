"""The file of the run index: opened, checked, and set aside where it is not ours or damaged."""

import contextlib
import os
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc_viz.recording.index.query import SCHEMA, DamagedError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

FILE_NAME = "runs.sqlite"
"""Name of the index file in the folder of the recordings."""
APPLICATION = 0x53504852
"""SQLite's application id of the file: "SPHR"."""
VERSION = 4
"""Version of the schema."""
BUSY_S = 15.0
"""How long one waits for other writers, each of which takes milliseconds."""
CACHE_KB = 16_384
"""SQLite's page cache: it holds all that filters read of 10,000 runs."""

_CANNOT_WRITE = {sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM}
_DAMAGED = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
_BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}


class UnfitError(Exception):
    """The file cannot serve as the index; the message is the end of a sentence that starts with its name."""


def primary_code(error: sqlite3.Error) -> int:
    """SQLite's code of the error; its upper bits only refine it. 0 if it has none."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


def is_damage(error: sqlite3.Error) -> bool:
    """Whether the file's content is broken."""
    # Neither Python for bytes that are no text nor SQLite for an unknown format has a class or a code of its own.
    words = ("decode to UTF-8", "unsupported file format")
    unknown = isinstance(error, sqlite3.OperationalError) and any(part in str(error) for part in words)
    return unknown or isinstance(error, DamagedError) or primary_code(error) in _DAMAGED


def may_pass(error: sqlite3.Error, after_s: float) -> bool:
    """Whether it may be that another process is just making or renaming the file.

    SQLite does not wait for everything: an error of a locked file may come at once.
    """
    code = primary_code(error)
    return code == sqlite3.SQLITE_IOERR or (code in _BUSY and after_s < BUSY_S / 2)


def connect(path: Path) -> sqlite3.Connection:
    """Open the index at ``path``, made if it is missing.

    Raises ``UnfitError`` if there is another file or a damaged one, ``PermissionError`` if it cannot be written, and
    ``sqlite3.Error`` if it is locked or the disk is full.
    """
    if not all(os.access(place, os.W_OK) for place in (path, path.parent) if place.exists()):
        raise PermissionError(f"no write access to {path}")
    connection: sqlite3.Connection | None = None
    try:
        connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute(f"PRAGMA cache_size = -{CACHE_KB}")
        _check_or_create(connection)
        return connection
    except (sqlite3.Error, UnfitError, UnicodeDecodeError) as error:
        if connection is not None:
            connection.close()
        if isinstance(error, UnicodeDecodeError):  # of SQLite's own words about the file, which quote it
            raise UnfitError("is damaged") from error
        if isinstance(error, sqlite3.Error) and primary_code(error) in _CANNOT_WRITE:
            raise PermissionError(str(error)) from error
        if isinstance(error, sqlite3.Error) and is_damage(error):
            raise UnfitError("is damaged") from error
        raise


def identity(path: Path) -> tuple[int, int] | None:
    """Which file lies at the path, if there is one: it stays the same when its content changes."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def memory(path: Path) -> sqlite3.Connection:
    """An index that is in no file, with what the one at ``path`` has, if that can be read."""
    with contextlib.suppress(sqlite3.Error, UnfitError, UnicodeDecodeError):
        address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with contextlib.closing(sqlite3.connect(address, uri=True)) as file:
            return _in_memory(file)
    return _in_memory(None)


def _in_memory(copied: sqlite3.Connection | None) -> sqlite3.Connection:
    connection = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    try:
        if copied is not None:
            copied.backup(connection)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA foreign_keys = ON")
        _check_or_create(connection)
    except (sqlite3.Error, UnfitError, UnicodeDecodeError):
        connection.close()
        raise
    return connection


def _check_or_create(connection: sqlite3.Connection) -> None:
    """Empty files get the tables; others must have exactly ours, since a foreign trigger or view would be run."""
    if not _schema(connection):
        # Readers then don't wait for writers. Where the file system cannot do it, SQLite keeps to what it can.
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("BEGIN IMMEDIATE")
        if not _schema(connection):
            for statement in SCHEMA:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {APPLICATION}")
            connection.execute(f"PRAGMA user_version = {VERSION}")
        connection.execute("COMMIT")
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise UnfitError("is a database of another program")
    if version != VERSION or _schema(connection) != set(SCHEMA):
        raise UnfitError("was made by another version of spherloc")


def _schema(connection: sqlite3.Connection) -> set[str | None]:
    # SQLite keeps a statement as it was given; what it makes by itself has no SQL.
    rows = connection.execute("SELECT sql FROM sqlite_schema WHERE name NOT LIKE 'sqlite\\_%' ESCAPE '\\'").fetchall()
    return {sql for (sql,) in rows}


def set_aside(path: Path, file: tuple[int, int] | None) -> Path | None:
    """Rename the database, and what SQLite keeps beside it, and return its new name. Nothing is deleted.

    None if it is not that ``file`` any more: another process has renamed it and made a new one. Raises
    ``RecordingError`` if it cannot be renamed.
    """
    when = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")
    aside = path.with_name(f"{path.name}.{when}.aside")
    try:
        with _alone(path.parent):
            if file is None or file != identity(path):
                return None
            # The file itself last: a process that finds none makes a new one, and must not find the old log beside it.
            for end in ("-wal", "-shm", ""):
                with contextlib.suppress(FileNotFoundError):
                    path.with_name(path.name + end).rename(aside.with_name(aside.name + end))
    except OSError as error:
        reason = error.strerror or error
        raise RecordingError(f"{path}: cannot be used nor renamed ({reason}); move it away.") from error
    return aside


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """While no other process sets a database of the folder aside, where the system can see to that."""
    if fcntl is None:
        yield
        return
    place = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(place, fcntl.LOCK_EX)
        yield
    finally:
        os.close(place)


def sentence(path: Path, error: Exception) -> str:
    """Why the index cannot be used, and what to do."""
    code = primary_code(error) if isinstance(error, sqlite3.Error) else 0
    if code in _BUSY:
        return f"{path}: another program has locked the list of runs for {BUSY_S:.0f} s; end it and try again."
    if code == sqlite3.SQLITE_FULL:
        return f"{path}: the disk is full; make room, then run spherloc reindex."
    if code == sqlite3.SQLITE_IOERR:
        return f"{path}: the list of runs cannot be read or written ({error}); make room on its disk, or check that."
    if code in _CANNOT_WRITE or isinstance(error, PermissionError):
        return f"{path}: the list of runs cannot be written; give its folder write access or choose another one."
    return f"{path}: the list of runs cannot be used ({error}); run spherloc reindex."
