"""Textures of streets, squares and apartments: facades, ground, leaves and signs, walls and furniture."""

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.worlds import paint
from spherloc.worlds.paint import Canvas, Colour

Tiles = dict[str, tuple[str, NDArray[np.uint8]]]

SIZE = 256
"""Texels of a facade's bay, about 3 m."""
WINDOW = (0.28, 0.18, 0.72, 0.80)
"""Where the window is in its bay: left, top, right, bottom."""
DOOR = (0.30, 0.22, 0.70, 1.0)

STYLES: tuple[tuple[str, Colour, Colour, Colour], ...] = (
    ("brick", (0.55, 0.25, 0.19), (0.70, 0.66, 0.60), (0.93, 0.92, 0.88)),
    ("plaster", (0.86, 0.77, 0.56), (0.95, 0.93, 0.87), (0.36, 0.22, 0.14)),
    ("stone", (0.71, 0.66, 0.58), (0.52, 0.48, 0.42), (0.20, 0.28, 0.26)),
    ("brick", (0.74, 0.62, 0.42), (0.55, 0.50, 0.44), (0.16, 0.18, 0.22)),
    ("plaster", (0.55, 0.66, 0.70), (0.92, 0.93, 0.92), (0.94, 0.94, 0.92)),
)
"""Of buildings: how the wall is made, its colour, that of joints and trims, and that of window frames."""

SHOPS = ("BAKERY", "BOOKS", "CAFE", "FLOWERS", "PHARMACY", "HOTEL", "CYCLES", "TAILOR", "RECORDS", "OPTICIAN", "WINE")


def facade_tiles(rng: np.random.Generator) -> Tiles:
    """For each style: blank wall, wall with a window, with a door, with a shop window, and a cornice."""
    tiles: Tiles = {}
    for number, (sort, colour, trim, frame) in enumerate(STYLES):
        wall = _wall(rng, sort, colour, trim)
        tiles[f"wall_{number}"] = ("wall", paint.finish(wall))
        for variant in range(2):
            tiles[f"window_{number}_{variant}"] = ("wall", _window(rng, wall, trim, frame, variant))
        tiles[f"door_{number}"] = ("wall", _door(rng, wall, trim, number))
        tiles[f"shop_{number}"] = ("wall", _shop(rng, trim, frame))
        tiles[f"cornice_{number}"] = ("wall", _cornice(rng, trim))
    for number in range(4):
        tiles[f"roof_{number}"] = ("roof", _roof(rng, ((0.42, 0.24, 0.18), (0.28, 0.29, 0.33))[number % 2]))
    return tiles


def sign_tiles(rng: np.random.Generator) -> Tiles:
    """Names of shops, house numbers and posters: no two are alike."""
    tiles: Tiles = {}
    for name in SHOPS:
        ground = rng.uniform(0.05, 0.9, 3)
        sign = paint.mottle(paint.plain(64, 256, ground.tolist()), rng, 6)
        letters = (0.97, 0.95, 0.85) if ground.mean() < 0.5 else (0.08, 0.06, 0.10)
        paint.frame(sign, (0.01, 0.04, 0.99, 0.96), letters, 0.012)
        paint.text(sign, name, (0.06, 0.12, 0.94, 0.88), letters, 4)
        tiles[f"sign_{name}"] = ("sign", paint.finish(sign, np.full(sign.shape[:2], 0.35, np.float32)))
    for number in range(12):
        tiles[f"poster_{number}"] = ("sign", paint.finish(paint.poster(rng, 128, 128)))
    for number in range(16):
        plate = paint.plain(32, 32, (0.10, 0.16, 0.42))
        paint.frame(plate, (0, 0, 1, 1), (0.95, 0.95, 0.95), 0.06)
        paint.text(plate, str(2 * number + 1), (0.1, 0.1, 0.9, 0.9), (0.97, 0.97, 0.97), 1)
        tiles[f"number_{number}"] = ("sign", paint.finish(plate))
    return tiles


