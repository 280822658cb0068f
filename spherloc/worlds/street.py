"""A street of terraced houses whose bays repeat: one window looks like the next, and so does the next house."""

import numpy as np

from spherloc.worlds.atlas import pack
from spherloc.worlds.buildings import BAY_M, Front, add_house
from spherloc.worlds.furniture import add_bench, add_lamp, add_tree
from spherloc.worlds.mesh import MeshBuilder
from spherloc.worlds.occluders import add_car, occluder_tiles
from spherloc.worlds.outdoor_tiles import STYLES, facade_tiles, ground_tiles, nature_tiles, sign_tiles
from spherloc.worlds.shading import with_dark_corners
from spherloc.worlds.world import Lane, Surfaces, World

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
