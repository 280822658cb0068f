"""An apartment of six rooms: walls with hardly any texture, doors that look alike, furniture and a few pictures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from spherloc.types import FloatArray
from spherloc.worlds import furniture as put
from spherloc.worlds.mesh import MeshBuilder, pack
from spherloc.worlds.occluders import occluder_tiles
from spherloc.worlds.shading import with_dark_corners
from spherloc.worlds.tiles import PICTURES, furniture_tiles, nature_tiles, room_tiles
from spherloc.worlds.world import Lane, Surfaces, World

HEIGHT_M = 2.6
WALL_M = 0.06
"""Half the thickness of a wall."""
PIECE_M = 2.6
"""Longest piece of wall that shows a tile once."""


@dataclass(frozen=True)
class Opening:
    """A hole in a wall."""

    left_m: float
    """Along x or y, in the apartment's frame, lowest."""
    right_m: float
    """Highest."""
    low_m: float = 0.0
    high_m: float = 2.1
    window: bool = False
    """Shows the view; else it leads to another room."""


@dataclass(frozen=True)
class Room:
    """A rectangle between the middles of its walls."""

    low: tuple[float, float]
    high: tuple[float, float]
    paper: str
    """Tile of its walls."""
    floor: str
    openings: Mapping[str, Sequence[Opening]] = field(default_factory=dict)
    """By side: "south" (low y), "north", "west" (low x), "east"."""


def add_room(builder: MeshBuilder, room: Room) -> None:
    """Seen from inside; from outside, a viewer that culls back faces looks through walls and ceiling."""
    x0, y0, x1, y1 = room.low[0] + WALL_M, room.low[1] + WALL_M, room.high[0] - WALL_M, room.high[1] - WALL_M
    cells = (max(1, round((x1 - x0) / 2)), max(1, round((y1 - y0) / 2)))
    outer = (room.low[0], room.low[1], room.high[0] - room.low[0], room.high[1] - room.low[1])
    builder.sheet([outer[0], outer[1], 0], [outer[2], 0, 0], [0, outer[3], 0], cells, room.floor)
    builder.sheet([x1, y0, HEIGHT_M], [x0 - x1, 0, 0], [0, y1 - y0, 0], cells, "ceiling")
    # Each wall runs from left to right as one looks at it from inside.
    for side, start, end in (
        ("south", (x1, y0), (x0, y0)),
        ("north", (x0, y1), (x1, y1)),
        ("west", (x0, y0), (x0, y1)),
        ("east", (x1, y1), (x1, y0)),
    ):
        _add_wall(builder, room, np.array(start), np.array(end), room.openings.get(side, ()))


def _add_wall(
    builder: MeshBuilder, room: Room, start: FloatArray, end: FloatArray, openings: Sequence[Opening]
) -> None:
    axis = int(np.argmax(np.abs(end - start)))
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    outwards = np.array([-along[1], along[0]])

    def patch(a: float, b: float, low: float, high: float, depth: float = 0.0) -> list[FloatArray]:
        return [
            np.append(start + x * along + depth * outwards, z) for x, z in ((a, low), (b, low), (b, high), (a, high))
        ]

    holes = []
    for opening in openings:
        ends = sorted((value - start[axis]) * along[axis] for value in (opening.left_m, opening.right_m))
        holes.append((*ends, opening))
    at = 0.0
    for left, right, opening in [*sorted(holes, key=lambda hole: hole[0]), (length, length, None)]:
        pieces = max(1, int(np.ceil((left - at) / PIECE_M)))
        for piece in range(pieces):
            a, b = at + (left - at) * piece / pieces, at + (left - at) * (piece + 1) / pieces
            builder.quad(patch(a, b, 0, HEIGHT_M), room.paper)
        at = right
        if opening is not None:
            _add_opening(builder, room, patch, left, right, opening)


def _add_opening(
    builder: MeshBuilder,
    room: Room,
    patch: Callable[..., list[FloatArray]],
    left: float,
    right: float,
    opening: Opening,
) -> None:
    low, high = opening.low_m, opening.high_m
    builder.quad(patch(left, right, high, HEIGHT_M), room.paper, (0, 0, 1, 1 - high / HEIGHT_M))
    if low > 0:
        builder.quad(patch(left, right, 0, low), room.paper, (0, 1 - low / HEIGHT_M, 1, 1))
    deep = 0.14 if opening.window else WALL_M
    front, back = patch(left, right, low, high), patch(left, right, low, high, deep)
    for a, b in ((0, 3), (1, 2)):  # the sides of the hole
        corners = [front[a], back[a], back[b], front[b]] if a == 0 else [back[a], front[a], front[b], back[b]]
        builder.quad(corners, "white")
    builder.quad([back[3], back[2], front[2], front[3]], "white")
    if opening.window:
        builder.quad([front[0], front[1], back[1], back[0]], "white")
        builder.quad(back, "view", lit=True)
    else:
        for a, b in ((left - 0.07, left), (right, right + 0.07)):
            builder.quad(patch(a, b, 0, high + 0.07, -0.012), "white")
        builder.quad(patch(left, right, high, high + 0.07, -0.012), "white")


