"""Neutral primitives as rerun chunks: of each primitive only what changes, at the steps at which it changes."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr
from rerun.chunk import Chunk

from spherloc_viz.layers.primitives import Picture, Points, Textured
from spherloc_viz.recording.chart_bars import bars
from spherloc_viz.recording.components import PARTS, Columns, Rows

TIMELINE = "step"
"""The sequence timeline of every recording: the index of the step in ``layers.steps``."""
NEAR = 1e-6
"""Numbers that differ by no more, relative to the largest of them, are equal: they are written with 24 bits."""


def drawing_chunks(pictures: Mapping[int, Picture]) -> Iterator[Chunk]:
    """Everything that the pictures of a run show, by the index of their step, in ascending order.

    Between two rows of a component rerun shows the earlier one, so that only changes are written: a primitive that
    changes its colours has no new positions, and one that has gone has empty rows. Pictures on meshes are left out:
    they would be most of a file, which holds the paths of its images.
    """
    yield Chunk.from_columns("/", [], rr.ViewCoordinates.columns(xyz=[rr.ViewCoordinates.RDF]))
    yield _framing(next(iter(pictures.values())))
    when = list(pictures)
    tracks: dict[tuple[str, type], Rows] = {}
    for index, picture in enumerate(pictures.values()):
        for path, item in _items(picture):
            tracks.setdefault((path, type(item)), [None] * len(pictures))[index] = item
    for (path, kind), track in tracks.items():
        columns: dict[tuple[int, ...], Columns] = {}
        for part in PARTS[kind]:
            changes = _changes(track, part.look)
            columns.setdefault(changes, []).extend(part.encode([track[i] for i in changes]))
        for changes, together in columns.items():
            steps = rr.TimeColumn(TIMELINE, sequence=[when[i] for i in changes])
            yield Chunk.from_columns(path, [steps], together)


def _changes(track: Rows, look: tuple[str, ...]) -> tuple[int, ...]:
    """The steps at which what the fields show differs from what was written last."""
    steps: list[int] = []
    shown: Any = None
    for index, item in enumerate(track):
        if item is shown or (item is not None and shown is not None and _same(item, shown, look)):
            continue
        steps.append(index)
        shown = item
    return tuple(steps)


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
    for item in (item for item in picture.scene if not isinstance(item, Textured)):
        yield rr.new_entity_path(["scene", *item.name.split("/")]), item
    for chart in picture.charts:
        for curve in (curve for curve in chart.curves if len(curve.x)):
            yield chart_path(chart.name, curve.label), bars(chart, curve)
    for table in picture.tables:
        yield rr.new_entity_path(["tables", table.name]), table


def _same(item: Any, shown: Any, look: tuple[str, ...]) -> bool:
    return all(_equal(getattr(item, name), getattr(shown, name)) for name in look)


def _equal(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if not isinstance(a, np.ndarray) or not isinstance(b, np.ndarray):
        return bool(a == b)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    # Most are equal in every bit, and that is found out quickly.
    if a.tobytes() == b.tobytes():
        return True
    return a.dtype.kind == "f" and bool(np.abs(a - b).max() <= NEAR * np.abs(b).max())
