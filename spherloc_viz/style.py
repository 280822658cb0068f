"""One colour means one thing, in the page, in the recording and in the documentation."""

import numpy as np
from numpy.typing import NDArray

RGB = tuple[int, int, int]

INLIER: RGB = (0, 158, 115)
OUTLIER: RGB = (213, 70, 60)
CLIQUE: RGB = (240, 180, 30)
ESTIMATE: RGB = (40, 120, 220)
TRUTH: RGB = (160, 130, 210)
ALTERNATIVE: RGB = (110, 205, 215)
SAMPLE: RGB = (230, 90, 190)
UNDECIDED: RGB = (140, 146, 156)
SPHERE: RGB = (170, 190, 215)
SELECTED: RGB = (176, 36, 228)
SCALE: RGB = (128, 132, 140)
"""Colour of the scale bar."""
CLOUD: RGB = (78, 84, 96)
REFERENCE: RGB = (200, 150, 110)
"""Colours of a map's points, fainter than any match, and of the places where its images were taken."""
GROUND: RGB = (70, 74, 82)
GROUND_ON_LIGHT: RGB = (200, 204, 210)
"""Colours of the grid at the foot of the map, faint on dark and on light."""

LEGEND: tuple[tuple[RGB, str], ...] = (
    (INLIER, "inlier"),
    (OUTLIER, "outlier"),
    (CLIQUE, "maximum clique"),
    (SAMPLE, "tried"),
    (ESTIMATE, "estimate"),
    (TRUTH, "truth"),
    (ALTERNATIVE, "alternative pose"),
    (UNDECIDED, "not decided yet"),
    (SELECTED, "selected"),
)
"""What each colour means, in the order in which the legend shows it."""

LAYERS: tuple[str, ...] = (
    "mesh",
    "point cloud",
    "ground",
    "map",
    "cameras",
    "uncertainty",
    "trajectory",
    "sphere",
    "image",
    "rays",
    "yaw ring",
    "balls",
    "pairs",
    "boxes",
    "selection",
    "scale bar",
)
"""Layers of the canvas that can be switched on and off."""

MAX_DRAWN_MATCHES = 120
MAX_DRAWN_RAYS = 600
MAX_DRAWN_ARCS = 240
MAX_DRAWN_BALLS = 40
MAX_DRAWN_PAIRS = 200
MAX_DRAWN_ALTERNATIVES = 8
MAX_SELECTED_DOTS = 500
MAX_SELECTED_CIRCLES = 8
MAX_SELECTED_ARCS = 40
MAX_SELECTED_BALLS = 8

DIM = 0.6
"""How far the colours of what is not selected move towards grey."""


def blended(first: RGB, last: RGB, share: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (K, 3) between two, by the share (K,) of the last one."""
    start, end = np.array(first, np.float64), np.array(last, np.float64)
    return np.round(start + share[:, None] * (end - start)).astype(np.uint8)


def css(color: RGB) -> str:
    """The colour as "#rrggbb"."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def css_text(color: RGB) -> str:
    """The colour for words: nearer to that of the words around, so that it reads on dark and on light."""
    return f"color-mix(in srgb, {css(color)} 45%, currentColor)"


ERROR_RAMP: tuple[RGB, ...] = ((48, 96, 214), (60, 190, 180), (245, 205, 70))
"""Colours of errors from zero to the largest success: the bluer, the smaller (as in Fig. 10). Failures are red."""


def error_scale(errors: NDArray[np.float64], limit: float) -> float:
    """The error with the ramp's last colour: the largest within ``limit``, so that small errors use all colours too."""
    within = errors[errors <= limit]
    return float(within.max(initial=0.0)) or limit


def error_colors(errors: NDArray[np.float64], limit: float) -> NDArray[np.uint8]:
    """Colours (N, 3) of errors (N,) by the ramp over ``error_scale``; beyond ``limit``, or unknown, the outliers'."""
    ramp = np.array(ERROR_RAMP, dtype=np.float64)
    share = np.nan_to_num(errors / error_scale(errors, limit), nan=1.0, posinf=1.0)
    place = (len(ramp) - 1) * np.clip(share, 0.0, 1.0)
    columns = [np.interp(place, np.arange(len(ramp)), ramp[:, channel]) for channel in range(3)]
    colors = np.column_stack(columns).round().astype(np.uint8)
    colors[~(errors <= limit)] = OUTLIER
    return colors
