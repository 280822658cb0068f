"""Textures of cars, people and boxes."""

import numpy as np

from spherloc.worlds import paint
from spherloc.worlds.outdoor_tiles import Tiles
from spherloc.worlds.paint import Canvas


def occluder_tiles(rng: np.random.Generator) -> Tiles:
    """Paint is white where a tint is to give the colour."""
    cardboard = paint.mottle(paint.plain(128, 128, (0.66, 0.49, 0.31)), rng, 12, 0.06)
    paint.rectangle(cardboard, (0.42, 0, 0.58, 1), (0.80, 0.70, 0.48))
    paint.text(cardboard, "FRAGILE", (0.06, 0.62, 0.94, 0.86), (0.55, 0.12, 0.10), 2)
    tiles: Tiles = {
        "skin": ("person", paint.finish(paint.mottle(paint.plain(32, 32, (0.95, 0.92, 0.9)), rng, 4))),
        "trousers": ("person", paint.finish(paint.mottle(paint.plain(64, 32, (0.16, 0.19, 0.28)), rng, 12, 0.3))),
        "cardboard": ("box", paint.finish(cardboard)),
    }
    for number in range(2):
        shirt = paint.mottle(paint.plain(64, 64, (0.85, 0.85, 0.85)), rng, 12, 0.15)
        for stripe in range(8 * number):
            paint.rectangle(shirt, (0, stripe / 8, 1, stripe / 8 + 0.05), (0.25, 0.25, 0.3))
        tiles[f"shirt_{number}"] = ("person", paint.finish(shirt))
    return tiles | _car_tiles(rng)


def _car_tiles(rng: np.random.Generator) -> Tiles:
    flank = paint.plain(64, 256, (0.92, 0.92, 0.92))
    for at in (0.30, 0.52, 0.74):
        paint.rectangle(flank, (at, 0.0, at + 0.006, 0.85), (0.35, 0.35, 0.35))
        paint.rectangle(flank, (at + 0.02, 0.18, at + 0.06, 0.26), (0.5, 0.5, 0.5))
    paint.rectangle(flank, (0, 0.82, 1, 1), (0.25, 0.25, 0.25))
    front = paint.plain(64, 128, (0.92, 0.92, 0.92))
    paint.rectangle(front, (0.25, 0.35, 0.75, 0.7), (0.1, 0.1, 0.1))
    rear = paint.plain(64, 128, (0.92, 0.92, 0.92))
    for ends, colour in ((front, (1.0, 0.98, 0.85)), (rear, (0.85, 0.08, 0.05))):
        for left in (0.04, 0.78):
            paint.rectangle(ends, (left, 0.2, left + 0.18, 0.5), colour)
        paint.rectangle(ends, (0.36, 0.55, 0.64, 0.8), (0.97, 0.97, 0.97))
        paint.text(ends, f"SL {int(rng.integers(100, 999))}", (0.37, 0.56, 0.63, 0.79), (0.05, 0.05, 0.08), 1)
    glass = paint.plain(32, 64, (0.10, 0.13, 0.15))
    glass += np.linspace(0.25, 0.0, 32, dtype=np.float32)[:, None, None]
    window = glass.copy()
    paint.rectangle(window, (0.46, 0, 0.52, 1), (0.05, 0.05, 0.05))
    paintwork = paint.mottle(paint.plain(32, 64, (0.92, 0.92, 0.92)), rng, 3, 0.04)
    return {
        "car_paint": ("car", paint.finish(paintwork)),
        "car_flank": ("car", paint.finish(flank)),
        "car_front": ("car", paint.finish(front)),
        "car_rear": ("car", paint.finish(rear)),
        "car_glass": ("glass", paint.finish(glass)),
        "car_window": ("glass", paint.finish(window)),
        "tyre": ("car", paint.finish(paint.plain(32, 32, (0.06, 0.06, 0.06)))),
        "wheel": ("car", paint.finish(_wheel())),
    }


def _wheel() -> Canvas:
    wheel = paint.plain(64, 64, (0.05, 0.05, 0.05))
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    wheel[(radius < 0.62) & (np.sin(5 * angle) > -0.3)] = (0.6, 0.6, 0.62)
    wheel[radius < 0.15] = (0.4, 0.4, 0.42)
    return wheel
