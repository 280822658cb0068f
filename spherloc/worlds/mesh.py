"""Triangles with texture coordinates, and the builder that worlds are made with."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spherloc.types import FloatArray
from spherloc.worlds.atlas import Atlas

WHITE = (1.0, 1.0, 1.0)
WHOLE = (0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Textured triangles; seen from the front, their corners go anticlockwise."""

    vertices: FloatArray
    """(V, 3), metres."""
    faces: NDArray[np.int32]
    """(F, 3) indices of vertices."""
    uv: NDArray[np.float32]
    """(V, 2), texels of the atlas."""
    tint: NDArray[np.float32]
    """(V, 3): multiplies the texture's colour."""
    tile: NDArray[np.int32]
    """(F,) index of the atlas's tile."""
    surface: NDArray[np.int32]
    """(F,): number of the part (a quadrilateral, a post, a crown) that a face belongs to."""
    lit: NDArray[np.bool_]
    """(F,): a lamp is on behind this face's glass."""

    def normals(self) -> FloatArray:
        """Unit normals (F, 3)."""
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)

    def texels_per_metre(self) -> NDArray[np.float32]:
        """(F,): square root of a face's area in the atlas over its area in the world."""
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        d, e, f = (self.uv[self.faces[:, corner]].astype(np.float64) for corner in range(3))
        world = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        flat = np.abs((e - d)[:, 0] * (f - d)[:, 1] - (e - d)[:, 1] * (f - d)[:, 0])
        return np.sqrt(flat / np.maximum(world, 1e-12)).astype(np.float32)


def xyz(x: float, y: float, z: float) -> FloatArray:
    """A vector (3,)."""
    return np.array([x, y, z], dtype=np.float64)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several that share an atlas."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    surfaces = np.cumsum([0, *(int(mesh.surface.max(initial=-1)) + 1 for mesh in meshes)])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=False)]).astype(np.int32),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
        tint=np.concatenate([mesh.tint for mesh in meshes]),
        tile=np.concatenate([mesh.tile for mesh in meshes]),
        surface=np.concatenate([m.surface + s for m, s in zip(meshes, surfaces, strict=False)]).astype(np.int32),
        lit=np.concatenate([mesh.lit for mesh in meshes]),
    )


