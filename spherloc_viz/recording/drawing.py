"""Neutral primitives as rerun chunks: one chunk per primitive, one row per step at which it changes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from spherloc_viz.layers.primitives import Balls, Chart, Curve, Mesh, Picture, Points, Segments, Step, Table
from spherloc_viz.recording.markdown import step_text, table_text

TIMELINE = "step"
"""The sequence timeline of every recording: the index of the step in ``layers.steps``."""

MARKER_SHARE = 0.003
"""Width of a marker's bar, as a share of the chart."""
LEVEL_OPACITY = 0.25
"""Of the bar that stands for a level, so that what it is held against shows through."""
LINE_SHARE = 0.8
"""Width of the bar of a line's sample, as a share of the least distance between samples."""

# Without it, a value that rerun cannot convert is dropped with a warning and the recording lacks it.
rr.set_strict_mode(True)

Columns = list[rr.ComponentColumn]
Rows = list[Any]
"""One primitive per row, or None where it is absent and the row clears it."""


@dataclass(frozen=True, eq=False)
class Bars:
    """A curve as the only chart with an x axis that rerun has: K bars."""

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


def drawing_chunks(pictures: Sequence[Picture]) -> Iterator[Chunk]:
    """Everything that the pictures of a run show, one picture a step.

    Between two rows rerun shows the earlier one, so that only changes are written: a primitive that looks as it did
    at the step before has no row, and one that has gone has an empty row.
    """
    yield Chunk.from_columns("/", [], rr.ViewCoordinates.columns(xyz=[rr.ViewCoordinates.RDF]))
    yield _framing(pictures[0])
    tracks: dict[tuple[str, type], Rows] = {}
    for index, picture in enumerate(pictures):
        for path, item in _items(picture):
            tracks.setdefault((path, type(item)), [None] * len(pictures))[index] = item
    for (path, kind), track in tracks.items():
        steps = [i for i, item in enumerate(track) if not _same(item, track[i - 1] if i else None)]
        columns = _ENCODERS[kind]([track[i] for i in steps])
        yield Chunk.from_columns(path, [rr.TimeColumn(TIMELINE, sequence=steps)], columns)


def chart_path(*names: str) -> str:
    """Entity of a chart, or of a curve of it. The viewer's legend shows it, so it is kept free of escapes."""
    return rr.new_entity_path(["charts", *(name.replace(" ", "_") for name in names)])


def _framing(picture: Picture) -> Chunk:
    """Where to look: brings the middle of the first picture's dots to the origin and most of them within 1 of it.

    So one fixed eye suits every scene. Without an eye, rerun's own follows the largest ball from step to step.
    """
    dots = np.concatenate([np.zeros((0, 3)), *(item.positions for item in picture.scene if isinstance(item, Points))])
    middle = np.median(dots, axis=0) if len(dots) else np.zeros(3)
    extent = float(np.percentile(np.linalg.norm(dots - middle, axis=1), 90)) if len(dots) else 1.0
    scale = 1.0 / max(extent, 1e-6)
    return Chunk.from_columns("/scene", [], rr.Transform3D.columns(translation=[-scale * middle], scale=[[scale] * 3]))


def _items(picture: Picture) -> Iterator[tuple[str, Any]]:
    yield "/step", picture.step
    for item in picture.scene:
        yield rr.new_entity_path(["scene", *item.name.split("/")]), item
    for chart in picture.charts:
        for curve in (curve for curve in chart.curves if len(curve.x)):
            yield chart_path(chart.name, curve.label), bars(chart, curve)
    for table in picture.tables:
        yield rr.new_entity_path(["tables", table.name]), table


