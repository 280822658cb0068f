"""Reads calibration files as tables, lists and numbers, with errors that name the place of a wrong value."""

import errno
import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from spherloc.cameras._checks import UnrecognisedError, coefficients, finite, located
from spherloc.errors import MAX_REASON, CalibrationError, InputError, reason, shorten, show
from spherloc.files import is_file, is_image, names_in, read_file

CALIBRATION_NAME = re.compile(r"(calib|cam|lens|sensors|transforms).*\.(json|toml|txt|xml|ya?ml)$", re.IGNORECASE)
"""Usual names of calibration files."""

MAX_FILE_BYTES = 256 * 1024
"""Largest calibration file: they take a few kilobytes, and the YAML reader takes minutes for megabytes."""

MAX_VALUES = 100_000
"""Largest number of values of a YAML file, with its aliases written out."""

PIXEL_CENTRE_SHIFT = 0.5
"""Added to a principal point that counts from the centre of the top-left pixel."""

KNOWN = (
    "give a YAML of KITTI-360, Kalibr, EuRoC, stella, ROS or 360Loc, a file of OpenCV, a JSON of Basalt, Project Aria, "
    "WoodScape or nerfstudio, COLMAP's cameras.txt, kapture's sensors.txt, an OCamCalib text or a TOML with a [camera] "
    "table (docs/conventions.md has its keys)"
)


class _Loader(yaml.SafeLoader):
    """``yaml.safe_load`` without merge keys, with which a small file can fill the memory."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave ``<<`` as it is; it is then refused like any unknown tag."""


OPENCV_TYPES = ("opencv-matrix", "opencv-nd-matrix")
"""What OpenCV's FileStorage calls its tables of rows, cols, dt and data, and of sizes, dt and data, as OpenCV 5 writes
arrays of one dimension."""

for _type in OPENCV_TYPES:  # read as plain tables
    _Loader.add_constructor(f"tag:yaml.org,2002:{_type}", yaml.SafeLoader.construct_yaml_map)


_Loader.add_constructor("tag:yaml.org,2002:python/tuple", yaml.SafeLoader.construct_yaml_seq)
"""Sizes, as Python scripts write them without thinking of other readers."""


def read_text(path: Path) -> str:
    """The text of a calibration file; raises ``CalibrationError`` if it is missing, not text, or too large."""
    if is_image(path.name) and is_file(path):
        raise CalibrationError("is an image: give the file with the calibration of its camera.")
    try:
        content = read_file(path, MAX_FILE_BYTES)
    except FileNotFoundError:
        raise CalibrationError("there is no such file: give the path of a calibration file.") from None
    except IsADirectoryError:
        raise CalibrationError(f"is a folder: give the calibration file itself{_such_as(path)}.") from None
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise UnrecognisedError(f"is {reason(error)}, which no calibration is: {KNOWN}.") from None
        raise UnrecognisedError(f"cannot be read ({reason(error)}): check the path and its permissions.") from None
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnrecognisedError(f"byte {error.start} is not UTF-8 text: {KNOWN}.") from None


def _such_as(folder: Path) -> str:
    """A file in a folder that is a calibration by its name, as the end of a sentence; empty if there is none."""
    try:
        names = [name for name in names_in(folder) if CALIBRATION_NAME.search(name)]
    except InputError:
        return ""
    return f", such as {folder / names[0]}" if names else ""


def parse_yaml(text: str) -> Any:
    """The document of a YAML text, OpenCV's ``%YAML:1.0`` included; raises ``CalibrationError`` with the line."""
    if text.startswith("%YAML"):
        text = f"#{text}"  # OpenCV's "%YAML:1.0" is not a valid directive; as a comment it keeps the line numbers
    try:
        loader = _Loader(text)
        root = loader.get_single_node()
        if root is None:
            return None
        _refuse_multiplied(root)
        return loader.construct_document(root)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}" if mark else "the text"
        what = shorten(
            str(getattr(error, "problem", None) or getattr(error, "reason", None) or "syntax error"), MAX_REASON
        )
        if "python/object/apply:numpy" in str(error):
            raise UnrecognisedError(f"{place} has an array of NumPy: write it as a list, by its tolist().") from None
        raise UnrecognisedError(f"{place} is not valid YAML ({what}): correct it.") from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        # PyYAML raises these for impossible dates, numbers and tags, and for deep nesting.
        raise UnrecognisedError(f"a value is not valid YAML ({reason(error)}): correct it.") from None


