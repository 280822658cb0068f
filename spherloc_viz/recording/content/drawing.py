"""Neutral primitives as rerun chunks: of each primitive only what changes, at the steps at which it changes."""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from spherloc.types import FloatArray
from spherloc_viz.layers.key_step import match_colors
from spherloc_viz.layers.primitives import Label, Picture, Points, Textured
from spherloc_viz.recording.content.columns import VECTOR_3D, Times, Values, static_chunk, vectors
from spherloc_viz.recording.content.components import MATCHES, PARTS, Bars, Keypoints, Part, Rows, Words, bars

NEAR = 1e-6
"""Numbers that differ by no more, relative to the largest of them, are equal: they are written with 24 bits."""
WORDS = "/scene/words"
"""All labels."""


def drawing_chunks(pictures: Mapping[int, Picture], pixels: FloatArray) -> Iterator[Chunk]:
    """Everything that the pictures of a run show, by the index of their step, in ascending order.

    ``pixels`` (N, 2) are those of its matches in the recorded query image, whose dots change colour with the map's.

    Between two rows of a component rerun shows the earlier one, so that only changes are written: a primitive that
    changes its colours has no new positions, and one that has gone has empty rows. Pictures on meshes are left out:
    they would be most of a file, which holds the paths of its images.
    """
    yield Chunk.from_columns("/", [], list(rr.ViewCoordinates.columns(xyz=[rr.ViewCoordinates.RDF])))
    yield _framing(next(iter(pictures.values())))
    when = np.array(list(pictures), np.int64)
    for (path, kind), track in _tracks(list(pictures.values()), pixels).items():
        yield _chunk(path, [(_changes(track, part.look), part) for part in PARTS[kind]], track, when)


def _tracks(pictures: Sequence[Picture], pixels: FloatArray) -> dict[tuple[str, type], Rows]:
    """Every primitive by its entity and type: what it is in each of the pictures, None where it is not there."""
    tracks: dict[tuple[str, type], Rows] = {}
    drawn: dict[tuple[int, int], Bars] = {}
    for index, picture in enumerate(pictures):
        items: list[tuple[str, Any]] = [
            ("/step", picture.step),
            (MATCHES, Keypoints(pixels, match_colors(picture))),
        ]
        items += [(_scene_path(item.name), item) for item in picture.scene if not isinstance(item, Textured | Label)]
        labels = [item for item in picture.scene if isinstance(item, Label)]
        if labels:
            positions = np.stack([label.position for label in labels])
            items.append((WORDS, Words(tuple(label.text for label in labels), positions)))
        for chart in picture.charts:
            for curve in (curve for curve in chart.curves if len(curve.x)):
                # Charts stay for all later steps, and are the same objects there.
                key = id(chart), id(curve)
                shown = drawn[key] = drawn.get(key) or bars(chart, curve)
                items.append((chart_path(chart.name, curve.label), shown))
        items += [(table_path(table.name), table) for table in picture.tables]
        for path, item in items:
            tracks.setdefault((path, type(item)), [None] * len(pictures))[index] = item
    return tracks


def _chunk(path: str, parts: list[tuple[list[int], Part]], track: Rows, when: NDArray[np.int64]) -> Chunk:
    """A chunk with a row for every step at which any part of a primitive changes, and in it only what does."""
    steps = sorted({index for changes, _ in parts for index in changes})
    place_of = {index: place for place, index in enumerate(steps)}
    columns = []
    for changes, part in parts:
        places = [place_of[index] for index in changes]
        for values in part.encode([track[index] for index in changes]):
            columns.append(values.whole() if len(places) == len(steps) else values.among(places, len(steps)))
    return Chunk.from_columns(path, [Times(when[steps])], columns)


def _changes(track: Rows, look: tuple[str, ...]) -> list[int]:
    """The steps at which what the fields show differs from what was written last."""
    steps: list[int] = []
    shown: Any = None
    for index, item in enumerate(track):
        if item is shown:
            continue
        if item is None or shown is None or not _same(item, shown, look):
            steps.append(index)
            shown = item
    return steps


@lru_cache(maxsize=1024)
def chart_path(*names: str) -> str:
    """Entity of a chart, or of a curve of it. The viewer's legend shows it, so it is kept free of escapes."""
    return rr.new_entity_path(["charts", *(name.replace(" ", "_") for name in names)])


@lru_cache(maxsize=1024)
def _scene_path(name: str) -> str:
    return rr.new_entity_path(["scene", *name.split("/")])


@lru_cache(maxsize=1024)
def table_path(name: str) -> str:
    """Entity of a table."""
    return rr.new_entity_path(["tables", name])


def _framing(picture: Picture) -> Chunk:
    """Where to look: brings the middle of the first picture's dots to the origin and most of them within 1 of it.

    So one fixed eye suits every scene. Without an eye, rerun's own follows the largest ball from step to step.
    """
    dots = np.concatenate([np.zeros((0, 3)), *(item.positions for item in picture.scene if isinstance(item, Points))])
    middle, extent = np.zeros(3), 1.0
    if len(dots):
        half, most = len(dots) // 2, 9 * len(dots) // 10
        middle = np.partition(dots, half, axis=0)[half]
        away = dots - middle
        extent = float(np.sqrt(np.partition(np.einsum("ni,ni->n", away, away), most)[most]))
    scale = 1.0 / max(extent, 1e-6)
    place, size = (vectors(row, VECTOR_3D) for row in (-scale * middle[None], np.full((1, 3), scale)))
    columns = [Values(rr.Transform3D.descriptor_translation(), place, [1])]
    return static_chunk("/scene", [*columns, Values(rr.Transform3D.descriptor_scale(), size, [1])])


def _same(item: Any, shown: Any, look: tuple[str, ...]) -> bool:
    for name in look:
        a, b = getattr(item, name), getattr(shown, name)
        if a is not b and not _equal(a, b):
            return False
    return True


def _equal(a: Any, b: Any) -> bool:
    if not isinstance(a, np.ndarray) or not isinstance(b, np.ndarray):
        return bool(a == b)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    # Most are equal in every bit, and that is found out quickly.
    if a.tobytes() == b.tobytes():
        return True
    return a.dtype.kind == "f" and bool(np.abs(a - b).max() <= NEAR * np.abs(b).max())
