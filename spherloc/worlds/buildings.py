"""Houses made of bays: the same window again and again, which is what makes a street hard to tell from itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spherloc.types import FloatArray
from spherloc.worlds.mesh import WHITE, MeshBuilder, xyz
from spherloc.worlds.outdoor_tiles import DOOR, SHOPS, WINDOW

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
