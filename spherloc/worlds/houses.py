"""A street of terraced houses and a campus square: houses made of bays, so that one window looks like the next."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from spherloc.types import FloatArray
from spherloc.worlds.furniture import add_bench, add_lamp, add_tree
from spherloc.worlds.mesh import WHITE, MeshBuilder, pack, xyz
from spherloc.worlds.occluders import add_car, occluder_tiles
from spherloc.worlds.shading import with_dark_corners
from spherloc.worlds.tiles import DOOR, SHOPS, STYLES, WINDOW, facade_tiles, ground_tiles, nature_tiles, sign_tiles
from spherloc.worlds.world import Lane, Surfaces, World

BAY_M = 3.0
STOREY_M = 3.2
RECESS_M = 0.16
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Front:
    """The plane of a facade."""

    origin: FloatArray
    """(3,) its foot on the left, as one stands before it."""
    right: FloatArray
    """(3,) unit vector along it."""
    inwards: FloatArray
    """(3,) unit vector into the house."""

    def at(self, along_m: float, up_m: float, depth_m: float = 0.0) -> FloatArray:
        """A place on it, or behind it."""
        return self.origin + along_m * self.right + up_m * UP + depth_m * self.inwards

    def patch(self, left: float, right: float, low: float, high: float, depth_m: float = 0.0) -> list[FloatArray]:
        """Corners of an upright rectangle in it."""
        corners = ((left, low), (right, low), (right, high), (left, high))
        return [self.at(x, z, depth_m) for x, z in corners]


def add_opening(
    builder: MeshBuilder,
    front: Front,
    left_m: float,
    low_m: float,
    tile: str,
    hole: tuple[float, float, float, float],
    tint: ArrayLike = WHITE,
    lit: bool = False,
) -> None:
    """A bay whose window or door, the part ``hole`` of its tile, lies deeper than its wall."""
    x0, y0, x1, y1 = hole
    columns, rows = (0.0, x0, x1, 1.0), (0.0, y0, y1, 1.0)
    # Sixteen corners of the wall around the hole, row by row from the top; then the hole's four corners, deeper.
    at = [(x, y) for y in rows for x in columns]
    inner = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)]

    def place(x: float, y: float, depth_m: float) -> FloatArray:
        return front.at(left_m + x * BAY_M, low_m + (1 - y) * STOREY_M, depth_m)

    vertices = [place(x, y, 0.0) for x, y in at] + [place(x, y, RECESS_M) for x, y in inner]
    cells = [(r, c) for r in range(3) for c in range(3) if (r, c) != (1, 1) and not (r == 2 and y1 == 1.0)]
    quads = [(4 * r + 4 + c, 4 * r + 5 + c, 4 * r + 1 + c, 4 * r + c) for r, c in cells]
    surfaces = [0] * len(quads) + [1, 2, 3, 4]
    quads += [(9, 18, 16, 5), (19, 10, 6, 17), (9, 10, 19, 18), (16, 17, 6, 5)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    # The reveal repeats a narrow strip of the wall beside the hole.
    reveal = [(x0 - 0.03, y0), (x1 + 0.03, y0), (x0 - 0.03, y1), (x1 + 0.03, y1)]
    builder.add(np.array(vertices), faces, at + reveal, tile, tint, surfaces=np.repeat(surfaces, 2))
    pane = [place(x0, y1, RECESS_M), place(x1, y1, RECESS_M), place(x1, y0, RECESS_M), place(x0, y0, RECESS_M)]
    builder.quad(pane, tile, hole, tint, lit)


def add_house(
    builder: MeshBuilder,
    rng: np.random.Generator,
    front: Front,
    bays: int,
    storeys: int,
    style: int,
    number: int,
    recessed: int = 3,
) -> None:
    """A house of ``bays`` x ``storeys`` behind ``front``: shops or a door below, windows above, cornice, roof.

    The windows of the lowest ``recessed`` storeys lie deeper than the wall; farther ones look the same without.
    """
    windows = f"window_{style}_{int(rng.integers(2))}"
    tint = np.clip(rng.uniform(0.86, 1.0) + rng.uniform(-0.04, 0.04, 3), 0, 1)
    _ground_floor(builder, rng, front, bays, style, number, windows, tint)
    for bay in range(bays):
        left = bay * BAY_M
        for storey in range(1, storeys):
            lit, low = bool(rng.random() < 0.4), storey * STOREY_M
            if storey < recessed:
                add_opening(builder, front, left, low, windows, WINDOW, tint, lit)
            else:
                builder.quad(front.patch(left, left + BAY_M, low, low + STOREY_M), windows, tint=tint, lit=lit)
            if style == 4 and storey == 2 and bay % 2 == 0:
                _balcony(builder, front, left, low)
    _top(builder, rng, front, bays, storeys, style)


def _ground_floor(
    builder: MeshBuilder,
    rng: np.random.Generator,
    front: Front,
    bays: int,
    style: int,
    number: int,
    windows: str,
    tint: FloatArray,
) -> None:
    door = int(rng.integers(bays))
    shops = rng.random() < 0.6
    for bay in range(bays):
        left, lit = bay * BAY_M, bool(rng.random() < 0.45)
        if bay == door:
            add_opening(builder, front, left, 0, f"door_{style}", DOOR, tint, lit)
            plate = front.patch(left + 2.25, left + 2.55, 1.85, 2.15, -0.02)
            builder.quad(plate, f"number_{number % 16}")
        elif shops:
            builder.quad(front.patch(left, left + BAY_M, 0, STOREY_M), f"shop_{style}", tint=tint, lit=lit)
            if bay != door + 1 and rng.random() < 0.75:
                _sign(builder, rng, front, left)
        else:
            add_opening(builder, front, left, 0, windows, WINDOW, tint, lit)
            if rng.random() < 0.15:
                _poster(builder, rng, front, left)


def _sign(builder: MeshBuilder, rng: np.random.Generator, front: Front, left: float) -> None:
    name = SHOPS[int(rng.integers(len(SHOPS)))]
    lit = bool(rng.random() < 0.7)
    builder.quad(front.patch(left + 0.25, left + 2.75, 2.45, 3.08, -0.06), f"sign_{name}", lit=lit)
    if rng.random() < 0.4:
        edge = [front.at(left + 0.2, 2.35), front.at(left + 2.8, 2.35)]
        outer = [front.at(left + 0.2, 2.0, -0.9), front.at(left + 2.8, 2.0, -0.9)]
        builder.quad([*outer, edge[1], edge[0]], "awning", tint=rng.uniform(0.5, 1.0, 3))


def _poster(builder: MeshBuilder, rng: np.random.Generator, front: Front, left: float) -> None:
    across = left + rng.uniform(0.0, 0.1)
    builder.quad(front.patch(across, across + 0.7, 1.0, 1.9, -0.015), f"poster_{int(rng.integers(12))}")


def _balcony(builder: MeshBuilder, front: Front, left: float, low: float) -> None:
    a, b, out = left + 0.5, left + 2.5, -0.75
    builder.quad([front.at(a, low, out), front.at(b, low, out), front.at(b, low), front.at(a, low)], "slabs")
    builder.quad([front.at(a, low), front.at(b, low), front.at(b, low, out), front.at(a, low, out)], "slabs")
    builder.quad(front.patch(a, b, low, low + 0.95, out), "railing")
    for x, inner, outer in ((a, 0.0, out), (b, out, 0.0)):
        corners = [front.at(x, low, inner), front.at(x, low, outer)]
        builder.quad([*corners, corners[1] + 0.95 * UP, corners[0] + 0.95 * UP], "railing")


def _top(builder: MeshBuilder, rng: np.random.Generator, front: Front, bays: int, storeys: int, style: int) -> None:
    """Cornice, roof, chimneys, and the flanks that stand above lower neighbours."""
    width, height = bays * BAY_M, storeys * STOREY_M
    tile, deep, rise = f"roof_{style % 4}", 5.0, 3.2
    for bay in range(0, bays, 2):
        left, right = bay * BAY_M, min(width, (bay + 2) * BAY_M)
        builder.quad(front.patch(left, right, height - 0.1, height + 0.5, -0.3), f"cornice_{style}")
        for z, a, b in ((height - 0.1, -0.3, 0.0), (height + 0.5, 0.0, -0.3)):
            corners = [front.at(left, z, b), front.at(right, z, b), front.at(right, z, a), front.at(left, z, a)]
            builder.quad(corners, f"cornice_{style}", (0, 0.8, 1, 1))
    origin = front.at(0, height + 0.4, -0.2)
    builder.sheet(origin, width * front.right, (deep + 0.2) * front.inwards + rise * UP, (bays // 2 + 1, 2), tile)
    for x, forward in ((0.0, True), (width, False)):
        ends = [front.at(x, 0, deep), front.at(x, 0)] if forward else [front.at(x, 0), front.at(x, 0, deep)]
        rises = [rise + 0.4, 0.4] if forward else [0.4, rise + 0.4]
        tops = [ends[1] + (height + rises[1]) * UP, ends[0] + (height + rises[0]) * UP]
        builder.quad([*ends, *tops], f"wall_{style}", tint=(0.85, 0.85, 0.85))
    for _ in range(int(rng.integers(1, 3))):
        middle = front.at(rng.uniform(1, width - 1), height + 0.4 + 0.6 * rise, 3.0)
        turn = float(np.arctan2(front.right[1], front.right[0]))
        builder.box(middle - xyz(0.4, 0.3, 0.8), middle + xyz(0.4, 0.3, 1.6), "wall_0", turn)


LENGTH_M = 108.0
ROAD_M = 3.6
"""From the middle of the road to its kerb."""
HOUSES_M = 8.4
"""From the middle of the road to the houses."""
KERB_M = 0.12

PROVENANCE = (
    "Built by this project's code from a seed: houses of repeated bays, road and trees; textures drawn in numpy and "
    "OpenCV; no data of others."
)


def build_street(seed: int) -> World:
    """108 m of street along x with houses on both sides, closed by houses at its ends."""
    return World(
        kind="street",
        seed=seed,
        provenance=PROVENANCE,
        build=lambda: _surfaces(seed),
        path=np.array([[6.0, -1.7, 1.6], [LENGTH_M - 6.0, -1.7, 1.6]]),
        lanes=(
            Lane("car", (3.2, 3.6), 2.0),
            Lane("person", (-5.8, -3.2), 1.5),
            Lane("person", (6.6, 9.2), 1.5),
        ),
    )


def _surfaces(seed: int) -> Surfaces:
    rng = np.random.default_rng([seed, 11])
    atlas = pack(facade_tiles(rng) | sign_tiles(rng) | ground_tiles(rng) | nature_tiles(rng) | occluder_tiles(rng))
    builder = MeshBuilder(atlas)
    _ground(builder, rng)
    _houses(builder, rng)
    lamps = _things(builder, rng)
    return Surfaces(with_dark_corners(builder.mesh(), 3.0), atlas, lamps)


def _ground(builder: MeshBuilder, rng: np.random.Generator) -> None:
    cell = ROAD_M
    for x in np.arange(-2 * cell, LENGTH_M + 2 * cell, cell):
        for y in (-ROAD_M, 0.0):
            tile = f"asphalt_{int(rng.choice(3, p=[0.48, 0.47, 0.05]))}"
            corners = np.array([[x, y, 0], [x + cell, y, 0], [x + cell, y + cell, 0], [x, y + cell, 0]])
            builder.quad(np.roll(corners, int(rng.integers(4)), axis=0), tile)
        line = [[x, -0.08, 0.004], [x, 0.08, 0.004], [x - cell, 0.08, 0.004], [x - cell, -0.08, 0.004]]
        builder.quad(line[::-1], "marking", tint=(1, 1, 1))
    columns = round(LENGTH_M / 4.6)
    for side in (-1, 1):
        low, high = sorted((side * ROAD_M, side * HOUSES_M))
        builder.sheet([0, low, KERB_M], [LENGTH_M, 0, 0], [0, high - low, 0], (columns, 1), "slabs")
        # Seen from the road, the kerb on its left runs along x and the one on its right against it.
        start = [0 if side > 0 else LENGTH_M, side * ROAD_M, 0]
        builder.sheet(start, [side * LENGTH_M, 0, 0], [0, 0, KERB_M], (columns, 1), "kerb")


def _houses(builder: MeshBuilder, rng: np.random.Generator) -> None:
    number = 0
    for side in (-1, 1):
        bays_left = round(LENGTH_M / BAY_M)
        done = 0
        style = -1
        while bays_left > 0:
            bays = bays_left if bays_left < 7 else int(rng.integers(3, 6))
            style = int(rng.choice([other for other in range(len(STYLES)) if other != style]))
            along = done * BAY_M
            if side > 0:  # one looks at it towards +y, so that left is at smaller x
                front = Front(np.array([along, HOUSES_M, 0.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
            else:
                start = np.array([along + bays * BAY_M, -HOUSES_M, 0.0])
                front = Front(start, np.array([-1.0, 0, 0]), np.array([0, -1.0, 0]))
            add_house(builder, rng, front, bays, int(rng.integers(3, 6)), style, number)
            number += 1
            done, bays_left = done + bays, bays_left - bays
    for x, way in ((-7.0, -1.0), (LENGTH_M + 7.0, 1.0)):
        front = Front(np.array([x, 15.0 * way, 0.0]), np.array([0, -way, 0]), np.array([way, 0, 0]))
        add_house(builder, rng, front, 10, 4, int(rng.integers(len(STYLES))), number)
        builder.sheet([min(x, x - 7 * way), -15, -0.01], [7, 0, 0], [0, 30, 0], (2, 7), "slabs")


def _things(builder: MeshBuilder, rng: np.random.Generator) -> np.ndarray:
    lamps = []
    for index, x in enumerate(np.arange(7.0, LENGTH_M - 3, 13.5)):
        side = 1 if index % 2 else -1
        lamps.append(add_lamp(builder, [x, side * (ROAD_M + 0.45), KERB_M]))
        add_tree(builder, rng, [x + rng.uniform(5, 8), -side * (ROAD_M + 0.8), KERB_M], float(rng.uniform(5.0, 6.8)))
        if rng.random() < 0.6:
            add_bench(builder, [x + 3, side * (HOUSES_M - 1.6), KERB_M], 0.0 if side > 0 else np.pi)
    for x in rng.choice(np.arange(4.0, LENGTH_M - 4, 6.0), 6, replace=False):
        add_car(builder, rng, np.array([x, ROAD_M - 1.05, 0.0]), np.pi)
    return np.array(lamps)


HALF_M = 45.0
"""From the middle of the square to the houses."""
CELL_M = 4.5
SQUARE_PROVENANCE = (
    "Built by this project's code from a seed: a square between houses of repeated bays; textures drawn in numpy and "
    "OpenCV; no data of others."
)


def build_campus(seed: int) -> World:
    """A square of 90 m x 90 m; the path bends across it past benches, hedges and poster columns."""
    x = np.linspace(-30.0, 30.0, 61)
    path = np.column_stack([x, 7.5 + 5.0 * np.sin(x / 9.0), np.full(len(x), 1.6)])
    return World(
        kind="campus",
        seed=seed,
        provenance=SQUARE_PROVENANCE,
        build=lambda: _square_surfaces(seed, path),
        path=path,
        lanes=(Lane("person", (-9.0, 9.0), 3.0), Lane("box", (-5.0, 5.0), 0.5), Lane("car", (5.0, 9.0), 0.5)),
    )


def _square_surfaces(seed: int, path: FloatArray) -> Surfaces:
    rng = np.random.default_rng([seed, 13])
    atlas = pack(facade_tiles(rng) | sign_tiles(rng) | ground_tiles(rng) | nature_tiles(rng) | occluder_tiles(rng))
    builder = MeshBuilder(atlas)
    _square_ground(builder, rng)
    _square_houses(builder, rng)
    _fountain(builder, rng)
    lamps = _near_things(builder, rng, path)
    return Surfaces(with_dark_corners(builder.mesh(), 3.0), atlas, lamps)


def _is_lawn(x: float, y: float) -> bool:
    """Four lawns at the corners of the square."""
    return 16 < abs(x) < 38 and 20 < abs(y) < 38


def _square_ground(builder: MeshBuilder, rng: np.random.Generator) -> None:
    for x in np.arange(-HALF_M, HALF_M, CELL_M):
        for y in np.arange(-HALF_M, HALF_M, CELL_M):
            middle = (x + CELL_M / 2, y + CELL_M / 2)
            tile = (
                "grass" if _is_lawn(*middle) else "cobbles" if (round(x / CELL_M) + round(y / CELL_M)) % 3 else "slabs"
            )
            corners = np.array([[x, y, 0], [x + CELL_M, y, 0], [x + CELL_M, y + CELL_M, 0], [x, y + CELL_M, 0]])
            shade = np.full(3, rng.uniform(0.85, 1.0))
            builder.quad(np.roll(corners, int(rng.integers(4)), axis=0), tile, tint=shade)


def _square_houses(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """Two long houses of one style on each side, so that far windows repeat 20 times."""
    for side in range(4):
        angle = side * np.pi / 2
        inwards = np.round([np.cos(angle), np.sin(angle), 0.0])
        right = np.array([inwards[1], -inwards[0], 0.0])
        style, storeys = (2, 0, 4, 1)[side], int(rng.integers(3, 5))
        for half, bays in ((0, 13), (1, 13)):
            along = -HALF_M + 3.0 + half * (HALF_M - 1.0)
            front = Front(HALF_M * inwards + along * right, right, inwards)
            add_house(builder, rng, front, bays, storeys + half, style, 2 * side + half, recessed=0)
        tower = HALF_M * inwards + (HALF_M + 1.0) * right + 2.0 * inwards
        builder.box(tower - xyz(2.5, 2.5, 0), tower + xyz(2.5, 2.5, BAY_M * (6 + side)), f"wall_{style}", top="roof_1")


def _fountain(builder: MeshBuilder, rng: np.random.Generator) -> None:
    place = np.array([0.0, -4.0, 0.0])
    builder.prism(place, place + xyz(0, 0, 0.55), (4.0, 3.9), "wall_2", 20)
    angle = np.linspace(0, 2 * np.pi, 21)
    rim = place + np.column_stack([3.9 * np.cos(angle[:-1]), 3.9 * np.sin(angle[:-1]), np.full(20, 0.5)])
    flat = np.column_stack([0.5 + 0.5 * np.cos(angle[:-1]), 0.5 - 0.5 * np.sin(angle[:-1])])
    builder.add(rim, [(0, k, k + 1) for k in range(1, 19)], flat, "car_glass", (0.7, 0.9, 1.0))
    builder.prism(place, place + xyz(0, 0, 2.4), (0.5, 0.28), "wall_2", 10)
    builder.prism(place + xyz(0, 0, 2.2), place + xyz(0, 0, 2.6), (0.5, 1.3), "wall_2", 14)
    builder.blob(rng, place + xyz(0, 0, 3.0), (0.45, 0.45, 0.6), "metal", 0.1, fine=2)


def _near_things(builder: MeshBuilder, rng: np.random.Generator, path: FloatArray) -> FloatArray:
    """Along the path: hedges, benches, poster columns, lamps, trees; and trees on the lawns."""
    lamps = []
    for index in range(4, 60, 7):
        place, ahead = path[index] * (1, 1, 0), path[index + 1] - path[index - 1]
        turn = float(np.arctan2(ahead[1], ahead[0]))
        left = np.array([-np.sin(turn), np.cos(turn), 0.0])
        side = 1 if index % 2 else -1
        add_bench(builder, place + 3.0 * side * left, turn if side > 0 else turn + np.pi)
        lamps.append(add_lamp(builder, place - 3.2 * side * left))
        if index % 3 == 0:
            _column(builder, rng, place + 4.2 * side * left + xyz(2.4, 0, 0))
        hedge = place - 5.2 * side * left
        builder.box(hedge - xyz(1.6, 0.35, 0), hedge + xyz(1.6, 0.35, 0.8), f"leaves_{index % 3}", turn)
        add_tree(builder, rng, place + 7.0 * side * left, float(rng.uniform(5, 7)))
    for x in (-32, -22, 22, 32):
        for y in (-34, -25, 25, 34):
            add_tree(
                builder,
                rng,
                np.array([x, y, 0]) + rng.normal(0, 1.2, 3) * (1, 1, 0),
                float(rng.uniform(6, 8)),
                crowns=3,
            )
    return np.array(lamps)


def _column(builder: MeshBuilder, rng: np.random.Generator, foot: FloatArray) -> None:
    """A column with six posters around it."""
    angle = np.linspace(0, 2 * np.pi, 7)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(7)])
    for a, b in pairwise(ring):
        low, high = foot + 0.6 * np.array([a, b]), np.array([0, 0, 0.5])
        builder.quad([low[0], low[1], low[1] + high, low[0] + high], "wall_2")
        up = np.array([0, 0, 2.3])
        builder.quad([low[0] + high, low[1] + high, low[1] + up, low[0] + up], f"poster_{int(rng.integers(12))}")
    builder.prism(foot + xyz(0, 0, 2.3), foot + xyz(0, 0, 2.75), (0.75, 0.1), "metal", 10)
