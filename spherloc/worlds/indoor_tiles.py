"""Textures of an apartment: walls with next to nothing on them, furniture, and a few things that stand out."""

import cv2
import numpy as np

from spherloc.worlds import paint
from spherloc.worlds.outdoor_tiles import Tiles
from spherloc.worlds.paint import Canvas

WALLS = ((0.90, 0.87, 0.80), (0.74, 0.80, 0.78), (0.86, 0.78, 0.70), (0.78, 0.80, 0.86), (0.93, 0.93, 0.91))
PICTURES = 10


def room_tiles(rng: np.random.Generator) -> Tiles:
    """Walls, floors, ceiling, doors, the view from a window."""
    tiles: Tiles = {}
    for number, colour in enumerate(WALLS):
        wall = paint.mottle(paint.plain(256, 256, colour), rng, 3, 0.025, 3)
        if number == 3:  # a paper with stripes
            for stripe in range(16):
                paint.rectangle(wall, (stripe / 16, 0, stripe / 16 + 0.02, 1), [0.93 * c for c in colour])
        paint.rectangle(wall, (0, 0.965, 1, 1), (0.95, 0.94, 0.92))
        tiles[f"paper_{number}"] = ("wall", paint.finish(paint.mottle(wall, rng, 64, 0.015, 2)))
    ceramic = paint.bricks(rng, (256, 256), (12, 12), (0.88, 0.91, 0.92), (0.66, 0.68, 0.68))
    flat = paint.plain(256, 256, (0.88, 0.91, 0.92))
    tiles["ceramic"] = ("wall", paint.finish(0.25 * ceramic + 0.75 * np.where(ceramic < 0.69, ceramic, flat)))
    boards = paint.bricks(rng, (256, 256), (14, 2), (0.60, 0.42, 0.26), (0.30, 0.20, 0.12))
    grain = 1 + 0.12 * cv2.resize(paint.noise(rng, 256, 32, 128, 3), (256, 256))[..., None]
    tiles["parquet"] = ("floor", paint.finish(boards * grain))
    stone = paint.bricks(rng, (256, 256), (6, 6), (0.62, 0.60, 0.58), (0.42, 0.41, 0.40))
    tiles["stone_floor"] = ("floor", paint.finish(paint.mottle(stone, rng, 32, 0.07, 3)))
    tiles["ceiling"] = ("wall", paint.finish(paint.mottle(paint.plain(128, 128, (0.95, 0.95, 0.94)), rng, 4, 0.02)))
    tiles["white"] = ("wall", paint.finish(paint.mottle(paint.plain(64, 64, (0.94, 0.94, 0.92)), rng, 4, 0.02)))
    door = paint.plain(256, 128, (0.92, 0.91, 0.88))
    for row in range(2):
        paint.frame(door, (0.14, 0.07 + 0.46 * row, 0.86, 0.46 + 0.46 * row), (0.74, 0.73, 0.70), 0.03)
    paint.rectangle(door, (0.04, 0.5, 0.13, 0.52), (0.5, 0.48, 0.42))
    tiles["leaf"] = ("wood", paint.finish(paint.mottle(door, rng, 8, 0.02)))
    tiles["view"] = ("glass", paint.finish(*_view(rng)))
    return tiles


