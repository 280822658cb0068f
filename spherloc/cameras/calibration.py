"""Reads camera calibrations of other tools, recognised by their content, and the project's own ``[camera]`` tables.

KITTI-360, Kalibr and OpenCV put the centre of the top-left pixel at (0, 0), this project at (0.5, 0.5): what is read
from them gets 0.5 added to the principal point. The project's own TOML is taken as it is.
"""

import re
import tomllib
from pathlib import Path
from typing import Any

import yaml

from spherloc.cameras._checks import coefficients, finite, located, show
from spherloc.cameras.base import Camera
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError, InputError
from spherloc.registry import lookup

MAX_FILE_BYTES = 256 * 1024
"""Calibrations take a few kilobytes, and the YAML reader minutes for megabytes."""

PIXEL_CENTRE_SHIFT = 0.5
"""Added to a principal point that counts from the centre of the top-left pixel."""

_KNOWN = "give a KITTI-360 YAML, a Kalibr camchain or a TOML with a [camera] table"
_YAML_KEY = re.compile(r"""["']?[\w.-]+["']?\s*:(\s|$)""")


class _Loader(yaml.SafeLoader):
    """``yaml.safe_load`` without merge keys, through which a small file can take up all memory."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave ``<<`` as it is; it is then refused like any unknown tag."""


def load_camera(path: str | Path, name: str | None = None) -> Camera:
    """The camera that a calibration file describes.

    Recognised by content: a KITTI-360 YAML (``model_type: MEI``), a Kalibr camchain (``cam0``, ...: pinhole with
    equidistant distortion, or omni with radtan) and a TOML with a ``[camera]`` table or with its keys at the top.
    ``name`` picks a camera of a camchain, by default its first one. Principal points of KITTI-360 and Kalibr are
    moved by +0.5 pixels to this project's convention (the centre of the top-left pixel is (0.5, 0.5)).

    Raises ``CalibrationError``, naming the file and the place, for whatever cannot be read as a usable camera.
    """
    with located(str(path)):
        text = _read_text(Path(path))
        if not _looks_like_yaml(text):
            return _from_toml(text, name)
        document = _parse_yaml(text)
        if isinstance(document, dict) and "model_type" in document:
            return _from_kitti360(document, name)
        cameras = _kalibr_cameras(document)
        if cameras:
            return _from_kalibr(cameras, name)
        raise CalibrationError(f"this YAML has neither 'model_type' nor 'cam0' at its top: {_KNOWN}.")


def camera_from_table(table: Any, where: str) -> Camera:
    """The camera of a ``[camera]`` table, its class found by the table's ``model``; ``where`` names the file.

    Raises ``CalibrationError`` for an unknown model and for unknown, missing or unusable values.
    """
    with located(where):
        model = _value(_table(table), "model")
        try:
            # The sentence about an unknown model quotes it: a short text on one line.
            camera_class = lookup("cameras", show(model).strip("'"))
        except InputError as error:
            raise CalibrationError(str(error)) from None
    return camera_class.from_dict(table, where)


def _read_text(path: Path) -> str:
    try:
        if not path.is_file():
            raise CalibrationError("there is no such file: give the path of a calibration file.")
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CalibrationError(f"cannot be read ({reason}): check the path and its permissions.") from None
    if len(content) > MAX_FILE_BYTES:
        raise CalibrationError(f"is larger than {MAX_FILE_BYTES // 1024} KiB, which no calibration is: {_KNOWN}.")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CalibrationError(f"byte {error.start} is not UTF-8 text: {_KNOWN}.") from None


def _looks_like_yaml(text: str) -> bool:
    """Judged by the first line with content: ``%YAML``, ``---`` or ``key:``."""
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    return first.startswith(("%", "---")) or _YAML_KEY.match(first) is not None


def _parse_yaml(text: str) -> Any:
    if text.startswith("%YAML"):
        text = f"#{text}"  # OpenCV's "%YAML:1.0" is no YAML directive; commented out, the lines keep their numbers
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}" if mark else "the text"
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "syntax error"
        raise CalibrationError(f"{place} is not valid YAML ({_one_line(reason)}): correct it.") from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        # PyYAML lets these through for impossible dates, numbers and tags, and for deep nesting.
        raise CalibrationError(f"a value is not valid YAML ({_one_line(error)}): correct it.") from None


def _from_toml(text: str, name: str | None) -> Camera:
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"is neither YAML nor valid TOML ({_one_line(error)}): {_KNOWN}.") from None
    if name is not None:
        raise CalibrationError(f"describes one camera, without a name: leave out the name {show(name)}.")
    if "camera" in document:
        return camera_from_table(document["camera"], "[camera]")
    if "model" in document:
        return camera_from_table(document, "top level")
    raise CalibrationError(f"has neither a [camera] table nor a key 'model': {_KNOWN}.")


