"""Columns of components as arrow arrays, put together here since rerun's own batches take many times as long."""

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from spherloc_viz.recording.content.names import TIMELINE

MARKDOWN = "text/markdown"
"""Media type of texts."""

VECTOR_3D: pa.DataType = rr.components.Position3DBatch._ARROW_DATATYPE
VECTOR_2D: pa.DataType = rr.components.Position2DBatch._ARROW_DATATYPE
TRIANGLE: pa.DataType = rr.components.TriangleIndicesBatch._ARROW_DATATYPE
STRIP_3D: pa.DataType = rr.components.LineStrip3DBatch._ARROW_DATATYPE
STRIP_2D: pa.DataType = rr.components.LineStrip2DBatch._ARROW_DATATYPE
BLOB: pa.DataType = rr.components.BlobBatch._ARROW_DATATYPE


class Values(NamedTuple):
    """A component in R rows, one behind the other."""

    descriptor: rr.ComponentDescriptor
    values: pa.Array
    """Values of all rows, one after the other."""
    lengths: Sequence[int]
    """(R,) how many of them each row has."""

    def whole(self) -> "Column":
        """A column of these rows."""
        return Column(self.descriptor, _lists(self.lengths, self.values))

    def among(self, places: Sequence[int], count: int) -> "Column":
        """A column of ``count`` rows that has these rows at ``places`` and says nothing in the others."""
        every = [0] * count
        for place, length in zip(places, self.lengths, strict=True):
            every[place] = length
        return Column(self.descriptor, _lists(every, self.values, places))


class Column(rr.ComponentColumn):
    """What ``Chunk.from_columns`` takes; null where a row says nothing about the component."""

    def __init__(self, descriptor: rr.ComponentDescriptor, rows: pa.ListArray) -> None:
        """Takes rows as they are, where its base would put them together anew."""
        self.descriptor, self.rows = descriptor, rows

    def component_descriptor(self) -> rr.ComponentDescriptor:
        """What the column holds."""
        return self.descriptor

    def as_arrow_array(self) -> pa.Array:
        """Its rows."""
        return self.rows


@dataclass(frozen=True, eq=False)
class Times:
    """When the rows of a chunk are, which ``Chunk.from_columns`` takes too."""

    steps: NDArray[np.int64]
    """(R,) indices of steps."""

    def timeline_name(self) -> str:
        """Their timeline."""
        return TIMELINE

    def as_arrow_array(self) -> pa.Int64Array:
        """The numbers of the steps."""
        return pa.array(self.steps + 1)


def _lists(lengths: Sequence[int], values: pa.Array, present: Sequence[int] | None = None) -> pa.ListArray:
    """Lists of these lengths (R,); those that are not among the ``present`` are null."""
    # A run has some two hundred columns of a few rows each, for which numpy would take most of the time.
    offsets = pa.py_buffer(array("i", accumulate(lengths, initial=0)))
    bits = None
    if present is not None:
        bits = pa.py_buffer(sum(1 << place for place in present).to_bytes(len(lengths) // 8 + 1, "little"))
    return pa.Array.from_buffers(pa.list_(values.type), len(lengths), [bits, offsets], -1, 0, [values])


def vectors(rows: NDArray[Any], kind: pa.DataType) -> pa.Array:
    """(N, 2) or (N, 3) numbers as vectors of a type such as ``VECTOR_3D``."""
    dtype = kind.value_type.to_pandas_dtype()
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(rows, dtype).ravel()), type=kind)


def strips(outlines: Sequence[NDArray[Any]], kind: pa.DataType) -> pa.Array:
    """Lines of (K, 2) or (K, 3) points, each of its own length, as strips."""
    ends = list(accumulate(map(len, outlines), initial=0))
    return pa.ListArray.from_arrays(
        pa.array(ends, pa.int32()), vectors(np.concatenate(outlines), kind.value_type), type=kind
    )


def segments(ends: NDArray[Any], kind: pa.DataType) -> pa.Array:
    """Lines from one point to another, (L, 2, 2) or (L, 2, 3), as strips."""
    places = pa.array(np.arange(0, 2 * len(ends) + 1, 2, dtype=np.int32))
    return pa.ListArray.from_arrays(places, vectors(ends.reshape(-1, ends.shape[-1]), kind.value_type), type=kind)


def numbers(values: Any, dtype: type = np.float32) -> pa.Array:
    """Numbers (N,)."""
    return pa.array(np.asarray(values, dtype))


def packed(colors: NDArray[Any], opacity: float = 1.0) -> NDArray[np.uint32]:
    """sRGB bytes (N, 3) as rerun's colours (N,)."""
    rgba = np.empty((len(colors), 4), np.uint8)
    rgba[:, :3], rgba[:, 3] = colors, round(255 * opacity)
    return rgba.view(">u4").ravel().astype(np.uint32)


def static_chunk(entity: str, columns: Iterable[Values]) -> Chunk:
    """A chunk that holds at every step; every column has one row."""
    return Chunk.from_columns(entity, [], [column.whole() for column in columns])


def markdown(texts: Sequence[str]) -> list[Values]:
    """The components of text documents in Markdown, one text a row."""
    one = [1] * len(texts)
    media = pa.array([MARKDOWN] * len(texts))
    return [
        Values(rr.TextDocument.descriptor_text(), pa.array(texts, pa.utf8()), one),
        Values(rr.TextDocument.descriptor_media_type(), media, one),
    ]


def encoded_image(content: bytes, media_type: str) -> list[Values]:
    """The components of an image file."""
    bytes_ = pa.array(np.frombuffer(content, np.uint8))
    blob = pa.ListArray.from_arrays(pa.array([0, len(content)], pa.int32()), bytes_, type=BLOB)
    return [
        Values(rr.EncodedImage.descriptor_blob(), blob, [1]),
        Values(rr.EncodedImage.descriptor_media_type(), pa.array([media_type]), [1]),
    ]
