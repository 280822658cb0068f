"""Runs as rows of the index's tables, and back."""

import json
import sqlite3
from collections.abc import Sequence
from typing import Any, get_type_hints

from spherloc_viz.recording.run_row import RunRow

DETAILS = ("options", "message", "summary", "note", "thumbnail")
"""Columns that no filter looks at. They have a table of their own, so that a filter reads 2 MB and not 40."""
_SQL_TYPES = {str: "TEXT", int: "INTEGER", bool: "INTEGER", float: "REAL", bytes: "BLOB", tuple: "TEXT"}


def _column(kind: Any) -> str:
    """``str | None`` is TEXT, ``str`` TEXT NOT NULL; labels, a tuple, are JSON."""
    options = [option for option in getattr(kind, "__args__", (kind,)) if option is not type(None)]
    if getattr(kind, "__origin__", None) is tuple:
        return "TEXT NOT NULL"
    return _SQL_TYPES[options[0]] + ("" if type(None) in getattr(kind, "__args__", ()) else " NOT NULL")


class DamagedError(sqlite3.DatabaseError):
    """The tables hold what is never put there: somebody else has changed them."""


_TYPES = get_type_hints(RunRow)
_COLUMNS = {name: _column(kind) for name, kind in _TYPES.items()}
MAIN = tuple(name for name in _COLUMNS if name not in DETAILS)
"""Columns of the table that filters scan."""
NULLABLE = {name for name, definition in _COLUMNS.items() if not definition.endswith("NOT NULL")}
"""Columns that may be unknown."""
_BOOLEANS = {name for name, kind in _TYPES.items() if bool in getattr(kind, "__args__", (kind,))}


def _definitions(names: Sequence[str]) -> str:
    return ", ".join(f"{name} {_COLUMNS[name]}{' UNIQUE' if name == 'file' else ''}" for name in names)


SCHEMA = (
    f"CREATE TABLE runs (id INTEGER PRIMARY KEY, {_definitions(MAIN)}, stamp TEXT NOT NULL) STRICT",
    f"CREATE TABLE details (id INTEGER PRIMARY KEY REFERENCES runs ON DELETE CASCADE, {_definitions(DETAILS)}) STRICT",
    "CREATE TABLE words (id INTEGER PRIMARY KEY REFERENCES runs ON DELETE CASCADE, words TEXT NOT NULL) STRICT",
    "CREATE TABLE labels (label TEXT NOT NULL, id INTEGER NOT NULL REFERENCES runs ON DELETE CASCADE, "
    "PRIMARY KEY (label, id)) STRICT, WITHOUT ROWID",
    "CREATE TABLE skipped (file TEXT PRIMARY KEY, stamp TEXT NOT NULL, sentence TEXT NOT NULL) STRICT",
    "CREATE INDEX labels_of_run ON labels (id)",
    "CREATE INDEX runs_by_time ON runs (created, file)",
    "CREATE INDEX runs_by_problem ON runs (problem_key)",
)
"""``stamp`` says which version of its files a row was read from; files that could not be read are ``skipped``."""

_UPSERT = (
    f"INSERT INTO runs ({', '.join(MAIN)}, stamp) VALUES ({', '.join('?' * (len(MAIN) + 1))}) "
    f"ON CONFLICT (file) DO UPDATE SET {', '.join(f'{name} = excluded.{name}' for name in (*MAIN, 'stamp'))} "
    "RETURNING id"
)
_REPLACE_DETAILS = f"INSERT OR REPLACE INTO details (id, {', '.join(DETAILS)}) VALUES (?{', ?' * len(DETAILS)})"
_SELECT = f"SELECT {', '.join(['runs.id', *MAIN, *DETAILS])} FROM runs JOIN details ON details.id = runs.id"
AT_ONCE = 500
"""Rows that one statement asks for."""


def put(connection: sqlite3.Connection, row: RunRow, stamp: str) -> None:
    """Insert a run, or replace the one of the same file."""
    values = {name: getattr(row, name) for name in _COLUMNS} | {"labels": json.dumps(row.labels)}
    (run,) = connection.execute(_UPSERT, [*(values[name] for name in MAIN), stamp]).fetchone()
    connection.execute(_REPLACE_DETAILS, [run, *(values[name] for name in DETAILS)])
    connection.execute("INSERT OR REPLACE INTO words VALUES (?, ?)", (run, words(row)))
    connection.execute("DELETE FROM labels WHERE id = ?", (run,))
    connection.executemany("INSERT OR IGNORE INTO labels VALUES (?, ?)", [(label, run) for label in row.labels])
    connection.execute("DELETE FROM skipped WHERE file = ?", (row.file,))


def words(row: RunRow) -> str:
    """What a text search looks at."""
    texts = (row.scene, row.name, row.query or "", row.message, row.summary, row.note, row.file, row.title)
    return "\n".join([*texts, *row.labels]).casefold()


def rows_of(connection: sqlite3.Connection, ids: Sequence[int]) -> tuple[RunRow, ...]:
    """The runs with these ids, in their order. Raises ``DamagedError`` if a row is none that ``put`` stores."""
    found: dict[int, RunRow] = {}
    for start in range(0, len(ids), AT_ONCE):
        some = ids[start : start + AT_ONCE]
        places = ", ".join("?" * len(some))
        for values in connection.execute(f"{_SELECT} WHERE runs.id IN ({places})", some):
            found[values[0]] = _row(values[1:])
    if len(found) < len(set(ids)):
        raise DamagedError("a run has no details")
    return tuple(found[run] for run in ids)


def _row(values: Sequence[Any]) -> RunRow:
    row: dict[str, Any] = dict(zip((*MAIN, *DETAILS), values, strict=True))
    row["labels"] = _labels(row["labels"])
    row |= {name: bool(row[name]) for name in _BOOLEANS if row[name] is not None}
    return RunRow(**row)


def _labels(told: str) -> tuple[str, ...]:
    try:
        labels = json.loads(told)
    except (ValueError, RecursionError):
        labels = None
    if not isinstance(labels, list) or not all(isinstance(label, str) for label in labels):
        raise DamagedError("labels are no list of texts")
    return tuple(labels)
