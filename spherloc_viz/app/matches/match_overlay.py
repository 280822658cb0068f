"""What is drawn above the images of a problem, and what a press there means."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.geometry import transform
from spherloc.trace import Trace
from spherloc.types import ByteArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.app.matches import match_drawing as drawing
from spherloc_viz.app.matches.match_drawing import Place
from spherloc_viz.layers.frame import even, one_color
from spherloc_viz.layers.match_view import MatchView, inlier_colored, valid_outlines

MOST_RINGS = 100
REACH = 32.0
"""How near to a match a press on an image must be, in units of the drawing: about 12 px."""


@dataclass(frozen=True, eq=False)
class Overlay:
    """Dots and lines above one or two images. K matches are shown."""

    places: list[Place]
    """Of the images."""
    parts: list[str]
    """SVG."""
    caption: str
    """What is seen, in sentences."""
    ends: list[FloatArray]
    """(K, 2) where the matches are in the drawing, for each image."""
    numbers: IntArray
    """(K,) their original numbers."""

    def nearest(self, image: str, x: float, y: float) -> int | None:
        """Original number of the match nearest to a press at these shares of an image; None if none is near."""
        if image not in drawing.NAMES[: len(self.ends)]:
            return None
        which = drawing.NAMES.index(image)
        place, ends = self.places[which], self.ends[which]
        at = np.array([place.x + x * place.width, place.y + y * place.height])
        distances: FloatArray = np.nan_to_num(np.linalg.norm(ends - at, axis=1), nan=np.inf)
        if not len(distances) or distances.min() > REACH:
            return None
        return int(self.numbers[np.argmin(distances)])


def overlay(
    trace: Trace,
    view: MatchView,
    colors: ByteArray,
    places: list[Place],
    selected: tuple[int, ...],
    kept: NDArray,
    photo: bool,
) -> Overlay:
    """The matches of a view in their colours (N, 3), the ``selected`` ones with rings and with the residual.

    ``kept`` (N,) are original numbers. Without a ``photo`` of the query all residuals are shown.
    """
    problem, own = trace.problem, view.own
    inlier = inlier_colored(colors)
    chosen = np.intersect1d(np.array(selected, dtype=np.int64), own)
    drawn = drawing.thinned(own, inlier, even(chosen, MOST_RINGS))
    ends = [places[0].at(problem.pixels)]
    if len(places) > 1 and problem.reference_pixels is not None:
        ends.append(places[1].at(problem.reference_pixels))
    parts: list[str] = [] if photo else [*_outlines(problem.camera, places[0])]
    if len(ends) > 1:
        parts += drawing.lines(ends[0][view.lines], ends[1][view.lines], colors[view.lines], drawing.LINE_PX, 0.7)
    predicted, caption = _predicted(trace, places[0], ends[0]), view.caption
    if not photo and predicted is not None and inlier.any():
        some = even(drawn, style.MAX_DRAWN_MATCHES)
        parts += drawing.lines(ends[0][some], predicted[some], colors[some], 1.0, 0.45)
        parts += drawing.crosses(predicted[drawn[inlier[drawn]]], style.ESTIMATE, 9.0, 1.3)
        caption += " Lines lead to where the estimated pose puts the points; crosses mark that for inliers."
        if len(some) < len(drawn):
            caption += f" {len(some)} of {len(drawn)} lines are drawn."
    for end in ends:
        parts += drawing.dots(end[drawn], colors[drawn])
    parts += _selected_parts(even(chosen, MOST_RINGS), ends, predicted, kept)
    if len(chosen) > MOST_RINGS:
        caption += f" {MOST_RINGS} of {len(chosen):,} selected matches have rings."
    if len(drawn) < len(own):
        caption += f" {len(drawn)} of {len(own):,} dots are drawn; every match can be pressed."
    return Overlay(places, parts, caption, [end[own] for end in ends], kept[own])


def _selected_parts(chosen: IntArray, ends: list[FloatArray], predicted: FloatArray | None, kept: NDArray) -> list[str]:
    color = one_color(style.SELECTED, len(chosen))
    parts: list[str] = []
    if len(ends) > 1:
        parts += drawing.lines(ends[0][chosen], ends[1][chosen], color, 2.5, 1.0)
    if predicted is not None:
        parts += drawing.lines(ends[0][chosen], predicted[chosen], one_color(style.ESTIMATE, len(chosen)), 2.0, 1.0)
        parts += drawing.crosses(predicted[chosen], style.ESTIMATE, 14.0, 2.5)
    for end in ends:
        parts += drawing.rings(end[chosen], kept[chosen].tolist())
    return parts


def _predicted(trace: Trace, place: Place, query: FloatArray) -> FloatArray | None:
    """Where (N, 2) in the drawing the estimated pose puts the points; NaN for out of sight and across a seam."""
    if trace.cam_from_map is None:
        return None
    pixels, valid = trace.problem.camera.project(transform(trace.cam_from_map, trace.problem.points))
    found = place.at(pixels)
    low, high = np.array([place.x, place.y]), np.array([place.x + place.width, place.y + place.height])
    with np.errstate(invalid="ignore"):
        near = np.abs(found[:, 0] - query[:, 0]) < 0.5 * place.width
        found[~(valid & near & (found >= low).all(axis=1) & (found <= high).all(axis=1))] = np.nan
    return found


@lru_cache(maxsize=16)
def _outlines(camera: Camera, place: Place) -> list[str]:
    """The border of what the camera sees."""
    parts = []
    for outline in valid_outlines(camera):
        flat = place.at(outline).ravel().tolist()
        data = "M" + ("%.0f %.0fL" * (len(flat) // 2) % tuple(flat))[:-1] + "Z"
        parts.append(f'<path d="{data}" fill="none" stroke="currentColor" opacity=".45" stroke-width="2"/>')
    return parts
