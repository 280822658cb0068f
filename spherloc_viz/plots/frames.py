"""What part of a map a picture from above shows."""

import numpy as np

from spherloc.types import FloatArray

Frame = tuple[FloatArray, FloatArray]
"""Middle (2,) and half the extent (2,) of a picture, in the units of the map."""

MARGIN = 0.08
MIN_EXTENT = 0.4
"""Least extent of a picture, so that a camera that stands still is not magnified to its noise."""
CLOSE = 0.15
"""If the cameras lie within this share of the picture, a second one shows them alone."""
ROOM = 0.35
"""Room on each side of the images of a map, in their largest extent."""
SEEN = 0.5
"""Least share of a map's points in a picture of it; those farther away are cut."""


def around(places: FloatArray) -> Frame:
    """The frame that holds places (N, 2), some of which may be nan, with a margin."""
    middle, half = _bounds(places)
    half = np.maximum(half, 0.5 * MIN_EXTENT)
    return middle, not_narrow(half) + 2.0 * MARGIN * half.max()


def with_room(places: FloatArray, points: FloatArray) -> Frame:
    """The frame that holds places (N, 2) with room around them, and some of the points (P, 2) of the map at least.

    Few points far away must not shrink all else to a dot.
    """
    middle, half = _bounds(places)
    room = 2.0 * ROOM * half.max()
    if len(points):
        beyond = (np.abs(points - middle) - half).max(axis=1)
        room = max(room, float(np.quantile(beyond, SEEN)))
    return middle, not_narrow(np.maximum(half + room, 0.5 * MIN_EXTENT))


def frames_of(whole: Frame, own: Frame) -> list[Frame]:
    """The frame of the map, and that of the cameras too if it is far smaller."""
    return [whole, own] if own[1].max() < CLOSE * whole[1].max() else [whole]


def corners(frame: Frame) -> FloatArray:
    """The lower left and the upper right corner (2, 2)."""
    middle, half = frame
    return np.stack([middle - half, middle + half])


def not_narrow(half: FloatArray) -> FloatArray:
    """Half an extent (2,) that is enlarged where a picture would be very flat, or narrow on a wide page."""
    return np.maximum(half, [0.75 * half[1], 0.3 * half[0]])


def _bounds(places: FloatArray) -> Frame:
    shown = places[np.isfinite(places).all(axis=1)]
    if not len(shown):
        return np.zeros(2), np.zeros(2)
    low, high = shown.min(axis=0), shown.max(axis=0)
    return 0.5 * (low + high), 0.5 * (high - low)
