"""A scale bar in front of a map or a part of it."""

import numpy as np

from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import length_text, one_color
from spherloc_viz.layers.primitives import Label, SceneItem, Segments

BAR_SHARE = 0.25
"""Largest length of the scale bar, as a share of the map's width."""
BAR_TICK = 0.04
"""Height of its marks, and of the bar above the ground, as a share of the bar: a kerb must not hide it."""
BAR_INSET = 0.12
"""Its distance from the near side of the map, as a share of the map's depth: at the side itself may stand a wall."""


def scale_bar(name: str, box: FloatArray, metric: bool) -> list[SceneItem]:
    """A bar with its length, in front of what lies between the corners ``box`` (2, 3), as the overview shows it.

    ``name`` begins the names of its primitives, and ``metric`` tells whether lengths are in metres.
    """
    low, high = box
    length = round_length(BAR_SHARE * max(float((high - low)[[0, 2]].max()), 1e-3))
    near = low[2] + BAR_INSET * (high - low)[2]
    start = np.array([0.5 * (low + high)[0] - 0.5 * length, high[1] - BAR_TICK * length, near])
    along, tick = np.array([length, 0.0, 0.0]), np.array([0.0, -BAR_TICK * length, 0.0])
    marks = start + np.array([0.0, 0.5, 1.0])[:, None] * along
    heights = np.array([1.0, 0.6, 1.0])[:, None] * tick
    lines = np.concatenate([[[start, start + along]], np.stack([marks, marks + heights], axis=1)])
    below = start + 0.5 * along - 1.5 * tick
    return [
        Segments(f"{name}/bar", "scale bar", lines, one_color(style.SCALE, len(lines)), 3.0),
        Label(f"{name}/length", "scale bar", below, length_text(length, metric)),
    ]


def round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not larger."""
    power = 10.0 ** np.floor(np.log10(most))
    return max(float(step * power) for step in (0.5, 1.0, 2.0, 5.0) if step * power <= most * (1.0 + 1e-9))
