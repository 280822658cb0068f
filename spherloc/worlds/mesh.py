"""A world's surfaces: triangles with texture coordinates, all textures in one image, and both as binary glTF 2.0."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from spherloc.types import ByteArray, FloatArray

WIDTH = 2048


@dataclass(frozen=True, eq=False)
class Atlas:
    """Tiles with sides of powers of two, packed so that none leaks into the smaller copies of another."""

    texels: ByteArray
    """(H, W, 4): red, green, blue, and how much a texel shines when it is lit."""
    names: tuple[str, ...]
    """Of the tiles."""
    kinds: tuple[str, ...]
    """What each tile shows ("wall", "foliage", "grass", ...): seasons recolour by kind."""
    boxes: NDArray[np.int32]
    """(T, 4): left, top, width, height of each tile, texels."""

    @cached_property
    def index(self) -> Mapping[str, int]:
        """Number of a tile by its name."""
        return {name: number for number, name in enumerate(self.names)}

    @cached_property
    def pyramid(self) -> tuple[ByteArray, ...]:
        """The atlas, and copies of half the size each."""
        levels: list[Any] = [self.texels]
        for _ in range(int(np.log2(self.boxes[:, 2:].min())), 0, -1):
            height, width = levels[-1].shape[:2]
            levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
        return tuple(levels)

    def sample(self, at: NDArray[np.float32], tiles: NDArray[np.int32], level: NDArray[np.float32]) -> NDArray:
        """Values (N, 4), float32 from 0 to 255, at ``at`` (N, 2) in texels, between the two nearest of the copies.

        ``level`` (N,) is the logarithm to base 2 of the pixel's size in texels; never beyond two texels of the tile.
        """
        boxes = self.boxes[tiles].astype(np.float32)
        most = np.minimum(np.log2(boxes[:, 2:].min(axis=1)) - 1, len(self.pyramid) - 1)
        level = np.clip(level, 0, most)
        below = np.floor(level).astype(np.int32)
        share = (level - below)[:, None]
        upper = np.minimum(below + 1, most.astype(np.int32))
        return (1 - share) * self._at_level(at, boxes, below) + share * self._at_level(at, boxes, upper)

    def _at_level(self, at: NDArray, boxes: NDArray, level: NDArray[np.int32]) -> NDArray:
        values = np.zeros((len(at), 4), dtype=np.float32)
        for number, image in enumerate(self.pyramid):
            chosen = np.flatnonzero(level == number)
            if len(chosen) == 0:
                continue
            scale = np.float32(0.5**number)
            low = boxes[chosen, :2] * scale + 0.5
            high = (boxes[chosen, :2] + boxes[chosen, 2:]) * scale - 0.5
            # OpenCV puts texel centres at whole numbers, and its maps have a limited width.
            spot = np.clip(at[chosen] * scale, low, high) - 0.5
            rows = -(-len(chosen) // 1024)
            maps = np.zeros((rows * 1024, 2), dtype=np.float32)
            maps[: len(chosen)] = spot
            maps = maps.reshape(rows, 1024, 2)
            found = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
            values[chosen] = found.reshape(-1, 4)[: len(chosen)]
        return values


def pack(tiles: Mapping[str, tuple[str, ByteArray]]) -> Atlas:
    """An atlas of named tiles (kind, (H, W, 4) with sides of powers of two up to ``WIDTH``)."""
    order = sorted(tiles, key=lambda name: (*(-size for size in tiles[name][1].shape[:2]), name))
    boxes, left, top, shelf = {}, 0, 0, 0
    for name in order:
        height, width = tiles[name][1].shape[:2]
        if left + width > WIDTH:
            left, top = 0, top + shelf
        shelf = height if left == 0 else shelf
        boxes[name] = (left, top, width, height)
        left += width
    texels = np.zeros((top + shelf, WIDTH, 4), dtype=np.uint8)
    for name, (x, y, width, height) in boxes.items():
        texels[y : y + height, x : x + width] = tiles[name][1]
    return Atlas(texels, tuple(tiles), tuple(tiles[n][0] for n in tiles), np.array([boxes[n] for n in tiles], np.int32))


WHITE = (1.0, 1.0, 1.0)
WHOLE = (0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class TexturedMesh:
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


def joined(meshes: Sequence[TexturedMesh]) -> TexturedMesh:
    """One mesh of several that share an atlas."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    surfaces = np.cumsum([0, *(int(mesh.surface.max(initial=-1)) + 1 for mesh in meshes)])
    return TexturedMesh(
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
    parts: list[TexturedMesh] = field(default_factory=list)
    """What was added so far."""

    def mesh(self) -> TexturedMesh:
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
            TexturedMesh(
                vertices=vertices,
                faces=faces,
                uv=box[:2] + np.asarray(at, np.float32) * box[2:],
                tint=np.broadcast_to(np.asarray(tint, np.float32), (len(vertices), 3)),
                tile=np.full(len(faces), number, np.int32),
                surface=np.broadcast_to(np.asarray(surfaces, np.int32), len(faces)),
                lit=np.full(len(faces), lit),
            )
        )


