"""A scene as a flat picture, SVG on white: for paper and for lists, made without a browser."""

from collections.abc import Iterator
from html import escape

import numpy as np

from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.app.stage.still_page import Still
from spherloc_viz.app.stage.views import Viewpoint, projected
from spherloc_viz.layers.primitives import Balls, Label, Mesh, Points, SceneItem, Segments

WIDTH, HEIGHT = 560.0, 350.0
MIN_DOT_PX, MAX_DOT_PX = 1.2, 12.0
LINE = 0.6
"""Width of lines relative to that on the screen, where the canvas is larger."""
LABEL_PX = 11.0
LETTER = 0.55
"""Average width of a letter as a share of the height of its line."""
NEAR_M = 1e-3
"""Shapes nearer to the viewer than this are left out."""
MAX_STACKED = 0.7
"""Largest opacity of balls that all lie over each other."""
OUTLINE_PX, OUTLINE_OPACITY = 0.5, 0.35
"""Outline of balls, which are paler the more there are."""
BEHIND_M = 1e6
"""Added to the distance of balls, their centres and the lines between these, so that they do not hide the camera."""

Shape = tuple[float, str]
"""Distance of a shape from the viewer, m, and its SVG."""


def svg(still: Still) -> str:
    """The picture, ``WIDTH`` by ``HEIGHT``; far shapes are drawn first. Textures of meshes are left out."""
    eye = _Eye(still)
    shapes = [
        (depth + BEHIND_M * (item.layer == "balls"), text) for item in still.items for depth, text in _shapes(item, eye)
    ]
    body = "".join(text for _, text in sorted(shapes, key=lambda shape: -shape[0]))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:g} {HEIGHT:g}">'
        f'<rect width="{WIDTH:g}" height="{HEIGHT:g}" fill="#fff"/>'
        f'<g font-family="sans-serif" font-size="{LABEL_PX:g}" text-anchor="middle">{body}</g></svg>'
    )


class _Eye:
    """The viewer's pose and the projection into the picture."""

    def __init__(self, still: Still) -> None:
        self.view = Viewpoint(still.position, still.target, still.field_of_view_rad)
        self._forward = (still.target - still.position) / np.linalg.norm(still.target - still.position)
        self._scale_px = 0.5 * HEIGHT / np.tan(0.5 * still.field_of_view_rad)

    def depths_m(self, positions: FloatArray) -> FloatArray:
        """Depths (N,) of positions (N, 3) along the line of sight, m."""
        return (positions - self.view.position) @ self._forward

    def pixels(self, positions: FloatArray) -> FloatArray:
        """Pixels (N, 2) of positions (N, 3), from the upper left corner."""
        return np.array([0.5 * WIDTH, 0.5 * HEIGHT]) + self._scale_px * projected(self.view, positions) * [1.0, -1.0]

    def sizes_px(self, sizes_m: FloatArray, depths_m: FloatArray) -> FloatArray:
        """Sizes (N,) in the picture, px, of lengths (N,) at depths (N,)."""
        return self._scale_px * sizes_m / np.maximum(depths_m, NEAR_M)


def _shapes(item: SceneItem, eye: _Eye) -> Iterator[Shape]:
    match item:
        case Points():
            depths = eye.depths_m(item.positions)
            radii = np.clip(eye.sizes_px(np.full(len(depths), item.radius_m), depths), MIN_DOT_PX, MAX_DOT_PX)
            yield from _discs(eye, item.positions, depths, radii, item.colors, 1.0)
        case Balls():
            depths = eye.depths_m(item.centers)
            radii = eye.sizes_px(item.radii_m, depths)
            opacity = min(item.opacity, 1.0 - (1.0 - MAX_STACKED) ** (1.0 / max(1, len(radii))))
            for depth, disc in _discs(eye, item.centers, depths, radii, item.colors, opacity):
                yield depth + BEHIND_M, disc
        case Segments():
            yield from _lines(eye, item)
        case Mesh():
            yield from _outline(eye, item)
        case Label():
            depth = float(eye.depths_m(item.position[None])[0])
            if depth > NEAR_M:
                ((x, y),) = eye.pixels(item.position[None])
                if 0 < x < WIDTH and 0 < y < HEIGHT:
                    half = min(0.5 * LETTER * LABEL_PX * len(item.text), 0.5 * WIDTH)
                    x = float(np.clip(x, half, WIDTH - half))
                    # Labels are drawn in front of everything.
                    look = 'fill="#222" stroke="#fff" stroke-width="3" paint-order="stroke"'
                    yield -depth, f'<text x="{x:.1f}" y="{y:.1f}" {look}>{escape(item.text)}</text>'


def _discs(
    eye: _Eye, positions: FloatArray, depths: FloatArray, radii: FloatArray, colors: np.ndarray, opacity: float
) -> Iterator[Shape]:
    faint = f' fill-opacity="{opacity:.2g}" stroke-opacity="{OUTLINE_OPACITY:g}"' if opacity < 1.0 else ""
    for (x, y), depth, radius, color in zip(eye.pixels(positions), depths, radii, colors, strict=True):
        if depth > NEAR_M and -radius < x < WIDTH + radius and -radius < y < HEIGHT + radius:
            fill = _css(color)
            line = f' stroke="{fill}" stroke-width="{OUTLINE_PX:g}"{faint}' if faint else ""
            yield float(depth), f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{fill}"{line}/>'


def _lines(eye: _Eye, item: Segments) -> Iterator[Shape]:
    ground = style.css(style.GROUND_ON_LIGHT) if item.layer == "ground" else None
    depths = eye.depths_m(item.points.reshape(-1, 3)).reshape(-1, 2)
    for ends, depth, color in zip(item.points, depths, item.colors, strict=True):
        if depth.max() <= NEAR_M:
            continue
        if depth.min() <= NEAR_M:  # cut off the part behind the viewer
            near, far = np.argsort(depth)
            share = (depth[far] - NEAR_M) / (depth[far] - depth[near])
            ends = np.stack([ends[far], ends[far] + share * (ends[near] - ends[far])])
        (x, y), (u, v) = np.clip(eye.pixels(ends), -1e5, 1e5)
        if max(x, u) < 0 or min(x, u) > WIDTH or max(y, v) < 0 or min(y, v) > HEIGHT:
            continue
        stroke = ground or _css(color)
        yield (
            float(depth.mean()),
            f'<path d="M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" stroke="{stroke}" stroke-width="{LINE * item.width_px:.2g}"/>',
        )


def _outline(eye: _Eye, item: Mesh) -> Iterator[Shape]:
    from scipy.spatial import ConvexHull, QhullError  # takes a quarter of a second

    depths = eye.depths_m(item.vertices)
    if not len(depths) or depths.min() <= NEAR_M:
        return
    pixels = eye.pixels(item.vertices)
    try:
        around = pixels[ConvexHull(pixels).vertices]
    except QhullError:  # seen from its edge
        return
    corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in around)
    fill = style.css(item.color)
    yield float(depths.max()), f'<polygon points="{corners}" fill="{fill}" fill-opacity="{0.5 * item.opacity:.2g}"/>'


def _css(color: np.ndarray) -> str:
    red, green, blue = map(int, color)
    return style.css((red, green, blue))
