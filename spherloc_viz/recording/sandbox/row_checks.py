"""What the row of a recording may hold, before it is believed: values of moderate size, of the types that we write."""

import base64
import re
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any, get_args, get_type_hints

from spherloc.diagnosis.causes import Cause
from spherloc.errors import RecordingError, show
from spherloc_viz.recording.origin import Source
from spherloc_viz.recording.run_row import RunRow

ROW_TEXT_LIMIT = 4_096
"""Characters of a text in a list."""
LONG_TEXT_LIMIT = 65_536
"""Characters of options and of a note."""
LABELS_LIMIT = 100
COUNT_LIMIT = 1_000_000
"""Correspondences, and steps."""
THUMBNAIL_LIMIT_BYTES = 262_144
THUMBNAIL_LIMIT_PX = 2_048
"""A side; a small file can claim a picture that fills the memory of a browser."""

_TYPES: dict[str, tuple[Any, ...]] = {name: get_args(kind) or (kind,) for name, kind in get_type_hints(RunRow).items()}
"""What the value of each field of a row may be."""
_LONG = ("options", "note")
_PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0dIHDR"
_WORDS = {
    "run_id": r"[A-Za-z0-9_.-]{1,128}",
    "estimator": r"[A-Za-z0-9_.-]{1,128}",
    "problem_key": r"[A-Za-z0-9_-]{0,128}",
}
_ONE_OF: dict[str, tuple[str, ...]] = {
    "source": ("", *get_args(Source)),
    "outcome": ("success", "failure", "unknown"),
    "diagnosis": ("", *(cause.value for cause in Cause)),
}
_AT_MOST = {"correspondences": COUNT_LIMIT, "inliers": COUNT_LIMIT, "steps": COUNT_LIMIT, "format_version": 1_000}
_NOT_NEGATIVE = (*_AT_MOST, "outlier_rate", "rotation_error_deg", "translation_error_m", "time_ms", "size_bytes")
_INTEGER_LIMIT = 1 << 63
"""Integers of SQLite are smaller."""


def table_from_row(row: RunRow) -> dict[str, Any]:
    """The row as JSON can have it; its thumbnail as base 64."""
    return vars(row) | {"thumbnail": base64.b64encode(row.thumbnail).decode("ascii")}


def row_from_table(table: Any, path: Path) -> RunRow:
    """The row that ``table_from_row`` made a table of; its ``file`` is the name of ``path``.

    Raises ``RecordingError``, in one sentence, if it is no such table or if a value cannot be what it should: a text
    or picture too long, a number that is not finite, a word that is not one of those that there are.
    """
    if not isinstance(table, dict) or table.keys() != _TYPES.keys():
        raise _bad(path, "the row", table)
    values: dict[str, Any] = {**table, "file": path.name}
    try:
        values["labels"] = tuple(values["labels"])
        values["thumbnail"] = base64.b64decode(values["thumbnail"], validate=True)
    except (TypeError, ValueError):
        raise _bad(path, "labels or thumbnail", (values["labels"], values["thumbnail"])) from None
    for name, value in values.items():
        if not _value_fits(name, value):
            raise _bad(path, name, value)
    row = RunRow(**values)
    if row.inliers > row.correspondences or row.key_step >= max(row.steps, 1) or row.key_step < 0:
        shown = (row.inliers, row.correspondences, row.key_step, row.steps)
        raise _bad(path, "inliers, correspondences, key_step, steps", shown)
    return row


def _bad(path: Path, what: str, value: Any) -> RecordingError:
    return RecordingError(f"{path}: its row has an impossible value of {what} ({show(value)}); record the run again.")


def _value_fits(name: str, value: Any) -> bool:
    kinds = _TYPES[name]
    if value is None:
        return type(None) in kinds
    if isinstance(value, bool):
        return bool in kinds
    if isinstance(value, str):
        return str in kinds and _text_fits(name, value)
    if isinstance(value, bytes):
        return bytes in kinds and is_thumbnail(value)
    if isinstance(value, tuple):
        texts = [isinstance(item, str) and _text_fits(name, item) for item in value]
        return name == "labels" and len(value) <= LABELS_LIMIT and all(texts)
    if isinstance(value, int) and int in kinds:
        return -_INTEGER_LIMIT <= value < _INTEGER_LIMIT and _number_fits(name, value)
    return isinstance(value, int | float) and float in kinds and _number_fits(name, value)


def _text_fits(name: str, text: str) -> bool:
    if len(text) > (LONG_TEXT_LIMIT if name in _LONG else ROW_TEXT_LIMIT) or not _is_unicode(text):
        return False
    if name == "created":
        return _is_utc(text)
    if name in _ONE_OF:
        return text in _ONE_OF[name]
    return name not in _WORDS or re.fullmatch(_WORDS[name], text) is not None


def _is_unicode(text: str) -> bool:
    """Whether it can be stored and sent: JSON can have halves of characters."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _is_utc(text: str) -> bool:
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        return False
    # One form only, so that texts sort by time.
    return when.tzinfo is not None and when.astimezone(UTC).isoformat(timespec="milliseconds") == text


def _number_fits(name: str, value: float) -> bool:
    if not isfinite(value) or (name in _NOT_NEGATIVE and value < 0) or value > _AT_MOST.get(name, value):
        return False
    return name != "outlier_rate" or value <= 1.0


def is_thumbnail(picture: bytes) -> bool:
    """Whether it is a small PNG, or nothing; its pixels are not decoded."""
    if not picture:
        return True
    sides = (int.from_bytes(picture[start : start + 4], "big") for start in (16, 20))
    is_small = len(picture) <= THUMBNAIL_LIMIT_BYTES and all(0 < side <= THUMBNAIL_LIMIT_PX for side in sides)
    return is_small and picture.startswith(_PNG)
