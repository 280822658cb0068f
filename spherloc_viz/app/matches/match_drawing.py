"""Query and reference with their matches as HTML: photographs below, dots and lines as SVG above, and presses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.geometry import transform
from spherloc.trace import Trace
from spherloc.types import BoolArray, ByteArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.app.matches import match_drawing as drawing
from spherloc_viz.app.plots import shapes
from spherloc_viz.layers.frame import even, one_color
from spherloc_viz.layers.matches import MatchView, inlier_colored, valid_outlines

WIDTH, GAP = 1000.0, 14.0
"""Size of the drawing, in its own units; the page scales it."""
WIDE = 2.6
"""Largest sum of the aspect ratios of two images that are shown side by side; others stand one above the other."""
MAX_DOTS = 600
LINE_PX, RING = 1.2, 20.0
DOT_PX = ((500, 3.0), (200, 4.0), (0, 5.5))
"""Least number of dots, and their width in px."""
MAX_LABELS = 8
NAMES = ("query", "reference")


@dataclass(frozen=True)
class Place:
    """Position and size of an image in the drawing."""

    x: float
    y: float
    width: float
    height: float
    scale: float
    """Units of the drawing per pixel of the image."""

    def at(self, pixels: FloatArray) -> FloatArray:
        """Positions (N, 2) in the drawing of pixels (N, 2) of the image."""
        return self.scale * pixels + [self.x, self.y]


def arrange(sizes: Sequence[tuple[float, float]]) -> tuple[list[Place], float]:
    """Places of one or two images of these widths and heights, px, and the height of the drawing."""
    aspects = [width / height for width, height in sizes]
    if len(sizes) == 2 and sum(aspects) <= WIDE:
        height = (WIDTH - GAP) / sum(aspects)
        first = Place(0.0, 0.0, height * aspects[0], height, height / sizes[0][1])
        second = Place(first.width + GAP, 0.0, height * aspects[1], height, height / sizes[1][1])
        return [first, second], height
    places, y = list[Place](), 0.0
    for (width, _), aspect in zip(sizes, aspects, strict=True):
        places.append(Place(0.0, y, WIDTH, WIDTH / aspect, WIDTH / width))
        y += WIDTH / aspect + GAP
    return places, y - GAP


def backgrounds_html(uris: Sequence[str | None]) -> str:
    """The style classes of the photographs."""
    rules = "".join(
        f".match-{name}{{background-image:url({uri})}}"
        for name, uri in zip(NAMES, uris, strict=False)
        if uri is not None
    )
    return f"<style>{rules}</style>"


def frame_html(places: Sequence[Place], height: float, photos: Sequence[bool], parts: Sequence[str], label: str) -> str:
    """The drawing: photographs, or empty frames where there is none, and the SVG ``parts`` above them."""
    boxes = []
    for name, place, photo in zip(NAMES, places, photos, strict=False):
        look = "background-size:100% 100%;filter:brightness(.78)" if photo else "background:rgba(128,136,150,.13)"
        boxes.append(
            f'<div class="match-{name}" style="position:absolute;border-radius:3px;{look};'
            f"left:{place.x / WIDTH:.3%};top:{place.y / height:.3%};"
            f'width:{place.width / WIDTH:.3%};height:{place.height / height:.3%}"></div>'
        )
    touchable = "".join(
        shapes.rect(
            place.x, place.y, place.width, place.height, 'fill="transparent"' + shapes.touch(f"image-pick:{name}")
        )
        for name, place in zip(NAMES, places, strict=False)
    )
    return (
        f'<div style="position:relative;width:100%;aspect-ratio:{WIDTH:.0f}/{height:.1f}">{"".join(boxes)}'
        f'<svg viewBox="0 0 {WIDTH:.0f} {height:.1f}" role="img" aria-label="{escape(label)}" '
        f'style="position:absolute;inset:0;width:100%;height:100%">{"".join(parts)}{touchable}</svg></div>'
    )


def thinned(own: IntArray, inlier: BoolArray, chosen: IntArray) -> IntArray:
    """About ``MAX_DOTS`` of the matches ``own``, inliers last: even samples of inliers and of others, by the mask
    ``inlier`` (N,), half of each if there are enough, and all that are ``chosen``."""
    if len(own) <= MAX_DOTS:
        return np.concatenate([own[~inlier[own]], own[inlier[own]]])
    inliers, others = own[inlier[own]], own[~inlier[own]]
    take = min(len(inliers), max(MAX_DOTS // 2, MAX_DOTS - len(others)))
    return np.concatenate([even(others, MAX_DOTS - take), np.union1d(even(inliers, take), chosen)])


def dots(places: FloatArray, colors: ByteArray) -> list[str]:
    """Dots at positions (N, 2), one path per colour; the last colours lie on top."""
    width_px = next(width for least, width in DOT_PX if len(places) >= least)
    look = f'fill="none" stroke-linecap="round" stroke-width="{width_px}" vector-effect="non-scaling-stroke"'
    parts = []
    for color, own in _by_color(places, colors):
        flat = own.ravel().tolist()
        data = "M%.0f %.0fh0" * (len(flat) // 2) % tuple(flat)
        parts.append(f'<path d="{data}" stroke="{color}" {look}/>')
    return parts


def lines(starts: FloatArray, ends: FloatArray, colors: ByteArray, width_px: float, opacity: float) -> list[str]:
    """Straight lines between positions (N, 2), one path per colour."""
    look = f'fill="none" stroke-width="{width_px:g}" opacity="{opacity:g}" vector-effect="non-scaling-stroke"'
    parts = []
    for color, both in _by_color(np.column_stack([starts, ends]), colors):
        flat = both.ravel().tolist()
        data = "M%.0f %.0fL%.0f %.0f" * (len(flat) // 4) % tuple(flat)
        parts.append(f'<path d="{data}" stroke="{color}" {look}/>')
    return parts


def crosses(places: FloatArray, color: style.RGB, size: float, width_px: float) -> list[str]:
    """Diagonal crosses at positions (N, 2)."""
    known = places[np.isfinite(places).all(axis=1)]
    if not len(known):
        return []
    x, y = (known - size).T
    flat = np.column_stack([x, y, x, y + 2 * size]).ravel().tolist()
    step = f"l{2 * size:g} {2 * size:g}"
    data = f"M%.0f %.0f{step}M%.0f %.0fl{2 * size:g} {-2 * size:g}" * len(known) % tuple(flat)
    return [
        f'<path d="{data}" fill="none" stroke="{style.css(color)}" stroke-width="{width_px:g}" '
        'vector-effect="non-scaling-stroke"/>'
    ]


def rings(places: FloatArray, numbers: Sequence[int]) -> list[str]:
    """A ring around each place (N, 2) of a selected match and, unless they are many, its number beside it."""
    parts = []
    color = style.css(style.SELECTED)
    for (x, y), number in zip(places.tolist(), numbers, strict=True):
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        for paint, width_px in (("#ffffff", 4.5), (color, 2.5)):
            look = f'fill="none" stroke="{paint}" stroke-width="{width_px}" vector-effect="non-scaling-stroke"'
            parts.append(shapes.dot(x, y, RING, look))
        if len(numbers) <= MAX_LABELS:
            # ToldBeside the ring, on the side where there is more room, and within the drawing.
            left = x > 0.5 * WIDTH
            parts.append(
                f'<text x="{x + (-1.4 if left else 1.4) * RING:.0f}" y="{max(y + 15.0, 40.0):.0f}" font-size="42" '
                f'text-anchor="{"end" if left else "start"}" font-weight="600" fill="{color}" stroke="#ffffff" '
                f'stroke-width="3" paint-order="stroke">{number}</text>'
            )
    return parts


def _by_color(rows: FloatArray, colors: ByteArray) -> list[tuple[str, FloatArray]]:
    """Rows without NaN, grouped by colour, the most frequent colours first."""
    known = np.isfinite(rows).all(axis=1)
    rows, colors = rows[known], colors[known]
    packed = colors.astype(np.int64) @ [1 << 16, 1 << 8, 1]
    kinds, counts = np.unique(packed, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return [(f"#{color:06x}", rows[packed == color]) for color in kinds[order].tolist()]


MAX_RINGS = 100
REACH = 32.0
"""Largest distance of a press from the match that it selects, in units of the drawing: about 12 px."""


@dataclass(frozen=True, eq=False)
class Overlay:
    """Dots and lines above one or two images. K matches are shown."""

    places: list[Place]
    """Places of the images in the drawing."""
    parts: list[str]
    """Elements of the SVG."""
    caption: str
    """Sentences that say what is shown."""
    ends: list[FloatArray]
    """(K, 2) positions of the matches in the drawing, for each image."""
    numbers: IntArray
    """(K,) original numbers of the matches."""

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
    drawn = drawing.thinned(own, inlier, even(chosen, MAX_RINGS))
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
    parts += _selected_parts(even(chosen, MAX_RINGS), ends, predicted, kept)
    if len(chosen) > MAX_RINGS:
        caption += f" {MAX_RINGS} of {len(chosen):,} selected matches have rings."
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
    """Positions (N, 2) in the drawing of the points at the estimated pose; NaN if out of sight or across the seam."""
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
    """The border of the part of the image that the camera model sees."""
    parts = []
    for outline in valid_outlines(camera):
        flat = place.at(outline).ravel().tolist()
        data = "M" + ("%.0f %.0fL" * (len(flat) // 2) % tuple(flat))[:-1] + "Z"
        parts.append(f'<path d="{data}" fill="none" stroke="currentColor" opacity=".45" stroke-width="2"/>')
    return parts
