"""Pictures in a recording: the query image with its keypoints, and a small picture of the run for lists."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from spherloc.errors import show
from spherloc.geometry import camera_centre
from spherloc.problem import AlignedProblem, Problem
from spherloc.trace import Trace
from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers.matches import valid_outlines
from spherloc_viz.layers.query_image import Photograph, photograph, shrunk
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


WIDTH_PX, HEIGHT_PX = 96, 64
MARGIN_PX = 9.0
BACKGROUND = (30, 33, 39)
MOST_DOTS = 160
"""More matches are thinned evenly: a PNG of single dots grows with them."""
SQUARE = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
"""Pixels of a dot."""
CAMERA_PX = 7.0
COMPRESSION = 3
OUTSIDE_SHARE = 0.04
"""Share of the map points on every side that do not set the scale; some may lie far away."""


def thumbnail(trace: Trace) -> bytes:
    """A PNG of 96 x 64 pixels, about 2 kB. Forward (+z of the aligned map) is up, +x is right."""
    aligned, problem = trace.problem.aligned, trace.problem
    flat: FloatArray = (problem.points @ aligned.map_turn.T)[:, [0, 2]]
    cameras = [(pose, color) for pose, color in _cameras(trace) if pose is not None]
    window = _window(flat, [camera_centre(aligned.align_pose(pose))[[0, 2]] for pose, _ in cameras])
    image = np.empty((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    image[:] = BACKGROUND
    dots = _pixels(flat, *window)
    shown = np.linspace(0, len(dots) - 1, min(MOST_DOTS, len(dots))).round().astype(int)
    agrees = trace.inlier_mask[shown]
    # Those that agree lie on top.
    for mask, color in ((~agrees, style.OUTLIER), (agrees, style.INLIER)):
        squares = (dots[shown[mask], None, :] + SQUARE).reshape(-1, 2)
        x, y = squares[((squares >= 0) & (squares < (WIDTH_PX, HEIGHT_PX))).all(axis=1)].T
        image[y, x] = color
    for pose, color in cameras:
        _draw_camera(image, aligned, pose, window, color)
    done, png = cv2.imencode(".png", image[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION])
    return png.tobytes() if done else b""


def _cameras(trace: Trace) -> list[tuple[FloatArray | None, style.RGB]]:
    return [(trace.problem.truth_cam_from_map, style.TRUTH), (trace.cam_from_map, style.ESTIMATE)]


def _window(flat: FloatArray, cameras: list[FloatArray]) -> tuple[FloatArray, float]:
    """The middle (2,) of what is seen and its scale in pixels a metre: most points, and cameras not absurdly far."""
    ordered, aside = np.sort(flat, axis=0), int(OUTSIDE_SHARE * len(flat))
    low, high = ordered[aside], ordered[-1 - aside]
    room = float(np.max(high - low))
    near = [np.clip(place, low - room, high + room) for place in cameras]
    low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
    size = np.array([WIDTH_PX, HEIGHT_PX]) - 2.0 * MARGIN_PX
    return 0.5 * (low + high), 1.0 / max(float(np.max((high - low) / size)), 1e-9)


def _pixels(flat: FloatArray, middle: FloatArray, scale: float) -> NDArray[np.int64]:
    """Pixels (K, 2) of places (K, 2) x, z of the aligned map."""
    away = np.clip((flat - middle) * scale, -10.0 * WIDTH_PX, 10.0 * WIDTH_PX) * np.array([1.0, -1.0])
    return np.round(away + 0.5 * np.array([WIDTH_PX, HEIGHT_PX])).astype(np.int64)


def _draw_camera(
    image: NDArray[np.uint8],
    aligned: AlignedProblem,
    cam_from_map: FloatArray,
    window: tuple[FloatArray, float],
    color: style.RGB,
) -> None:
    """A wedge that opens where the camera looks."""
    pose = aligned.align_pose(cam_from_map)
    place = _pixels(camera_centre(pose)[None, [0, 2]], *window)[0]
    ahead = np.array([pose[2, 0], -pose[2, 2]])
    ahead = CAMERA_PX * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    aside = 0.6 * np.array([-ahead[1], ahead[0]])
    corners = np.round([place, place + ahead + aside, place + ahead - aside]).astype(np.int32)
    cv2.polylines(image, [corners], True, color, 1, cv2.LINE_AA)
    cv2.circle(image, tuple(place.tolist()), 2, color, -1)
