"""The folder of a sequence's results: each finished query is written to the disk before the next one starts."""

import contextlib
import csv
import io
import itertools
import json
import math
import os
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from spherloc.datasets.scene_file import numbers
from spherloc.errors import InputError, reason, show
from spherloc.experiments.configuration import Configuration, in_short, read_configuration
from spherloc.files import lock, read_file, reading, write_whole
from spherloc.geometry import align_to_down, camera_centre
from spherloc.outcome import Outcome
from spherloc.types import FloatArray

LOCALIZED, DOUBTFUL, FAILED = (str(outcome) for outcome in (Outcome.LOCALIZED, Outcome.DOUBTFUL, Outcome.FAILED))
UNREADABLE = "unreadable"
POSED = (LOCALIZED, DOUBTFUL)
STATUSES = (*POSED, FAILED, UNREADABLE)


@dataclass(frozen=True, eq=False)
class QueryResult:
    """The result of one query image; unknown values are None."""

    index: int
    """Place in the scene's sequence, from 0."""
    query: str
    """Name of the query image."""
    status: str
    """"localized"; "doubtful": there is a pose, but it is not believed, see ``spherloc.outcome``, or other queries or
    maps speak against it; "failed": the image is usable but has no pose; "unreadable": the image cannot be used and
    does not count in success rates."""
    timestamp_s: float | None = None
    """When the image was taken, seconds."""
    references: int | None = None
    """Number of reference images that were matched."""
    matches: int | None = None
    """Number of 2D-3D correspondences."""
    inliers: int | None = None
    """Number of correspondences that agree with the pose."""
    estimated_outlier_rate: float | None = None
    """Outlier rate that the front end estimated, 0 to 1."""
    true_outlier_rate: float | None = None
    """Share of the correspondences more than 8 px from their true pixel."""
    rotation_error_deg: float | None = None
    """Angle between true and estimated rotation, degrees."""
    translation_error_m: float | None = None
    """Distance between true and estimated camera position, metres."""
    expected_rotation_error_deg: float | None = None
    """What the pose's covariance expects of that angle, root mean square, degrees."""
    expected_translation_error_m: float | None = None
    """The same of that distance, metres."""
    registration_error_m: float | None = None
    """Distance by which registration moves the query's depth to fit the map, metres; inf if it does not fit."""
    precision: float | None = None
    """Share of the inliers that are within 8 px of their true pixel."""
    recall: float | None = None
    """Share of the correspondences within 8 px of their true pixel that are inliers."""
    f1: float | None = None
    """Harmonic mean of both."""
    gravity_source: str | None = None
    """Source of the query's gravity."""
    gravity_bound_deg: float | None = None
    """Bound on the error of that gravity, degrees."""
    gravity_error_deg: float | None = None
    """Angle between that gravity and the one of the true pose, degrees."""
    matching_ms: float | None = None
    """Wall time of features, retrieval, matching and lifting; another query may have been solved at the same time."""
    estimating_ms: float | None = None
    """Wall time of the estimator."""
    diagnosis: str | None = None
    """Value of ``spherloc.diagnosis.Cause``."""
    recording: str | None = None
    """The recording's file, relative to the folder of the results if it is inside."""
    message: str = ""
    """The outcome in a sentence, followed by what speaks against a doubtful pose."""
    remarks: tuple[str, ...] = ()
    """What the front end skipped and why, in sentences."""
    inputs: str | None = None
    """Digest of the query's camera, gravity, true pose and size of the image file, to see whether these change."""
    cam_from_map: FloatArray | None = None
    """Estimated pose (3, 4)."""
    truth_cam_from_map: FloatArray | None = None
    """True pose (3, 4)."""

    def doubted(self, why: str) -> "QueryResult":
        """The row of a localized query as a doubtful one, since other maps or other queries speak against its pose, as
        the sentence ``why`` says."""
        return replace(self, status=DOUBTFUL, message=f"{self.message} {why}", remarks=(*self.remarks, why))

    @property
    def doubts(self) -> tuple[str, ...]:
        """The sentence with which it was ``doubted``; none otherwise."""
        ends = self.status == DOUBTFUL and self.remarks and self.message.endswith(self.remarks[-1])
        return self.remarks[-1:] if ends else ()

    @property
    def position_m(self) -> FloatArray:
        """Estimated camera position (3,) in the map frame; NaN without a pose."""
        return np.full(3, np.nan) if self.cam_from_map is None else camera_centre(self.cam_from_map)

    @property
    def true_position_m(self) -> FloatArray:
        """True camera position (3,) in the map frame; NaN if it is unknown."""
        return np.full(3, np.nan) if self.truth_cam_from_map is None else camera_centre(self.truth_cam_from_map)


