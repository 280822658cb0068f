"""One colour means one thing, in the page, in the recording and in the documentation."""

import numpy as np
from numpy.typing import NDArray

RGB = tuple[int, int, int]

INLIER: RGB = (0, 158, 115)
OUTLIER: RGB = (213, 70, 60)
CLIQUE: RGB = (240, 180, 30)
ESTIMATE: RGB = (40, 120, 220)
TRUTH: RGB = (160, 130, 210)
RIVAL: RGB = (110, 205, 215)
SAMPLE: RGB = (230, 90, 190)
UNDECIDED: RGB = (140, 146, 156)
SPHERE: RGB = (170, 190, 215)

LEGEND: tuple[tuple[RGB, str], ...] = (
    (INLIER, "inlier"),
    (OUTLIER, "outlier"),
    (CLIQUE, "maximum clique"),
    (SAMPLE, "sample"),
    (ESTIMATE, "estimate"),
    (TRUTH, "truth"),
    (RIVAL, "rival pose"),
    (UNDECIDED, "not decided yet"),
)
"""What each colour means, in the order in which the legend shows it."""

LAYERS: tuple[str, ...] = ("mesh", "map", "cameras", "trajectory", "sphere", "rays", "yaw ring", "balls", "pairs")
"""Layers of the canvas that can be switched on and off."""

MAX_DRAWN_MATCHES = 120
MAX_DRAWN_RAYS = 600
MAX_DRAWN_ARCS = 240
MAX_DRAWN_BALLS = 70
MAX_DRAWN_PAIRS = 200
MAX_DRAWN_RIVALS = 8


def css(color: RGB) -> str:
    """The colour as "#rrggbb"."""
    return "#{:02x}{:02x}{:02x}".format(*color)


ERROR_RAMP: tuple[RGB, ...] = ((48, 96, 214), (72, 190, 190), (245, 205, 70), (214, 62, 48))
"""Colours of errors from zero to the worst that is told apart: the bluer, the smaller (as in Fig. 10)."""


def error_colors(errors: NDArray[np.float64], worst: float) -> NDArray[np.uint8]:
    """Colours (N, 3) of errors (N,) by the ramp, whose last colour stands for ``worst`` and all beyond."""
    ramp = np.array(ERROR_RAMP, dtype=np.float64)
    place = (len(ramp) - 1) * np.clip(np.nan_to_num(errors / worst, nan=1.0, posinf=1.0), 0.0, 1.0)
    columns = [np.interp(place, np.arange(len(ramp)), ramp[:, channel]) for channel in range(3)]
    return np.column_stack(columns).round().astype(np.uint8)
