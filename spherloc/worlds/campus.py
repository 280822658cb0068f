"""A campus square: repeated facades far away, and cobbles, hedges and benches near by."""

from itertools import pairwise

import numpy as np

from spherloc.types import FloatArray
from spherloc.worlds.atlas import pack
from spherloc.worlds.buildings import BAY_M, Front, add_house
from spherloc.worlds.furniture import add_bench, add_lamp, add_tree
from spherloc.worlds.mesh import MeshBuilder, xyz
from spherloc.worlds.occluders import occluder_tiles
from spherloc.worlds.outdoor_tiles import facade_tiles, ground_tiles, nature_tiles, sign_tiles
from spherloc.worlds.shading import with_dark_corners
from spherloc.worlds.world import Lane, Surfaces, World

HALF_M = 45.0
"""From the middle of the square to the houses."""
CELL_M = 4.5
PROVENANCE = (
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
        provenance=PROVENANCE,
        build=lambda: _surfaces(seed, path),
        path=path,
        lanes=(Lane("person", (-9.0, 9.0), 3.0), Lane("box", (-5.0, 5.0), 0.5), Lane("car", (5.0, 9.0), 0.5)),
    )


def _surfaces(seed: int, path: FloatArray) -> Surfaces:
    rng = np.random.default_rng([seed, 13])
    atlas = pack(facade_tiles(rng) | sign_tiles(rng) | ground_tiles(rng) | nature_tiles(rng) | occluder_tiles(rng))
    builder = MeshBuilder(atlas)
    _ground(builder, rng)
    _houses(builder, rng)
    _fountain(builder, rng)
    lamps = _near_things(builder, rng, path)
    return Surfaces(with_dark_corners(builder.mesh(), 3.0), atlas, lamps)


def _is_lawn(x: float, y: float) -> bool:
    """Four lawns at the corners of the square."""
    return 16 < abs(x) < 38 and 20 < abs(y) < 38


def _ground(builder: MeshBuilder, rng: np.random.Generator) -> None:
    for x in np.arange(-HALF_M, HALF_M, CELL_M):
        for y in np.arange(-HALF_M, HALF_M, CELL_M):
            middle = (x + CELL_M / 2, y + CELL_M / 2)
            tile = (
                "grass" if _is_lawn(*middle) else "cobbles" if (round(x / CELL_M) + round(y / CELL_M)) % 3 else "slabs"
            )
            corners = np.array([[x, y, 0], [x + CELL_M, y, 0], [x + CELL_M, y + CELL_M, 0], [x, y + CELL_M, 0]])
            shade = np.full(3, rng.uniform(0.85, 1.0))
            builder.quad(np.roll(corners, int(rng.integers(4)), axis=0), tile, tint=shade)


def _houses(builder: MeshBuilder, rng: np.random.Generator) -> None:
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
