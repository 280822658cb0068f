"""Brushes for procedural textures. A canvas is (H, W, 3), RGB from 0 to 1; all that is random comes from ``rng``."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Canvas = NDArray[np.floating[Any]]
Colour = Sequence[float] | NDArray[np.floating[Any]]


def noise(rng: np.random.Generator, height: int, width: int, cells: int, octaves: int = 4) -> Canvas:
    """Smooth noise (H, W), mean about 0 and values mostly in [-1, 1], that repeats seamlessly in both directions."""
    total = np.zeros((height, width), dtype=np.float32)
    weight = 1.0
    for octave in range(octaves):
        rows, columns = (max(1, min(size, (cells << octave) * size // max(height, width))) for size in (height, width))
        grid = rng.uniform(-1, 1, (rows, columns)).astype(np.float32)
        around = np.pad(grid, 2, mode="wrap")
        x = (np.arange(width, dtype=np.float32) + 0.5) * columns / width + 1.5
        y = (np.arange(height, dtype=np.float32) + 0.5) * rows / height + 1.5
        total += weight * cv2.remap(around, *np.meshgrid(x, y), cv2.INTER_LINEAR)
        weight *= 0.55
    return total


def plain(height: int, width: int, colour: Colour) -> Canvas:
    """One colour."""
    return np.full((height, width, 3), colour, dtype=np.float32)


def mottle(
    canvas: Canvas, rng: np.random.Generator, cells: int = 8, strength: float = 0.06, octaves: int = 5
) -> Canvas:
    """The canvas with uneven brightness, as weather and wear leave it."""
    height, width = canvas.shape[:2]
    return canvas * (1 + strength * noise(rng, height, width, cells, octaves)[..., None])


def rectangle(canvas: Canvas, box: Sequence[float], colour: Colour) -> None:
    """Fill (left, top, right, bottom), each a share of the canvas."""
    left, top, right, bottom = _pixels(canvas, box)
    canvas[top:bottom, left:right] = colour


def frame(canvas: Canvas, box: Sequence[float], colour: Colour, thickness: float) -> None:
    """A frame inside (left, top, right, bottom); ``thickness`` is a share of the canvas's width."""
    left, top, right, bottom = box
    upright = thickness * canvas.shape[1] / canvas.shape[0]
    rectangle(canvas, (left, top, right, top + upright), colour)
    rectangle(canvas, (left, bottom - upright, right, bottom), colour)
    rectangle(canvas, (left, top, left + thickness, bottom), colour)
    rectangle(canvas, (right - thickness, top, right, bottom), colour)


def bricks(
    rng: np.random.Generator, size: tuple[int, int], grid: tuple[int, int], colour: Colour, joint: Colour
) -> Canvas:
    """A wall of (rows, columns) staggered bricks; it repeats seamlessly where the number of rows is even."""
    (height, width), (rows, columns) = size, grid
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    row = (y * rows / height).astype(int)
    along = x * columns / width + 0.5 * (row % 2)
    column = along.astype(int) % columns
    shade = rng.normal(1, 0.11, (rows, columns, 1)) * rng.normal(1, 0.025, (rows, columns, 3))
    canvas = (np.asarray(colour) * shade[row, column]).astype(np.float32)
    gap_y = (y * rows / height) % 1 < 1.15 * rows / height
    gap_x = along % 1 < 1.15 * columns / width
    canvas[gap_y | gap_x] = joint
    return mottle(canvas, rng, 40, 0.06, 2)


def text(canvas: Canvas, words: str, box: Sequence[float], colour: Colour, bold: int = 2) -> None:
    """Words in capitals that fill the width of (left, top, right, bottom), as far as its height allows."""
    left, top, right, bottom = _pixels(canvas, box)
    (wide, high), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 1.0, bold)
    scale = min((right - left) / wide, 0.75 * (bottom - top) / high)
    origin = (int((left + right - wide * scale) / 2), int((top + bottom + high * scale) / 2))
    ink = np.zeros(canvas.shape[:2], np.uint8)
    cv2.putText(ink, words, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, (255,), bold, cv2.LINE_AA)
    cover = (ink.astype(np.float32) / 255)[..., None]
    canvas += cover * (np.asarray(colour, np.float32) - canvas)


def poster(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """A picture of bright shapes and lines, unlike any other: what a wall needs to be recognized."""
    canvas = plain(height, width, rng.uniform(0.15, 0.95, 3))
    canvas += 0.25 * noise(rng, height, width, 4, 3)[..., None] * rng.uniform(-1, 1, 3).astype(np.float32)
    canvas = to_bytes(canvas)
    for _ in range(int(rng.integers(7, 14))):
        colour = rng.uniform(5, 255, 3).tolist()
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        size = int(rng.integers(height // 14, height // 3))
        match rng.integers(0, 4):
            case 0:
                cv2.circle(canvas, (x, y), size // 2, colour, -1, cv2.LINE_AA)
            case 1:
                cv2.rectangle(canvas, (x, y), (x + size, y + size // 2), colour, -1)
            case 2:
                corners = np.array([x, y]) + rng.integers(-size, size, (3, 2))
                cv2.fillPoly(canvas, [corners.astype(np.int32)], colour, cv2.LINE_AA)
            case _:
                end = (int(rng.integers(0, width)), int(rng.integers(0, height)))
                cv2.line(canvas, (x, y), end, colour, max(2, size // 10), cv2.LINE_AA)
    return mottle(from_bytes(canvas), rng, 32, 0.05, 2)


def to_bytes(canvas: Canvas) -> NDArray[np.uint8]:
    """For OpenCV, which draws smooth edges on bytes alone."""
    return np.round(255 * np.clip(canvas, 0, 1)).astype(np.uint8)


def from_bytes(picture: NDArray[np.uint8]) -> Canvas:
    """A canvas again."""
    return picture.astype(np.float32) / 255


def finish(canvas: Canvas, glow: Canvas | None = None) -> NDArray[np.uint8]:
    """(H, W, 4) bytes of a canvas; the fourth channel says which part shines when a lamp is lit behind it."""
    light = np.zeros(canvas.shape[:2], np.float32) if glow is None else glow
    return to_bytes(np.dstack([canvas, light]))


def _pixels(canvas: Canvas, box: Sequence[float]) -> tuple[int, int, int, int]:
    height, width = canvas.shape[:2]
    left, top, right, bottom = box
    return round(left * width), round(top * height), round(right * width), round(bottom * height)
