"""A review as a file of Rerun: a property that queries see, and a text for people."""

import contextlib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream, RrdReader
from rerun.error_utils import RerunWarning

from spherloc.errors import RecordingError
from spherloc_viz.recording.content.markdown import plain
from spherloc_viz.recording.content.properties import APPLICATION_ID, REVIEW_ENTITY, REVIEW_PROPERTY


def write_file(path: Path, labels: Sequence[str], note: str, run_id: str) -> None:
    """Write labels and note as a layer of the recording with this id. Raises ``OSError`` and what rerun raises."""
    values: dict[str, Any] = {"labels": pa.array(labels, pa.string()), "note": pa.array([note], pa.string())}
    lines = [" ".join(f"**{plain(label)}**" for label in labels), *map(plain, note.splitlines())]
    document = rr.TextDocument.columns(text=["\n\n".join(lines).strip()], media_type=[rr.MediaType.MARKDOWN])
    chunks = [
        Chunk.from_property(REVIEW_PROPERTY, rr.AnyValues(**values)),
        Chunk.from_columns(REVIEW_ENTITY, [], document),
    ]
    LazyChunkStream.from_iter(chunks).write_rrd(path, application_id=APPLICATION_ID, recording_id=run_id)


def read_file(path: Path, most_labels: int) -> tuple[list[str], str]:
    """Labels and note of a file. Raises ``TypeError``, ``ValueError`` and what rerun raises if it is damaged."""
    found = _reader(path).stream().filter(content=[f"/__properties/{REVIEW_PROPERTY}"]).to_chunks()
    (batch,) = (chunk.to_record_batch() for chunk in found)
    batch.validate(full=True)
    (note,) = _texts(batch.column("note"), 1)
    return _texts(batch.column("labels"), most_labels), note


def _texts(column: pa.Array, most: int) -> list[str]:
    """The only cell of a column of lists of texts; looked at before it becomes Python's, which could take gigabytes."""
    if len(column) != 1 or column.type != pa.list_(pa.string()) or len(column[0].values or ()) > most:
        raise TypeError("not one list of texts")
    return [value for value in column[0].as_py() if value is not None]


def recording_id(recording: Path) -> str:
    """The recording's id. Raises ``RecordingError`` if it is none of ours."""
    if not recording.is_file():
        raise RecordingError(f"{recording}: no such file; give the path of a recording (.rrd).")
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        for entry in _reader(recording).recordings():
            if entry.application_id == APPLICATION_ID:
                return entry.recording_id
    raise RecordingError(f"{recording}: not a whole recording (.rrd); give one that spherloc wrote.")


def _reader(path: Path) -> RrdReader:
    """Raises ``ValueError`` for a file without its end, of which rerun only warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RerunWarning)
        try:
            return RrdReader(path)
        except RerunWarning as warning:
            raise ValueError(str(warning)) from warning
