"""Reads camera calibrations of other tools, recognised by their content, and the project's own ``[camera]`` tables.

Most tools put the centre of the top-left pixel at (0, 0), this project at (0.5, 0.5): what is read from them gets 0.5
added to the principal point. The project's own TOML is taken as it is, and so are COLMAP's and
360Loc's files, which share the convention.
"""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spherloc.cameras import json_files, ocam_files, tool_files
from spherloc.cameras._checks import UnrecognisedError, located
from spherloc.cameras._files import (
    KNOWN,
    parse_json,
    parse_opencv_xml,
    parse_yaml,
    read_text,
    table_of,
    value_of,
)
from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_text import colmap_lines, colmap_text
from spherloc.cameras.extensions import camera_class_of, read_by_extensions, tried
from spherloc.cameras.opencv_files import about_opencv, is_opencv, opencv, opencv_arrays
from spherloc.cameras.woodscape_files import is_woodscape, woodscape
from spherloc.errors import CalibrationError, InputError, reason, show
from spherloc.registry import extension_of, guarded

_ONE_CAMERA = {
    "imgw": tool_files.loc360,
    "parameter": tool_files.adapter,
    "Camera": tool_files.stella,
    "intrinsics": tool_files.euroc,
}
"""Readers of files of one camera without a name, by the top-level key by which the kind is recognised."""

_YAML_KEY = re.compile(r"""["']?[\w.-]+["']?\s*:(\s|$)""")


def load_camera(path: str | Path, name: str | None = None, size: tuple[int, int] | None = None) -> Camera:
    """The camera that a calibration file describes.

    The kind is recognised by the content: a KITTI-360 YAML (``model_type: MEI``), a Kalibr camchain (``cam0``, ...:
    pinhole or omni with radtan, equidistant or none, ds, eucm), the YAML of stella_vslam (``Camera``), 360Loc
    (``imgw``) and fisheye-calib-adapter (``parameter``), that of ROS and the YAML, XML or JSON of OpenCV's samples and
    of scripts (``distortion_coefficients``, ``D`` and other names), a Basalt JSON (``value0``), a JSON of cameras by
    name (``model``, ``params``), nerfstudio's ``transforms.json`` (``fl_x``), a JSON of WoodScape (``intrinsic``),
    COLMAP's ``cameras.txt``, OCamCalib's ``calib_results.txt`` and a TOML or JSON with a ``[camera]`` table or with its
    keys at the top. ``name`` picks one of ``camera_names``, by default the first one. ``size`` is that of the images,
    px, for a file of OpenCV that does not state it. Principal points that count from the centre of the top-left pixel
    are moved by +0.5 pixels to this project's convention (that centre is (0.5, 0.5)). A file of another kind is given
    to the readers of extensions (docs/extending.md).

    Raises ``CalibrationError``, naming the file and the place, for whatever cannot be read as a usable camera.
    """
    with located(str(path)):
        try:
            return _own_kind(Path(path), name, size)
        except UnrecognisedError as error:
            return read_by_extensions(Path(path), name, str(error))


def camera_names(path: str | Path) -> tuple[str, ...]:
    """Names of the cameras of a file that can have several: "cam0" in a camchain or a Basalt JSON, "1" in COLMAP's.

    Empty for another file. Raises ``CalibrationError`` if the file cannot be read.
    """
    with located(str(path)):
        text = read_text(Path(path))
        if text.lstrip().startswith("{"):
            document = parse_json(text)
            return tool_files.basalt_names(document) or tuple(json_files.named_cameras(document))
        if _looks_like_yaml(text):
            return tuple(tool_files.chain_tables(parse_yaml(text)))
        return tuple(colmap_lines(text))


def about_calibration(path: str | Path, size: tuple[int, int] | None = None) -> str:
    """What ``load_camera`` had to conclude about the lens of a file that does not say it, with the reason, as a
    sentence without the file's name; empty if nothing. ``size`` is as there.

    Raises ``CalibrationError``, naming the file, if it cannot be read.
    """
    with located(str(path)):
        text = read_text(Path(path))
        if text.lstrip().startswith("{"):
            document = parse_json(text)
        elif text.lstrip().startswith("<"):
            document = parse_opencv_xml(text)
        else:
            document = parse_yaml(text) if _looks_like_yaml(text) else {}
        return about_opencv(document, size) if _reader_of(document) is opencv else ""


