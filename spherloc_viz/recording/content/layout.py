"""How a recording opens: the blueprint, a second store in the recording's own ``.rrd`` file.

An ``.rrd`` file is a header of 12 bytes, messages of 16 bytes (kind, length) and a payload, and a message with an index
of all chunks by their places in the file (https://rerun.io/docs, "RRD format"). So files cannot be put end to end: the
places in the second one's index move. They are a column of an arrow table, ``chunk_byte_offset``, which is moved here.
The layout comes second, since it is the same for many runs: what it takes to move it is little and known.
"""

import io
import os
import struct
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import rerun.blueprint as rrb
import rerun_bindings
from numpy.typing import NDArray
from rerun import RecordingStream
from rerun.blueprint import archetypes

from spherloc.kernel_cache import kernel
from spherloc_viz.layers.primitives import Chart, Picture
from spherloc_viz.recording.content.drawing import chart_path, table_path
from spherloc_viz.recording.content.names import APPLICATION_ID, REVIEW_ENTITY
from spherloc_viz.recording.content.panels import ARCS, GRAPH, RESIDUALS, Panels
from spherloc_viz.recording.content.texts import legible

HEADER_BYTES = 12
END, CHUNK = 0, 2
"""Kinds of messages: the last one, which holds the index, and one that is in it."""
TAIL = struct.Struct("<QQI8sI")
"""At the end of a file: place and length of the index, its checksum, ``RRF2FOOT``, and how many of them there are."""
MARK = b"RRF2FOOT"
MESSAGE = struct.Struct("<QQ")
CHECKSUM_SEED = 7_850_921
LZ4 = 2
"""Code of a compressed table."""


@dataclass(frozen=True, eq=False)
class RrdFile:
    """The parts of a file with one store."""

    header: bytes
    """Version and packing."""
    messages: bytes
    """Without the index."""
    index: bytes
    """Payload of the last message."""


def split(content: bytes) -> RrdFile:
    """The parts of a file that rerun wrote.

    Raises ``ValueError`` if it has no index, or one of a form that is not known here.
    """
    start, index = _index_of(io.BytesIO(content))
    return RrdFile(content[:HEADER_BYTES], content[HEADER_BYTES : start - MESSAGE.size], index)


def append(path: Path, second: RrdFile) -> int:
    """Put the store of ``second`` behind the one in a file that rerun has just written; returns the size in bytes.

    Raises ``OSError``, and ``ValueError`` if an index has a form that is not known here.
    """
    with path.open("r+b") as file:
        if file.read(HEADER_BYTES) != second.header:
            raise ValueError("rerun wrote two files of different forms")
        start, index = _index_of(file)
        end = start - MESSAGE.size
        # Indices are protobuf messages with one repeated field, of which one behind the other are both.
        index += _moved(second, end - HEADER_BYTES)
        start = end + len(second.messages) + MESSAGE.size
        tail = TAIL.pack(start, len(index), _checksum(index), MARK, 1)
        file.seek(end)
        file.write(b"".join([second.messages, MESSAGE.pack(END, len(index)), index, tail]))
        file.truncate()
        return file.tell()


def _index_of(file: BinaryIO) -> tuple[int, bytes]:
    """Where in a file the index is, and the index. Raises ``OSError``, and ``ValueError`` if there is none."""
    size = file.seek(0, os.SEEK_END)
    if size < HEADER_BYTES + MESSAGE.size + TAIL.size:
        raise ValueError("rerun wrote a file without an index")
    file.seek(size - TAIL.size)
    start, length, checksum, mark, count = TAIL.unpack(file.read(TAIL.size))
    if mark != MARK or count != 1 or not HEADER_BYTES + MESSAGE.size <= start <= start + length <= size - TAIL.size:
        raise ValueError("rerun wrote a file whose index is not where it was expected")
    file.seek(start)
    index = file.read(length)
    if checksum != _checksum(index):
        raise ValueError("rerun wrote a file whose index is damaged")
    return start, index


def _checksum(index: bytes) -> int:
    return int(xxh32(np.frombuffer(index, np.uint8), CHECKSUM_SEED))


def _moved(file: RrdFile, by: int) -> bytes:
    """The index of a file with all places in it larger by ``by`` bytes."""
    (manifest,) = _fields(file.index).values()
    parts = _fields(manifest)
    table = _fields(parts[4])
    if table[3] != LZ4 or set(parts) != {1, 2, 3, 4}:
        raise ValueError("rerun wrote an index of an unknown form")
    content = bytearray(pa.decompress(table[2], table[4], codec="lz4_raw", asbytes=True))
    # Looked for by what it must be: to have arrow read a table of some hundred columns takes far longer.
    known = _places(file.messages)
    column = known.tobytes()
    if not len(known) or content.count(column) != 1:
        raise ValueError("rerun wrote an index of an unknown form")
    start = content.index(column)
    content[start : start + len(column)] = (known + np.uint64(by)).tobytes()
    table[2] = pa.compress(bytes(content), codec="lz4_raw", asbytes=True)
    parts[4] = _message(table)
    return _message({1: _message(parts)})


