"""How primitives, the query image and small pictures of runs are written: the components of each, as rerun has them."""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import accumulate
from typing import Any

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
from spherloc_viz.layers.primitives import Balls, Chart, Curve, Mesh, Points, Segments, Step, Table
from spherloc_viz.layers.query_image import Photograph, photograph, shrunk
from spherloc_viz.recording.content.columns import (
    MARKDOWN,
    STRIP_2D,
    STRIP_3D,
    TRIANGLE,
    VECTOR_2D,
    VECTOR_3D,
    Values,
    encoded_image,
    numbers,
    packed,
    segments,
    static_chunk,
    strips,
    vectors,
)
from spherloc_viz.recording.content.names import QUERY_IMAGE
from spherloc_viz.recording.content.texts import legible, step_text, table_text

MATCHES = "/query/matches"
"""Keypoints of all matches, in the colours of the step."""
FRAME = "/query/frame"
"""Outline of the image, and of what the camera sees of it."""
LONGEST_PX = 960
"""Longest side of the recorded image."""
MAX_BYTES = 400_000
"""Largest recorded image; a larger one is compressed more."""
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
    """(N, 2) pixels in the recorded image."""
    colors: ByteArray
    """(N, 3) colours, sRGB."""


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
        if done and len(content) <= MAX_BYTES:
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
MAX_DOTS = 160
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
    dots = _thumbnail_pixels(flat, *window)
    shown = np.linspace(0, len(dots) - 1, min(MAX_DOTS, len(dots))).round().astype(int)
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


def _thumbnail_pixels(flat: FloatArray, middle: FloatArray, scale: float) -> NDArray[np.int64]:
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
    place = _thumbnail_pixels(camera_centre(pose)[None, [0, 2]], *window)[0]
    ahead = np.array([pose[2, 0], -pose[2, 2]])
    ahead = CAMERA_PX * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    aside = 0.6 * np.array([-ahead[1], ahead[0]])
    corners = np.round([place, place + ahead + aside, place + ahead - aside]).astype(np.int32)
    cv2.polylines(image, [corners], True, color, 1, cv2.LINE_AA)
    cv2.circle(image, tuple(place.tolist()), 2, color, -1)


MARKER_SHARE = 0.003
"""Width of a marker's bar, as a share of the chart."""
LEVEL_OPACITY = 0.25
"""Opacity of the bar that stands for a level: the bars behind it stay visible."""
LINE_SHARE = 0.8
"""Width of the bar of a line's sample, as a share of the least distance between samples."""


@dataclass(frozen=True, eq=False)
class Bars:
    """A curve as K bars."""

    left: NDArray[np.float64]
    """(K,) left edges."""
    heights: NDArray[np.float64]
    """(K,) heights."""
    widths: NDArray[np.float64]
    """(K,) widths."""
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


# Without it, a value that rerun cannot convert is dropped with a warning and the recording lacks it.
rr.set_strict_mode(True)

Rows = list[Any]
"""One primitive per row, or None where it is absent and the row clears it."""
WORDS = int(packed(np.array([style.SCALE]))[0])
"""Colour of words in the scene, which reads on dark and on light."""
SOLID: int = rr.components.FillMode.Solid.value


@dataclass(frozen=True, eq=False)
class Words:
    """All labels of a picture, a primitive of recordings: an entity for each would cost more than the words do."""

    texts: tuple[str, ...]
    """K words."""
    positions: FloatArray
    """(K, 3) of their middles."""


@dataclass(frozen=True)
class Part:
    """Components of a primitive that are written together."""

    look: tuple[str, ...]
    """Fields of the primitive that they show."""
    encode: Callable[[Rows], list[Values]]


def _joined(rows: Rows, name: str, shape: tuple[int, ...]) -> tuple[NDArray[Any], list[int]]:
    """The arrays called ``name`` of all rows as one, and how many entries each row has."""
    arrays = [np.zeros((0, *shape)) if row is None else getattr(row, name) for row in rows]
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays), [len(array) for array in arrays]


def _rgba(colors: NDArray[np.uint8], opacity: float) -> NDArray[np.uint32]:
    # rerun repeats a single colour over all instances of the row.
    same = colors.tobytes() == len(colors) * colors[:1].tobytes()
    return packed(colors[:1] if same else colors, opacity)


def _colors(rows: Rows, descriptor: rr.ComponentDescriptor) -> Values:
    none = np.zeros(0, np.uint32)
    each = [none if row is None else _rgba(row.colors, getattr(row, "opacity", 1.0)) for row in rows]
    return Values(descriptor, pa.array(np.concatenate(each)), [len(row) for row in each])


def _single(rows: Rows, descriptor: rr.ComponentDescriptor, kind: pa.DataType, value: Callable[[Any], Any]) -> Values:
    """A column with one value in every row that shows something."""
    present = [value(row) for row in rows if row is not None]
    return Values(descriptor, pa.array(present, kind), [row is not None for row in rows])


def _one_color(rows: Rows, descriptor: rr.ComponentDescriptor) -> Values:
    """A column with the colour of every row that shows something."""
    shown = [row for row in rows if row is not None]
    each = [packed(np.array([row.color]), getattr(row, "opacity", 1.0)) for row in shown]
    return Values(descriptor, pa.array(np.concatenate(each)), [row is not None for row in rows])


def _positions(rows: Rows) -> list[Values]:
    positions, lengths = _joined(rows, "positions", (3,))
    return [Values(rr.Points3D.descriptor_positions(), vectors(positions, VECTOR_3D), lengths)]


