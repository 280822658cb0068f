"""Finds the circle that a fisheye's image fills; outside it there is no light."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from spherloc.images import grey
from spherloc.types import BoolArray, ByteArray, FloatArray

BLACK = 16
"""Largest grey value of what no light has reached, after JPEG compression."""
MIN_DARK_CORNERS = 3
"""Least number of dark corners of an image with a circle."""
RAYS, SAMPLES = 720, 300
MARGIN_PX = 3
"""The rim is not where a ray from the middle leaves the image, nor so close to it."""
BOUND_PX = 2.0
MIN_ON_CIRCLE = 0.5
"""Least share of the rim that is on the circle."""


@dataclass(frozen=True)
class Circle:
    """A circle in an image, px."""

    x: float
    y: float
    radius: float


def image_circle(images: Iterable[ByteArray]) -> Circle | None:
    """The circle that images (H, W) or (H, W, 3) of one size fill, or None if three corners are not dark in all."""
    brightest: ByteArray | None = None
    for image in images:
        plain = grey(image)
        brightest = plain if brightest is None else np.maximum(brightest, plain)
    if brightest is None:
        return None
    lit = np.asarray(cv2.medianBlur(brightest, 5)) > BLACK
    side = max(2, min(lit.shape) // 20)
    corners = [lit[:side, :side], lit[:side, -side:], lit[-side:, :side], lit[-side:, -side:]]
    if sum(bool(corner.mean() < 0.1) for corner in corners) < MIN_DARK_CORNERS or not lit.any():
        return None
    return _through(_rim(lit))


def _rim(lit: BoolArray) -> FloatArray:
    """Pixels (K, 2) where rays from the middle of the lit pixels leave them, but for those that leave the image."""
    height, width = lit.shape
    rows, columns = np.nonzero(lit)
    middle = np.array([np.median(columns), np.median(rows)])
    steps = np.arange(max(height, width))[:, None]
    found = []
    for angle in np.linspace(0.0, 2.0 * np.pi, RAYS, endpoint=False):
        way = np.array([np.cos(angle), np.sin(angle)])
        places = (middle + steps * way).astype(int)
        places = places[np.all((places >= 0) & (places < (width, height)), axis=1)]
        last = np.flatnonzero(lit[places[:, 1], places[:, 0]])
        if len(last) and last[-1] < len(places) - MARGIN_PX:
            found.append(middle + last[-1] * way)
    return np.array(found).reshape(-1, 2)


def _through(points: FloatArray) -> Circle | None:
    """The circle through most of the points (K, 2), pixel indices; None if fewer than half are on one."""
    if len(points) < RAYS // 20:
        return None
    rng = np.random.default_rng(0)
    best = np.zeros(len(points), dtype=bool)
    for _ in range(SAMPLES):
        x, y, radius = _fitted(points[rng.choice(len(points), 3, replace=False)])
        near = np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius) < BOUND_PX
        best = near if near.sum() > best.sum() else best
    if best.mean() < MIN_ON_CIRCLE:
        return None
    x, y, radius = _fitted(points[best])
    return Circle(x + 0.5, y + 0.5, radius)


def _fitted(points: FloatArray) -> tuple[float, float, float]:
    """Centre and radius of the circle that fits points (K, 2) best: x^2 + y^2 = 2 a x + 2 b y + c."""
    rows = np.column_stack([2.0 * points, np.ones(len(points))])
    (a, b, c), *_ = np.linalg.lstsq(rows, np.sum(points**2, axis=1), rcond=None)
    return float(a), float(b), float(np.sqrt(max(a * a + b * b + c, 0.0)))
