"""What rerun calls components: the parts of every primitive, and how each of them is written."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from spherloc_viz.layers.primitives import Balls, Label, Mesh, Points, Segments, Step, Table
from spherloc_viz.recording.chart_bars import Bars, tensors
from spherloc_viz.recording.markdown import step_text, table_text

# Without it, a value that rerun cannot convert is dropped with a warning and the recording lacks it.
rr.set_strict_mode(True)

Columns = list[rr.ComponentColumn]
Rows = list[Any]
"""One primitive per row, or None where it is absent and the row clears it."""


@dataclass(frozen=True)
class Part:
    """Components of a primitive that are written together."""

    look: tuple[str, ...]
    """Fields of the primitive that they show."""
    encode: Callable[[Rows], Columns]


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


def _positions(rows: Rows) -> Columns:
    positions, lengths = _joined(rows, "positions", (3,), np.float32)
    return [_column(rr.Points3D.descriptor_positions(), rr.components.Position3DBatch(positions), lengths)]


def _point_radius(rows: Rows) -> Columns:
    descriptor = rr.Points3D.descriptor_radii()
    return [_single(rows, descriptor, rr.components.RadiusBatch, lambda row: row.radius_m)]


def _ids(rows: Rows) -> Columns:
    if not any(row is not None and row.ids is not None for row in rows):
        return []
    ids = [np.zeros(0, np.int64) if row is None or row.ids is None else row.ids for row in rows]
    batch = rr.AnyBatchValue("correspondence", pa.array(np.concatenate(ids)))
    return [_column(rr.ComponentDescriptor("correspondence"), batch, [len(row) for row in ids])]


def _strips(rows: Rows) -> Columns:
    points, lengths = _joined(rows, "points", (2, 3), np.float32)
    ends = rr.encodings.Vec3DBatch(points.reshape(-1, 3)).as_arrow_array()
    offsets = np.arange(0, 2 * len(points) + 1, 2, dtype=np.int32)
    strips = pa.ListArray.from_arrays(offsets, ends, type=rr.components.LineStrip3DBatch._ARROW_DATATYPE)
    return [_column(rr.LineStrips3D.descriptor_strips(), rr.components.LineStrip3DBatch(strips), lengths)]


def _strip_radius(rows: Rows) -> Columns:
    # rerun reads a negative radius as points on the screen.
    descriptor = rr.LineStrips3D.descriptor_radii()
    return [_single(rows, descriptor, rr.components.RadiusBatch, lambda row: -row.width_px / 2)]


def _balls(rows: Rows) -> Columns:
    centers, lengths = _joined(rows, "centers", (3,), np.float32)
    radii, _ = _joined(rows, "radii_m", (), np.float32)
    half_sizes = rr.components.HalfSize3DBatch(np.repeat(radii[:, None], 3, axis=1))
    fill = rr.Ellipsoids3D.descriptor_fill_mode()
    return [
        _column(rr.Ellipsoids3D.descriptor_half_sizes(), half_sizes, lengths),
        _column(rr.Ellipsoids3D.descriptor_centers(), rr.components.Translation3DBatch(centers), lengths),
        _single(rows, fill, rr.components.FillModeBatch, lambda row: "solid"),
    ]


def _vertices(rows: Rows) -> Columns:
    vertices, counts = _joined(rows, "vertices", (3,), np.float32)
    return [_column(rr.Mesh3D.descriptor_vertex_positions(), rr.components.Position3DBatch(vertices), counts)]


def _faces(rows: Rows) -> Columns:
    faces, counts = _joined(rows, "faces", (3,), np.uint32)
    indices = rr.components.TriangleIndicesBatch(faces)
    return [_column(rr.Mesh3D.descriptor_triangle_indices(), indices, counts)]


def _heights(rows: Rows) -> Columns:
    heights = tensors([row.heights for row in rows if row is not None])
    return [_column(rr.BarChart.descriptor_values(), heights, [row is not None for row in rows])]


def _abscissa(rows: Rows) -> Columns:
    left = tensors([row.left for row in rows if row is not None])
    widths, counts = _joined(rows, "widths", (), np.float32)
    return [
        _column(rr.BarChart.descriptor_abscissa(), left, [row is not None for row in rows]),
        _column(rr.BarChart.descriptor_widths(), rr.components.LengthBatch(widths), counts),
    ]


def _label(rows: Rows) -> Columns:
    places = [np.zeros((0, 3)) if row is None else row.position[None] for row in rows]
    batch = rr.components.Position3DBatch(np.concatenate(places).astype(np.float32))
    texts = rr.Points3D.descriptor_labels()
    return [
        _column(rr.Points3D.descriptor_positions(), batch, [len(place) for place in places]),
        _single(rows, texts, rr.components.TextBatch, lambda row: row.text),
        # The word is what is shown, not the dot that rerun hangs it on.
        _single(rows, rr.Points3D.descriptor_radii(), rr.components.RadiusBatch, lambda row: 0.0),
    ]


def _text(write: Callable[[Any], str]) -> Callable[[Rows], Columns]:
    """Encoder of a primitive that ``write`` turns into Markdown."""

    def encode(rows: Rows) -> Columns:
        media = rr.TextDocument.descriptor_media_type()
        return [
            _single(rows, rr.TextDocument.descriptor_text(), rr.components.TextBatch, write),
            _single(rows, media, rr.components.MediaTypeBatch, lambda row: rr.MediaType.MARKDOWN),
        ]

    return encode


def _colored(descriptor: rr.ComponentDescriptor) -> Callable[[Rows], Columns]:
    return lambda rows: [_colors(rows, descriptor)]


def _plain(descriptor: rr.ComponentDescriptor, batch: type) -> Callable[[Rows], Columns]:
    return lambda rows: [_one_color(rows, descriptor, batch)]


PARTS: dict[type, tuple[Part, ...]] = {
    Points: (
        Part(("positions",), _positions),
        Part(("colors",), _colored(rr.Points3D.descriptor_colors())),
        Part(("radius_m",), _point_radius),
        Part(("ids",), _ids),
    ),
    Segments: (
        Part(("points",), _strips),
        Part(("colors",), _colored(rr.LineStrips3D.descriptor_colors())),
        Part(("width_px",), _strip_radius),
    ),
    Balls: (
        Part(("centers", "radii_m"), _balls),
        Part(("colors", "opacity"), _colored(rr.Ellipsoids3D.descriptor_colors())),
    ),
    Mesh: (
        Part(("vertices",), _vertices),
        Part(("faces",), _faces),
        Part(("color", "opacity"), _plain(rr.Mesh3D.descriptor_albedo_factor(), rr.components.AlbedoFactorBatch)),
    ),
    Label: (Part(("position", "text"), _label),),
    Bars: (
        Part(("heights",), _heights),
        Part(("left", "widths"), _abscissa),
        Part(("color", "opacity"), _plain(rr.BarChart.descriptor_color(), rr.components.ColorBatch)),
    ),
    Step: (Part(("title", "caption", "equation", "note"), _text(step_text)),),
    Table: (Part(("name", "columns", "rows"), _text(table_text)),),
}