_TYPES = {item.name: item.type for item in fields(QueryResult)}
_FIELDS = tuple(_TYPES)
_POSES = ("cam_from_map", "truth_cam_from_map")
_WHOLE = {name for name, kind in _TYPES.items() if kind in (int, int | None)}
_TEXTS = {name for name, kind in _TYPES.items() if kind in (str, str | None)}
_NEEDED = {item.name for item in fields(QueryResult) if item.default is not None}
"""Fields of every line. The others may be null, or missing in files of versions that did not have them: both are
None."""

PLACE = ("x_m", "y_m", "z_m", "heading_deg")
"""Columns of the CSV that tell the estimated pose: the camera's position in the map's frame, metres or units of a map
whose scale is unknown, and ``heading_deg``. Whole poses are in the trajectory."""
_AFTER = _FIELDS.index("status") + 1
COLUMNS = tuple(name for name in (*_FIELDS[:_AFTER], *PLACE, *_FIELDS[_AFTER:]) if name not in (*_POSES, "inputs"))
"""Columns of the CSV."""
MIN_LEVEL = math.sin(math.radians(5.0))
"""Least horizontal part of a camera's axis, a unit vector, that has a heading."""


def heading_deg(cam_from_map: FloatArray, gravity_map: FloatArray) -> float | None:
    """Direction of view of a pose (3, 4), degrees from -180 to 180: of the optical axis, which in a panorama is the
    middle of the image, seen from above.

    It is counted counter-clockwise from the map's x axis, brought to the horizontal by the smallest rotation that makes
    the map level; ``gravity_map`` (3,) is the unit vector pointing down. None for a camera that looks up or down.
    """
    ahead = align_to_down(gravity_map) @ cam_from_map[2, :3]
    if math.hypot(ahead[0], ahead[2]) < MIN_LEVEL:
        return None
    return math.degrees(math.atan2(ahead[2], ahead[0]))


def json_line(row: QueryResult) -> str:
    """The row as one JSON object on one line; infinity is the text "inf", since JSON has no number for it."""
    values = {name: getattr(row, name) for name in _FIELDS}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            values[name] = value.tolist()
        elif isinstance(value, float) and not math.isfinite(value):
            values[name] = "inf" if value > 0 else None
    return json.dumps(values, allow_nan=False)


def row_of_json(line: str, place: str) -> QueryResult:
    """The row of a line that ``json_line`` wrote; ``place`` names the file and the line number.

    Raises ``InputError`` for any other line.
    """
    try:
        values = json.loads(line, parse_constant=lambda word: show(word))
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict) or not _NEEDED <= set(values) <= set(_FIELDS):
        raise _damaged(place, "is not a result of a query")
    for name, value in values.items():
        if value is not None or name in _NEEDED:
            values[name] = _value(name, value, place)
    if (values["status"] in POSED) != (values.get("cam_from_map") is not None) or values["status"] not in STATUSES:
        raise _damaged(place, f"has the status {show(values['status'])}, which does not fit its pose")
    return QueryResult(**values)


def _value(name: str, value: Any, place: str) -> Any:
    if name in _POSES:
        try:
            return numbers(value, (3, 4), name, place)
        except InputError:
            raise _damaged(place, f"has a {name} that is not a pose") from None
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


def csv_text(rows: Iterable[QueryResult], setting: Configuration, header: bool = True) -> str:
    """The rows as CSV, a line each: unknown values are empty, and no spreadsheet takes a cell for a formula.

    Names of lengths end in "_m", or in "_units" if the units of the map are unknown.
    """
    file = io.StringIO(newline="")
    writer = csv.writer(file, lineterminator="\n")
    if header:
        writer.writerow(name if setting.metric else re.sub("_m$", "_units", name) for name in COLUMNS)
    for row in rows:
        place = _place(row, setting.gravity_map)
        writer.writerow([_cell(place[name] if name in place else getattr(row, name)) for name in COLUMNS])
    return file.getvalue()


def _place(row: QueryResult, gravity_map: FloatArray) -> dict[str, float | None]:
    """The columns ``PLACE`` of a row."""
    pose = row.cam_from_map
    if pose is None:
        return dict.fromkeys(PLACE)
    return dict(zip(PLACE, (*camera_centre(pose).tolist(), heading_deg(pose, gravity_map)), strict=True))


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


