"""COLMAP's ``cameras.txt``: a line a camera, with its id, model, width, height and parameters.

kapture's ``sensors.txt`` has the same, separated by commas, behind its own id, a name and the kind of the sensor.
"""

import re

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import CalibrationError, show

_CAMERA = re.compile(r"(\d+)\s+([A-Z][A-Z0-9_]+)\s+(\d+)\s+(\d+)((?:\s+[^\s=:]+)+)", re.ASCII)

_KAPTURE = "# kapture format"
_UNKNOWN = "UNKNOWN_CAMERA"
"""The model of a camera of kapture whose calibration is not known."""

Lines = dict[str, tuple[str, int, int, list[str]]]
"""Model, width, height and parameters of cameras by their ids."""


def colmap_lines(text: str) -> Lines:
    """The cameras of one of the two kinds of file, in its order; empty for another file."""
    if text.startswith(_KAPTURE):
        return _of_kapture(text)
    lines = [line.strip() for line in text.splitlines()]
    found = [_CAMERA.fullmatch(line) for line in lines if line and not line.startswith("#")]
    cameras = {}
    for match in found:
        if match is None:
            return {}
        cameras[match[1]] = match[2], int(match[3]), int(match[4]), match[5].split()
    return cameras


def _of_kapture(text: str) -> Lines:
    """Those with a calibration among all sensors; empty if one has no size in whole pixels."""
    cameras = {}
    for line in text.splitlines():
        words = [word.strip() for word in line.split(",")]
        if line.startswith("#") or len(words) < 6 or words[2] != "camera" or words[3] == _UNKNOWN:
            continue
        if not (words[4].isdecimal() and words[5].isdecimal()):
            return {}
        cameras[words[0]] = words[3], int(words[4]), int(words[5]), words[6:]
    return cameras


def colmap_text(cameras: Lines, name: str | None) -> Camera:
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
