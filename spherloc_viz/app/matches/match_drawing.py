"""Query and reference with their matches as HTML: photographs below, dots and lines as SVG above them.

The photographs are the backgrounds of two style classes, which are sent once; the drawing above them is sent anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from spherloc.types import BoolArray, ByteArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.app.plots import shapes
from spherloc_viz.layers.frame import even

WIDTH, GAP = 1000.0, 14.0
"""Of the drawing, in its own units; the page scales it."""
WIDE = 2.6
"""Up to this sum of widths over heights, two images stand side by side."""
MOST_DOTS = 600
LINE_PX, RING = 1.2, 20.0
DOT_PX = ((500, 3.0), (200, 4.0), (0, 5.5))
"""From this many dots on: their width."""
MOST_LABELS = 8
NAMES = ("query", "reference")


@dataclass(frozen=True)
class Place:
    """Where an image stands in the drawing."""

    x: float
    y: float
    width: float
    height: float
    scale: float
    """Units of the drawing by a pixel of the image."""

    def at(self, pixels: FloatArray) -> FloatArray:
        """Pixels (N, 2) of the image in the drawing."""
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
    """About ``MOST_DOTS`` of the matches ``own``, inliers last: an even sample of the inliers among all (N,), half if
    others fill the rest, one of the others, and all that are ``chosen``."""
    if len(own) <= MOST_DOTS:
        return np.concatenate([own[~inlier[own]], own[inlier[own]]])
    inliers, others = own[inlier[own]], own[~inlier[own]]
    take = min(len(inliers), max(MOST_DOTS // 2, MOST_DOTS - len(others)))
    return np.concatenate([even(others, MOST_DOTS - take), np.union1d(even(inliers, take), chosen)])


def dots(places: FloatArray, colors: ByteArray) -> list[str]:
    """Dots (N, 2), one path a colour; the last colours lie on top."""
    width_px = next(width for least, width in DOT_PX if len(places) >= least)
    look = f'fill="none" stroke-linecap="round" stroke-width="{width_px}" vector-effect="non-scaling-stroke"'
    parts = []
    for color, own in _by_color(places, colors):
        flat = own.ravel().tolist()
        data = "M%.0f %.0fh0" * (len(flat) // 2) % tuple(flat)
        parts.append(f'<path d="{data}" stroke="{color}" {look}/>')
    return parts


def lines(starts: FloatArray, ends: FloatArray, colors: ByteArray, width_px: float, opacity: float) -> list[str]:
    """Straight lines between places (N, 2), one path a colour."""
    look = f'fill="none" stroke-width="{width_px:g}" opacity="{opacity:g}" vector-effect="non-scaling-stroke"'
    parts = []
    for color, both in _by_color(np.column_stack([starts, ends]), colors):
        flat = both.ravel().tolist()
        data = "M%.0f %.0fL%.0f %.0f" * (len(flat) // 4) % tuple(flat)
        parts.append(f'<path d="{data}" stroke="{color}" {look}/>')
    return parts


def crosses(places: FloatArray, color: style.RGB, size: float, width_px: float) -> list[str]:
    """Diagonal crosses (N, 2)."""
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
        if len(numbers) <= MOST_LABELS:
            # Beside the ring, on the side where there is more room, and within the drawing.
            left = x > 0.5 * WIDTH
            parts.append(
                f'<text x="{x + (-1.4 if left else 1.4) * RING:.0f}" y="{max(y + 11.0, 30.0):.0f}" font-size="32" '
                f'text-anchor="{"end" if left else "start"}" font-weight="600" fill="{color}" stroke="#ffffff" '
                f'stroke-width="3" paint-order="stroke">{number}</text>'
            )
    return parts


def _by_color(rows: FloatArray, colors: ByteArray) -> list[tuple[str, FloatArray]]:
    """Rows without gaps in their numbers, by colour, the most frequent colours first."""
    known = np.isfinite(rows).all(axis=1)
    rows, colors = rows[known], colors[known]
    packed = colors.astype(np.int64) @ [1 << 16, 1 << 8, 1]
    kinds, counts = np.unique(packed, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return [(f"#{color:06x}", rows[packed == color]) for color in kinds[order].tolist()]
