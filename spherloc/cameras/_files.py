"""Reads calibration files as documents of tables, lists and numbers, and their values with errors that say where."""

import json
from pathlib import Path
from typing import Any

import yaml

from spherloc.cameras._checks import coefficients, finite, located, show
from spherloc.errors import CalibrationError

MAX_FILE_BYTES = 256 * 1024
"""Calibrations take a few kilobytes, and the YAML reader minutes for megabytes."""

PIXEL_CENTRE_SHIFT = 0.5
"""Added to a principal point that counts from the centre of the top-left pixel."""

KNOWN = (
    "give a YAML of KITTI-360, Kalibr, stella or 360Loc, a Basalt JSON or a TOML with a [camera] table "
    "(docs/conventions.md has its keys)"
)


class _Loader(yaml.SafeLoader):
    """``yaml.safe_load`` without merge keys, through which a small file can take up all memory."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave ``<<`` as it is; it is then refused like any unknown tag."""


def read_text(path: Path) -> str:
    """The text of a calibration file; raises ``CalibrationError`` if there is no readable text of that size."""
    try:
        if not path.is_file():
            raise CalibrationError("there is no such file: give the path of a calibration file.")
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CalibrationError(f"cannot be read ({reason}): check the path and its permissions.") from None
    if len(content) > MAX_FILE_BYTES:
        raise CalibrationError(f"is larger than {MAX_FILE_BYTES // 1024} KiB, which no calibration is: {KNOWN}.")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CalibrationError(f"byte {error.start} is not UTF-8 text: {KNOWN}.") from None


def parse_yaml(text: str) -> Any:
    """The document of a YAML text, OpenCV's ``%YAML:1.0`` included; raises ``CalibrationError`` with the line."""
    if text.startswith("%YAML"):
        text = f"#{text}"  # OpenCV's "%YAML:1.0" is no YAML directive; commented out, the lines keep their numbers
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}" if mark else "the text"
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "syntax error"
        raise CalibrationError(f"{place} is not valid YAML ({one_line(reason)}): correct it.") from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        # PyYAML lets these through for impossible dates, numbers and tags, and for deep nesting.
        raise CalibrationError(f"a value is not valid YAML ({one_line(error)}): correct it.") from None


def parse_json(text: str) -> Any:
    """The document of a JSON text; raises ``CalibrationError`` with the line."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise CalibrationError(f"line {error.lineno} is not valid JSON ({one_line(error.msg)}): correct it.") from None
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"a value is not valid JSON ({one_line(error)}): correct it.") from None


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


def one_line(error: object) -> str:
    """The text of a library's error, as a part of a sentence."""
    return " ".join(str(error).split()).rstrip(".")


def _number(value: Any) -> Any:
    """A number that YAML 1.1 takes for text: 1e-3, without a point."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
