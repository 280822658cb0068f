"""Recordings that lie: the frames of an ``.rrd`` file taken apart, changed, and sealed again so that checksums fit.

A file is a header of 12 bytes, frames (16 bytes of kind and length, then a protobuf message), a frame with the index of
all chunks, and a foot of 32 bytes: where the index is, how long, and its checksum.
"""

import json
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import Chunk, LazyChunkStream, RrdReader

from spherloc_viz.recording.content.names import APPLICATION_ID

FOOT_BYTES = 32
ALONE = "in a chunk of its own"
"""Key of a row that is."""
LZ4 = pa.Codec("lz4_raw")

DATA = "/data"

Change = Callable[[dict[str, Any]], Mapping[str, Any] | None]
"""Of the columns of a chunk, or of a row of the chunk of data; None drops it."""


def changed(good: Path, path: Path, changes: Mapping[str, Change], *more: Chunk) -> Path:
    """Write the recording ``good`` to ``path`` with some of its chunks changed, named by their entities, or with rows
    of its data, as "/data/run". A row may be put into a chunk of its own, as older formats have it: ``alone``."""
    reader = RrdReader(good)
    (entry,) = reader.recordings()
    chunks = []
    for chunk in reader.stream(store=entry):
        change = changes.get(chunk.entity_path)
        if chunk.entity_path == DATA and any(name.startswith(f"{DATA}/") for name in changes):
            chunks += _changed_data(chunk, changes)
        else:
            chunks += [chunk] if change is None else list(_changed_chunk(chunk, change))
    stream = LazyChunkStream.from_iter([*chunks, *more])
    stream.write_rrd(path, application_id=APPLICATION_ID, recording_id=entry.recording_id)
    return path


def _changed_chunk(chunk: Chunk, change: Change) -> Iterator[Chunk]:
    batch = chunk.to_record_batch()
    lists = [name for name in batch.schema.names if pa.types.is_list(batch.column(name).type)]
    columns = change({name: batch.column(name) for name in lists})
    if columns is not None:
        rows = pa.RecordBatch.from_pydict(columns)
        yield from Chunk.from_record_batch(rows, index=None, entity_path=chunk.entity_path)


def _changed_data(chunk: Chunk, changes: Mapping[str, Change]) -> Iterator[Chunk]:
    """The rows of the data one behind the other, in one chunk but for those that stand alone."""
    batch = chunk.to_record_batch()
    told, content, at = json.loads(batch.column("scalars")[0].values[0].as_py()), _content(batch), 0
    texts, arrays = [], []
    for name, part in told.items():
        size = sum(np.dtype(kind).itemsize * math.prod(shape) for _, kind, shape in part["arrays"])
        row: Mapping[str, Any] | None = {
            "scalars": pa.array([[json.dumps(part)]]),
            "arrays": listed(content[at : at + size]),
        }
        at += size
        change = changes.get(f"{DATA}/{name}")
        row = row if change is None else change(dict(row))
        if row is not None and row.get(ALONE):
            columns = pa.RecordBatch.from_pydict({key: value for key, value in row.items() if key != ALONE})
            yield from Chunk.from_record_batch(columns, index=None, entity_path=f"{DATA}/{name}")
        elif row is not None:
            texts.append(f"{json.dumps(name)}: {row['scalars'][0].values[0].as_py()}")
            arrays.append(_content(row) if "arrays" in row else np.zeros(0, np.uint8))
    if texts:
        scalars = pa.array([["{" + ", ".join(texts) + "}"]])
        columns = pa.RecordBatch.from_pydict({"scalars": scalars, "arrays": listed(np.concatenate(arrays))})
        yield from Chunk.from_record_batch(columns, index=None, entity_path=DATA)


def _content(columns: Any) -> np.ndarray:
    return columns["arrays"][0].values.to_numpy(zero_copy_only=False)


