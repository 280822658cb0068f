"""What a reviewer asks of the list of runs: rows of its tables, filters, ranges, dates, and the order of the answer."""

import json
import math
import re
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, get_type_hints

from spherloc.errors import InputError, show
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
    f"CREATE TABLE runs (id INTEGER PRIMARY KEY, {_definitions(MAIN)}, stamp TEXT NOT NULL, "
    "examined INTEGER NOT NULL) STRICT",
    f"CREATE TABLE details (id INTEGER PRIMARY KEY REFERENCES runs ON DELETE CASCADE, {_definitions(DETAILS)}) STRICT",
    "CREATE TABLE words (id INTEGER PRIMARY KEY REFERENCES runs ON DELETE CASCADE, words TEXT NOT NULL) STRICT",
    "CREATE TABLE labels (label TEXT NOT NULL, id INTEGER NOT NULL REFERENCES runs ON DELETE CASCADE, "
    "PRIMARY KEY (label, id)) STRICT, WITHOUT ROWID",
    "CREATE TABLE skipped (file TEXT PRIMARY KEY, stamp TEXT NOT NULL, sentence TEXT NOT NULL) STRICT",
    "CREATE INDEX labels_of_run ON labels (id)",
    "CREATE INDEX runs_by_time ON runs (created, file)",
    "CREATE INDEX runs_by_problem ON runs (problem_key)",
)
"""``stamp`` says which version of its files a row was read from, ``examined`` whether they were read wholly or written
here; files that could not be read are ``skipped``."""

_STORED = (*MAIN, "stamp", "examined")
_UPSERT = (
    f"INSERT INTO runs ({', '.join(_STORED)}) VALUES ({', '.join('?' * len(_STORED))}) "
    f"ON CONFLICT (file) DO UPDATE SET {', '.join(f'{name} = excluded.{name}' for name in _STORED)} "
    "RETURNING id"
)
_REPLACE_DETAILS = f"INSERT OR REPLACE INTO details (id, {', '.join(DETAILS)}) VALUES (?{', ?' * len(DETAILS)})"
_SELECT = f"SELECT {', '.join(['runs.id', *MAIN, *DETAILS])} FROM runs JOIN details ON details.id = runs.id"
AT_ONCE = 500
"""Rows that one statement asks for."""


def put(connection: sqlite3.Connection, row: RunRow, stamp: str, examined: bool) -> None:
    """Insert a run, or replace the one of the same file."""
    values = {name: getattr(row, name) for name in _COLUMNS} | {"labels": json.dumps(row.labels)}
    (run,) = connection.execute(_UPSERT, [*(values[name] for name in MAIN), stamp, examined]).fetchone()
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
        raise DamagedError("labels are not a list of texts")
    return tuple(labels)