MAX_BYTES = 400_000
MIN_TEXTURE_BYTES = 60_000
HEADER_BYTES = 2_000
FLOAT, USHORT, UINT, UBYTE = 5126, 5123, 5125, 5121


def write_glb(mesh: TexturedMesh, atlas: Atlas) -> bytes:
    """Vertices as they are (metres, the mesh's own frame), tints as vertex colours, and the atlas as a small JPEG."""
    height, width = atlas.texels.shape[:2]
    vertices = mesh.vertices.astype(np.float32)
    uv = np.round(np.clip(mesh.uv / (width, height), 0, 1) * 65535).astype(np.uint16)
    colour = np.full((len(mesh.tint), 4), 255, np.uint8)
    colour[:, :3] = np.round(np.clip(mesh.tint, 0, 1) * 255)
    index = mesh.faces.astype(np.uint16 if len(vertices) <= 65535 else np.uint32)
    parts = [index.tobytes(), vertices.tobytes(), uv.tobytes(), colour.tobytes()]
    parts.append(_jpeg(atlas, max(MIN_TEXTURE_BYTES, MAX_BYTES - HEADER_BYTES - sum(map(len, parts)))))
    views, binary = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part + b"\0" * (-len(part) % 4)
    box = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    count, whole = len(vertices), USHORT if index.itemsize == 2 else UINT
    accessors = [
        {"bufferView": 0, "componentType": whole, "count": index.size, "type": "SCALAR"},
        {"bufferView": 1, "componentType": FLOAT, "count": count, "type": "VEC3"} | box,
        {"bufferView": 2, "componentType": USHORT, "normalized": True, "count": count, "type": "VEC2"},
        {"bufferView": 3, "componentType": UBYTE, "normalized": True, "count": count, "type": "VEC4"},
    ]
    return _container(_document(accessors, views, len(binary)), binary)


def _document(accessors: list[dict[str, Any]], views: list[dict[str, Any]], length: int) -> dict[str, Any]:
    """The JSON part: one mesh with one matt material."""
    attributes = {"POSITION": 1, "TEXCOORD_0": 2, "COLOR_0": 3}
    matt = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {
        "asset": {"version": "2.0", "generator": "spherloc"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": matt}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/jpeg"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    header = json.dumps(document, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    chunks = struct.pack("<I4s", len(header), b"JSON") + header + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _jpeg(atlas: Atlas, most_bytes: int) -> bytes:
    """The largest of the atlas's smaller copies that fits, at the best quality that fits."""
    content = b""
    for image in atlas.pyramid[1:4]:
        for quality in (85, 70, 50):
            done, data = cv2.imencode(".jpg", image[..., 2::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
            content = data.tobytes() if done else b""
            if len(content) <= most_bytes:
                return content
    return content
