"""Places built by code, and pictures of them through any camera, with exact depth and poses."""

from collections.abc import Callable
from functools import lru_cache

from spherloc.errors import InputError, show
from spherloc.worlds.apartment import build_apartment
from spherloc.worlds.conditions import Conditions
from spherloc.worlds.houses import build_campus, build_street
from spherloc.worlds.render import Render, image_path, render, stored_range
from spherloc.worlds.world import World

__all__ = ["WORLDS", "Conditions", "Render", "World", "build_world", "image_path", "render", "stored_range"]

WORLDS: dict[str, Callable[[int], World]] = {
    "street": build_street,
    "apartment": build_apartment,
    "campus": build_campus,
}
"""By kind."""


@lru_cache(maxsize=8)
def build_world(kind: str, seed: int = 0) -> World:
    """The world of that kind; another seed gives another one of the same sort.

    Raises ``InputError`` for an unknown kind or a negative seed.
    """
    if kind not in WORLDS:
        raise InputError(f"no world {show(kind)}; there are {', '.join(WORLDS)}.")
    if seed < 0:
        raise InputError(f"world {kind}: seed is {seed}; give 0 or more.")
    return WORLDS[kind](seed)