EYE_M = 1.45
PROVENANCE = (
    "Built by this project's code from a seed: rooms and furniture of boxes; textures drawn in numpy and OpenCV; no "
    "data of others."
)


def _doors() -> dict[str, Opening]:
    return {
        "living": Opening(2.75, 3.65),
        "kitchen": Opening(7.75, 8.65),
        "bedroom": Opening(1.55, 2.45),
        "study": Opening(5.75, 6.65),
        "bath": Opening(9.1, 10.0),
        "passage": Opening(1.5, 3.3, 0.0, 2.25),
    }


def _rooms() -> tuple[Room, ...]:
    door = _doors()

    def window(left: float, right: float) -> Opening:
        return Opening(left, right, 0.85, 2.2, window=True)

    living = {"north": [door["living"]], "east": [door["passage"]], "south": [window(1.0, 2.4), window(3.4, 4.8)]}
    kitchen = {"north": [door["kitchen"]], "west": [door["passage"]], "east": [window(1.6, 3.0)]}
    hall = {
        "south": [door["living"], door["kitchen"]],
        "north": [door["bedroom"], door["study"], door["bath"]],
    }
    return (
        Room((0, 0), (6, 5), "paper_0", "parquet", living),
        Room((6, 0), (11, 5), "paper_4", "stone_floor", kitchen),
        Room((0, 5), (11, 6.5), "paper_1", "parquet", hall),
        Room((0, 6.5), (4.5, 10.2), "paper_3", "parquet", {"south": [door["bedroom"]], "north": [window(1.4, 3.0)]}),
        Room((4.5, 6.5), (8.2, 10.2), "paper_2", "parquet", {"south": [door["study"]], "north": [window(5.6, 7.2)]}),
        Room((8.2, 6.5), (11, 10.2), "ceramic", "stone_floor", {"south": [door["bath"]]}),
    )


def build_apartment(seed: int) -> World:
    """11 m x 10.2 m: living room, kitchen, hall, bedroom, study, bath; the path passes through all but the bath."""
    corners = [(1.0, 9.3), (2.0, 8.0), (2.0, 5.75), (3.2, 5.75), (3.2, 2.5), (7.6, 2.4), (8.2, 3.6), (8.2, 5.75)]
    way = _rounded(np.array([*corners, (6.2, 5.75), (6.2, 8.6)]))
    return World(
        kind="apartment",
        seed=seed,
        provenance=PROVENANCE,
        build=lambda: _surfaces(seed),
        path=np.column_stack([way, np.full(len(way), EYE_M)]),
        lanes=(Lane("person", (-0.7, 0.7), 2.0), Lane("box", (-0.9, 0.9), 1.0)),
        indoor=True,
        lamp_reach_m=6.0,
    )


def _surfaces(seed: int) -> Surfaces:
    rng = np.random.default_rng([seed, 12])
    atlas = pack(room_tiles(rng) | furniture_tiles(rng) | nature_tiles(rng) | occluder_tiles(rng))
    builder = MeshBuilder(atlas)
    for room in _rooms():
        add_room(builder, room)
    pictures = rng.permutation(PICTURES).tolist()
    _living(builder, rng, pictures)
    _kitchen(builder, rng, pictures)
    _quiet_rooms(builder, rng, pictures)
    places = ((3, 2.6), (8.5, 2.5), (2.8, 5.75), (8, 5.75), (2.3, 8.4), (6.4, 8.4), (9.6, 8.4))
    lamps = np.array([put.ceiling_lamp(builder, place) for place in places])
    return Surfaces(with_dark_corners(builder.mesh(), 1.2), atlas, lamps)


def _rounded(corners: FloatArray) -> FloatArray:
    """A polygon (P, 2) with its corners cut three times (Chaikin), ends kept."""
    for _ in range(3):
        first, second = 0.75 * corners[:-1] + 0.25 * corners[1:], 0.25 * corners[:-1] + 0.75 * corners[1:]
        inner = np.stack([first, second], axis=1).reshape(-1, 2)
        corners = np.concatenate([corners[:1], inner[1:-1], corners[-1:]])
    return corners