def alone(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """The row in a chunk of its own, as format 2 has it."""
    return {**row, ALONE: True}


def unpacked(columns: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The values and the arrays of a row of ``/data``."""
    told = json.loads(columns["scalars"][0].values[0].as_py())
    content, at = _content(columns), 0
    arrays: dict[str, np.ndarray] = {}
    for name, kind, shape in told["arrays"]:
        size = np.dtype(kind).itemsize * math.prod(shape)
        arrays[name], at = content[at : at + size].view(kind).reshape(shape), at + size
    return told["values"], arrays


def packed(values: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The row of values and arrays, in the format of today."""
    forms = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    content = np.frombuffer(b"".join(array.tobytes() for array in arrays.values()), np.uint8)
    return {"scalars": pa.array([[json.dumps({"arrays": forms, "values": values})]]), "arrays": listed(content)}


def packed_as_format_1(values: Mapping[str, Any], columns: Mapping[str, Any]) -> dict[str, Any]:
    """The row of values and of an arrow column for each array, in the oldest format, which can still be read."""
    row = {name: listed(array) for name, array in columns.items()} | {"scalars": pa.array([[json.dumps(values)]])}
    return dict(alone(row))


def listed(array: Any) -> pa.Array:
    """One row that holds ``array`` (M,) or (M, K), as recordings have it."""
    values = array if isinstance(array, pa.Array) else pa.array(array.ravel())
    if not isinstance(array, pa.Array):
        for size in reversed(array.shape[1:]):
            values = pa.FixedSizeListArray.from_arrays(values, size)
    return pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)


def places(path: Path) -> dict[str, tuple[int, int]]:
    """Offset and length of the message of every chunk of the recording, by its entity."""
    reader = RrdReader(path)
    (entry,) = reader.recordings()
    _, batch = reader.store(store=entry)._internal._chunk_index()
    names = ("chunk_entity_path", "chunk_byte_offset", "chunk_byte_size")
    rows = zip(*(pa.record_batch(batch).column(name).to_pylist() for name in names), strict=True)
    return {entity: (offset, size) for entity, offset, size in rows}


def with_message(good: Path, entity: str, change: Callable[[bytes], bytes]) -> bytes:
    """The file with the message of a chunk changed: the new one is put before the index, which then points to it."""
    content = good.read_bytes()
    offset, size = places(good)[entity]
    new = change(content[offset : offset + size])
    head, index = _parts(content)
    # The length of a message can equal a number of another column, so all of them are changed.
    pairs = (_u64(offset), _u64(len(head) + 16)), (_u64(size), _u64(len(new)))
    return sealed(head + _u64(2) + _u64(len(new)) + new, _index_with(index, pairs))


def with_index(good: Path, *pairs: tuple[bytes, bytes]) -> bytes:
    """The file with bytes of its index replaced, and a checksum that fits."""
    head, index = _parts(good.read_bytes())
    return sealed(head, _index_with(index, pairs))


def _u64(number: int) -> bytes:
    return struct.pack("<Q", number)


def _parts(content: bytes) -> tuple[bytes, bytes]:
    """The frames before the index, and the index."""
    index_at, length, _ = struct.unpack("<QQI", content[-FOOT_BYTES : -FOOT_BYTES + 20])
    return content[: index_at - 16], content[index_at : index_at + length]


def _index_with(index: bytes, pairs: Iterable[tuple[bytes, bytes]]) -> bytes:
    """An index holds a manifest for every store, with a table (field 4), packed (2) from a number of bytes (4)."""
    manifests = []
    for number, manifest in proto_fields(index):
        fields = list(proto_fields(manifest))
        packed = dict(proto_fields(dict(fields)[4]))
        table = LZ4.decompress(packed[2], packed[4], asbytes=True)
        for old, new in pairs:
            table = table.replace(old, new)
        packed |= {2: LZ4.compress(table, asbytes=True), 4: len(table)}
        body = b"".join(proto_field(*item) for item in packed.items())
        manifests.append(proto_field(number, b"".join(proto_field(n, body if n == 4 else v) for n, v in fields)))
    return b"".join(manifests)


def sealed(head: bytes, index: bytes) -> bytes:
    """Frames, index and foot as a file."""
    foot = struct.pack("<QQI", len(head) + 16, len(index), xxh32(index))
    return head + struct.pack("<QQ", 0, len(index)) + index + foot + b"RRF2FOOT" + struct.pack("<I", 1)


def message(content: bytes, claim: int | None = None, change: Callable[[bytes], bytes] | None = None) -> bytes:
    """A chunk's message with another claim of its size when unpacked, or with its arrow bytes changed."""
    fields = list(proto_fields(content))
    told, packed = next(v for n, v in fields if n == 3), next(v for n, v in fields if n == 5)
    if change is not None:
        arrow = change(LZ4.decompress(packed, told, asbytes=True))
        told, packed = len(arrow), LZ4.compress(arrow, asbytes=True)
    made = {3: told if claim is None else claim, 5: packed}
    return b"".join(proto_field(number, made.get(number, value)) for number, value in fields)


def proto_fields(content: bytes) -> Iterator[tuple[int, Any]]:
    """Number and value, an integer or bytes, of each field of a protobuf message."""
    at = 0
    while at < len(content):
        key, at = _varint(content, at)
        value, at = _varint(content, at)
        if key & 7 == 2:
            value, at = content[at : at + value], at + value
        yield key >> 3, value


def proto_field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, bytes):
        return _packed_varint(number << 3 | 2) + _packed_varint(len(value)) + value
    return _packed_varint(number << 3) + _packed_varint(value)


def _varint(content: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (content[at] & 127) << shift
        at, shift = at + 1, shift + 7
        if content[at - 1] < 128:
            return value, at


def _packed_varint(value: int) -> bytes:
    packed = bytearray()
    while value > 127:
        packed.append(value & 127 | 128)
        value >>= 7
    return bytes([*packed, value])


def xxh32(content: bytes, seed: int = 7_850_921) -> int:
    """The checksum of an index (XXH32 with rerun's seed)."""
    mask, one, two, three, four, five = 0xFFFFFFFF, 2654435761, 2246822519, 3266489917, 668265263, 374761393
    lanes = [(seed + one + two) & mask, (seed + two) & mask, seed, (seed - one) & mask]
    stripes = len(content) // 16
    for words in struct.iter_unpack("<4I", content[: 16 * stripes]):
        lanes = [_turn((lane + word * two) & mask, 13) * one & mask for lane, word in zip(lanes, words, strict=True)]
    digest = sum(_turn(lane, by) for lane, by in zip(lanes, (1, 7, 12, 18), strict=True)) + len(content) & mask
    rest = content[16 * stripes :]
    for (word,) in struct.iter_unpack("<I", rest[: len(rest) // 4 * 4]):
        digest = _turn((digest + word * three) & mask, 17) * four & mask
    for byte in rest[len(rest) // 4 * 4 :]:
        digest = _turn((digest + byte * five) & mask, 11) * one & mask
    digest = (digest ^ digest >> 15) * two & mask
    digest = (digest ^ digest >> 13) * three & mask
    return digest ^ digest >> 16


def _turn(word: int, by: int) -> int:
    return (word << by | word >> 32 - by) & 0xFFFFFFFF