SORT_KEYS = (
    "created",
    "file",
    "scene",
    "name",
    "estimator",
    "outcome",
    "diagnosis",
    "source",
    "correspondences",
    "inliers",
    "outlier_rate",
    "rotation_error_deg",
    "translation_error_m",
    "time_ms",
    "steps",
    "size_bytes",
)
"""Columns by which runs can be sorted; runs without a value come last in both directions."""
GROUP_KEYS = ("diagnosis", "outcome", "estimator", "scene", "source", "label", "problem_key")
"""Columns by which runs can be counted."""
OUTCOMES = ("success", "failure", "unknown")
SOURCES = ("page", "command", "sweep", "sequence", "gallery", "unknown")
PAGE_KEPT = 100
"""Runs that pages made by themselves, of which few are kept; labelled ones are not counted."""
MAX_TEXT = 200
"""Characters of a text that is searched for."""

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_ONE_SIDED = re.compile(rf"(<=|>=|<|>)\s*({_NUMBER})", re.ASCII)
_BETWEEN = re.compile(rf"({_NUMBER})\s*\.\.\s*({_NUMBER})", re.ASCII)
_ALONE = re.compile(_NUMBER, re.ASCII)
_AGO = re.compile(r"(\d{1,5})\s*(min|h|d|w)", re.ASCII)
_UNITS = {"min": "minutes", "h": "hours", "d": "days", "w": "weeks"}
EQUAL = 1e-6
"""A number alone means itself, up to this share of it: 0.9 also finds 90 of 100 as a computer divides it."""


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``. A run whose number is unknown is in no range."""

    low: float = -math.inf
    """The least."""
    high: float = math.inf
    """The largest."""
    low_open: bool = False
    """Without ``low`` itself."""
    high_open: bool = False
    """Without ``high`` itself."""


@dataclass(frozen=True)
class RunQuery:
    """Which runs, and in what order. None asks for nothing; all that is asked must be true."""

    text: str | None = None
    """Words that must all occur in scene, name, query image, message, summary, note, labels, file or title, in any
    case and also inside of words."""
    scene: str | None = None
    """The scene or the name of the problem, whole; of a path also the last part, with or without ``.toml``."""
    estimator: str | None = None
    """Registered name."""
    outcome: str | None = None
    """ "success", "failure" or "unknown"."""
    diagnosis: str | None = None
    """Value of ``spherloc.diagnosis.Cause``; empty for runs that were not diagnosed."""
    doubtful: bool | None = None
    """Whether the diagnosis speaks against the pose."""
    label: str | None = None
    """One of the labels, whole."""
    source: str | None = None
    """Who ran it."""
    problem_key: str | None = None
    """Runs of this very problem."""
    pages: bool | None = None
    """Only runs that pages made by themselves and that have no label; if False, all but those."""
    outlier_rate: Range | None = None
    """0 to 1."""
    rotation_error_deg: Range | None = None
    translation_error_m: Range | None = None
    inliers: Range | None = None
    correspondences: Range | None = None
    time_ms: Range | None = None
    since: str | None = None
    """Created at this time or later, ISO 8601 in UTC as ``parse_when`` gives it."""
    until: str | None = None
    """Created before this time."""
    sort: str = "created"
    """One of ``SORT_KEYS``."""
    descending: bool = True

    def __post_init__(self) -> None:
        """Raises ``InputError`` for an unknown sort key or a text that is too long."""
        if self.sort not in SORT_KEYS:
            raise InputError(f"runs cannot be sorted by {show(self.sort)}: choose one of {', '.join(SORT_KEYS)}.")
        if self.text is not None and len(self.text) > MAX_TEXT:
            raise InputError(f"a text of {len(self.text)} characters cannot be searched for: give at most {MAX_TEXT}.")


def parse_range(text: str) -> Range:
    """A range from ``">0.9"``, ``"<=3"``, ``"0.5..0.9"`` (both included) or ``"0.9"``.

    Raises ``InputError`` for anything else.
    """
    text = text.strip()
    if found := _ONE_SIDED.fullmatch(text):
        sign, number = found[1], _finite(found[2])
        is_open = len(sign) == 1
        return Range(high=number, high_open=is_open) if sign[0] == "<" else Range(low=number, low_open=is_open)
    if found := _BETWEEN.fullmatch(text):
        low, high = _finite(found[1]), _finite(found[2])
        if low <= high:
            return Range(low, high)
        raise InputError(f"the range {show(text)} is empty: give the smaller number first.")
    if _ALONE.fullmatch(text):
        number = _finite(text)
        return Range(number - EQUAL * abs(number), number + EQUAL * abs(number))
    raise InputError(f"{show(text)} is not a range: give one such as '>0.9', '<=3', '0.5..0.9' or '0.9'.")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise InputError(f"{text} is too large a number for a range: leave that side open, as in '>0.9'.")
    return number


def parse_when(text: str, now: datetime, end: bool = False) -> str:
    """A time from a date (``2026-01-31``), a date and time (``2026-01-31T08:30``), both UTC, or an age (``90min``,
    ``2h``, ``3d``, ``1w``) before ``now``, as ``RunQuery`` takes it.

    With ``end``, a date alone means the end of that day. Raises ``InputError`` for anything else.
    """
    text = text.strip()
    try:
        if found := _AGO.fullmatch(text):
            return _iso(now - timedelta(**{_UNITS[found[2]]: int(found[1])}))
        when = datetime.fromisoformat(text)
        when = when.replace(tzinfo=UTC) if when.tzinfo is None else when
        return _iso(when + timedelta(days=1) if end and re.fullmatch(r"\d{4}-\d\d-\d\d", text) else when)
    except (ValueError, OverflowError):
        pass
    raise InputError(f"{show(text)} is not a time: give one such as 2026-01-31, 2026-01-31T08:30, or 2h, 3d or 1w ago.")


def _iso(when: datetime) -> str:
    return when.astimezone(UTC).isoformat(timespec="milliseconds")


_EXACT = ("estimator", "outcome", "diagnosis", "source", "problem_key", "doubtful")
_RANGES = ("outlier_rate", "rotation_error_deg", "translation_error_m", "inliers", "correspondences", "time_ms")

Condition = tuple[str, list[Any]]
"""SQL that follows WHERE, and its parameters."""


def condition(query: RunQuery) -> Condition:
    """What must be true of a row of ``runs``."""
    parts: list[Condition] = [("TRUE", [])]
    for name in _EXACT:
        if (value := getattr(query, name)) is not None:
            parts.append((f"{name} = ?", [value]))
    for name in _RANGES:
        if (limits := getattr(query, name)) is not None:
            parts.append(_within(name, limits))
    if query.scene is not None:
        parts.append(_scene(query.scene))
    if query.label is not None:
        parts.append(("id IN (SELECT id FROM labels WHERE label = ?)", [query.label]))
    if query.pages is not None:
        parts.append((f"{'' if query.pages else 'NOT '}(source = 'page' AND labels = '[]')", []))
    if query.since is not None:
        parts.append(("created >= ?", [query.since]))
    if query.until is not None:
        parts.append(("created < ?", [query.until]))
    if wanted := (query.text or "").casefold().split():
        # instr() knows no wildcards, so that nothing must be escaped.
        tests = " AND ".join(["instr(words, ?)"] * len(wanted))
        parts.append((f"id IN (SELECT id FROM words WHERE {tests})", list(wanted)))
    return " AND ".join(sql for sql, _ in parts), [value for _, values in parts for value in values]


def _within(name: str, limits: Range) -> Condition:
    low, high = ">" if limits.low_open else ">=", "<" if limits.high_open else "<="
    return f"{name} {low} ? AND {name} {high} ?", [limits.low, limits.high]


def _scene(scene: str) -> Condition:
    endings = [f"/{scene}", f"/{scene}.toml"]
    sql = " OR ".join(["name = ?", "scene IN (?, ?)", *["substr(scene, -length(?)) = ?"] * len(endings)])
    return f"({sql})", [scene, scene, f"{scene}.toml", *(ending for ending in endings for _ in range(2))]


def order(query: RunQuery) -> str:
    """The order of the answer; the file's name, which sorts by time, makes it the same every time."""
    assert query.sort in SORT_KEYS
    direction = "DESC" if query.descending else "ASC"
    # Only where it can be null, since an index cannot sort by more than columns.
    nulls_last = f"{query.sort} IS NULL, " if query.sort in NULLABLE else ""
    return f"{nulls_last}{query.sort} {direction}, file {direction}"


def groups(query: RunQuery, by: str) -> Condition:
    """A whole statement that counts runs by the value of ``by``, most of them first."""
    assert by in GROUP_KEYS
    where, values = condition(query)
    table = f"labels WHERE id IN (SELECT id FROM runs WHERE {where})" if by == "label" else f"runs WHERE {where}"
    return f"SELECT {by}, count(*) FROM {table} GROUP BY {by} ORDER BY count(*) DESC, {by}", values