def _living(builder: MeshBuilder, rng: np.random.Generator, pictures: list[int]) -> None:
    put.sofa(builder, (0.5, 3.9), (2.5, 4.85), "cloth_0")
    put.table(builder, (0.9, 2.7), (2.1, 3.3), 0.42, "timber_1")
    builder.quad([[0.5, 2.0, 0.01], [2.6, 2.0, 0.01], [2.6, 3.7, 0.01], [0.5, 3.7, 0.01]], "rug")
    put.block(builder, (0.7, 0.12), (2.3, 0.5), (0.0, 0.45), "timber_2")
    put.block(builder, (0.9, 0.25), (2.1, 0.31), (0.5, 1.15), "screen")
    put.bookcase(builder, (0.08, 0.9), (0.4, 2.1), "east")
    put.bookcase(builder, (4.2, 4.6), (5.6, 4.92), "south")
    put.table(builder, (4.0, 0.9), (5.3, 1.8), 0.75, "timber_0")
    for middle, back in (((3.7, 1.35), "west"), ((4.65, 2.1), "north"), ((5.55, 1.1), "east")):
        put.chair(builder, middle, back, "timber_0")
    put.plant(builder, rng, (5.5, 3.9))
    put.picture(builder, (0.065, 3.2, 1.6), "east", pictures[0], (0.9, 0.7))
    put.picture(builder, (1.5, 4.935, 1.65), "south", pictures[1], (1.0, 0.7))
    put.picture(builder, (5.935, 4.2, 1.6), "west", pictures[2], (0.6, 0.8))


def _kitchen(builder: MeshBuilder, rng: np.random.Generator, pictures: list[int]) -> None:
    for index, x in enumerate(np.arange(6.3, 10.7, 0.6)):
        front = "oven" if index == 3 else "cupboard"
        put.block(builder, (x, 0.07), (x + 0.6, 0.65), (0.0, 0.86), front, top="timber_1")
        if index == 3:
            builder.quad([[x, 0.1, 0.87], [x + 0.6, 0.1, 0.87], [x + 0.6, 0.62, 0.87], [x, 0.62, 0.87]], "hob")
        else:
            put.block(builder, (x, 0.07), (x + 0.6, 0.4), (1.45, 2.15), "cupboard")
    put.block(builder, (10.3, 3.9), (10.92, 4.9), (0.0, 1.9), "white")
    put.table(builder, (9.2, 2.0), (10.2, 3.0), 0.75, "timber_1")
    put.chair(builder, (9.7, 3.3), "north", "timber_1")
    put.chair(builder, (8.9, 2.5), "west", "timber_1")
    put.picture(builder, (10.3, 4.935, 2.2), "south", pictures[3], (0.5, 0.35))
    put.picture(builder, (6.065, 4.2, 1.55), "east", pictures[4], (0.5, 0.7))
    put.plant(builder, rng, (6.5, 1.0 + 3.6))


def _quiet_rooms(builder: MeshBuilder, rng: np.random.Generator, pictures: list[int]) -> None:
    put.bed(builder, (2.5, 7.6), (4.2, 10.1))
    put.block(builder, (0.08, 6.7), (0.65, 8.3), (0, 2.1), "timber_1")
    put.block(builder, (2.05, 9.65), (2.45, 10.1), (0, 0.5), "timber_0")
    put.picture(builder, (4.435, 8.2, 1.6), "west", pictures[5], (0.8, 0.6))
    put.table(builder, (7.3, 7.6), (8.1, 9.2), 0.74, "timber_0")
    put.chair(builder, (7.0, 8.4), "west", "timber_2")
    put.block(builder, (7.9, 8.0), (7.95, 8.8), (0.8, 1.25), "screen")
    put.bookcase(builder, (4.57, 7.3), (4.85, 8.9), "east")
    put.picture(builder, (8.135, 7.1, 1.6), "west", pictures[6], (0.5, 0.7))
    put.picture(builder, (7.2, 6.565, 1.6), "north", pictures[7], (0.7, 0.5))
    put.block(builder, (8.3, 9.35), (10.9, 10.1), (0, 0.55), "white")
    put.block(builder, (10.35, 7.2), (10.9, 7.9), (0.6, 0.85), "white")
    put.block(builder, (0.08, 5.2), (0.4, 6.2), (0, 0.9), "timber_1")
    put.picture(builder, (5.0, 5.065, 1.6), "north", pictures[8], (0.8, 0.6))
    put.picture(builder, (10.935, 5.75, 1.6), "west", pictures[9], (0.6, 0.8))
    put.plant(builder, rng, (10.6, 5.4))
    for x, y, turn in ((2.42, 6.98, 1.45), (6.62, 6.98, 1.6), (3.68, 4.52, 1.5), (9.97, 6.98, 1.5)):
        builder.box([x - 0.43, y - 0.02, 0.01], [x + 0.43, y + 0.02, 2.05], "leaf", turn)