CONFIGURATION, ROWS, TABLE = "configuration.json", "results.jsonl", "results.csv"
TRAJECTORY, TRUE_TRAJECTORY, PICTURE, SUMMARY = "trajectory.tum", "truth.tum", "trajectory.png", "summary.json"
VEHICLE_TRAJECTORY = "vehicle.tum"
REWRITTEN = (TABLE, TRAJECTORY, TRUE_TRAJECTORY, VEHICLE_TRAJECTORY, PICTURE, SUMMARY)
"""Files of the folder that every run of the sequence writes again."""
MAX_BYTES = 2_000_000_000


@dataclass(frozen=True, eq=False)
class SequenceResults:
    """A sequence's results, in the order of its query images. Q rows."""

    folder: Path
    """The folder from which they were read."""
    configuration: Configuration
    """The settings with which they were made."""
    rows: tuple[QueryResult, ...]
    """One row for each finished query."""

    @property
    def names(self) -> tuple[str, ...]:
        """(Q,) names of the query images."""
        return tuple(row.query for row in self.rows)

    @property
    def status(self) -> tuple[str, ...]:
        """(Q,) "localized", "doubtful", "failed" or "unreadable"."""
        return tuple(row.status for row in self.rows)

    @cached_property
    def positions_m(self) -> FloatArray:
        """(Q, 3) estimated camera positions, map frame; NaN without a pose."""
        return np.array([row.position_m for row in self.rows]).reshape(-1, 3)

    @cached_property
    def true_positions_m(self) -> FloatArray:
        """(Q, 3) true camera positions, map frame; NaN where they are unknown."""
        return np.array([row.true_position_m for row in self.rows]).reshape(-1, 3)

    @property
    def rotation_errors_deg(self) -> FloatArray:
        """(Q,) rotation errors, degrees; NaN without a pose or its truth."""
        return self._numbers("rotation_error_deg")

    @property
    def translation_errors_m(self) -> FloatArray:
        """(Q,) position errors, metres; NaN without a pose or its truth."""
        return self._numbers("translation_error_m")

    @property
    def registration_errors_m(self) -> FloatArray:
        """(Q,) registration errors, metres; NaN without a pose or where nothing was registered."""
        return self._numbers("registration_error_m")

    @property
    def recordings(self) -> tuple[Path | None, ...]:
        """(Q,) files of the recordings; they may have been moved or deleted since."""
        return tuple(None if row.recording is None else self.folder / row.recording for row in self.rows)

    def _numbers(self, name: str) -> FloatArray:
        values = [getattr(row, name) for row in self.rows]
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def read_results(folder: Path) -> SequenceResults:
    """The results that ``spherloc localize`` wrote into a folder, finished or not.

    A last line that a killed process left half written is ignored. Raises ``InputError`` that names the file and
    the line if a file is missing, unreadable or damaged.
    """
    folder = Path(folder)
    configuration = read_configuration(folder / CONFIGURATION)
    rows, _ = _read_rows(folder / ROWS)
    return SequenceResults(folder, configuration, rows)


def _read_rows(path: Path) -> tuple[tuple[QueryResult, ...], int]:
    """Rows in the order of the sequence, and the number of bytes of the file that hold complete lines."""
    if not os.path.lexists(path):
        return (), 0
    with reading(path, "give another folder"):
        content = read_file(path, MAX_BYTES)
    whole = content[: content.rfind(b"\n") + 1]
    rows: dict[str, QueryResult] = {}
    for number, line in enumerate(whole.split(b"\n")[:-1], start=1):
        place = f"{path}, line {number}"
        row = row_of_json(line.decode("utf-8", errors="replace"), place)
        if row.query in rows:
            raise InputError(
                f"{place}: the query {show(row.query)} is there a second time; delete one of the two lines."
            )
        rows[row.query] = row
    return tuple(sorted(rows.values(), key=lambda row: row.index)), len(whole)


def folder_for(base: Path, configuration: Configuration) -> Path:
    """``base``, or if it holds results of another configuration, the first of ``base``_2, ``base``_3, ... without any.

    Raises ``InputError`` if a configuration there is damaged.
    """
    others = (base.with_name(f"{base.name}_{number}") for number in itertools.count(2))
    return next(folder for folder in itertools.chain([base], others) if _may_hold(folder, configuration))


def _may_hold(folder: Path, configuration: Configuration) -> bool:
    """Whether a folder has results of that configuration, or of none."""
    path = folder / CONFIGURATION
    return not os.path.lexists(path) or not read_configuration(path).differences(configuration)