def furniture_tiles(rng: np.random.Generator) -> Tiles:
    """Wood, cloth, books, kitchen fronts, pictures."""
    tiles: Tiles = {}
    for number, colour in enumerate(((0.52, 0.34, 0.19), (0.80, 0.68, 0.50), (0.24, 0.17, 0.13))):
        rings = cv2.resize(paint.noise(rng, 8, 128, 40, 4), (128, 128))[..., None]
        tiles[f"timber_{number}"] = ("wood", paint.finish(paint.plain(128, 128, colour) * (1 + 0.22 * rings)))
    for number, colour in enumerate(((0.28, 0.36, 0.46), (0.62, 0.30, 0.24), (0.82, 0.80, 0.74))):
        weave = paint.plain(128, 128, colour) * (1 + 0.10 * rng.standard_normal((128, 128, 1)).astype(np.float32))
        tiles[f"cloth_{number}"] = ("cloth", paint.finish(paint.mottle(weave, rng, 4, 0.08)))
    tiles["books"] = ("books", paint.finish(_books(rng)))
    front = paint.plain(128, 128, (0.84, 0.86, 0.84))
    paint.frame(front, (0.03, 0.03, 0.97, 0.97), (0.62, 0.64, 0.63), 0.02)
    paint.rectangle(front, (0.35, 0.1, 0.65, 0.13), (0.35, 0.35, 0.35))
    tiles["cupboard"] = ("wood", paint.finish(paint.mottle(front, rng, 6, 0.02)))
    oven = front.copy()
    paint.rectangle(oven, (0.12, 0.34, 0.88, 0.86), (0.07, 0.07, 0.08))
    for knob in range(5):
        paint.rectangle(oven, (0.14 + 0.16 * knob, 0.17, 0.2 + 0.16 * knob, 0.24), (0.15, 0.15, 0.15))
    tiles["oven"] = ("metal", paint.finish(oven))
    hob = paint.plain(64, 64, (0.06, 0.06, 0.07))
    for x, y in ((0.12, 0.12), (0.58, 0.12), (0.12, 0.58), (0.58, 0.58)):
        paint.frame(hob, (x, y, x + 0.3, y + 0.3), (0.5, 0.5, 0.52), 0.03)
    tiles["hob"] = ("metal", paint.finish(hob))
    screen = paint.plain(64, 128, (0.03, 0.03, 0.04)) + np.linspace(0.08, 0, 64, dtype=np.float32)[:, None, None]
    tiles["screen"] = ("glass", paint.finish(screen))
    tiles["shade"] = ("lamp", paint.finish(paint.plain(32, 32, (0.97, 0.93, 0.82)), np.ones((32, 32), np.float32)))
    for number in range(PICTURES):
        picture = paint.poster(rng, 128, 128)
        paint.frame(picture, (0, 0, 1, 1), ((0.1, 0.1, 0.1), (0.55, 0.40, 0.2))[number % 2], 0.05)
        tiles[f"picture_{number}"] = ("picture", paint.finish(picture))
    rug = paint.plain(256, 256, (0.50, 0.16, 0.14))
    for ring, colour in enumerate(((0.82, 0.70, 0.48), (0.16, 0.20, 0.34), (0.72, 0.55, 0.32), (0.35, 0.10, 0.10))):
        inset = 0.04 + 0.075 * ring
        paint.frame(rug, (inset, inset, 1 - inset, 1 - inset), colour, 0.035)
    for _ in range(90):
        x, y = rng.uniform(0.34, 0.64, 2)
        paint.rectangle(rug, (x, y, x + 0.03, y + 0.03), rng.uniform(0.1, 0.8, 3))
    tiles["rug"] = ("cloth", paint.finish(paint.mottle(rug, rng, 80, 0.12, 2)))
    return tiles


def _view(rng: np.random.Generator) -> tuple[Canvas, Canvas]:
    """Sky over tree tops behind a window's frame, and which part of it shines."""
    canvas = paint.plain(128, 128, (0.86, 0.93, 1.0))
    canvas[:70] *= 1 - 0.12 * np.clip(paint.noise(rng, 70, 128, 4), 0, 1)[..., None]
    tops = 74 + 9 * paint.noise(rng, 1, 128, 12, 3)[0]
    trees = np.array([0.34, 0.46, 0.28], np.float32) * (1 + 0.3 * paint.noise(rng, 128, 128, 20, 3))[..., None]
    canvas = np.where((np.arange(128)[:, None] > tops[None])[..., None], trees, canvas).astype(np.float32)
    glow = np.ones((128, 128, 1), np.float32)
    for brush, colour in ((canvas, (0.95, 0.95, 0.94)), (glow, (0.0,))):
        paint.frame(brush, (0, 0, 1, 1), colour, 0.05)
        paint.rectangle(brush, (0.48, 0, 0.52, 1), colour)
    return canvas, glow[..., 0]


def _books(rng: np.random.Generator) -> Canvas:
    """Five boards full of backs of books."""
    canvas = paint.plain(256, 256, (0.12, 0.09, 0.07))
    for board in range(5):
        foot = (board + 1) / 5 - 0.02
        at = 0.01
        while at < 0.97:
            wide, tall = rng.uniform(0.014, 0.04), rng.uniform(0.11, 0.165)
            colour = rng.uniform(0.08, 0.85, 3)
            paint.rectangle(canvas, (at, foot - tall, min(at + wide, 0.99), foot), colour)
            paint.rectangle(canvas, (at, foot - 0.8 * tall, min(at + wide, 0.99), foot - 0.7 * tall), 1 - colour)
            at += wide + (0.002 if rng.random() < 0.9 else 0.06)
        paint.rectangle(canvas, (0, foot, 1, foot + 0.02), (0.45, 0.30, 0.17))
    return canvas
