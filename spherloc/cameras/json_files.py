"""Calibrations in JSON: cameras that have a model and a list of parameters, one or several by name, and the
``transforms.json`` of nerfstudio and instant-ngp.

COLMAP's and nerfstudio's models put the centre of the top-left pixel at (0.5, 0.5); Project Aria's FISHEYE624 puts it
at (0, 0), so that 0.5 is added to its principal points.
"""

from typing import Any

from spherloc import registry
from spherloc.cameras._checks import located
from spherloc.cameras._files import PIXEL_CENTRE_SHIFT, list_of, numbers_of, size_of, table_of, value_of
from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.errors import CalibrationError, show

ARIA = ("FISHEYE624", "FisheyeRadTanThinPrism")
_ARIA_NAMES = "f, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3"
_PANORAMA = "EQUIRECTANGULAR"
_ORDERED = {
    "fisheye624": "RAD_TAN_THIN_PRISM_FISHEYE if they are COLMAP's 16, or FISHEYE624 if they are Project Aria's 15, "
    "which count pixels from the centre of the top-left one",
    "kannala_brandt": "OPENCV_FISHEYE if they are COLMAP's 8",
    "eucm": "EUCM if they are COLMAP's 6",
    "equirectangular": "EQUIRECTANGULAR if they are COLMAP's 2",
}
"""What models of this project are called where their numbers are a list, in whose order."""
_COEFFICIENTS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""nerfstudio's models: the keys of their distortion, which may be absent."""


def named_cameras(document: Any) -> dict[str, dict[Any, Any]]:
    """The tables with 'model' and 'params' of a JSON by their name; none if it has none."""
    if not isinstance(document, dict):
        return {}
    inside = {str(name): table for name, table in document.items() if isinstance(table, dict)}
    return {name: table for name, table in inside.items() if {"model", "params"} <= table.keys()}


def is_transforms(document: Any) -> bool:
    """Whether a JSON is a ``transforms.json``, whose images have one camera."""
    return isinstance(document, dict) and ("fl_x" in document or document.get("camera_model") == _PANORAMA)


def is_own_model(model: Any) -> bool:
    """Whether a model is called as this project, or an extension, calls it in a ``[camera]`` table."""
    return isinstance(model, str) and model in registry.names("cameras")


def own_table(document: Any) -> dict[Any, Any] | None:
    """The table of a JSON that is a ``[camera]`` table, at its top or as ``camera``, with a model of this project; None
    for another JSON."""
    if not isinstance(document, dict):
        return None
    table = document.get("camera", document)
    return table if isinstance(table, dict) and is_own_model(table.get("model")) else None


def camera_of_table(table: dict[Any, Any]) -> Camera:
    """The camera of a table with ``model``, the name of a model of COLMAP or of Project Aria, ``params`` in that
    model's order, and ``size``, or ``width`` and ``height``.

    Raises ``CalibrationError`` for another table.
    """
    model = value_of(table, "model")
    width, height = size_of(table, "size") if "size" in table else (value_of(table, "width"), value_of(table, "height"))
    params = value_of(table, "params")
    if model in ARIA:
        f, cx, cy, *lens = list_of(table, "params", _ARIA_NAMES)
        return Fisheye624(width, height, f, f, cx + PIXEL_CENTRE_SHIFT, cy + PIXEL_CENTRE_SHIFT, tuple(lens))
    if is_own_model(model):
        called = f"call it {_ORDERED[model]}, or " if model in _ORDERED else ""
        raise CalibrationError(
            f"model {show(model)} does not say in which order the numbers in 'params' are: {called}give each by its "
            "key, as in the [camera] table of a scene file."
        )
    if not isinstance(params, list):
        raise CalibrationError(f"key 'params' is {show(params)}: give a list of numbers.")
    return camera_from_colmap(model, width, height, params, f"model {show(model)}")


def transforms(document: dict[Any, Any]) -> Camera:
    """The camera of a ``transforms.json``; raises ``CalibrationError`` for another file, and for other models."""
    size = value_of(document, "w"), value_of(document, "h")
    model = document.get("camera_model", "OPENCV")
    if model == _PANORAMA:
        return Equirectangular(*size)
    if not isinstance(model, str) or model not in _COEFFICIENTS:
        raise CalibrationError(f"the camera_model {show(model)} is not supported: give {', '.join(_COEFFICIENTS)}.")
    lens = {key: document.get(key, 0.0) for key in _COEFFICIENTS[model]}
    fx, fy, cx, cy = numbers_of({"fl_y": value_of(document, "fl_x")} | document, "fl_x", "fl_y", "cx", "cy")
    fisheye = "k4" in lens
    name = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    return camera_from_colmap(name, *size, [fx, fy, cx, cy, *(numbers_of(lens, *lens) or [0.0] * 4)], "top level")


def camera_named(document: Any, name: str | None) -> Camera:
    """The camera of that name, by default the first; raises ``CalibrationError`` if there is none."""
    cameras = named_cameras(document)
    if name is not None and name not in cameras:
        raise CalibrationError(f"has no camera {show(name)}: choose one of {', '.join(cameras)}.")
    chosen = name or next(iter(cameras))
    with located(show(chosen)):
        return camera_of_table(table_of(cameras[chosen]))
