"""A small picture of a run for lists: the map from above, which matches agree, and where the camera is and was."""

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import camera_centre
from spherloc.problem import AlignedProblem
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz import style

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
