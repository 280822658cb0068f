"""One row a query: what was found, how far off it is, and its texts in JSON and CSV."""

import csv
import io
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from spherloc.datasets.scene_file import numbers
from spherloc.errors import InputError, show
from spherloc.geometry import camera_centre
from spherloc.outcome import Outcome
from spherloc.types import FloatArray

LOCALIZED, DOUBTFUL, FAILED = (str(outcome) for outcome in (Outcome.LOCALIZED, Outcome.DOUBTFUL, Outcome.FAILED))
UNREADABLE = "unreadable"
POSED = (LOCALIZED, DOUBTFUL)
STATUSES = (*POSED, FAILED, UNREADABLE)


@dataclass(frozen=True, eq=False)
class QueryResult:
    """The result of one query image. What is unknown is None."""

    index: int
    """Place in the scene's sequence, from 0."""
    query: str
    """Name of the query image."""
    status: str
    """"localized"; "doubtful": a pose that is not to be believed, see ``spherloc.outcome``; "failed": a usable image
    got no pose; or "unreadable": the image cannot be used, so no method is judged by it."""
    timestamp_s: float | None = None
    """When the image was taken, seconds."""
    references: int | None = None
    """Reference images that were matched."""
    matches: int | None = None
    """2D-3D correspondences."""
    inliers: int | None = None
    """Correspondences that agree with the pose."""
    estimated_outlier_rate: float | None = None
    """What the front end guessed."""
    true_outlier_rate: float | None = None
    """Share of the correspondences more than 8 px from their true pixel."""
    rotation_error_deg: float | None = None
    """Angle between true and estimated rotation, degrees."""
    translation_error_m: float | None = None
    """Distance between true and estimated camera position, metres."""
    registration_error_m: float | None = None
    """How far the query's depth is off the map's at the pose, metres; inf if they do not meet."""
    precision: float | None = None
    """Share of the inliers that are within 8 px of their true pixel."""
    recall: float | None = None
    """Share of the correspondences within 8 px of their true pixel that are inliers."""
    f1: float | None = None
    """Harmonic mean of both."""
    matching_ms: float | None = None
    """Wall time of features, retrieval, matching and lifting; another query may have been solved meanwhile."""
    estimating_ms: float | None = None
    """Wall time of the estimator."""
    diagnosis: str | None = None
    """Value of ``spherloc.diagnosis.Cause``."""
    recording: str | None = None
    """The recording's file, relative to the folder of the results if it is inside."""
    message: str = ""
    """The outcome in a sentence, and of a doubtful one what speaks against it."""
    remarks: tuple[str, ...] = ()
    """What the front end skipped and why, in sentences."""
    cam_from_map: FloatArray | None = None
    """Estimated pose (3, 4)."""
    truth_cam_from_map: FloatArray | None = None
    """True pose (3, 4)."""

    @property
    def position_m(self) -> FloatArray:
        """Estimated camera position (3,) in the map frame; NaN without a pose."""
        return np.full(3, np.nan) if self.cam_from_map is None else camera_centre(self.cam_from_map)

    @property
    def true_position_m(self) -> FloatArray:
        """True camera position (3,) in the map frame; NaN if it is unknown."""
        return np.full(3, np.nan) if self.truth_cam_from_map is None else camera_centre(self.truth_cam_from_map)


_FIELDS = tuple(item.name for item in fields(QueryResult))
_POSES = ("cam_from_map", "truth_cam_from_map")
_WHOLE = {"index", "references", "matches", "inliers"}
_TEXTS = {"query", "status", "diagnosis", "recording", "message"}
_NEEDED = {"index", "query", "status", "message", "remarks"}

COLUMNS = tuple(name for name in _FIELDS if name not in _POSES)
"""Of the CSV; poses are in the trajectory."""


def json_line(row: QueryResult) -> str:
    """The row as one JSON object on one line; infinity is the text "inf", as JSON has no word for it."""
    values = {name: getattr(row, name) for name in _FIELDS}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            values[name] = value.tolist()
        elif isinstance(value, float) and not math.isfinite(value):
            values[name] = "inf" if value > 0 else None
    return json.dumps(values, allow_nan=False)


def row_of_json(line: str, place: str) -> QueryResult:
    """The row of a line by ``json_line``; ``place`` names its file and number.

    Raises ``InputError`` if it is no such line.
    """
    try:
        values = json.loads(line, parse_constant=lambda word: show(word))
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict) or set(values) != set(_FIELDS):
        raise _damaged(place, "is no result of a query")
    for name in _FIELDS:
        if values[name] is None and name not in _NEEDED:
            continue
        values[name] = _value(name, values[name], place)
    if (values["status"] in POSED) != (values["cam_from_map"] is not None) or values["status"] not in STATUSES:
        raise _damaged(place, f"has the status {show(values['status'])}, which does not fit its pose")
    return QueryResult(**values)


def _value(name: str, value: Any, place: str) -> Any:
    if name in _POSES:
        try:
            return numbers(value, (3, 4), name, place)
        except InputError:
            raise _damaged(place, f"has a {name} that is no pose") from None
    if name == "remarks":
        if isinstance(value, list) and all(isinstance(remark, str) for remark in value):
            return tuple(value)
    elif name in _TEXTS:
        if isinstance(value, str):
            return value
    elif name in _WHOLE:
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53:
            return value
    elif value == "inf":
        return math.inf
    elif isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300:
        return float(value)
    raise _damaged(place, f"has {show(value)} for {name}")


def _damaged(place: str, what: str) -> InputError:
    return InputError(f"{place}: {what}, so the file is damaged; delete that line to have its query done again.")


def csv_text(rows: Iterable[QueryResult], header: bool = True) -> str:
    """The rows as CSV, a line each: what is unknown is empty, and no spreadsheet takes a cell for a formula."""
    file = io.StringIO(newline="")
    writer = csv.writer(file, lineterminator="\n")
    if header:
        writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow([_cell(getattr(row, name)) for name in COLUMNS])
    return file.getvalue()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        value = " ".join(value)
    if isinstance(value, str):
        # A line break in a file name must not break the row, and "=cmd()" must stay a text where the table is opened.
        value = "".join(character if character.isprintable() else " " for character in value)
        return f"'{value}" if value.lstrip()[:1] in ("=", "+", "-", "@") else value
    return repr(value)
