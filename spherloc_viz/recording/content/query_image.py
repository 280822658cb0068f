"""The query image of a recording, or the empty image plane, with the keypoints of all matches on it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from spherloc.errors import show
from spherloc.problem import Problem
from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers.match_view import valid_outlines
from spherloc_viz.layers.photograph import Photograph, photograph, shrunk
from spherloc_viz.recording.content.columns import (
    STRIP_2D,
    Values,
    encoded_image,
    numbers,
    packed,
    static_chunk,
    strips,
)
from spherloc_viz.recording.content.properties import QUERY_IMAGE

MATCHES = "/query/matches"
"""Keypoints of all matches, in the colours of the step."""
FRAME = "/query/frame"
"""Outline of the image, and of what the camera sees of it."""
LONGEST_PX = 960
"""Longest side of the recorded image."""
MOST_BYTES = 400_000
"""Of the recorded image: with more, it is pressed harder."""
QUALITIES = (80, 60, 40, 20)
DOT_PX = 2.5
FRAME_PX = 1.0
MARGIN = 0.03
"""Around the image, as a share of its width."""


@dataclass(frozen=True, eq=False)
class QueryImage:
    """What is recorded of a query image."""

    jpeg: bytes
    """Empty if there is no image, or it cannot be read."""
    scale: float
    """Its pixels by those of the problem."""
    remark: str
    """Why there is none; empty if there is, or if the problem has none."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Dots on the image, a primitive of recordings."""

    pixels: FloatArray
    """(N, 2) in the recorded image."""
    colors: ByteArray
    """(N, 3)."""


def query_image(problem: Problem) -> QueryImage:
    """The image of a problem as it is recorded."""
    if problem.image is None:
        return QueryImage(b"", 1.0, "")
    photo = photograph(problem.image)
    if photo is None:
        return QueryImage(b"", 1.0, f"The query image {show(problem.image.name)} cannot be read any more.")
    known = _pressed(photo)
    if known is None:
        return QueryImage(b"", 1.0, f"The query image {show(problem.image.name)} is too large to be recorded.")
    return known


@lru_cache(maxsize=8)
def _pressed(photo: Photograph) -> QueryImage | None:
    """A photograph as it is recorded; kept, since most runs are of the same few images."""
    small = shrunk(photo.image, LONGEST_PX / max(photo.image.shape[:2]))
    scale = photo.scale * small.shape[1] / photo.image.shape[1]
    image = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    for quality in QUALITIES:
        done, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if done and len(content) <= MOST_BYTES:
            return QueryImage(content.tobytes(), scale, "")
    return None


def image_chunks(problem: Problem, image: QueryImage) -> Iterator[Chunk]:
    """The image, and outlines where there is none."""
    if image.jpeg:
        yield static_chunk(QUERY_IMAGE, encoded_image(image.jpeg, "image/jpeg"))
    width, height = image.scale * problem.camera.width, image.scale * problem.camera.height
    border = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], np.float64)
    # Lines of no length, so that the view leaves a margin around the image.
    corners = [np.array([corner, corner]) for corner in (border[0] - MARGIN * width, border[2] + MARGIN * width)]
    outlines = [border, *corners]
    if not image.jpeg:
        outlines += [image.scale * np.vstack([outline, outline[:1]]) for outline in valid_outlines(problem.camera)]
    yield static_chunk(
        FRAME,
        [
            Values(rr.LineStrips2D.descriptor_strips(), strips(outlines, STRIP_2D), [len(outlines)]),
            Values(rr.LineStrips2D.descriptor_colors(), pa.array(packed(np.array([style.UNDECIDED]))), [1]),
            Values(rr.LineStrips2D.descriptor_radii(), numbers([-FRAME_PX / 2]), [1]),
        ],
    )
