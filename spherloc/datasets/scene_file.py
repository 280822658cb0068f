"""Scene files: small TOML documents whose ``kind`` names the dataset loader that reads them."""

import ast
import importlib
import inspect
import math
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from spherloc import registry
from spherloc.datasets.given_path import what_it_is
from spherloc.errors import InputError, reason, show
from spherloc.files import is_file, is_folder, read_file, reading, size_of
from spherloc.problem import Problem

MAX_BYTES = 1_000_000
ADVICE = "give the path of a scene file (TOML) or a bundled scene's name"
_INSTALLED = Path(__file__).resolve().parent / "scenes"
BUNDLED = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).resolve().parents[2] / "scenes"
"""Folder of the bundled scenes: inside this package in an installation, beside the packages in a checkout."""


_EXTENSION_KINDS: dict[type, str] = {}
"""Names of kinds that extensions registered, by the class of the scenes that their loaders gave."""


class Scene(Protocol):
    """Something that gives a localization problem."""

    @property
    def name(self) -> str:
        """Name that users see."""
        ...

    def problem(self, seed: int | None = None) -> Problem:
        """The problem; ``seed`` replaces the scene's own seed where the scene is random."""
        ...


def load_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Raises ``InputError``, in one sentence with the file's name, if it is missing, unreadable, or has a wrong key.
    """
    path = Path(path)
    _refuse_others(path)
    table = read_table(path)
    kind = text(table, "kind", str(path))
    try:
        load = loader_of(kind)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    with registry.guarded("datasets", kind, str(path)):
        scene = load(table, path)
    if registry.extension_of("datasets", kind):
        if not isinstance(getattr(scene, "name", None), str) or not callable(getattr(scene, "problem", None)):
            raise InputError(
                f"{path}: {registry.title('datasets', kind)} gave {show(scene)}, which has no name or no problem(); "
                "tell its authors."
            )
        _EXTENSION_KINDS.setdefault(type(scene), kind)
    return scene


def loader_of(kind: str) -> Any:
    """The loader of a kind of scene files; raises ``InputError`` if there is none or it is not a function."""
    load = registry.lookup("datasets", kind)
    if not callable(load):
        raise InputError(f"{registry.title('datasets', kind)} is {show(load)}, not a function; tell its authors.")
    return load


def checked_problem(scene: Scene, problem: Callable[[], Any]) -> Problem:
    """The result of ``problem``, a call of the scene's method; it is checked if an extension has the scene's class.

    Raises ``InputError`` for whatever an extension's scene raises, and if its result is not a ``Problem``.
    """
    kind = _EXTENSION_KINDS.get(type(scene))
    if kind is None or type(scene).__module__.startswith("spherloc."):
        return problem()
    with registry.guarded("datasets", kind, scene.name):
        found = problem()
    if not isinstance(found, Problem):
        raise InputError(
            f"{scene.name}: {registry.title('datasets', kind)} gave {show(found)}, which is not a Problem; tell its "
            "authors."
        )
    return found


def read_table(path: Path) -> dict[str, Any]:
    """The keys of a scene file, not checked yet.

    Raises ``InputError`` for a missing file and for one that is not TOML.
    """
    with reading(path, ADVICE):
        content = read_file(path, MAX_BYTES)
    try:
        text_of_file = content.decode("utf-8-sig")
        table = tomllib.loads(text_of_file)
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file in UTF-8; give the path of a scene file (TOML).") from None
    except tomllib.TOMLDecodeError as error:
        why = reason(error)
        if _BAD_ESCAPE.match(why) and (place := _LINE.search(why)):
            raise InputError(f"{path}: line {place[1]} {_BACKSLASHES}") from None
        raise InputError(f"{path}: not valid TOML: {why}; correct the file there.") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a usable scene file ({reason(error)}); correct or replace it.") from None
    several_lines = any(quotes in text_of_file for quotes in ('"""', "'''"))  # such texts have line ends themselves
    if not several_lines and (wrong := _escaped_path(table, path.parent)):
        raise InputError(f"{path}: '{wrong}' {_BACKSLASHES}")
    return table


_PROSE = ("about", "name")
"""Keys of texts for people."""
_BAD_ESCAPE = re.compile(r"Unescaped '\\'|Invalid hex value|Escaped character is not")
"""Begins what ``tomllib`` says of a backslash in double quotes that begins no escape."""
_LINE = re.compile(r"\(at line (\d+),")
_CONTROL = re.compile(r"[\b\t\n\f\r]")
"""What single letters after a backslash stand for."""
_BACKSLASHES = (
    r"has a backslash in double quotes, where it begins an escape such as \t; write a path with forward slashes, or in "
    "single quotes."
)


def _escaped_path(table: Mapping[str, Any], folder: Path) -> str:
    """The first key whose text has a character that only an escape gives, and is no path from the folder; else ""."""
    for key, value in table.items():
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, dict) and (wrong := _escaped_path(inner, folder)):
                return wrong
        if isinstance(value, str) and key not in _PROSE and _CONTROL.search(value):
            there = folder / value
            if not is_file(there) and not is_folder(there):
                return key
    return ""


def check_there(path: Path) -> None:
    """Raise ``InputError`` if there is no such scene file; for a folder, an image or a video it says which command
    takes it."""
    _refuse_others(path)
    with reading(path, ADVICE):
        size_of(path)


def _refuse_others(path: Path) -> None:
    if told := what_it_is(path):
        raise InputError(told)


def bundled_scenes() -> dict[str, Path]:
    """Scene files that come with the project, by stem."""
    return {path.stem: path for path in sorted(BUNDLED.glob("*.toml"))}


