"""The numbers of a recording: the problem and the run as rows at ``/data``, and back, bit for bit.

There are the rows "problem", "run", "origin", "diagnosis" and one "stages/KIND" for every stage. The column ``arrays``
has the bytes of all of their arrays, one behind the other; the column ``scalars`` is JSON: by the name of each row the
names, types and shapes of its ``arrays`` and all of its other ``values``. A number that JSON has no word for is
``{"number": "inf"}`` (or "-inf", "nan"). In format 2 each row has an entity of its own, such as ``/data/problem``, and
in format 1 each array a column.
"""

import contextlib
import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk, LazyStore, RrdReader, StoreEntry
from rerun.error_utils import RerunWarning

from spherloc.cameras.calibration import camera_from_table
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, Diagnosis, Measures
from spherloc.errors import InputError, RecordingError, show
from spherloc.problem import Problem
from spherloc.trace import Certificate, Trace
from spherloc_viz.given_files import check_recording_file
from spherloc_viz.layers.key_step import StepNumbers
from spherloc_viz.options import plain
from spherloc_viz.recording.content.columns import Times, Values, static_chunk
from spherloc_viz.recording.content.names import (
    APPLICATION_ID,
    ARRAYS,
    DATA,
    FORMAT_VERSION,
    NUMBERS,
    OLDEST_VERSION,
    PROPERTIES,
    QUERY_IMAGE,
    THUMBNAIL_PROPERTY,
)
from spherloc_viz.recording.content.properties import read_image, read_properties, row_from_properties
from spherloc_viz.recording.origin import Origin, machine
from spherloc_viz.recording.recorded_run import RecordedRun
from spherloc_viz.recording.review_file import read_review
from spherloc_viz.recording.run_row import RunRow

MAX_ARRAY_BYTES = 16_384
"""Stage arrays above this are left out of a lean recording: they follow from the problem, the options and the seed."""
MAX_SCENE_BYTES = 65_536
"""The text of a larger scene file is not recorded."""

STORED_AS = {"nfa": "chance_sets", "alternative_cam_from_map": "rival_cam_from_map"}
"""Fields that recordings know by the name that they had in the first format."""
NOT_FINITE = "number"
"""Key of the table that stands for infinity or NaN."""

Row = dict[str, Any]


def data_chunk(trace: Trace, origin: Origin, diagnosis: Diagnosis, full: bool) -> Chunk:
    """A static chunk with the problem, the result, where it came from, what is wrong with it, and every stage.

    Of a stage it is the small arrays or, with ``full``, all of them; of an extension's stage only arrays of numbers and
    what JSON can hold.
    """
    rows = {
        "problem": _problem_row(trace.problem),
        "run": _run_row(trace),
        "origin": asdict(origin) | {"scene_text": scene_text(origin.scene_path)},
        "diagnosis": _stored(
            {item.name: getattr(diagnosis, item.name) for item in fields(diagnosis) if item.name != "measures"}
        ),
    }
    for stage in trace.stages:
        row = {item.name: getattr(stage, item.name) for item in fields(stage)}
        kept = {
            name: value
            for name, value in row.items()
            if (full or getattr(value, "nbytes", 0) <= MAX_ARRAY_BYTES) and _can_be_written(value)
        }
        rows[f"stages/{stage.kind}"] = kept
    return _chunk(rows)


