"""Numbers of every step, for questions over many runs: an entity of plain columns on the timeline of steps."""

from collections.abc import Sequence

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from spherloc_viz.layers.step_numbers import StepNumbers
from spherloc_viz.recording.content.columns import Times, Values

NUMBERS = "/numbers"
"""Its columns are the fields of ``StepNumbers``."""
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
    return Chunk.from_columns(NUMBERS, [Times(pa.array([row.step for row in numbers], pa.int64()))], columns)
