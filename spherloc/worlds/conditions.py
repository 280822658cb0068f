"""Under which conditions a picture is taken: light, season, passers-by, and the camera's own faults."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, show
from spherloc.worlds.mesh import Atlas


@dataclass(frozen=True)
class Light:
    """Linear brightness of what lights a world; 1 makes a white wall white."""

    sun: tuple[float, float, float]
    """Red, green, blue of the sun on a surface that faces it."""
    sky: tuple[float, float, float]
    """Of the light from above on a level surface."""
    azimuth_deg: float
    """Where the sun stands, anticlockwise from the world's x axis."""
    elevation_deg: float
    """Its height above the horizon."""
    zenith: tuple[float, float, float]
    """Colour of the sky above."""
    horizon: tuple[float, float, float]
    """Colour of the sky at the horizon, and of the haze."""
    clouds: float
    """How much of the sky they cover, 0 to 1."""
    lamps: float
    """Strength of lamps and lit windows, 0 to 1."""


LIGHTS = {
    "day": Light((1.25, 1.15, 0.98), (0.42, 0.48, 0.58), 55, 42, (0.10, 0.24, 0.60), (0.62, 0.74, 0.90), 0.45, 0.0),
    "morning": Light((1.1, 0.92, 0.68), (0.38, 0.44, 0.55), 150, 24, (0.16, 0.30, 0.62), (0.85, 0.80, 0.76), 0.3, 0.0),
    "overcast": Light((0.0, 0.0, 0.0), (0.82, 0.86, 0.92), 55, 50, (0.62, 0.66, 0.72), (0.82, 0.84, 0.87), 1.0, 0.0),
    "dusk": Light((0.55, 0.26, 0.10), (0.17, 0.17, 0.26), 205, 9, (0.06, 0.08, 0.22), (0.85, 0.38, 0.16), 0.55, 0.8),
    "night": Light(
        (0.03, 0.035, 0.05), (0.02, 0.024, 0.04), 100, 50, (0.006, 0.008, 0.02), (0.03, 0.03, 0.05), 0.2, 1.0
    ),
}
"""By name."""

SEASONS = ("summer", "spring", "autumn", "winter")

LIMITS = {
    "sun_azimuth_deg": (-360.0, 360.0),
    "sun_elevation_deg": (2.0, 90.0),
    "occluders": (0, 60),
    "motion_blur_px": (0.0, 40.0),
    "defocus_px": (0.0, 20.0),
    "noise": (0.0, 80.0),
    "exposure_stops": (-4.0, 4.0),
}


@dataclass(frozen=True)
class Conditions:
    """Of one picture; the default is a clear summer day, nobody about, and a perfect camera."""

    light: str = "day"
    """One of ``LIGHTS``."""
    season: str = "summer"
    """One of ``SEASONS``: leaves and lawns turn with it, and winter brings snow."""
    sun_azimuth_deg: float | None = None
    """Where the sun stands, anticlockwise from the world's x axis; None for what the light says."""
    sun_elevation_deg: float | None = None
    """Its height above the horizon; None for what the light says."""
    occluders: int = 0
    """How many cars, people and boxes stand about that the map has not."""
    motion_blur_px: float = 0.0
    """Length of the smear that a turning camera makes, px, along the rows."""
    defocus_px: float = 0.0
    """Standard deviation of an unsharp lens's blur, px."""
    noise: float = 0.0
    """Standard deviation of the sensor's noise, grey levels of 255."""
    exposure_stops: float = 0.0
    """Brighter (positive) or darker by powers of two."""

    def __post_init__(self) -> None:
        for key, known in (("light", tuple(LIGHTS)), ("season", SEASONS)):
            if getattr(self, key) not in known:
                raise InputError(f"conditions: no {key} {show(getattr(self, key))}; there are {', '.join(known)}.")
        for key in LIMITS:
            if getattr(self, key) is not None or not key.startswith("sun_"):
                object.__setattr__(self, key, _limited(key, getattr(self, key)))


def _limited(key: str, value: Any) -> float | int:
    lowest, highest = LIMITS[key]
    whole = key == "occluders"
    if not _is_number(value, whole) or not lowest <= value <= highest:
        kind = "whole number" if whole else "number"
        raise InputError(f"conditions: {key} is {show(value)}; give a {kind} from {lowest:g} to {highest:g}.")
    return int(value) if whole else float(value)


def _is_number(value: Any, whole: bool) -> bool:
    return isinstance(value, int if whole else (int, float)) and not isinstance(value, bool)


CLEAR = Conditions()
"""A clear summer day."""


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