def ground_tiles(rng: np.random.Generator) -> Tiles:
    """Asphalt with and without markings, slabs, cobbles, kerbs, lawn."""
    tiles: Tiles = {}
    for number in range(3):
        asphalt = _asphalt(rng)
        if number == 2:
            _manhole(asphalt)
        tiles[f"asphalt_{number}"] = ("road", paint.finish(asphalt))
    line = _asphalt(rng)
    worn = 0.72 + 0.12 * paint.noise(rng, SIZE, SIZE, 24, 3)[..., None]
    marked = line.copy()
    marked[: SIZE // 2] = np.where(worn[: SIZE // 2] > 0.6, 0.78, line[: SIZE // 2])
    tiles["marking"] = ("road", paint.finish(marked[:, :32]))
    slabs = paint.bricks(rng, (SIZE, SIZE), (8, 6), (0.58, 0.57, 0.55), (0.36, 0.35, 0.34))
    tiles["slabs"] = ("paving", paint.finish(paint.mottle(slabs, rng, 3, 0.10)))
    cobbles = paint.bricks(rng, (SIZE, SIZE), (16, 14), (0.47, 0.45, 0.43), (0.24, 0.23, 0.21))
    tiles["cobbles"] = ("paving", paint.finish(paint.mottle(cobbles, rng, 3, 0.12)))
    tiles["kerb"] = ("paving", paint.finish(paint.mottle(paint.plain(32, 128, (0.62, 0.61, 0.58)), rng, 8, 0.12)))
    blades = paint.noise(rng, SIZE, SIZE, 60, 3)[..., None]
    lawn = paint.plain(SIZE, SIZE, (0.26, 0.40, 0.14)) * (1 + 0.45 * blades)
    tiles["grass"] = ("grass", paint.finish(paint.mottle(lawn, rng, 3, 0.2)))
    return tiles


def nature_tiles(rng: np.random.Generator) -> Tiles:
    """Leaves, bark, metal, wood."""
    tiles: Tiles = {}
    for number, colour in enumerate(((0.20, 0.36, 0.11), (0.28, 0.42, 0.14), (0.14, 0.30, 0.13))):
        tiles[f"leaves_{number}"] = ("foliage", paint.finish(_leaves(rng, colour)))
    bark = (
        paint.plain(128, 64, (0.34, 0.26, 0.19))
        * (1 + 0.4 * cv2.resize(paint.noise(rng, 16, 64, 32), (64, 128)))[..., None]
    )
    tiles["bark"] = ("wood", paint.finish(bark))
    planks = paint.bricks(rng, (64, 64), (4, 1), (0.48, 0.32, 0.18), (0.16, 0.10, 0.06))
    tiles["planks"] = ("wood", paint.finish(planks))
    tiles["metal"] = ("metal", paint.finish(paint.mottle(paint.plain(64, 64, (0.16, 0.19, 0.19)), rng, 8, 0.2)))
    tiles["lantern"] = ("lamp", paint.finish(paint.plain(32, 32, (0.92, 0.88, 0.74)), np.ones((32, 32), np.float32)))
    awning = paint.plain(64, 128, (0.92, 0.90, 0.84))
    for stripe in range(4):
        paint.rectangle(awning, (stripe / 4, 0, stripe / 4 + 0.125, 1), (0.62, 0.10, 0.10))
    tiles["awning"] = ("sign", paint.finish(paint.mottle(awning, rng, 8)))
    railing = paint.plain(64, 128, (0.30, 0.31, 0.32))
    for bar in range(16):
        paint.rectangle(railing, (bar / 16, 0, bar / 16 + 0.022, 1), (0.05, 0.05, 0.06))
    paint.rectangle(railing, (0, 0, 1, 0.12), (0.05, 0.05, 0.06))
    paint.rectangle(railing, (0, 0.88, 1, 1), (0.05, 0.05, 0.06))
    tiles["railing"] = ("metal", paint.finish(railing))
    return tiles


def _wall(rng: np.random.Generator, sort: str, colour: Colour, joint: Colour) -> Canvas:
    if sort == "brick":
        wall = paint.bricks(rng, (SIZE, SIZE), (36, 13), colour, joint)
    elif sort == "stone":
        wall = paint.bricks(rng, (SIZE, SIZE), (8, 4), colour, joint)
    else:
        wall = paint.mottle(paint.plain(SIZE, SIZE, colour), rng, 64, 0.05, 2)
    return paint.mottle(wall, rng, 4, 0.07)


def _window(rng: np.random.Generator, wall: Canvas, trim: Colour, frame: Colour, variant: int) -> NDArray[np.uint8]:
    canvas = wall.copy()
    left, top, right, bottom = WINDOW
    border = 0.035
    paint.rectangle(canvas, (left - border, top - border, right + border, bottom), trim)
    paint.rectangle(canvas, (left - 0.06, bottom, right + 0.06, bottom + 0.04), trim)
    paint.rectangle(canvas, (left - 0.06, bottom + 0.04, right + 0.06, bottom + 0.05), [0.5 * c for c in trim])
    _glass(rng, canvas, WINDOW)
    paint.frame(canvas, WINDOW, frame, 0.025)
    middle = (left + right) / 2
    paint.rectangle(canvas, (middle - 0.012, top, middle + 0.012, bottom), frame)
    if variant:
        paint.rectangle(canvas, (left, top + 0.18, right, top + 0.205), frame)
    else:
        for share in (0.33, 0.66):
            at = top + share * (bottom - top)
            paint.rectangle(canvas, (left, at - 0.007, right, at + 0.007), frame)
    return paint.finish(paint.mottle(canvas, rng, 32, 0.03, 2), _shining(WINDOW, canvas))


def _glass(rng: np.random.Generator, canvas: Canvas, box: tuple[float, float, float, float]) -> None:
    """Panes that show some sky above and a dark room below, and curtains at the sides."""
    left, top, right, bottom = (round(share * SIZE) for share in box)
    height, width = bottom - top, right - left
    fall = np.linspace(0.46, 0.10, height, dtype=np.float32)[:, None, None]
    pane = fall * np.array([0.80, 0.95, 1.1], np.float32) + np.zeros((height, width, 1), np.float32)
    pane *= 1 + 0.5 * paint.noise(rng, height, width, 3, 3)[..., None]
    folds = 0.62 + 0.16 * np.sin(np.arange(width) * 0.9)[None, :, None]
    drawn = np.minimum(np.arange(width), np.arange(width)[::-1]) < rng.uniform(0.08, 0.3) * width
    pane = np.where(drawn[None, :, None], folds * np.array([0.95, 0.92, 0.84]), pane)
    canvas[top:bottom, left:right] = np.clip(pane, 0, 1)


def _shining(box: tuple[float, float, float, float], canvas: Canvas) -> Canvas:
    glow = np.zeros((*canvas.shape[:2], 1), np.float32)
    paint.rectangle(glow, box, (0.9,))
    return glow[..., 0]


def _door(rng: np.random.Generator, wall: Canvas, trim: Colour, number: int) -> NDArray[np.uint8]:
    canvas = wall.copy()
    left, top, right, _ = DOOR
    paint.rectangle(canvas, (left - 0.05, top - 0.05, right + 0.05, 1.0), trim)
    colours = ((0.10, 0.30, 0.22), (0.45, 0.10, 0.09), (0.14, 0.20, 0.38), (0.30, 0.19, 0.10), (0.12, 0.12, 0.13))
    colour = colours[number % len(colours)]
    paint.rectangle(canvas, (left, top, right, 1.0), colour)
    fan = (left + 0.03, top + 0.03, right - 0.03, top + 0.15)
    paint.rectangle(canvas, fan, (0.55, 0.66, 0.72))
    for column in range(2):
        for row in range(3):
            x, y = left + 0.04 + 0.18 * column, top + 0.20 + 0.185 * row
            paint.frame(canvas, (x, y, x + 0.14, y + 0.15), [0.55 * c for c in colour], 0.012)
    paint.rectangle(canvas, (right - 0.055, 0.62, right - 0.03, 0.66), (0.85, 0.70, 0.25))
    return paint.finish(paint.mottle(canvas, rng, 32, 0.04, 2), _shining(fan, canvas))


def _shop(rng: np.random.Generator, trim: Colour, frame: Colour) -> NDArray[np.uint8]:
    dark = [0.45 * a + 0.1 for a in frame]
    canvas = paint.plain(SIZE, SIZE, dark)
    pane = (0.06, 0.26, 0.94, 0.84)
    _glass(rng, canvas, pane)
    left, top, right, bottom = (round(share * SIZE) for share in pane)
    goods = canvas[top:bottom, left:right]
    for _ in range(26):
        at = rng.uniform(0.02, 0.9, 2)
        size = rng.uniform(0.03, 0.14, 2)
        low = 0.35 + 0.6 * at[1]
        paint.rectangle(goods, (at[0], low, at[0] + size[0], min(1.0, low + size[1])), rng.uniform(0.1, 0.95, 3))
    paint.frame(canvas, pane, [0.6 * c for c in trim], 0.02)
    paint.rectangle(canvas, (0.49, 0.26, 0.51, 0.84), [0.6 * c for c in trim])
    paint.frame(canvas, (0.05, 0.87, 0.95, 0.97), [1.3 * c for c in dark], 0.01)
    return paint.finish(paint.mottle(canvas, rng, 24, 0.05, 3), _shining(pane, canvas))


def _cornice(rng: np.random.Generator, trim: Colour) -> NDArray[np.uint8]:
    canvas = paint.plain(64, 256, trim)
    for band, shade in ((0.0, 1.08), (0.2, 0.72), (0.3, 1.0), (0.75, 0.62), (0.85, 0.9)):
        paint.rectangle(canvas, (0, band, 1, 1), [shade * c for c in trim])
    for tooth in range(16):
        paint.rectangle(canvas, (tooth / 16, 0.42, tooth / 16 + 0.032, 0.74), [0.55 * c for c in trim])
    return paint.finish(paint.mottle(canvas, rng, 12, 0.07))


def _roof(rng: np.random.Generator, colour: Colour) -> NDArray[np.uint8]:
    return paint.finish(paint.bricks(rng, (SIZE, SIZE), (20, 16), colour, [0.5 * c for c in colour]))


def _asphalt(rng: np.random.Generator) -> Canvas:
    canvas = paint.plain(SIZE, SIZE, (0.25, 0.25, 0.26)) * (1 + 0.16 * rng.standard_normal((SIZE, SIZE, 1)))
    canvas = paint.mottle(canvas.astype(np.float32), rng, 3, 0.14)
    for _ in range(3):
        walk = np.cumsum(rng.normal(0, 7, (14, 2)), axis=0) + rng.uniform(40, 216, 2)
        cv2.polylines(canvas, [walk.astype(np.int32)], False, (0.12, 0.12, 0.12), 1)
    x, y = rng.integers(30, 170, 2)
    canvas[y : y + 60, x : x + 44] *= 0.78
    return canvas


def _manhole(canvas: Canvas) -> None:
    picture = paint.to_bytes(canvas)
    cv2.circle(picture, (128, 128), 26, (40, 38, 36), -1, cv2.LINE_AA)
    for radius in (24, 17, 10, 4):
        cv2.circle(picture, (128, 128), radius, (86, 84, 80), 2, cv2.LINE_AA)
    canvas[:] = paint.from_bytes(picture)


def _leaves(rng: np.random.Generator, colour: Colour) -> Canvas:
    """Dabs of light and shade over a dark ground."""
    canvas = paint.to_bytes(paint.plain(SIZE, SIZE, [0.35 * c for c in colour]))
    for _ in range(2600):
        x, y = rng.integers(0, SIZE, 2).tolist()
        size = int(rng.integers(2, 6))
        shade = (255 * np.asarray(colour) * rng.uniform(0.5, 1.7)).tolist()
        cv2.ellipse(canvas, (x, y), (size, size // 2 + 1), float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
    return paint.mottle(paint.from_bytes(canvas), rng, 4, 0.25)


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
