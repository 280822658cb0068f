"""A camera as lines: an open pyramid around its viewing direction, its upper edge marked by a roof."""

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import one_color
from spherloc_viz.layers.primitives import Segments

CORNERS = np.array([[-0.5, -0.4, 0.7], [0.5, -0.4, 0.7], [0.5, 0.4, 0.7], [-0.5, 0.4, 0.7]])
"""Corners of the opening of a camera of size 1."""
_ROOF = np.array([0.0, -0.62, 0.7])
"""Tip of the roof above the upper edge of that opening."""
_EDGES = np.concatenate(
    [
        np.stack([np.zeros((4, 3)), CORNERS], axis=1),
        np.stack([CORNERS, np.roll(CORNERS, -1, axis=0)], axis=1),
        [[CORNERS[0], _ROOF], [_ROOF, CORNERS[1]]],
    ]
)
"""Lines (10, 2, 3) of a camera of size 1."""


def camera_lines(cam_from_map: FloatArray, size_m: float) -> FloatArray:
    """Lines (10, 2, 3) of a camera at a pose (3, 4)."""
    return camera_centre(cam_from_map) + size_m * _EDGES @ cam_from_map[:, :3]


def camera(name: str, cam_from_map: FloatArray, size_m: float, color: style.RGB, width_px: float) -> Segments:
    """A camera at a pose (3, 4)."""
    ends = camera_lines(cam_from_map, size_m)
    return Segments(name, "cameras", ends, one_color(color, len(ends)), width_px)
