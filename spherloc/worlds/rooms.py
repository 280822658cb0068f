"""Rooms: floor, ceiling, walls with openings for doors and windows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from spherloc.types import FloatArray
from spherloc.worlds.mesh import MeshBuilder

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
