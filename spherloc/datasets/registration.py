"""Judges a pose without a trusted truth, by how well the query's own depth fits the map (Sec. VI-B.2)."""

from typing import Protocol

from spherloc.cameras.base import FloatArray
from spherloc.frontend.view import View


class Registration(Protocol):
    """Registers the point clouds of a query and its map."""

    thresholds_m: tuple[float, ...]
    """Registration errors below which a localization counts as a success, strictest first."""

    def __call__(self, query: View, cam_from_map: FloatArray) -> float:
        """Registration error, metres, of the query's depth at an estimated pose (3, 4).

        Raises ``InputError`` if a depth map cannot be read.
        """
        ...
