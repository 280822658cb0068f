"""COLMAP's ``cameras.txt``: a line a camera, with its id, model, width, height and parameters."""

import re

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import CalibrationError, show

_CAMERA = re.compile(r"(\d+)\s+([A-Z][A-Z0-9_]+)\s+(\d+)\s+(\d+)((?:\s+[^\s=:]+)+)", re.ASCII)


def colmap_lines(text: str) -> dict[str, tuple[str, int, int, list[str]]]:
    """Model, width, height and parameters of the cameras by id, in the order of the file; empty for another file."""
    lines = [line.strip() for line in text.splitlines()]
    found = [_CAMERA.fullmatch(line) for line in lines if line and not line.startswith("#")]
    cameras = {}
    for match in found:
        if match is None:
            return {}
        cameras[match[1]] = match[2], int(match[3]), int(match[4]), match[5].split()
    return cameras


def colmap_text(cameras: dict[str, tuple[str, int, int, list[str]]], name: str | None) -> Camera:
    """The camera with the id ``name``, by default the first one, of what ``colmap_lines`` found.

    Raises ``CalibrationError`` if there is no such camera, or if it cannot be used.
    """
    name = name or next(iter(cameras))
    if name not in cameras:
        raise CalibrationError(f"has no camera {show(name)}: choose one of {', '.join(cameras)}.")
    model, width, height, words = cameras[name]
    where = f"camera {name}"
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise CalibrationError(f"{where}: {show(' '.join(words))} are not numbers: give COLMAP's file.") from None
    return camera_from_colmap(model, width, height, numbers, where)
