"""Doubts a calibration by where its principal point is."""

from collections.abc import Iterable

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.errors import shorten

OFF_CENTRE, NEAR_CENTRE = 0.1, 0.03
"""Distances of a principal point from the middle of the image, in widths and heights: that of one whose coordinates may
be exchanged, and of one that is right then."""


def about_principal_point(name: str, camera: Camera) -> str:
    """A sentence on a calibration, called ``name``, whose principal point is far from the middle of the image, while it
    would be near it with x and y exchanged, or is outside the image; else empty."""
    pixels, seen = camera.project(np.array([[0.0, 0.0, 1.0]]))
    size = np.array([camera.width, camera.height])
    off, exchanged = (float(np.abs(point / size - 0.5).max()) for point in (pixels[0], pixels[0, ::-1]))
    if not seen[0] or off < OFF_CENTRE:
        return ""
    x, y = pixels[0]
    where = f"The principal point of {shorten(name)} is at {x:.0f}, {y:.0f}"
    if exchanged <= NEAR_CENTRE:
        return (
            f"{where}, far from the middle of {camera.width} x {camera.height} pixels; if x and y are exchanged there, "
            "exchange them."
        )
    if off > 0.5:
        return (
            f"{where}, outside of {camera.width} x {camera.height} pixels; if the images are not cropped, give it in "
            "pixels of images of this size."
        )
    return ""


def about_principal_points(images: Iterable[tuple[str, Camera]]) -> list[str]:
    """A sentence on the first camera whose principal point seems to be wrong, and one on how many others are like it.

    ``images`` are their names and cameras.
    """
    named = {camera: name for name, camera in reversed(tuple(images))}
    found = [
        about for camera, name in named.items() if (about := about_principal_point(f"the camera of {name}", camera))
    ]
    more = [f"So it seems to be in {len(found) - 1} more of the {len(named)} cameras."] if len(found) > 1 else []
    return found[-1:] + more