def _refuse_multiplied(root: yaml.Node) -> None:
    """Raise ``CalibrationError`` if the document has more than ``MAX_VALUES`` values with its aliases written out."""
    counts: dict[int, int | None] = {}

    def count(node: yaml.Node) -> int:
        """Number of values of a node; None while it is being counted."""
        if id(node) not in counts:
            counts[id(node)] = None
            inner = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
            counts[id(node)] = 1 + (sum(map(count, inner)) if isinstance(node, yaml.CollectionNode) else 0)
        values = counts[id(node)]
        if values is None or values > MAX_VALUES:
            line = f"line {node.start_mark.line + 1}" if node.start_mark else "the text"
            what = "a value that contains itself" if values is None else f"more than {MAX_VALUES:,} values"
            raise CalibrationError(f"{line} has {what} by its aliases (*name): write the values themselves.")
        return values

    count(root)


def parse_json(text: str) -> Any:
    """The document of a JSON text; raises ``CalibrationError`` with the line."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise UnrecognisedError(f"line {error.lineno} is not valid JSON ({error.msg}): correct it.") from None
    except (ValueError, RecursionError) as error:
        raise UnrecognisedError(f"a value is not valid JSON ({reason(error)}): correct it.") from None


def parse_opencv_xml(text: str) -> dict[str, Any]:
    """The document of an XML text of OpenCV's FileStorage, as its YAML would be read; raises ``CalibrationError`` for
    another XML, with the line if it is not valid."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CalibrationError("defines entities, which calibrations have no use for: write the values themselves.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UnrecognisedError(f"line {error.position[0]} is not valid XML ({reason(error)}): correct it.") from None
    if root.tag != "opencv_storage":
        raise UnrecognisedError(f"this XML is a {show(root.tag)}, not OpenCV's 'opencv_storage': {KNOWN}.")
    return {str(node.tag): _opencv_value(node) for node in root}


def _opencv_value(node: ElementTree.Element) -> Any:
    """An array as a table of rows and cols or sizes, dt and data, and of any other node the number or the text."""
    if node.get("type_id") not in OPENCV_TYPES:
        words = (node.text or "").strip().strip('"')
        return int(words) if words.isascii() and words.isdigit() and len(words) < 10 else words
    table: dict[str, Any] = {str(part.tag): (part.text or "").strip() for part in node}
    return table | {key: table[key].split() for key in ("sizes", "data") if key in table}


def table_of(value: Any) -> dict[Any, Any]:
    """``value`` if it is a table; raises ``CalibrationError`` otherwise."""
    if not isinstance(value, dict):
        raise CalibrationError(f"the camera is {show(value)}: give a table of keys and values.")
    return value


def value_of(table: dict[Any, Any], key: str) -> Any:
    """The value under ``key``; raises ``CalibrationError`` if there is none."""
    if key not in table:
        raise CalibrationError(f"key '{key}' is missing: add it.")
    return table[key]


def numbers_of(table: dict[Any, Any], *keys: str) -> list[float]:
    """The finite numbers under ``keys``; raises ``CalibrationError`` otherwise."""
    return [finite(key, _number(value_of(table, key))) for key in keys]


def section_of(document: dict[Any, Any], section: str, *keys: str) -> list[float]:
    """The finite numbers under ``keys`` of the table ``section``; raises ``CalibrationError`` otherwise."""
    table = value_of(document, section)
    with located(section):
        return numbers_of(table_of(table), *keys)


def list_of(table: dict[Any, Any], key: str, names: str) -> tuple[float, ...]:
    """The finite numbers ``names`` ("fu, fv") in the list under ``key``; raises ``CalibrationError`` otherwise."""
    value = value_of(table, key)
    return coefficients(key, [_number(item) for item in value] if isinstance(value, list) else value, names)


def size_of(table: dict[Any, Any], key: str) -> tuple[Any, Any]:
    """Width and height, for the camera to check, in the list under ``key``; raises ``CalibrationError`` otherwise."""
    size = value_of(table, key)
    if not isinstance(size, list) or len(size) != 2:
        raise CalibrationError(f"key '{key}' is {show(size)}: give a list of width and height.")
    return size[0], size[1]


def whole(side: float) -> Any:
    """A side of an image, px, as an integer if it is one that a file has as a number with a point."""
    return int(side) if side.is_integer() else side


def _number(value: Any) -> Any:
    """The value as a number if it is one that YAML 1.1 takes for text, such as 1e-3, which has no point."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