def _same(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if type(a) is not type(b):
        return False
    if is_dataclass(a):
        return all(_same(getattr(a, item.name), getattr(b, item.name)) for item in fields(a))
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


def _column(descriptor: rr.ComponentDescriptor, batch: Any, lengths: Sequence[int]) -> rr.ComponentColumn:
    return rr.ComponentColumn(descriptor, batch, lengths=lengths)


def _joined(rows: Rows, name: str, shape: tuple[int, ...], dtype: type) -> tuple[NDArray[Any], list[int]]:
    """The arrays called ``name`` of all rows as one, and how many entries each row has."""
    arrays = [np.zeros((0, *shape)) if row is None else np.asarray(getattr(row, name)) for row in rows]
    return np.concatenate(arrays).astype(dtype).reshape(-1, *shape), [len(array) for array in arrays]


def _rgba(colors: Any, opacity: float) -> NDArray[np.uint32]:
    rgb = np.asarray(colors, dtype=np.uint8).reshape(-1, 3)
    alpha = np.full((len(rgb), 1), round(255 * opacity), dtype=np.uint8)
    packed = np.hstack([rgb, alpha]).view(">u4").astype(np.uint32).ravel()
    # rerun repeats a single colour over all instances of the row.
    return packed[:1] if (packed == packed[:1]).all() else packed


def _colors(rows: Rows, descriptor: rr.ComponentDescriptor) -> rr.ComponentColumn:
    packed = [
        np.zeros(0, np.uint32) if row is None else _rgba(row.colors, getattr(row, "opacity", 1.0)) for row in rows
    ]
    return _column(descriptor, rr.components.ColorBatch(np.concatenate(packed)), [len(row) for row in packed])


def _single(rows: Rows, descriptor: rr.ComponentDescriptor, batch: type, value: Callable[[Any], Any]) -> Any:
    """A column with one value in every row that shows something."""
    present = [value(row) for row in rows if row is not None]
    return _column(descriptor, batch(present), [row is not None for row in rows])


def _one_color(rows: Rows, descriptor: rr.ComponentDescriptor, batch: type) -> rr.ComponentColumn:
    """A column with the colour of every row that shows something."""
    packed = [_rgba(row.color, getattr(row, "opacity", 1.0)) for row in rows if row is not None]
    return _column(descriptor, batch(np.concatenate(packed)), [row is not None for row in rows])


def _points(rows: Rows) -> Columns:
    positions, lengths = _joined(rows, "positions", (3,), np.float32)
    columns = [
        _column(rr.Points3D.descriptor_positions(), rr.components.Position3DBatch(positions), lengths),
        _colors(rows, rr.Points3D.descriptor_colors()),
        _single(rows, rr.Points3D.descriptor_radii(), rr.components.RadiusBatch, lambda row: row.radius_m),
    ]
    if any(row is not None and row.ids is not None for row in rows):
        ids = [np.zeros(0, np.int64) if row is None or row.ids is None else row.ids for row in rows]
        batch = rr.AnyBatchValue("correspondence", pa.array(np.concatenate(ids)))
        columns.append(_column(rr.ComponentDescriptor("correspondence"), batch, [len(row) for row in ids]))
    return columns


def _segments(rows: Rows) -> Columns:
    points, lengths = _joined(rows, "points", (2, 3), np.float32)
    ends = rr.encodings.Vec3DBatch(points.reshape(-1, 3)).as_arrow_array()
    offsets = np.arange(0, 2 * len(points) + 1, 2, dtype=np.int32)
    strips = pa.ListArray.from_arrays(offsets, ends, type=rr.components.LineStrip3DBatch._ARROW_DATATYPE)
    radius = rr.LineStrips3D.descriptor_radii()
    return [
        _column(rr.LineStrips3D.descriptor_strips(), rr.components.LineStrip3DBatch(strips), lengths),
        _colors(rows, rr.LineStrips3D.descriptor_colors()),
        # rerun reads a negative radius as points on the screen.
        _single(rows, radius, rr.components.RadiusBatch, lambda row: -row.width_px / 2),
    ]


def _balls(rows: Rows) -> Columns:
    centers, lengths = _joined(rows, "centers", (3,), np.float32)
    radii, _ = _joined(rows, "radii_m", (), np.float32)
    half_sizes = rr.components.HalfSize3DBatch(np.repeat(radii[:, None], 3, axis=1))
    fill = rr.Ellipsoids3D.descriptor_fill_mode()
    return [
        _column(rr.Ellipsoids3D.descriptor_half_sizes(), half_sizes, lengths),
        _column(rr.Ellipsoids3D.descriptor_centers(), rr.components.Translation3DBatch(centers), lengths),
        _colors(rows, rr.Ellipsoids3D.descriptor_colors()),
        _single(rows, fill, rr.components.FillModeBatch, lambda row: "solid"),
    ]


def _mesh(rows: Rows) -> Columns:
    vertices, vertex_counts = _joined(rows, "vertices", (3,), np.float32)
    faces, face_counts = _joined(rows, "faces", (3,), np.uint32)
    indices = rr.components.TriangleIndicesBatch(faces)
    return [
        _column(rr.Mesh3D.descriptor_vertex_positions(), rr.components.Position3DBatch(vertices), vertex_counts),
        _column(rr.Mesh3D.descriptor_triangle_indices(), indices, face_counts),
        _one_color(rows, rr.Mesh3D.descriptor_albedo_factor(), rr.components.AlbedoFactorBatch),
    ]


def _bars(rows: Rows) -> Columns:
    present = [row for row in rows if row is not None]
    once = [row is not None for row in rows]
    widths, counts = _joined(rows, "widths", (), np.float32)
    return [
        _column(rr.BarChart.descriptor_values(), _tensors([row.heights for row in present]), once),
        _column(rr.BarChart.descriptor_abscissa(), _tensors([row.left for row in present]), once),
        _column(rr.BarChart.descriptor_widths(), rr.components.LengthBatch(widths), counts),
        _one_color(rows, rr.BarChart.descriptor_color(), rr.components.ColorBatch),
    ]


def _tensors(arrays: list[NDArray[Any]]) -> rr.components.TensorDataBatch:
    batches = [rr.components.TensorDataBatch(np.asarray(array, dtype=np.float64)) for array in arrays]
    return rr.components.TensorDataBatch(pa.concat_arrays([batch.as_arrow_array() for batch in batches]))


def _text(write: Callable[[Any], str]) -> Callable[[Rows], Columns]:
    """Encoder of a primitive that ``write`` turns into Markdown."""

    def encode(rows: Rows) -> Columns:
        media = rr.TextDocument.descriptor_media_type()
        return [
            _single(rows, rr.TextDocument.descriptor_text(), rr.components.TextBatch, write),
            _single(rows, media, rr.components.MediaTypeBatch, lambda row: rr.MediaType.MARKDOWN),
        ]

    return encode


_ENCODERS: dict[type, Callable[[Rows], Columns]] = {
    Points: _points,
    Segments: _segments,
    Balls: _balls,
    Mesh: _mesh,
    Bars: _bars,
    Step: _text(step_text),
    Table: _text(table_text),
}
