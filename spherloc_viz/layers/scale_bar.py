"""A bar on the ground that tells how long a length is."""

import numpy as np

from spherloc_viz import style
from spherloc_viz.layers.frame import RunView, one_color
from spherloc_viz.layers.primitives import Label, SceneItem, Segments

SHARE = 0.25
"""Length of the bar as a share of the map's width, at most."""
LEAST_M = 1e-4
"""Nobody cares for less."""
TICK = 0.04
"""Height of the marks, as a share of the bar."""


def scale_bar(view: RunView) -> list[SceneItem]:
    """The bar, before the front of the map as the overview shows it, with its length."""
    low, high = view.dense_box
    length = round_length(SHARE * max(float((high - low)[[0, 2]].max()), 1e-3))
    start = np.array([0.5 * (low + high)[0] - 0.5 * length, high[1], low[2] - TICK * length])
    along, tick = np.array([length, 0.0, 0.0]), np.array([0.0, -TICK * length, 0.0])
    marks = start + np.array([0.0, 0.5, 1.0])[:, None] * along
    heights = np.array([1.0, 0.6, 1.0])[:, None] * tick
    lines = np.concatenate([[[start, start + along]], np.stack([marks, marks + heights], axis=1)])
    below = start + 0.5 * along - 1.5 * tick
    return [
        Segments("scale/bar", "scale bar", lines, one_color(style.SCALE, len(lines)), 3.0),
        Label("scale/length", "scale bar", below, length_text(length)),
    ]


def round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not larger."""
    power = 10.0 ** np.floor(np.log10(most))
    return max(float(step * power) for step in (0.5, 1.0, 2.0, 5.0) if step * power <= most * (1.0 + 1e-9))


def length_text(length_m: float) -> str:
    """A length in the unit that suits its size, with two digits."""
    if 0.0 < length_m < LEAST_M:
        return "< 0.1 mm"
    for unit, metres in (("km", 1000.0), ("m", 1.0), ("cm", 0.01)):
        if length_m >= 0.995 * metres:
            return f"{_digits(length_m / metres)} {unit}"
    return f"{_digits(1000.0 * length_m)} mm"


def angle_text(angle_deg: float) -> str:
    """An angle with two digits behind the point where it is small."""
    return (
        f"{angle_deg:.3f}°" if angle_deg < 0.0995 else f"{angle_deg:.2f}°" if angle_deg < 9.95 else f"{angle_deg:.0f}°"
    )


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"
