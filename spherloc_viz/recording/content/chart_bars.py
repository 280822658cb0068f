"""Curves as the only chart with an x axis that rerun has: bars."""

from array import array
from dataclasses import dataclass
from functools import cache
from itertools import accumulate

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from spherloc.types import FloatArray
from spherloc_viz.layers.primitives import Chart, Curve

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


@dataclass(frozen=True, eq=False)
class _Form:
    """How rerun writes a tensor with numbers of one type: a structure whose numbers are one choice of a union."""

    whole: pa.StructType
    shape: pa.ListType
    names: pa.ListType
    union: pa.DenseUnionType
    numbers: pa.ListType
    code: int
    choices: list[pa.Array]
    """The union's, empty but for the one in use, which has a tensor in it."""


@cache
def _form(short: bool) -> _Form:
    """With numbers of 32 or of 64 bits."""
    one = rr.components.TensorDataBatch(np.zeros(1, np.float32 if short else np.float64)).as_arrow_array()
    fields, union = {field.name: field.type for field in one.type}, one.field("buffer")
    code = union.type_codes[0].as_py()
    choices = [union.field(k) for k in range(union.type.num_fields)]
    return _Form(one.type, fields["shape"], fields["names"], union.type, choices[code].type, code, choices)


def tensors(arrays: list[FloatArray]) -> pa.StructArray:
    """One-dimensional arrays as tensors, with 32 bits where these hold all numbers exactly, as they do counts.

    Put together here, since rerun takes 0.3 ms for each.
    """
    values = arrays[0] if len(arrays) == 1 else np.concatenate([np.zeros(0), *arrays])
    short = values.astype(np.float32)
    exact = bool((short == values).all())
    form, count, lengths = _form(exact), len(arrays), [len(array) for array in arrays]
    ends = pa.array(list(accumulate(lengths, initial=0)), pa.int32())
    choices = list(form.choices)
    choices[form.code] = pa.ListArray.from_arrays(ends, pa.array(short if exact else values), type=form.numbers)
    # From buffers, since from arrays the union would forget that its numbers are never null.
    codes, places = bytes([form.code]) * count, array("i", range(count))
    parts = [None, pa.py_buffer(codes), pa.py_buffer(places)]
    union = pa.Array.from_buffers(form.union, count, parts, children=choices)
    each = pa.array(range(count + 1), pa.int32())
    shape = pa.ListArray.from_arrays(each, pa.array(lengths, pa.uint64()), type=form.shape)
    children = [shape, pa.nulls(count, form.names), union]
    return pa.Array.from_buffers(form.whole, count, [None], 0, 0, children)