def _from_kitti360(document: dict[Any, Any], name: str | None) -> Camera:
    """MEI with gamma1, gamma2, u0, v0; the +0.5 is applied here."""
    if document["model_type"] != "MEI":
        raise CalibrationError(f"the model_type {show(document['model_type'])} is not supported: give MEI.")
    own_name = document.get("camera_name")
    if name is not None and name != own_name:
        raise CalibrationError(f"describes the camera {show(own_name)} only: ask for it instead of {show(name)}.")
    (xi,) = _section(document, "mirror_parameters", "xi")
    distortion = _section(document, "distortion_parameters", "k1", "k2", "p1", "p2")
    fx, fy, u0, v0 = _section(document, "projection_parameters", "gamma1", "gamma2", "u0", "v0")
    return Mei(
        width=_value(document, "image_width"),
        height=_value(document, "image_height"),
        fx=fx,
        fy=fy,
        cx=u0 + PIXEL_CENTRE_SHIFT,
        cy=v0 + PIXEL_CENTRE_SHIFT,
        xi=xi,
        distortion=(distortion[0], distortion[1], distortion[2], distortion[3]),
    )


def _kalibr_cameras(document: Any) -> dict[str, Any]:
    """The cameras of a camchain in the order of the file; empty if it is none."""
    if not isinstance(document, dict):
        return {}
    return {key: table for key, table in document.items() if isinstance(key, str) and re.fullmatch(r"cam\d+", key)}


def _from_kalibr(cameras: dict[str, Any], name: str | None) -> Camera:
    if name is not None and name not in cameras:
        raise CalibrationError(f"has no camera {show(name)}: choose one of {', '.join(cameras)}.")
    name = name or next(iter(cameras))
    with located(name):
        table = _table(cameras[name])
        lens = (_value(table, "camera_model"), _value(table, "distortion_model"))
        size = _value(table, "resolution")
        if not isinstance(size, list) or len(size) != 2:
            raise CalibrationError(f"key 'resolution' is {show(size)}: give a list of width and height.")
        if lens == ("pinhole", "equidistant"):
            return _kalibr_fisheye(table, *size)
        if lens == ("omni", "radtan"):
            return _kalibr_omni(table, *size)
        raise CalibrationError(
            f"the camera_model {show(lens[0])} with the distortion_model {show(lens[1])} is not supported: "
            "give pinhole with equidistant, or omni with radtan."
        )


def _kalibr_fisheye(table: dict[Any, Any], width: Any, height: Any) -> KannalaBrandt:
    """The +0.5 is applied here."""
    fx, fy, pu, pv = _list(table, "intrinsics", "fu, fv, pu, pv")
    cx, cy = pu + PIXEL_CENTRE_SHIFT, pv + PIXEL_CENTRE_SHIFT
    k1, k2, k3, k4 = _list(table, "distortion_coeffs", "k1, k2, k3, k4")
    return KannalaBrandt(width, height, fx, fy, cx, cy, (k1, k2, k3, k4))


def _kalibr_omni(table: dict[Any, Any], width: Any, height: Any) -> Mei:
    """The +0.5 is applied here."""
    xi, fx, fy, pu, pv = _list(table, "intrinsics", "xi, fu, fv, pu, pv")
    cx, cy = pu + PIXEL_CENTRE_SHIFT, pv + PIXEL_CENTRE_SHIFT
    k1, k2, p1, p2 = _list(table, "distortion_coeffs", "k1, k2, p1, p2")
    return Mei(width, height, fx, fy, cx, cy, xi, (k1, k2, p1, p2))


def _table(value: Any) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise CalibrationError(f"the camera is {show(value)}: give a table of keys and values.")
    return value


def _value(table: dict[Any, Any], key: str) -> Any:
    if key not in table:
        raise CalibrationError(f"key '{key}' is missing: add it.")
    return table[key]


def _section(document: dict[Any, Any], section: str, *keys: str) -> list[float]:
    """The numbers under ``keys`` in a table of a KITTI-360 file."""
    table = _value(document, section)
    with located(section):
        return [finite(key, _number(_value(_table(table), key))) for key in keys]


def _list(table: dict[Any, Any], key: str, names: str) -> tuple[float, ...]:
    """The numbers ``names`` ("fu, fv") in a list of a Kalibr file."""
    value = _value(table, key)
    return coefficients(key, [_number(item) for item in value] if isinstance(value, list) else value, names)


def _number(value: Any) -> Any:
    """A number that YAML 1.1 takes for text: 1e-3, without a point."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _one_line(error: object) -> str:
    return " ".join(str(error).split()).rstrip(".")