def camera_from_table(table: Any, where: str) -> Camera:
    """The camera of a ``[camera]`` table, its class found by the table's ``model``; ``where`` names the file.

    Raises ``CalibrationError`` for an unknown model and for unknown, missing or unusable values.
    """
    with located(where):
        model = value_of(table_of(table), "model")
        try:
            # The message about an unknown model quotes it, so it must be a short text on one line.
            camera_class = camera_class_of(show(model).strip("'"))
        except InputError as error:
            raise CalibrationError(str(error)) from None
    try:
        with guarded("cameras", model, where):
            camera = camera_class.from_dict(table, where)
        return tried(camera, model) if extension_of("cameras", model) else camera
    except CalibrationError:
        raise
    except InputError as error:  # of an extension
        raise CalibrationError(str(error)) from error


def _own_kind(path: Path, name: str | None, size: tuple[int, int] | None) -> Camera:
    """The camera of a file of a kind that spherloc itself reads; raises ``UnrecognisedError`` for another kind."""
    text = read_text(path)
    if text.lstrip().startswith("{"):
        return _from_json(parse_json(text), name, size)
    if text.lstrip().startswith("<"):
        return _one_camera(parse_opencv_xml(text), name, "XML", size)
    if ocam_files.is_ocam(text):
        _refuse_name(name)
        return ocam_files.ocam(text)
    cameras = colmap_lines(text)
    if cameras:
        return colmap_text(cameras, name)
    if _looks_like_yaml(text):
        return _from_yaml(parse_yaml(text), name, size)
    return _from_toml(text, name)


def _looks_like_yaml(text: str) -> bool:
    """Judged by the first line with content: ``%YAML``, ``---`` or ``key:``."""
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    return first.startswith(("%", "---")) or _YAML_KEY.match(first) is not None


def _from_json(document: Any, name: str | None, size: tuple[int, int] | None) -> Camera:
    if isinstance(document, dict) and "value0" in document:
        return tool_files.basalt(document, name)
    if json_files.named_cameras(document):
        return json_files.camera_named(document, name)
    if is_woodscape(document):
        return woodscape(document, name)
    if json_files.is_transforms(document):
        _refuse_name(name)
        return json_files.transforms(document)
    table = json_files.own_table(document)
    if table is not None:
        _refuse_name(name)
        where = "top level" if table is document else "camera"
        if "params" in table:
            with located(where):
                return json_files.camera_of_table(table)
        return camera_from_table(table, where)
    return _one_camera(document, name, "JSON", size)


def _from_yaml(document: Any, name: str | None, size: tuple[int, int] | None) -> Camera:
    keys = {str(key) for key in document} if isinstance(document, dict) else set()
    if "model_type" in keys:
        return tool_files.kitti360(document, name)
    chain = tool_files.chain_tables(document)
    if chain:
        if name is not None and name not in chain:
            raise CalibrationError(f"has no camera {show(name)}: choose one of {', '.join(chain)}.")
        name = name or next(iter(chain))
        return tool_files.camera_of(name, chain[name])
    return _one_camera(document, name, "YAML", size)


def _one_camera(document: Any, name: str | None, kind: str, size: tuple[int, int] | None) -> Camera:
    """The camera of a document that has one, without a name; raises ``UnrecognisedError`` if it has no known key."""
    read = _reader_of(document)
    if read is not None:
        _refuse_name(name)
        return opencv(document, size) if read is opencv else read(document)
    if arrays := opencv_arrays(document):
        raise UnrecognisedError(
            f"has arrays of OpenCV by the names {', '.join(arrays)}: call those of one camera camera_matrix and "
            "distortion_coefficients, or K and D."
        )
    raise UnrecognisedError(f"this {kind} has no known key at its top: {KNOWN}.")


def _reader_of(document: Any) -> Callable[[dict[Any, Any]], Camera] | None:
    """What reads a document of one camera without a name; None if it has no known key."""
    keys = {str(key) for key in document} if isinstance(document, dict) else set()
    if any(key.startswith(tool_files.STELLA_PREFIX) for key in keys):
        keys.add("Camera")
    known = next((read for mark, read in _ONE_CAMERA.items() if mark in keys), None)
    return known or (opencv if is_opencv(document) else None)


def _from_toml(text: str, name: str | None) -> Camera:
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise UnrecognisedError(f"is neither YAML nor valid TOML ({reason(error)}): {KNOWN}.") from None
    _refuse_name(name)
    if "camera" in document:
        return camera_from_table(document["camera"], "[camera]")
    if "model" in document:
        return camera_from_table(document, "top level")
    raise UnrecognisedError(f"has neither a [camera] table nor a key 'model': {KNOWN}.")


def _refuse_name(name: str | None) -> None:
    if name is not None:
        raise CalibrationError(f"describes one camera, without a name: leave out the name {show(name)}.")
