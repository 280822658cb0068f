"""The review of a run as a file of Rerun beside its recording: a property that queries see, and a text for people."""

import contextlib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream, RrdReader
from rerun.error_utils import RerunWarning

from spherloc.errors import InputError, RecordingError
from spherloc_viz.given_files import check_recording_file
from spherloc_viz.recording.content.head import OtherError, properties_of
from spherloc_viz.recording.content.names import APPLICATION_ID, REVIEW_ENTITY, REVIEW_PROPERTY
from spherloc_viz.recording.content.texts import plain
from spherloc_viz.recording.reviews import MAX_LABELS, UNREADABLE, Review, checked_review, file_stamp, review_path
from spherloc_viz.recording.storage.unfinished import unfinished

MAX_BYTES = 1 << 20
"""Largest review file; it has 6 kB and the text."""


def write_review(recording: Path, labels: Sequence[str], note: str, run_id: str | None = None) -> Review:
    """Store labels and a note beside a recording, in place of those before, and return them as they are stored.

    Without any, the file is removed. ``run_id`` is that of the recording, which is read if it is not given. A reader
    never sees half a file. Raises ``InputError`` if they are too long, ``RecordingError`` if they cannot be written.
    """
    review = checked_review(labels, note)
    path = review_path(Path(recording))
    part = unfinished(path)
    try:
        if review == Review():
            path.unlink(missing_ok=True)
            return review
        write_file(part, review.labels, review.note, run_id or recording_id(Path(recording)))
        part.replace(path)
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(
            f"{path}: labels and note cannot be stored ({reason}); make room or check the folder."
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return review


def read_review(recording: Path) -> Review:
    """Labels and note of a recording; empty if it has none.

    A file that another process replaces or removes meanwhile is read again. Raises ``RecordingError``, in one
    sentence, if the file that has them is damaged.
    """
    path = review_path(Path(recording))
    while before := file_stamp(path):
        try:
            if not path.is_file() or path.stat().st_size > MAX_BYTES:
                raise ValueError("not a file of labels")
            return checked_review(*read_file(path, MAX_LABELS))
        except (OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, InputError) as error:
            if file_stamp(path) == before:
                raise RecordingError(f"{path}: {UNREADABLE}") from error
    return Review()


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
    try:
        batch = properties_of(path)[0][REVIEW_PROPERTY]
    except (OtherError, KeyError):
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
    check_recording_file(recording)
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