def _point_radius(rows: Rows) -> list[Values]:
    return [_single(rows, rr.Points3D.descriptor_radii(), pa.float32(), lambda row: row.radius_m)]


def _ids(rows: Rows) -> list[Values]:
    if not any(row is not None and row.ids is not None for row in rows):
        return []
    ids = [np.zeros(0, np.int64) if row is None or row.ids is None else row.ids for row in rows]
    batch = numbers(np.concatenate(ids), np.int64)
    return [Values(rr.ComponentDescriptor("correspondence"), batch, [len(row) for row in ids])]


def _pixels(rows: Rows) -> list[Values]:
    pixels, lengths = _joined(rows, "pixels", (2,))
    radii = _single(rows, rr.Points2D.descriptor_radii(), pa.float32(), lambda row: -DOT_PX)
    return [Values(rr.Points2D.descriptor_positions(), vectors(pixels, VECTOR_2D), lengths), radii]


def _strips(rows: Rows) -> list[Values]:
    points, lengths = _joined(rows, "points", (2, 3))
    return [Values(rr.LineStrips3D.descriptor_strips(), segments(points, STRIP_3D), lengths)]


def _strip_radius(rows: Rows) -> list[Values]:
    # rerun reads a negative radius as points on the screen.
    return [_single(rows, rr.LineStrips3D.descriptor_radii(), pa.float32(), lambda row: -row.width_px / 2)]


def _balls(rows: Rows) -> list[Values]:
    centers, lengths = _joined(rows, "centers", (3,))
    radii, _ = _joined(rows, "radii_m", ())
    sizes = vectors(np.repeat(radii[:, None], 3, axis=1), VECTOR_3D)
    return [
        Values(rr.Ellipsoids3D.descriptor_half_sizes(), sizes, lengths),
        Values(rr.Ellipsoids3D.descriptor_centers(), vectors(centers, VECTOR_3D), lengths),
        _single(rows, rr.Ellipsoids3D.descriptor_fill_mode(), pa.uint8(), lambda row: SOLID),
    ]


def _vertices(rows: Rows) -> list[Values]:
    vertices, counts = _joined(rows, "vertices", (3,))
    return [Values(rr.Mesh3D.descriptor_vertex_positions(), vectors(vertices, VECTOR_3D), counts)]


def _faces(rows: Rows) -> list[Values]:
    faces, counts = _joined(rows, "faces", (3,))
    return [Values(rr.Mesh3D.descriptor_triangle_indices(), vectors(faces, TRIANGLE), counts)]


def _heights(rows: Rows) -> list[Values]:
    heights = tensors([row.heights for row in rows if row is not None])
    return [Values(rr.BarChart.descriptor_values(), heights, [row is not None for row in rows])]


def _abscissa(rows: Rows) -> list[Values]:
    left = tensors([row.left for row in rows if row is not None])
    widths, counts = _joined(rows, "widths", ())
    return [
        Values(rr.BarChart.descriptor_abscissa(), left, [row is not None for row in rows]),
        Values(rr.BarChart.descriptor_widths(), numbers(widths), counts),
    ]


def _words(rows: Rows) -> list[Values]:
    texts = [legible(text) for row in rows if row is not None for text in row.texts]
    positions = _positions(rows)
    return [
        *positions,
        Values(rr.Points3D.descriptor_labels(), pa.array(texts, pa.utf8()), positions[0].lengths),
        # Without a colour, rerun makes one up.
        _single(rows, rr.Points3D.descriptor_colors(), pa.uint32(), lambda row: WORDS),
        # The word is what is shown, not the dot that rerun hangs it on.
        _single(rows, rr.Points3D.descriptor_radii(), pa.float32(), lambda row: 0.0),
    ]


def _text(write: Callable[[Any], str]) -> Callable[[Rows], list[Values]]:
    """Encoder of a primitive that ``write`` turns into Markdown."""
    return lambda rows: [_single(rows, rr.TextDocument.descriptor_text(), pa.utf8(), write)]


def _media(rows: Rows) -> list[Values]:
    return [_single(rows, rr.TextDocument.descriptor_media_type(), pa.utf8(), lambda row: MARKDOWN)]


def _colored(descriptor: rr.ComponentDescriptor) -> Callable[[Rows], list[Values]]:
    return lambda rows: [_colors(rows, descriptor)]


def _plain(descriptor: rr.ComponentDescriptor) -> Callable[[Rows], list[Values]]:
    return lambda rows: [_one_color(rows, descriptor)]


PARTS: dict[type, tuple[Part, ...]] = {
    Points: (
        Part(("positions",), _positions),
        Part(("colors",), _colored(rr.Points3D.descriptor_colors())),
        Part(("radius_m",), _point_radius),
        Part(("ids",), _ids),
    ),
    Keypoints: (
        Part(("pixels",), _pixels),
        Part(("colors",), _colored(rr.Points2D.descriptor_colors())),
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
        Part(("color", "opacity"), _plain(rr.Mesh3D.descriptor_albedo_factor())),
    ),
    Words: (Part(("positions", "texts"), _words),),
    Bars: (
        Part(("heights",), _heights),
        Part(("left", "widths"), _abscissa),
        Part(("color", "opacity"), _plain(rr.BarChart.descriptor_color())),
    ),
    Step: (Part(("title", "caption", "equation", "note"), _text(step_text)), Part((), _media)),
    Table: (Part(("name", "columns", "rows"), _text(table_text)), Part((), _media)),
}
