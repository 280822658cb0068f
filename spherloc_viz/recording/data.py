"""The numbers behind the pictures: the trace as raw arrow rows under ``/data``, and back, bit for bit.

A row has one column an array, typed by its dtype and shape, and a column ``scalars`` with all the rest as JSON, in
which a number that JSON has no word for is ``{"number": "inf"}`` (or "-inf", "nan").
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rerun.chunk import Chunk

from spherloc.cameras.calibration import camera_from_table
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import Cause, Diagnosis
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz.options import plain
from spherloc_viz.recording.origin import Origin

MAX_ARRAY_BYTES = 65_536
"""Stage arrays above this are left out of a lean recording: they follow from the problem, the options and the seed."""
MAX_SCENE_BYTES = 65_536
"""The text of a larger scene file is not recorded."""

NOT_FINITE = "number"
"""Key of the table that stands for infinity or NaN."""

Row = dict[str, Any]


def data_chunks(trace: Trace, origin: Origin, diagnosis: Diagnosis, full: bool) -> Iterator[Chunk]:
    """Static chunks with the problem, the result, where it came from, what is wrong with it, and every stage.

    Of a stage it is the small arrays or, with ``full``, all of them.
    """
    yield _chunk("/data/problem", _problem_row(trace.problem))
    yield _chunk("/data/run", _run_row(trace))
    yield _chunk("/data/origin", asdict(origin) | {"scene_text": scene_text(origin.scene_path)})
    yield _chunk("/data/diagnosis", {item.name: getattr(diagnosis, item.name) for item in fields(diagnosis)})
    for stage in trace.stages:
        row = {item.name: getattr(stage, item.name) for item in fields(stage)}
        kept = {name: value for name, value in row.items() if full or getattr(value, "nbytes", 0) <= MAX_ARRAY_BYTES}
        yield _chunk(f"/data/stages/{stage.kind}", kept)


def scene_text(path: str | None) -> str | None:
    """The text of a scene file; None if it is no TOML of moderate size, or cannot be read."""
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
        "versions": dict(trace.versions),
        "timings_ms": dict(trace.timings_ms),
        "cam_from_map": trace.cam_from_map,
        "inlier_mask": trace.inlier_mask,
        "message": trace.message,
        "certificate": None if trace.certificate is None else asdict(trace.certificate),
    }


def problem_from_row(row: Row, where: str) -> Problem:
    """The recorded problem, bit for bit.

    Raises ``SpherlocError`` if the row describes none, and ``KeyError`` or ``TypeError`` if it is no problem's row.
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


def diagnosis_from_row(row: Row) -> Diagnosis:
    """What was wrong with the run.

    Raises ``KeyError``, ``TypeError`` or ``ValueError`` if the row says no such thing.
    """
    rival = row.pop("rival_cam_from_map", None)
    cause, evidence = Cause(row.pop("cause")), tuple(row.pop("evidence"))
    return Diagnosis(cause=cause, evidence=evidence, rival_cam_from_map=rival, **row)


def _chunk(path: str, row: Row) -> Chunk:
    arrays = {name: value for name, value in row.items() if isinstance(value, np.ndarray)}
    others = {name: value for name, value in row.items() if name not in arrays}
    scalars = json.dumps(plain(others, lambda number: {NOT_FINITE: str(number)}), allow_nan=False)
    columns = {name: _arrow(value) for name, value in arrays.items()} | {"scalars": pa.array([[scalars]])}
    return Chunk.from_record_batch(pa.RecordBatch.from_pydict(columns), index=None, entity_path=path)[0]


def _number(table: dict[str, Any]) -> Any:
    """A table of JSON, or the number that it stands for."""
    return float(table[NOT_FINITE]) if set(table) == {NOT_FINITE} else table


def _arrow(array: NDArray[Any]) -> pa.Array:
    """One row that holds ``array``; all axes but the first become fixed-size lists, which keeps the shape."""
    values = pa.array(array.ravel())
    for size in reversed(array.shape[1:]):
        values = pa.FixedSizeListArray.from_arrays(values, size)
    return pa.ListArray.from_arrays(pa.array([0, len(array)], pa.int32()), values)


def read_row(chunk: Chunk) -> Row:
    """Arrays and scalars of a chunk that ``data_chunks`` made; the arrays are read-only."""
    batch = chunk.to_record_batch()
    columns = {name: batch.column(name) for name in batch.schema.names if pa.types.is_list(batch.column(name).type)}
    row: Row = json.loads(columns.pop("scalars")[0].values[0].as_py(), object_hook=_number)
    return row | {name: _numpy(column[0].values) for name, column in columns.items()}


def _numpy(values: pa.Array) -> NDArray[Any]:
    shape = [len(values)]
    while isinstance(values, pa.FixedSizeListArray):
        shape.append(values.type.list_size)
        values = values.flatten()
    array = values.to_numpy(zero_copy_only=False).reshape(shape)
    array.setflags(write=False)
    return array
