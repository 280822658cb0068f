"""Trees, lamps and benches."""

import numpy as np
from numpy.typing import ArrayLike

from spherloc.types import FloatArray
from spherloc.worlds.mesh import MeshBuilder, xyz


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
