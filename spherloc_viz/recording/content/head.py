"""The row of a recording from the start of its file, in a tenth of a millisecond: Rerun's own reader takes three.

A file of Rerun is a header of 12 bytes and messages, each with its kind and its length in 16 bytes before it. A message
of data is a protobuf whose payload is one chunk as an Arrow stream, packed by LZ4. Ours begin with the properties. What
is laid out otherwise, as files of other versions may be, is left to Rerun's reader: nothing is refused here.

Only what the file says of itself is read. Whether the rest of it is whole and fits is for the examination to find out.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa

from spherloc_viz.recording.content.names import (
    APPLICATION_ID,
    FORMAT_VERSION,
    OLDEST_VERSION,
    RUN_PROPERTY,
    THUMBNAIL_PROPERTY,
)
from spherloc_viz.recording.content.properties import read_image, read_properties, row_from_properties
from spherloc_viz.recording.run_row import RunRow

MAX_HEAD_BYTES = 1 << 16
"""Bytes that are read at a file's start: three times what its properties take."""
MAX_UNPACKED_BYTES = 1 << 20
"""Largest unpacked chunk; the properties take 20 kB."""
_START, _OPTIONS, _END = b"RRF2", bytes([1, 2, 0, 0]), b"RRF2FOOT"
"""First bytes of a file, its options (LZ4 and protobuf), and, before the last four bytes, the mark at its end."""
_DATA, _LZ4, _RECORDING = 2, 2, 1
"""Kinds of messages, of packing and of stores."""
_PROPERTIES = "/__properties"


class OtherError(Exception):
    """The file has another layout than the one that spherloc writes."""


def read_head(path: Path) -> RunRow | None:
    """The row at the start of a recording, without labels and note; None if Rerun's reader must read it.

    The file may be hostile: call it only in the sandbox. Raises ``OSError``.
    """
    try:
        found, run_id, size = properties_of(path)
        values = read_properties(found[RUN_PROPERTY])
        if values.get("format_version") not in range(OLDEST_VERSION, FORMAT_VERSION + 1):
            return None
        thumbnail = read_image(found[THUMBNAIL_PROPERTY]) if THUMBNAIL_PROPERTY in found else b""
        return row_from_properties(values, file=path.name, run_id=run_id, size_bytes=size, thumbnail=thumbnail)
    except (OtherError, LookupError, TypeError, ValueError, AttributeError):
        return None


def properties_of(path: Path) -> tuple[dict[str, pa.RecordBatch], str, int]:
    """The properties at the start of a file by their names, the recording's id, and the size of the file.

    Raises ``OtherError`` if Rerun's reader must be asked, ``OSError`` if the file cannot be read.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(MAX_HEAD_BYTES)
        file.seek(max(0, size - 12))
        end = file.read(12)
    if start[:4] != _START or start[8:12] != _OPTIONS or end[:8] != _END:
        raise OtherError
    try:
        return *_properties(memoryview(start)), size
    except (LookupError, TypeError, ValueError, AttributeError, struct.error, pa.ArrowException) as error:
        raise OtherError from error


def _properties(start: memoryview) -> tuple[dict[str, pa.RecordBatch], str]:
    """The properties by their names, and the recording's id."""
    found: dict[str, pa.RecordBatch] = {}
    run_id = ""
    for message in _messages(start):
        fields = _fields(message)
        store = _fields(fields[1])
        if store[1] != _RECORDING or bytes(_fields(store[3])[1]).decode() != APPLICATION_ID:
            raise OtherError
        batch, entity = _unpacked(fields)
        run_id = bytes(store[2]).decode()
        if not entity.startswith(f"{_PROPERTIES}/"):  # the last of the properties is of the recording itself
            break
        found[entity.removeprefix(f"{_PROPERTIES}/")] = batch
        if found.keys() >= {RUN_PROPERTY, THUMBNAIL_PROPERTY}:
            break
    return found, run_id


def _messages(start: memoryview) -> Iterator[memoryview]:
    """Messages of data that lie in the start of a file, one after another."""
    at = 12
    while True:
        kind, size = struct.unpack_from("<QQ", start, at)
        at += 16 + size
        if at > len(start):
            raise OtherError
        if kind == _DATA:
            yield start[at - size : at]


def _unpacked(fields: dict[int, Any]) -> tuple[pa.RecordBatch, str]:
    """The chunk of a message, and what it is of."""
    if fields[2] != _LZ4 or fields[3] > MAX_UNPACKED_BYTES:
        raise OtherError
    with pa.ipc.open_stream(pa.decompress(fields[5], fields[3], codec="lz4_raw")) as stream:
        batch = stream.read_next_batch()
    batch.validate(full=True)
    return batch, (batch.schema.metadata or {})[b"rerun:entity_path"].decode()


def _fields(message: Any) -> dict[int, Any]:
    """The fields of a protobuf by their numbers: integers, and the bytes of all else."""
    found: dict[int, Any] = {}
    at = 0
    while at < len(message):
        key, at = _integer(message, at)
        kind = key & 7
        if kind == 0:
            found[key >> 3], at = _integer(message, at)
            continue
        if kind == 2:
            size, at = _integer(message, at)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise OtherError
        if at + size > len(message):
            raise OtherError
        found[key >> 3] = message[at : at + size]
        at += size
    return found


def _integer(message: memoryview, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, the least first, and where it ends."""
    value = 0
    for shift in range(0, 64, 7):
        byte = message[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise OtherError