def _places(messages: bytes) -> NDArray[np.uint64]:
    """Where in the file the payloads of chunks begin, in order."""
    places, at = [], 0
    while at + MESSAGE.size <= len(messages):
        kind, length = MESSAGE.unpack_from(messages, at)
        at += MESSAGE.size
        if kind == CHUNK:
            places.append(HEADER_BYTES + at)
        at += length
    return np.array(places, "<u8")


def _fields(message: bytes | int) -> dict[int, bytes | int]:
    """Fields of a protobuf message by number: bytes, or whole numbers."""
    if isinstance(message, int):
        raise ValueError("rerun wrote an index of an unknown form")
    fields: dict[int, bytes | int] = {}
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        value, at = _varint(message, at)
        if key & 7 == 2:
            value, at = message[at : at + value], at + value
        elif key & 7:
            raise ValueError("rerun wrote an index of an unknown form")
        fields[key >> 3] = value
    return fields


def _message(fields: dict[int, bytes | int]) -> bytes:
    out = bytearray()
    for number, value in fields.items():
        out += _coded(number << 3 | (0 if isinstance(value, int) else 2))
        out += _coded(value) if isinstance(value, int) else _coded(len(value)) + value
    return bytes(out)


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = message[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _coded(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


@kernel(inline="always")
def _rotated(value, by):
    return np.uint32((value << by) | (value >> np.uint32(np.uint32(32) - by)))


@kernel()
def xxh32(data, seed):
    """The hash XXH32 of bytes, by which rerun checks an index."""
    p1, p2, p3 = np.uint32(2654435761), np.uint32(2246822519), np.uint32(3266489917)
    p4, p5 = np.uint32(668265263), np.uint32(374761393)
    seed, size, at = np.uint32(seed), len(data), 0
    if size >= 16:
        lanes = np.array([np.uint32(seed + p1 + p2), np.uint32(seed + p2), seed, np.uint32(seed - p1)], np.uint32)
        while at + 16 <= size:
            for k in range(4):
                word = np.uint32(data[at]) | np.uint32(data[at + 1]) << np.uint32(8)
                word |= np.uint32(data[at + 2]) << np.uint32(16) | np.uint32(data[at + 3]) << np.uint32(24)
                lanes[k] = np.uint32(_rotated(np.uint32(lanes[k] + np.uint32(word) * p2), np.uint32(13)) * p1)
                at += 4
        out = _rotated(lanes[0], np.uint32(1)) + _rotated(lanes[1], np.uint32(7))
        out = np.uint32(out + _rotated(lanes[2], np.uint32(12)) + _rotated(lanes[3], np.uint32(18)))
    else:
        out = np.uint32(seed + p5)
    out = np.uint32(out + np.uint32(size))
    while at + 4 <= size:
        word = np.uint32(data[at]) | np.uint32(data[at + 1]) << np.uint32(8)
        word |= np.uint32(data[at + 2]) << np.uint32(16) | np.uint32(data[at + 3]) << np.uint32(24)
        out = np.uint32(_rotated(np.uint32(out + np.uint32(word) * p3), np.uint32(17)) * p4)
        at += 4
    while at < size:
        out = np.uint32(_rotated(np.uint32(out + np.uint32(data[at]) * p5), np.uint32(11)) * p1)
        at += 1
    out = np.uint32((out ^ (out >> np.uint32(15))) * p2)
    out = np.uint32((out ^ (out >> np.uint32(13))) * p3)
    return np.uint32(out ^ (out >> np.uint32(16)))


EYE = (1.15, -1.2, -1.55)
"""Where one looks from, in the frame in which the scene has radius 1: from the same side as the page's overview."""
LAYOUT_ROOM = 1 << 20
"""Bytes, many more than a layout takes."""
MAX_LAYOUTS = 64
"""Layouts that are kept; runs of one estimator share one or a few."""


@dataclass(frozen=True)
class LayoutContent:
    """What a layout has views for. Hashable, so that runs can share layouts."""

    charts: tuple[tuple[str, str, bool], ...]
    """Name and heading of every chart, and whether its legend stands on the left, where nothing high is behind it."""
    tables: tuple[str, ...]
    """Tables that a run shows before its last step; those of the last one are part of the outcome."""
    panels: Panels


def shown_in(pictures: Sequence[Picture], panels: Panels) -> LayoutContent:
    """What a run shows at any step, in the order of its first appearance."""
    charts: dict[str, Chart] = {}
    for picture in pictures:
        for chart in picture.charts:
            charts.setdefault(chart.name, chart)
    named = tuple(
        (name, legible(f"{chart.title}: {chart.y_label} over {chart.x_label}"), _low_on_the_left(chart))
        for name, chart in charts.items()
    )
    tables = tuple(dict.fromkeys(table.name for picture in pictures[:-1] for table in picture.tables))
    return LayoutContent(named, tables, panels)


def _low_on_the_left(chart: Chart) -> bool:
    curves = [curve for curve in chart.curves if curve.kind != "marker" and len(curve.x)]
    if not curves:
        return True
    x, y = (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("x", "y"))
    left = x < 0.5 * (x.min() + x.max())
    return float(y[left].max(initial=0.0)) <= float(y[~left].max(initial=0.0))


def blueprint(shown: LayoutContent) -> rrb.Blueprint:
    """The scene above the image, arcs and graph on the left; what the step says, charts and verdict on the right.

    The layout pauses on the timeline of steps. A blueprint cannot say at which step: that is decided when the recording
    is opened. A viewer in a page is told by its address.
    """
    plots = [
        rrb.BarChartView(
            origin=chart_path(name), name=label, plot_legend=rrb.PlotLegend("LeftTop" if left else "RightTop")
        )
        for name, label, left in shown.charts
    ]
    if shown.panels.residuals:
        # Second, since the chart of refinement is empty at most steps.
        # There are bars everywhere, so the heading says what a legend would hide.
        name, legend = "Residuals over log10 of px: right green, wrong red", rrb.PlotLegend(visible=False)
        plots.insert(1, rrb.BarChartView(origin=RESIDUALS, name=name, plot_legend=legend))
    texts = [
        rrb.TextDocumentView(origin="/outcome", name="Verdict"),
        rrb.TextDocumentView(origin=REVIEW_ENTITY, name="Review"),
        *(rrb.TextDocumentView(origin=table_path(name), name=name) for name in shown.tables),
    ]
    words = rrb.TextDocumentView(origin="/step", name="Step")
    side = [words, *plots[:1], *([rrb.Tabs(*plots[1:])] if plots[1:] else []), rrb.Tabs(*texts)]
    left = rrb.Vertical(_scene(), rrb.Horizontal(*_flat_views(shown.panels)), row_shares=[2.2, 1])
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*side, row_shares=[1.3, *[1] * (len(side) - 2), 1.5]), column_shares=[3, 2]),
        # Without its timeline: rerun chooses the only one, and says that a named one is missing while it still loads.
        rrb.TimePanel(state="collapsed", play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scene() -> rrb.Spatial3DView:
    eye = rrb.EyeControls3D(position=EYE, look_target=(0.0, 0.0, 0.0), eye_up=(0.0, -1.0, 0.0))
    grid = archetypes.LineGrid3D(visible=False)
    return rrb.Spatial3DView(origin="/", contents="/scene/**", name="Scene", eye_controls=eye, line_grid=grid)


def _flat_views(panels: Panels) -> list[rrb.View]:
    views: list[rrb.View] = [rrb.Spatial2DView(origin="/query", name="Query image")]
    if panels.arcs:
        views.append(rrb.Spatial2DView(origin=ARCS, name="Yaw arcs near the estimate (degrees)"))
    name = "Overlaps of balls"
    if panels.graph:
        # The balls have places of their own, and forces would only move them about.
        views.append(
            rrb.GraphView(
                origin=GRAPH,
                name=name,
                force_link=archetypes.ForceLink(enabled=False),
                force_many_body=archetypes.ForceManyBody(enabled=False),
                force_position=archetypes.ForcePosition(enabled=True),
                force_collision_radius=archetypes.ForceCollisionRadius(enabled=False),
                force_center=archetypes.ForceCenter(enabled=False),
            )
        )
    elif panels.large_graph:
        views.append(rrb.Spatial2DView(origin=GRAPH, name=name))
    return views


@lru_cache(maxsize=MAX_LAYOUTS)
def layout_file(shown: LayoutContent) -> RrdFile:
    """The blueprint as the parts of an ``.rbl`` file.

    Kept, since rerun leaves two threads behind for every blueprint that it saves.
    Raises ``OSError`` if it cannot be saved, ``ValueError`` if rerun saves it in an unknown form.
    """
    with tempfile.TemporaryDirectory(prefix="spherloc-") as folder:
        path = Path(folder) / "layout.rbl"
        # On a full disk, saving a blueprint would wait for ever: find that out first.
        path.write_bytes(bytes(LAYOUT_ROOM))
        path.unlink()
        _save(blueprint(shown), path)
        return split(path.read_bytes())


def _save(layout: rrb.Blueprint, path: Path) -> None:
    """Write a blueprint to a file that is complete when this returns.

    ``Blueprint.save`` leaves the end of the file to the deletion of its stream, which a profiler or debugger that
    holds the frame of this thread delays. So the stream is ours here, and disconnected.
    """
    native = rerun_bindings.new_blueprint(
        application_id=APPLICATION_ID, make_default=False, make_thread_default=False, default_enabled=True
    )
    stream = RecordingStream._from_native(native)
    try:
        stream.set_time("blueprint", sequence=0)
        layout._log_to_stream(stream)
        rerun_bindings.save_blueprint(str(path), native)
    finally:
        stream.disconnect()