@dataclass
class MeshBuilder:
    """Collects surfaces. Sizes in metres, z up; ``tile`` names a tile of the atlas."""

    atlas: Atlas
    """Where the tiles are."""
    parts: list[Mesh] = field(default_factory=list)
    """What was added so far."""

    def mesh(self) -> Mesh:
        """All of it as one."""
        return joined(self.parts)

    def quad(
        self,
        corners: ArrayLike,
        tile: str,
        uv: Sequence[float] = WHOLE,
        tint: ArrayLike = WHITE,
        lit: bool = False,
    ) -> None:
        """A flat quadrilateral (4, 3), seen from the front: bottom left, bottom right, top right, top left.

        ``uv`` is the part of the tile (left, top, right, bottom) from 0 to 1 that it shows; ``tint`` is (3,) or (4, 3).
        """
        left, top, right, bottom = uv
        at = [(left, bottom), (right, bottom), (right, top), (left, top)]
        self.add(np.asarray(corners, np.float64), [[0, 1, 2], [0, 2, 3]], at, tile, tint, lit)

    def sheet(
        self, origin: ArrayLike, right: ArrayLike, up: ArrayLike, cells: tuple[int, int], tile: str, **more: Any
    ) -> None:
        """A parallelogram from its bottom left corner ``origin``, spanned by two vectors, of (columns, rows) tiles."""
        start, along, above = (np.asarray(vector, np.float64) for vector in (origin, right, up))
        columns, rows = cells
        for row in range(rows):
            for column in range(columns):
                low = start + along * (column / columns) + above * (row / rows)
                steps = np.array([along * 0, along / columns, along / columns + above / rows, above / rows])
                self.quad(low + steps, tile, **more)

    def box(
        self, low: ArrayLike, high: ArrayLike, tile: str, turn_rad: float = 0.0, top: str | None = None, **more: Any
    ) -> None:
        """A box without its bottom, turned about the vertical through its middle; ``top`` names the tile above."""
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        middle, half = (low + high) / 2, (high - low) / 2
        c, s = np.cos(turn_rad), np.sin(turn_rad)

        def corner(x: int, y: int, z: int) -> FloatArray:
            dx, dy, dz = half * (x, y, z)
            return middle + xyz(c * dx - s * dy, s * dx + c * dy, dz)

        for (x0, y0), (x1, y1) in (
            ((-1, -1), (1, -1)),
            ((1, -1), (1, 1)),
            ((1, 1), (-1, 1)),
            ((-1, 1), (-1, -1)),
        ):
            self.quad([corner(x0, y0, -1), corner(x1, y1, -1), corner(x1, y1, 1), corner(x0, y0, 1)], tile, **more)
        lid = [corner(-1, -1, 1), corner(1, -1, 1), corner(1, 1, 1), corner(-1, 1, 1)]
        self.quad(lid, top or tile, **more)

    def prism(
        self,
        foot: ArrayLike,
        head: ArrayLike,
        radii: tuple[float, float],
        tile: str,
        sides: int = 8,
        tint: ArrayLike = WHITE,
    ) -> None:
        """A round post or trunk from ``foot`` to ``head`` with a radius at each; the tile goes around it once."""
        foot, head = np.asarray(foot, np.float64), np.asarray(head, np.float64)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides + 1)])
        vertices = np.concatenate([foot + radii[0] * ring, head + radii[1] * ring])
        at = np.array([(k / sides, 1 - row) for row in range(2) for k in range(sides + 1)])
        n = sides + 1
        faces = [f for k in range(sides) for f in ([k, k + 1, n + k + 1], [k, n + k + 1, n + k])]
        self.add(vertices, faces, at, tile, tint)

    def blob(
        self,
        rng: np.random.Generator,
        centre: ArrayLike,
        radii: ArrayLike,
        tile: str,
        bumps: float = 0.18,
        tint: ArrayLike = WHITE,
        fine: int = 2,
    ) -> None:
        """A bumpy ball: the crown of a tree, a bush, a head."""
        import trimesh  # takes half a second

        ball = trimesh.creation.icosphere(subdivisions=fine)
        direction = np.asarray(ball.vertices)
        shape = 1 + bumps * rng.uniform(-1, 1, len(direction))
        vertices = np.asarray(centre) + direction * np.asarray(radii) * shape[:, None]
        # Folded back and forth, so that there is no seam where a triangle would span the whole tile.
        longitude = np.arctan2(direction[:, 1], direction[:, 0])
        at = np.column_stack([np.abs(longitude) / np.pi, np.arccos(np.clip(direction[:, 2], -1, 1)) / np.pi])
        self.add(vertices, ball.faces, at, tile, tint)

    def add(
        self,
        vertices: FloatArray,
        faces: ArrayLike,
        at: ArrayLike,
        tile: str,
        tint: ArrayLike = WHITE,
        lit: bool = False,
        surfaces: ArrayLike = 0,
    ) -> None:
        """Triangles (F, 3) over vertices (V, 3) whose places in the tile are ``at`` (V, 2), 0 to 1 from its top left.

        Triangles with the same number in ``surfaces`` ((F,) or one for all) are one part.
        """
        number = self.atlas.index[tile]
        box = self.atlas.boxes[number].astype(np.float32)
        faces = np.asarray(faces, dtype=np.int32)
        self.parts.append(
            Mesh(
                vertices=vertices,
                faces=faces,
                uv=box[:2] + np.asarray(at, np.float32) * box[2:],
                tint=np.broadcast_to(np.asarray(tint, np.float32), (len(vertices), 3)),
                tile=np.full(len(faces), number, np.int32),
                surface=np.broadcast_to(np.asarray(surfaces, np.int32), len(faces)),
                lit=np.full(len(faces), lit),
            )
        )