def _can_be_written(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    try:
        json.dumps(plain(value, str))
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def scene_text(path: str | None) -> str | None:
    """The text of a scene file; None if it is not TOML of moderate size, or cannot be read."""
    if path is None or not path.endswith(".toml"):
        return None
    try:
        with Path(path).open("rb") as file:
            content = file.read(MAX_SCENE_BYTES + 1)
        return content.decode() if len(content) <= MAX_SCENE_BYTES else None
    except (OSError, ValueError):
        return None


def _problem_row(problem: Problem) -> Row:
    row = {item.name: getattr(problem, item.name) for item in fields(problem)}
    image = None if problem.image is None else str(problem.image)
    references = [str(path) for path in problem.reference_images]
    return row | {"camera": problem.camera.to_dict(), "image": image, "reference_images": references}


def _run_row(trace: Trace) -> Row:
    return {
        "estimator": trace.estimator,
        "options": asdict(trace.options),
        "seed": trace.seed,
        "versions": {**trace.versions, "machine": machine()},
        "timings_ms": dict(trace.timings_ms),
        "cam_from_map": trace.cam_from_map,
        "inlier_mask": trace.inlier_mask,
        "message": trace.message,
        "certificate": None if trace.certificate is None else _stored(asdict(trace.certificate)),
    }


def problem_from_row(row: Row, where: str) -> Problem:
    """The recorded problem, bit for bit.

    Raises ``SpherlocError`` if the row describes none, and ``KeyError`` or ``TypeError`` if it is not a problem's row.
    """
    image = None if row["image"] is None else Path(row["image"])
    references = tuple(Path(text) for text in row.get("reference_images", ()))
    changed = {"camera": camera_from_table(row["camera"], where), "image": image, "reference_images": references}
    changed["remarks"] = tuple(row.get("remarks", ()))
    problem = Problem(**row | changed)
    for name in ("gravity_camera", "gravity_map"):
        # Problem scales directions to unit length, and doing so twice can change the last bit.
        object.__setattr__(problem, name, row[name])
    return problem


def origin_from_row(row: Row) -> tuple[Origin, str | None]:
    """Where the run came from, and the text of its scene file.

    Raises ``SpherlocError``, ``KeyError`` or ``TypeError`` if the row says no such thing.
    """
    text, variation = row.pop("scene_text"), dict(row.pop("variation"))
    for name in ("true_camera", "spoiled", "mended", "hidden"):
        variation[name] = None if variation[name] is None else tuple(variation[name])
    return Origin(variation=Variation(**variation), **row), text


def _stored(row: Row) -> Row:
    return {STORED_AS.get(name, name): value for name, value in row.items()}


def certificate_from_row(row: Row) -> Certificate:
    """What is proven of the run. Raises ``KeyError`` or ``TypeError`` if the row says no such thing."""
    return Certificate(nfa=row.pop(STORED_AS["nfa"]), **row)


def diagnosis_from_row(row: Row, listed: RunRow) -> Diagnosis:
    """What was wrong with the run; its measures are those of its row ``listed`` in lists.

    Raises ``KeyError``, ``TypeError`` or ``ValueError`` if the row says no such thing.
    """
    alternative = row.pop(STORED_AS["alternative_cam_from_map"], None)
    cause, evidence = Cause(row.pop("cause")), tuple(row.pop("evidence"))
    measures = Measures(**{item.name: getattr(listed, item.name) for item in fields(Measures)})
    return Diagnosis(cause=cause, evidence=evidence, alternative_cam_from_map=alternative, measures=measures, **row)


def _chunk(rows: dict[str, Row]) -> Chunk:
    """One chunk, since every column costs more room in the file's index than most arrays have."""
    told, content = {}, []
    for name, row in rows.items():
        arrays = {key: np.ascontiguousarray(value) for key, value in row.items() if isinstance(value, np.ndarray)}
        others = {key: value for key, value in row.items() if key not in arrays}
        forms = [[key, array.dtype.str, list(array.shape)] for key, array in arrays.items()]
        told[name] = {ARRAYS: forms, "values": plain(others, lambda number: {NOT_FINITE: str(number)})}
        content += [array.tobytes() for array in arrays.values()]
    joined = np.frombuffer(b"".join(content), np.uint8)
    columns = [
        Values(rr.ComponentDescriptor("scalars"), pa.array([json.dumps(told, allow_nan=False)]), [1]),
        Values(rr.ComponentDescriptor(ARRAYS), pa.array(joined), [len(joined)]),
    ]
    return static_chunk(DATA, columns)


def read_rows(chunk: Chunk) -> dict[str, Row]:
    """The rows of a chunk of ``data_chunk`` by name, or the one row of a chunk of an older format; arrays are
    read-only.

    Raises ``KeyError``, ``TypeError`` or ``ValueError`` if it is none.
    """
    batch = chunk.to_record_batch()
    columns = {name: batch.column(name) for name in batch.schema.names if pa.types.is_list(batch.column(name).type)}
    told = json.loads(columns.pop("scalars")[0].values[0].as_py(), object_hook=_number)
    if chunk.entity_path == DATA:
        return _unpacked(told, columns[ARRAYS])
    name = chunk.entity_path.removeprefix(f"{DATA}/")
    if ARRAYS not in told:
        return {name: told | {key: _numpy(column[0].values) for key, column in columns.items()}}
    return _unpacked({name: told}, columns[ARRAYS])


def _unpacked(told: dict[str, Any], arrays: pa.ListArray) -> dict[str, Row]:
    """Rows from what is told of them and the bytes of their arrays."""
    content = arrays[0].values.to_numpy(zero_copy_only=False)
    rows, at = {}, 0
    for name, part in told.items():
        row = rows[name] = dict(part["values"])
        for key, kind, shape in part[ARRAYS]:
            dtype, end = np.dtype(kind), at
            if dtype.kind not in "biuf" or any(size < 0 for size in shape):
                raise ValueError(f"{key} is not an array of numbers")
            end += dtype.itemsize * math.prod(shape)
            row[key], at = content[at:end].view(dtype).reshape(shape), end
            row[key].setflags(write=False)
    return rows


def _number(table: dict[str, Any]) -> Any:
    """A table of JSON, or the number that it stands for."""
    return float(table[NOT_FINITE]) if set(table) == {NOT_FINITE} else table


def _numpy(values: pa.Array) -> NDArray[Any]:
    """An array of format 1, whose axes but the first are fixed-size lists."""
    shape = [len(values)]
    while isinstance(values, pa.FixedSizeListArray):
        shape.append(values.type.list_size)
        values = values.flatten()
    array = values.to_numpy(zero_copy_only=False).reshape(shape)
    array.setflags(write=False)
    return array


TYPES = {
    "stage": pa.utf8(),
    "key": pa.utf8(),
    "agreeing": pa.int64(),
    "rotation_error_deg": pa.float64(),
    "translation_error_m": pa.float64(),
}


def numbers_chunk(numbers: Sequence[StepNumbers]) -> Chunk:
    """A row a step; what is unknown there is null."""
    columns = []
    for name, kind in TYPES.items():
        values = [getattr(row, name) for row in numbers]
        known = [k for k, value in enumerate(values) if value is not None]
        column = Values(rr.ComponentDescriptor(name), pa.array([values[k] for k in known], kind), [1] * len(known))
        columns.append(column.among(known, len(values)))
    return Chunk.from_columns(NUMBERS, [Times(np.array([row.step for row in numbers], np.int64))], columns)


STAGES = "stages/"
THUMBNAIL = f"/__properties/{THUMBNAIL_PROPERTY}"


def read_recording(path: Path) -> RecordedRun:
    """Read a recording that ``write_recording`` made.

    Raises ``RecordingError``, in one sentence, if there is no such file or it is not a whole recording of ours.
    """
    path = Path(path)
    with _sentences(path):
        entry, chunks = _load(path, [PROPERTIES, THUMBNAIL, f"{DATA}/**", QUERY_IMAGE])
        return _run(path, entry, chunks)


def read_run_row(path: Path) -> RunRow:
    """What a list of runs shows about a recording, with its labels and note if it has some. Reads little of the file.

    Raises ``RecordingError`` as ``read_recording`` does.
    """
    path = Path(path)
    with _sentences(path):
        entry, chunks = _load(path, [PROPERTIES, THUMBNAIL])
        row = _row(path, entry, chunks)
    with contextlib.suppress(RecordingError):  # without labels a run is still a run
        review = read_review(path)
        row = replace(row, labels=review.labels, note=review.note)
    return row


def check_recording(path: Path) -> None:
    """Raise ``RecordingError``, in one sentence, unless ``path`` is a whole recording of ours."""
    _open(Path(path))


@contextlib.contextmanager
def _sentences(path: Path) -> Iterator[None]:
    """Turn every error that a damaged file causes, in rerun or here, into one sentence."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RuntimeError, OSError) as error:
        reason = "a part of the run is missing or has a wrong form"
        raise RecordingError(f"{path}: {reason} ({show(str(error))}); record the run again.") from error
    except InputError as error:
        raise RecordingError(f"{path}: describes no problem that can be solved: {error}") from error


def _open(path: Path) -> tuple[StoreEntry, LazyStore]:
    check_recording_file(path)
    try:
        with warnings.catch_warnings():
            # rerun only warns where a file has no index at its end.
            warnings.simplefilter("error", RerunWarning)
            reader = RrdReader(path)
            entry = next((e for e in reader.recordings() if e.application_id == APPLICATION_ID), None)
            store = None if entry is None else reader.store(store=entry)
    except (OSError, ValueError, RuntimeError, RerunWarning) as error:
        raise RecordingError(f"{path}: not a whole recording (.rrd); give one that spherloc wrote.") from error
    if entry is None or store is None:
        raise RecordingError(f"{path}: a recording of another program; give one that spherloc wrote.")
    return entry, store


def _load(path: Path, content: list[str]) -> tuple[StoreEntry, dict[str, Chunk]]:
    """Some chunks of a recording by their entities, if it has a format that we know."""
    entry, store = _open(path)
    chunks = {chunk.entity_path: chunk for chunk in store.stream().filter(content=content).to_chunks()}
    version = read_properties(chunks[PROPERTIES].to_record_batch())["format_version"]
    if version not in range(OLDEST_VERSION, FORMAT_VERSION + 1):
        advice = f"this spherloc reads formats up to {FORMAT_VERSION}; install the one that wrote it"
        raise RecordingError(f"{path}: has format {version}, and {advice}.")
    return entry, chunks


def _row(path: Path, entry: StoreEntry, chunks: Mapping[str, Chunk]) -> RunRow:
    thumbnail = read_image(chunks[THUMBNAIL].to_record_batch()) if THUMBNAIL in chunks else b""
    return row_from_properties(
        read_properties(chunks[PROPERTIES].to_record_batch()),
        file=path.name,
        run_id=entry.recording_id,
        size_bytes=path.stat().st_size,
        thumbnail=thumbnail,
    )


def _run(path: Path, entry: StoreEntry, chunks: Mapping[str, Chunk]) -> RecordedRun:
    rows: dict[str, Row] = {}
    for name, chunk in chunks.items():
        if name == DATA or name.startswith(f"{DATA}/"):
            rows |= read_rows(chunk)
    run, told = rows["run"], rows.get("diagnosis")
    found = run.pop("certificate", None)
    origin, scene = origin_from_row(rows["origin"]) if "origin" in rows else (None, None)
    listed = _row(path, entry, chunks)
    return RecordedRun(
        row=listed,
        properties=read_properties(chunks[PROPERTIES].to_record_batch()),
        problem=problem_from_row(rows["problem"], str(path)),
        stages={name[len(STAGES) :]: row for name, row in rows.items() if name.startswith(STAGES)},
        certificate=None if found is None else certificate_from_row(found),
        origin=origin,
        scene_text=scene,
        diagnosis=None if told is None else diagnosis_from_row(told, listed),
        query_image=read_image(chunks[QUERY_IMAGE].to_record_batch()) if QUERY_IMAGE in chunks else None,
        **run,
    )
