"""The properties of a recording, which say of a run what lists show, and back."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import fields
from datetime import datetime
from typing import Any, cast, get_args, get_type_hints

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from spherloc.trace import Trace
from spherloc_viz.recording.content.columns import Values, encoded_image, static_chunk
from spherloc_viz.recording.content.names import RUN_PROPERTY, THUMBNAIL_PROPERTY
from spherloc_viz.recording.content.texts import legible
from spherloc_viz.recording.run_row import STORED_AS, RunRow
from spherloc_viz.recording.run_summary import cut

NOT_RECORDED = {"file", "run_id", "labels", "note", "size_bytes", "thumbnail"}
"""Fields of a row that are not part of the property ``run``: they belong to the file or the review, or are a
picture."""

_KINDS: dict[type, pa.DataType] = {str: pa.utf8(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
RUN_TYPES: dict[str, pa.DataType] = {
    STORED_AS.get(name, name): _KINDS[(get_args(hint) or (hint,))[0]]
    for name, hint in get_type_hints(RunRow).items()
    if name not in NOT_RECORDED
} | {"upper_bound": pa.int64(), "lower_bound": pa.int64(), "chance_sets": pa.float64(), "versions": pa.utf8()}
"""Columns of the property ``run`` and their types; the last four are the certificate's and JSON."""


def property_chunks(trace: Trace, row: RunRow, created: datetime) -> Iterator[Chunk]:
    """The properties ``run`` and ``thumbnail``, and the name and time that the Rerun viewer shows for the recording.

    Unknown values are absent, so that a query finds nulls. In ``options``, which is JSON, infinity is the text "inf".
    """
    kept = [item.name for item in fields(row) if item.name not in NOT_RECORDED]
    values = {STORED_AS.get(name, name): getattr(row, name) for name in kept}
    certificate = trace.certificate
    if certificate is not None:
        values["upper_bound"] = certificate.upper_bound
        values["lower_bound"] = certificate.lower_bound
        values["chance_sets"] = certificate.nfa
    values["versions"] = json.dumps(dict(trace.versions))
    yield static_chunk(f"/__properties/{RUN_PROPERTY}", _named(values))
    if row.thumbnail:
        yield static_chunk(f"/__properties/{THUMBNAIL_PROPERTY}", encoded_image(row.thumbnail, "image/png"))
    name = legible(" ".join(f"{row.name}, {trace.estimator}, seed {trace.seed}".split()))
    info = rr.archetypes.RecordingInfo
    start_ns = pa.array([int(created.timestamp() * 1e9)], pa.int64())
    columns = [Values(info.descriptor_name(), pa.array([name]), [1])]
    yield static_chunk("/__properties", [*columns, Values(info.descriptor_start_time(), start_ns, [1])])


def _named(values: Mapping[str, Any]) -> list[Values]:
    """Numbers and texts by name, as one row; what is None is left out."""
    return [
        Values(rr.ComponentDescriptor(name), pa.array([value], RUN_TYPES[name]), [1])
        for name, value in values.items()
        if value is not None
    ]


def read_properties(batch: pa.RecordBatch) -> dict[str, Any]:
    """The values of a chunk of ``property_chunks`` by name."""
    # Whole columns as Python's lists: three times as fast as a scalar of Arrow for each.
    cells = zip(batch.schema.names, (column.to_pylist()[0] for column in batch.columns), strict=True)
    return {name: cell[0] for name, cell in cells if isinstance(cell, list) and cell}


def read_image(batch: pa.RecordBatch) -> bytes:
    """The file in a chunk with an encoded image."""
    column = batch.column("EncodedImage:blob")
    return column[0].values[0].values.to_numpy(zero_copy_only=False).tobytes()


_EMPTY: Mapping[type, Any] = {str: "", int: 0, float: 0.0}
_FIELDS = tuple(
    (item.name, STORED_AS.get(item.name, item.name), get_args(item.type) or (cast(type, item.type),))
    for item in fields(RunRow)
    if item.name not in NOT_RECORDED
)
"""Fields of a row that are recorded: their names, those by which they are recorded, and their types."""


def row_from_properties(values: Mapping[str, Any], **known: Any) -> RunRow:
    """The row that a recording's properties say; what older ones lack is unknown.

    Raises ``TypeError`` for a value of a wrong type.
    """
    row: dict[str, Any] = dict(known)
    values = {"source": "unknown", **values}
    for name, stored_as, kinds in _FIELDS:
        if name in known:
            continue
        value = values.get(stored_as)
        if value is None:
            row[name] = None if type(None) in kinds else _EMPTY[kinds[0]]
        elif isinstance(value, kinds) or (float in kinds and isinstance(value, int)):
            row[name] = cut(value) if isinstance(value, str) else value
        else:
            raise TypeError(f"{name} is of type {type(value).__name__}")
    return RunRow(**row)
