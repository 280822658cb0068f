"""Curves as the only chart with an x axis that rerun has: bars."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from spherloc_viz.layers.primitives import Chart, Curve

FloatArray = NDArray[np.float64]

MARKER_SHARE = 0.003
"""Width of a marker's bar, as a share of the chart."""
LEVEL_OPACITY = 0.25
"""Of the bar that stands for a level, so that what it is held against shows through."""
LINE_SHARE = 0.8
"""Width of the bar of a line's sample, as a share of the least distance between samples."""


@dataclass(frozen=True, eq=False)
class Bars:
    """A curve as K bars."""

    left: NDArray[np.float64]
    """(K,) left edges."""
    heights: NDArray[np.float64]
    """(K,)."""
    widths: NDArray[np.float64]
    """(K,)."""
    color: tuple[int, int, int]
    opacity: float = 1.0


def bars(chart: Chart, curve: Curve) -> Bars:
    """A step curve is exactly its bars; a line becomes bars around its samples, a marker one narrow bar, and a level
    one translucent bar up to it."""
    x = np.asarray(curve.x, dtype=np.float64)
    if curve.kind == "level":
        return Bars(x[:1], curve.y[:1], x[-1:] - x[:1], curve.color, LEVEL_OPACITY)
    if curve.kind == "step":
        return Bars(x, curve.y, np.diff(x, append=x[-1:]), curve.color)
    if curve.kind == "marker":
        every_x = np.concatenate([other.x for other in chart.curves])
        width = MARKER_SHARE * max(float(np.ptp(every_x)), 1.0)
    else:
        width = LINE_SHARE * (float(np.diff(x).min()) if len(x) > 1 else 1.0)
    return Bars(x - width / 2, curve.y, np.full(len(x), width), curve.color)


@cache
def _one_tensor(short: bool) -> pa.StructArray:
    """A tensor as rerun writes it, with numbers of 32 or of 64 bits."""
    return rr.components.TensorDataBatch(np.zeros(1, np.float32 if short else np.float64)).as_arrow_array()


def tensors(arrays: list[FloatArray]) -> pa.StructArray:
    """One-dimensional arrays as tensors, with 32 bits where these hold all numbers exactly, as they do counts.

    Put together here, since rerun takes 0.3 ms for each.
    """
    values = np.concatenate([np.zeros(0), *arrays])
    short = values.astype(np.float32)
    exact = np.array_equal(short, values)
    values, one = short if exact else values, _one_tensor(exact)
    buffer: pa.UnionArray = one.field("buffer")
    ends = np.cumsum([0, *map(len, arrays)], dtype=np.int32)
    code, count = buffer.type_codes[0].as_py(), len(arrays)
    every = pa.array(np.arange(count + 1, dtype=np.int32))
    numbers = pa.ListArray.from_arrays(pa.array(ends), pa.array(values), type=buffer.type.field(code).type)
    children = [buffer.field(k) for k in range(buffer.type.num_fields)]
    children[code] = numbers
    codes = pa.py_buffer(np.full(count, code, dtype=np.int8))
    places = pa.py_buffer(np.arange(count, dtype=np.int32))
    # From buffers, since from arrays the union would forget that its numbers are never null.
    union = pa.Array.from_buffers(buffer.type, count, [None, codes, places], children=children)
    lengths = pa.array(np.diff(ends).astype(np.uint64))
    shape = pa.ListArray.from_arrays(every, lengths, type=one.type.field("shape").type)
    labels = pa.nulls(count, one.type.field("names").type)
    return pa.StructArray.from_arrays([shape, labels, union], fields=list(one.type))
