"""How textures change with the season: leaves and lawns turn, and snow lies on what faces the sky."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spherloc.worlds.atlas import Atlas

RECOLOUR: dict[str, dict[str, tuple[tuple[float, float, float], float]]] = {
    "summer": {},
    "spring": {"foliage": ((0.62, 0.72, 0.36), 0.55), "grass": ((0.42, 0.62, 0.22), 0.5)},
    "autumn": {"foliage": ((0.78, 0.40, 0.10), 0.85), "grass": ((0.55, 0.47, 0.22), 0.65)},
    "winter": {"foliage": ((0.52, 0.50, 0.50), 0.8), "grass": ((0.88, 0.90, 0.94), 0.9)},
}
"""By season and kind of tile: the colour it takes on at mean brightness, and how far."""

SNOW = np.array([0.90, 0.92, 0.97], np.float32)
"""sRGB of snow in plain light."""


@lru_cache(maxsize=8)
def recoloured(atlas: Atlas, season: str) -> Atlas:
    """The atlas in another season: brightness patterns stay, colours turn."""
    changes = RECOLOUR[season]
    if not changes:
        return atlas
    texels = atlas.texels.copy()
    for kind, (left, top, width, height) in zip(atlas.kinds, atlas.boxes.tolist(), strict=True):
        if kind in changes:
            colour, share = changes[kind]
            part = texels[top : top + height, left : left + width, :3]
            part[:] = _turned(part, np.asarray(colour, np.float32), share)
    return replace(atlas, texels=texels)


def _turned(texels: NDArray[np.uint8], colour: NDArray[np.float32], share: float) -> NDArray[np.uint8]:
    old = texels.astype(np.float32) / 255
    brightness = old.mean(axis=2, keepdims=True)
    new = colour * brightness / max(float(brightness.mean()), 1e-3)
    return np.round(255 * np.clip((1 - share) * old + share * new, 0, 1)).astype(np.uint8)
