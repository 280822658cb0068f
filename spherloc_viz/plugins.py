"""What is registered by entry point, spherloc's own and extensions, and which extensions cannot be used."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from spherloc import registry
from spherloc.cameras.extensions import camera_class_of, reader_of
from spherloc.datasets.scene_file import loader_of, scene_kind
from spherloc.errors import InputError, shorten
from spherloc.estimators import estimate, options_type
from spherloc.registry import KINDS, Registered
from spherloc.solvers.base import solver_of
from spherloc.warm_up import tiny_problem, warm_up
from spherloc_viz import layers
from spherloc_viz.layers.extension import layer_of
from spherloc_viz.lessons.lesson import lesson_of, own_names
from spherloc_viz.options import json_text, option_fields

FORMATS = ("360loc", "adapter", "basalt", "kalibr", "kitti360", "stella", "toml")
"""Calibration files that spherloc reads without an entry point."""
TRIED = {"estimators": "", "solvers": registry.RANSAC}
"""Kinds that are tried, and what comes before their names to name an estimator."""
FASTEST = "ransac-2p"


@dataclass(frozen=True)
class Extension:
    """One thing that is registered."""

    registered: Registered
    problem: str = ""
    """Why it cannot be used, as a sentence; empty if it can."""


def extensions(announce: Callable[[str], None] | None = None) -> tuple[Extension, ...]:
    """All extensions, by the order of ``KINDS`` and by name; each is imported and its form looked at.

    With ``announce`` estimators and solvers are tried on a tiny problem too; it is called with a sentence if that will
    take long.
    """
    found = [one for kind in KINDS for one in registry.registered(kind, _taken(kind)) if not one.is_own]
    if announce is not None and any(one.kind in TRIED for one in found):
        warm_up(announce, [FASTEST])
    return tuple(Extension(one, one.clash or _problem(one.kind, one.name, announce is not None)) for one in found)


def built_in(kind: str) -> tuple[str, ...]:
    """Names of what spherloc has itself, by alphabet."""
    own = {found.name for found in registry.registered(kind) if found.is_own}
    return tuple(sorted(own | set(_taken(kind)) | (set(FORMATS) if kind == "calibrations" else set())))


def plugins_text(found: Collection[Extension]) -> str:
    """A paragraph a group for people: in a line what spherloc has itself, then a line or two an extension."""
    return "\n\n".join(_group_text(kind, [extension for extension in found if extension.registered.kind == kind])
                       for kind in KINDS)  # fmt: skip


def plugins_json(found: Collection[Extension]) -> str:
    """A line of JSON an extension."""
    return "\n".join(json_text(_record(extension)) for extension in found)


def _record(extension: Extension) -> dict[str, str]:
    told = {name: getattr(extension.registered, name) for name in ("kind", "name", "package", "version", "target")}
    return told | {"problem": extension.problem}


def _group_text(kind: str, found: Collection[Extension]) -> str:
    lines = [f"{KINDS[kind].capitalize()}s, group spherloc.{kind}", f"  built in: {', '.join(built_in(kind))}"]
    for extension in found:
        entry = extension.registered
        package = f"{shorten(entry.package)} {shorten(entry.version)}".strip()
        state = "cannot be used" if extension.problem else "usable"
        lines.append(f"  {shorten(entry.name)}: {state}; {package}, {shorten(entry.target)}")
        if extension.problem:
            lines.append(f"    {extension.problem}")
    return "\n".join(lines)


def _taken(kind: str) -> tuple[str, ...]:
    return {"layers": layers.KINDS, "lessons": own_names()}.get(kind, ())


def _problem(kind: str, name: str, try_out: bool) -> str:
    try:
        _LOOK[kind](name)
        if try_out and kind in TRIED:
            estimate(tiny_problem(), f"{TRIED[kind]}{name}")
    except InputError as error:
        named = registry.extension_of(kind, name) in str(error)
        return str(error) if named else f"{registry.title(kind, name)} {error}"
    return ""


def _look_at_estimator(name: str) -> None:
    option_fields(options_type(name))


def _look_at_loader(name: str) -> None:
    loader_of(name)
    if problem := scene_kind(name).problem:
        raise InputError(problem)


_LOOK: dict[str, Callable[[str], object]] = {
    "cameras": camera_class_of,
    "calibrations": reader_of,
    "solvers": solver_of,
    "estimators": _look_at_estimator,
    "datasets": _look_at_loader,
    "layers": layer_of,
    "lessons": lesson_of,
}
