"""A place built by code: its surfaces, its textures, and a path through it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from spherloc.errors import InputError
from spherloc.geometry import pose
from spherloc.types import FloatArray
from spherloc.worlds.mesh import Atlas, TexturedMesh, write_glb
from spherloc.worlds.rays import RayScene

MAX_POSES = 100_000


@dataclass(frozen=True)
class Lane:
    """Where things of one sort may stand that are there today only."""

    sort: str
    """"car", "person" or "box"."""
    offset_m: tuple[float, float]
    """From the path to the left, metres, lowest and highest; both signs where it lies on both sides."""
    weight: float = 1.0
    """How often this lane is chosen, compared with others."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What a world looks like."""

    mesh: TexturedMesh
    """All surfaces."""
    atlas: Atlas
    """Their textures, in summer."""
    lamps: FloatArray
    """(L, 3) places of lamps."""


@dataclass(frozen=True, eq=False)
class World:
    """Frame: metres, z up, gravity (0, 0, -1)."""

    kind: str
    """"street", "apartment" or "campus"."""
    seed: int
    """Of every random draw in its making."""
    provenance: str
    """Where geometry and textures come from."""
    build: Callable[[], Surfaces]
    """Makes its surfaces, which takes a second: who only asks for a route need not wait for them."""
    path: FloatArray
    """(P, 3) corners of the way that cameras travel, at the height of the eye."""
    lanes: tuple[Lane, ...]
    """Where occluders may stand."""
    indoor: bool = False
    """Lamps are always on, and no snow falls."""
    lamp_reach_m: float = 14.0
    """Beyond it a lamp gives no light."""

    @cached_property
    def surfaces(self) -> Surfaces:
        """Made when they are first asked for."""
        return self.build()

    @property
    def mesh(self) -> TexturedMesh:
        """All surfaces."""
        return self.surfaces.mesh

    @property
    def atlas(self) -> Atlas:
        """Their textures, in summer."""
        return self.surfaces.atlas

    @property
    def lamps(self) -> FloatArray:
        """(L, 3) places of lamps."""
        return self.surfaces.lamps

    @property
    def name(self) -> str:
        """Kind and seed."""
        return f"{self.kind} {self.seed}"

    @cached_property
    def rays(self) -> RayScene:
        """Finds what rays hit."""
        return RayScene(self.mesh)

    @property
    def length_m(self) -> float:
        """Of the path."""
        return float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())

    def along(self, share: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (N, 3) on the path and its level directions (N, 3) there, at ``share`` (N,) of its length, 0 to 1."""
        steps = np.linalg.norm(np.diff(self.path, axis=0), axis=1)
        travelled = np.concatenate([[0.0], np.cumsum(steps)])

        def place(at: FloatArray) -> FloatArray:
            return np.column_stack([np.interp(at, travelled, self.path[:, axis]) for axis in range(3)])

        at = np.clip(np.asarray(share, np.float64), 0, 1) * travelled[-1]
        # A direction over a short piece of the way turns smoothly at the path's corners.
        ahead = place(np.minimum(at + 0.75, travelled[-1])) - place(np.maximum(at - 0.75, 0.0))
        ahead[:, 2] = 0.0
        return place(at), ahead / np.linalg.norm(ahead, axis=1, keepdims=True)

    def route(
        self, count: int, offset_m: float = 0.0, heading_deg: float = 0.0, start: float = 0.0, stop: float = 1.0
    ) -> FloatArray:
        """Poses cam_from_world (count, 3, 4) of a level camera at equal distances along the path, looking along it.

        ``offset_m`` moves it to the left of the path and ``heading_deg`` turns it to the left; ``start`` and ``stop``
        are shares of the path's length. Raises ``InputError`` for an impossible count or a share outside 0 to 1.
        """
        if not 1 <= count <= MAX_POSES:
            raise InputError(f"world {self.name}: a route has {count} poses; give a count from 1 to {MAX_POSES:,}.")
        if not (0.0 <= start <= 1.0 and 0.0 <= stop <= 1.0):
            raise InputError(f"world {self.name}: a route goes from {start:g} to {stop:g}; give shares from 0 to 1.")
        places, ahead = self.along(np.linspace(start, stop, count))
        left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(count)])
        c, s = np.cos(np.radians(heading_deg)), np.sin(np.radians(heading_deg))
        forward, right = c * ahead + s * left, s * ahead - c * left
        down = np.broadcast_to([0.0, 0.0, -1.0], (count, 3))
        rotations = np.stack([right, down, forward], axis=1)
        return np.stack([pose(R, -R @ p) for R, p in zip(rotations, places + offset_m * left, strict=True)])

    def glb(self) -> bytes:
        """The mesh with its texture as a binary glTF in the world's own frame (z up), metres."""
        return self._glb

    @cached_property
    def _glb(self) -> bytes:
        return write_glb(self.mesh, self.atlas)

    def identity(self) -> tuple[Any, ...]:
        """What the world follows from, for keys of caches."""
        return self.kind, self.seed
