"""All textures of a world in one image, with smaller copies for distant surfaces."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.types import ByteArray

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
