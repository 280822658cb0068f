"""Furniture made of boxes, trees, lamps and benches. A piece stands on ``low`` (x, y) to ``high`` (x, y), metres."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spherloc.types import FloatArray
from spherloc.worlds.mesh import MeshBuilder, xyz

XY = tuple[float, float]


def block(builder: MeshBuilder, low: XY, high: XY, z: XY, tile: str, **more: Any) -> None:
    """A plain box between two heights."""
    builder.box([*low, z[0]], [*high, z[1]], tile, **more)


def table(builder: MeshBuilder, low: XY, high: XY, tall_m: float, tile: str) -> None:
    """A board on four legs."""
    block(builder, low, high, (tall_m - 0.05, tall_m), tile)
    under = [low[0], high[1], tall_m - 0.05], [high[0], low[1], tall_m - 0.05]
    builder.quad(
        [under[0], [high[0], high[1], tall_m - 0.05], under[1], [low[0], low[1], tall_m - 0.05]], tile, tint=(0.5,) * 3
    )
    for x in (low[0] + 0.05, high[0] - 0.05):
        for y in (low[1] + 0.05, high[1] - 0.05):
            block(builder, (x - 0.03, y - 0.03), (x + 0.03, y + 0.03), (0, tall_m - 0.05), tile)


def chair(builder: MeshBuilder, middle: XY, back: str, tile: str) -> None:
    """With its back to the "north", "south", "west" or "east"."""
    x, y = middle
    table(builder, (x - 0.21, y - 0.21), (x + 0.21, y + 0.21), 0.46, tile)
    dx, dy = {"north": (0, 0.19), "south": (0, -0.19), "west": (-0.19, 0), "east": (0.19, 0)}[back]
    half = (0.21, 0.02) if dx == 0 else (0.02, 0.21)
    block(builder, (x + dx - half[0], y + dy - half[1]), (x + dx + half[0], y + dy + half[1]), (0.46, 0.92), tile)


def sofa(builder: MeshBuilder, low: XY, high: XY, tile: str) -> None:
    """With its back along the highest y."""
    block(builder, low, high, (0.08, 0.42), tile)
    block(builder, (low[0], high[1] - 0.22), high, (0.42, 0.82), tile)
    for x in (low[0], high[0] - 0.2):
        block(builder, (x, low[1]), (x + 0.2, high[1]), (0.42, 0.6), tile)
    for x in np.linspace(low[0] + 0.45, high[0] - 0.45, 3):
        builder.box([x - 0.2, high[1] - 0.36, 0.42], [x + 0.2, high[1] - 0.22, 0.74], "cloth_1", tint=(0.9, 0.8, 0.6))


def bed(builder: MeshBuilder, low: XY, high: XY) -> None:
    """With its head along the highest y."""
    block(builder, low, high, (0.12, 0.3), "timber_0")
    block(builder, (low[0] + 0.03, low[1] + 0.03), (high[0] - 0.03, high[1] - 0.05), (0.3, 0.5), "cloth_2")
    block(builder, (low[0], low[1]), (high[0], high[1] - 0.7), (0.46, 0.56), "cloth_0", tint=(0.8, 0.9, 1.0))
    block(builder, (low[0], high[1] - 0.06), high, (0.0, 0.95), "timber_0")
    middle = (low[0] + high[0]) / 2
    for x in (low[0] + 0.1, middle + 0.05):
        block(builder, (x, high[1] - 0.5), (x + middle - low[0] - 0.15, high[1] - 0.1), (0.5, 0.62), "white")


def bookcase(builder: MeshBuilder, low: XY, high: XY, facing: str) -> None:
    """2 m tall, its books towards the "south", "east" or "west"."""
    block(builder, low, high, (0, 2.0), "timber_0")
    (x0, y0), (x1, y1) = low, high
    faces = {
        "south": [(x0, y0 - 0.005), (x1, y0 - 0.005)],
        "east": [(x1 + 0.005, y0), (x1 + 0.005, y1)],
        "west": [(x0 - 0.005, y1), (x0 - 0.005, y0)],
    }
    a, b = faces[facing]
    builder.quad([[*a, 0.05], [*b, 0.05], [*b, 1.95], [*a, 1.95]], "books")


def picture(builder: MeshBuilder, middle: tuple[float, float, float], facing: str, number: int, size: XY) -> None:
    """On a wall, looking "south", "north", "east" or "west" into the room."""
    right = {"south": (1, 0, 0), "north": (-1, 0, 0), "east": (0, 1, 0), "west": (0, -1, 0)}[facing]
    across, up = 0.5 * size[0] * np.array(right), np.array([0, 0, 0.5 * size[1]])
    corners = np.array([-across - up, across - up, across + up, up - across])
    builder.quad(np.array(middle) + corners, f"picture_{number}")


def plant(builder: MeshBuilder, rng: np.random.Generator, place: XY) -> None:
    """In a pot."""
    builder.prism([*place, 0], [*place, 0.38], (0.14, 0.19), "cloth_1", 10)
    for _ in range(3):
        centre = np.array([*place, 0.7]) + rng.normal(0, 0.12, 3) * (1, 1, 1.6)
        builder.blob(rng, centre, (0.22, 0.22, 0.3), "leaves_1", 0.45, fine=1)


def ceiling_lamp(builder: MeshBuilder, place: XY) -> tuple[float, float, float]:
    """A flat shade under the ceiling; returns where its light is."""
    builder.prism([*place, 2.5], [*place, 2.6], (0.2, 0.24), "shade", 12)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    flat = np.column_stack([np.cos(angle), np.sin(angle)])
    rim = np.column_stack([place + 0.2 * flat, np.full(12, 2.5)])
    builder.add(rim, [(0, k + 1, k) for k in range(1, 11)], 0.5 + 0.5 * flat, "shade", lit=True)
    return (*place, 2.4)


def add_tree(
    builder: MeshBuilder, rng: np.random.Generator, foot: ArrayLike, tall_m: float = 6.5, crowns: int = 6
) -> None:
    """A trunk and a crown of a few bumpy balls."""
    foot = np.asarray(foot, np.float64)
    lean = np.append(rng.normal(0, 0.12, 2), 0.0)
    fork = foot + lean + xyz(0, 0, 0.45 * tall_m)
    builder.prism(foot, fork, (0.022 * tall_m + 0.04, 0.02 * tall_m), "bark", 7)
    tile = f"leaves_{int(rng.integers(3))}"
    for index in range(crowns):
        angle, low = 2.4 * index + rng.uniform(0, 0.5), index < 4 - 2 * (crowns < 4)
        out = tall_m * (0.17 if low else 0.08)
        centre = fork + xyz(out * np.cos(angle), out * np.sin(angle), tall_m * rng.uniform(0.08, 0.2))
        centre[2] += 0.0 if low else 0.2 * tall_m
        radii = tall_m * rng.uniform(0.12, 0.17) * np.array([1, 1, 0.85])
        builder.blob(rng, centre, radii, tile, bumps=0.3, tint=rng.uniform(0.7, 1.0) * np.ones(3), fine=1)


def add_lamp(builder: MeshBuilder, foot: ArrayLike, tall_m: float = 4.2) -> FloatArray:
    """A lantern on a post; returns where its light is (3,)."""
    foot = np.asarray(foot, np.float64)
    head = foot + xyz(0, 0, tall_m)
    builder.prism(foot, foot + xyz(0, 0, 0.5), (0.13, 0.09), "metal", 6)
    builder.prism(foot, head, (0.055, 0.045), "metal", 6)
    builder.box(head - xyz(0.16, 0.16, 0), head + xyz(0.16, 0.16, 0.42), "lantern", top="metal", lit=True)
    return head + xyz(0, 0, -0.15)


def add_bench(builder: MeshBuilder, place: ArrayLike, turn_rad: float) -> None:
    """Seat, back and two feet."""
    place = np.asarray(place, np.float64)
    across = np.array([-np.sin(turn_rad), np.cos(turn_rad), 0.0])
    along = np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    builder.box(place + xyz(-0.9, -0.22, 0.4), place + xyz(0.9, 0.22, 0.47), "planks", turn_rad)
    back = place + 0.24 * across
    builder.box(back + xyz(-0.9, -0.03, 0.47), back + xyz(0.9, 0.03, 0.9), "planks", turn_rad)
    for side in (-0.7, 0.7):
        middle = place + side * along
        builder.box(middle - xyz(0.05, 0.2, 0), middle + xyz(0.05, 0.2, 0.4), "metal", turn_rad)