def scene_path(given: Path) -> Path:
    """The scene file that is meant: ``given``, unless there is no such file and it is the name of a bundled scene."""
    return given if is_file(given) else bundled_scenes().get(str(given), given)


def check_keys(table: Mapping[str, Any], required: set[str], optional: set[str], where: str) -> None:
    """Raise ``InputError`` for a missing or an unknown key of ``table``; ``where`` names its place."""
    for key in table:
        if key not in required | optional:
            known = ", ".join(sorted(required | optional))
            raise InputError(f"{where}: unknown key {show(key)}; the known ones are {known}.")
    for key in sorted(required):
        if key not in table:
            raise InputError(f"{where}: key '{key}' is missing; add it.")


def text(table: Mapping[str, Any], key: str, where: str) -> str:
    """A text value that must exist; raises ``InputError`` otherwise."""
    value = table.get(key)
    if not isinstance(value, str) or not value:
        raise InputError(f"{where}: key '{key}' must be a text; add {key} = \"...\".")
    return value


def section(table: Mapping[str, Any], key: str, where: str) -> dict[str, Any]:
    """A sub-table; empty if absent. Raises ``InputError`` for another value."""
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{where}: '{key}' must be a section [{key}].")
    return value


def number(table: Mapping[str, Any], key: str, where: str, lowest: float, highest: float) -> float:
    """A finite number within limits that must exist; raises ``InputError`` otherwise."""
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not lowest <= value <= highest:
        raise InputError(f"{where}: {key} is {show(value)}; give a number from {lowest:g} to {highest:g}.")
    return float(value)


def integer(table: Mapping[str, Any], key: str, where: str, lowest: int, highest: int) -> int:
    """A whole number within limits that must exist; raises ``InputError`` otherwise."""
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
        raise InputError(f"{where}: {key} is {show(value)}; give a whole number from {lowest} to {highest}.")
    return value


def numbers(value: Any, shape: tuple[int, ...], key: str, where: str) -> np.ndarray:
    """A (nested) list of finite numbers of the given shape; raises ``InputError`` for anything else."""
    try:
        array = np.array(value, dtype=object)
        real = all(isinstance(item, int | float) and not isinstance(item, bool) for item in array.flat)
        array = array.astype(np.float64) if real else np.empty(0)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{where}: {key} must hold {' x '.join(map(str, shape))} finite numbers.")
    return array


def bound_px(table: Mapping[str, Any], where: str) -> float | None:
    """``[options] bound_px``, or None where the scene states none."""
    options = section(table, "options", where)
    check_keys(options, set(), {"bound_px"}, f"{where} [options]")
    return number(options, "bound_px", f"{where} [options]", 1e-6, 1e4) if options else None


def gravity_error_rad(table: Mapping[str, Any], where: str) -> tuple[float, float | None]:
    """Bound and standard deviation of gravity's error (rad) from the optional ``bound_deg`` and ``sd_deg``.

    A bound alone is taken for three standard deviations (the standard deviation is None: ``Problem`` says so), and a
    standard deviation alone for a third of the bound.
    """
    sd_rad = math.radians(number(table, "sd_deg", where, 0.0, 180.0)) if "sd_deg" in table else None
    if "bound_deg" in table:
        return math.radians(number(table, "bound_deg", where, 0.0, 90.0)), sd_rad
    return (0.0 if sd_rad is None else 3.0 * sd_rad), sd_rad


@dataclass(frozen=True)
class SceneKind:
    """One kind of scene file."""

    name: str
    """Value of the scene file's ``kind``."""
    documentation: str
    """Docstring of the loader's module; its first line says what it reads."""
    extras: tuple[str, ...] = ()
    """Extras of spherloc that bring the packages it needs: the module's ``EXTRAS``, if it has one."""
    example: str = ""
    """A scene file of this kind (TOML): the module's ``EXAMPLE``, if it has one."""
    problem: str = ""
    """Why the loader cannot be imported; empty if it can."""


def scene_kinds() -> tuple[SceneKind, ...]:
    """All registered kinds, in alphabetical order."""
    return tuple(scene_kind(name) for name in registry.names("datasets"))


def scene_kind(name: str) -> SceneKind:
    """The kind of that name. Raises ``InputError`` naming the known ones if there is none."""
    if own := registry.own_module("datasets", name):
        return _own_kind(name, own)
    try:
        loader = loader_of(name)
        with registry.guarded("datasets", name):
            module = importlib.import_module(loader.__module__)
            return SceneKind(
                name=name,
                documentation=inspect.getdoc(module) or "",
                extras=tuple(map(str, getattr(module, "EXTRAS", ()))),
                example=str(getattr(module, "EXAMPLE", "")),
            )
    except InputError as error:
        if name not in registry.names("datasets"):
            raise
        return SceneKind(name, "", problem=str(error))  # an extension that cannot be imported must not hide the others


def _own_kind(name: str, module: str) -> SceneKind:
    """A kind of this package, read from the source of its module: importing all loaders takes seconds."""
    path = Path(__file__).with_name(f"{module.rpartition('.')[2]}.py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    values = {
        target.id: ast.literal_eval(item.value)
        for item in tree.body
        if isinstance(item, ast.Assign)
        for target in item.targets
        if isinstance(target, ast.Name) and target.id in ("EXTRAS", "EXAMPLE")
    }
    documentation = inspect.cleandoc(ast.get_docstring(tree) or "")
    return SceneKind(name, documentation, values.get("EXTRAS", ()), values.get("EXAMPLE", ""))