class ResultsLog:
    """Appends rows to the results in a folder. Use it as a context manager; one process at a time may have it."""

    def __init__(self, folder: Path, configuration: Configuration) -> None:
        """Start a folder of results or continue one.

        Raises ``InputError`` if the folder cannot be written, if its results were made with another configuration, if
        they are damaged, or if another process is writing there.
        """
        self.folder = Path(folder)
        self.rows: dict[str, QueryResult] = {}
        """The results by query name, those of earlier runs too."""
        self.repaired = False
        """Whether a line that an earlier run left half written was removed."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise self._unwritable(error) from None
        with contextlib.ExitStack() as stack:
            self._lock(stack)
            self._configure(configuration)
            rows, whole_bytes = _read_rows(self.folder / ROWS)
            self.rows = {row.query: row for row in rows}
            self._repair(whole_bytes)
            self._write_table()
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def append(self, row: QueryResult) -> None:
        """Write a row to the disk, before this returns. Raises ``InputError`` if that fails; other rows are kept."""
        with self._writing(ROWS), (self.folder / ROWS).open("ab") as file:
            file.write(f"{json_line(row)}\n".encode())
            file.flush()
            os.fsync(file.fileno())
        self.rows[row.query] = row
        with self._writing(TABLE), (self.folder / TABLE).open("a", encoding="utf-8", newline="") as table:
            table.write(csv_text([row], self.configuration, header=False))

    def forget_failures(self) -> int:
        """Remove the rows of queries without a pose, so that they are done again; returns how many.

        Raises ``InputError`` if the files cannot be written.
        """
        return self.forget([name for name, row in self.rows.items() if row.status not in POSED])

    def forget(self, queries: Collection[str]) -> int:
        """Remove the rows of these queries, so that they are done again; returns how many there were.

        Raises ``InputError`` if the files cannot be written.
        """
        kept = {name: row for name, row in self.rows.items() if name not in queries}
        removed = len(self.rows) - len(kept)
        if removed:
            self._rewrite(kept)
        return removed

    def change(self, rows: Iterable[QueryResult]) -> None:
        """Put these rows in the place of those of the same queries.

        Raises ``InputError`` if the files cannot be written.
        """
        self._rewrite(self.rows | {row.query: row for row in rows})

    def _rewrite(self, rows: dict[str, QueryResult]) -> None:
        self.write(ROWS, "".join(f"{json_line(row)}\n" for row in rows.values()).encode())
        self.rows = rows
        self._write_table()

    def results(self) -> SequenceResults:
        """The results so far, in the order of the sequence; they are also written to ``results.csv``."""
        self._write_table()
        ordered = sorted(self.rows.values(), key=lambda row: row.index)
        return SequenceResults(self.folder, self.configuration, tuple(ordered))

    def write(self, name: str, content: bytes) -> None:
        """Write a file into the folder, so that no reader sees half of it. Raises ``InputError`` if that fails."""
        with self._writing(name):
            write_whole(self.folder / name, content, sync=True)

    @contextlib.contextmanager
    def _writing(self, name: str):
        try:
            yield
        except OSError as error:
            raise InputError(
                f"{self.folder / name}: cannot be written ({reason(error)}); what is done is kept "
                f"({len(self.rows)} queries): make room there and give the same command to go on."
            ) from None

    def _unwritable(self, error: OSError | ValueError) -> InputError:
        return InputError(f"{self.folder}: results cannot be written there ({reason(error)}); give another folder.")

    def _lock(self, stack: contextlib.ExitStack) -> None:
        """Lock the folder against other processes."""
        try:
            handle = os.open(self.folder, os.O_RDONLY)
        except OSError:  # Windows cannot open folders
            return
        stack.callback(os.close, handle)
        try:
            lock(handle)
        except BlockingIOError:
            raise InputError(
                f"{self.folder}: another process is localizing into it; wait for it or give another folder."
            ) from None

    def _configure(self, configuration: Configuration) -> None:
        path = self.folder / CONFIGURATION
        if os.path.lexists(path):
            differences = read_configuration(path).differences(configuration)
            if differences:
                raise InputError(
                    f"{self.folder}: holds results of another configuration ({in_short(differences)}); give another "
                    "folder (--output)."
                )
        else:
            others = [name for name in (ROWS, *REWRITTEN) if os.path.lexists(self.folder / name)]
            if others:
                raise InputError(
                    f"{self.folder}: already holds {', '.join(others)}, but no {CONFIGURATION}, so they are not of a "
                    "sequence that could go on; give another folder."
                )
            self.write(CONFIGURATION, configuration.json_text().encode())
        self.configuration = configuration

    def _repair(self, whole_bytes: int) -> None:
        path = self.folder / ROWS
        with self._writing(ROWS):
            if path.exists() and path.stat().st_size > whole_bytes:
                os.truncate(path, whole_bytes)
                self.repaired = True

    def _write_table(self) -> None:
        ordered = sorted(self.rows.values(), key=lambda row: row.index)
        self.write(TABLE, csv_text(ordered, self.configuration).encode())
