"""Finds cameras, calibration readers, solvers, estimators, dataset loaders, layers and lessons by entry point.

To add one takes one file and one line. What another package registers is an extension (docs/extending.md). An extension
that cannot be imported or fails does not affect others: where it is used, one sentence names it.
"""

import importlib
import shlex
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import Distribution, EntryPoint, entry_points
from typing import Any

from spherloc.errors import InputError, SpherlocError, reason, shorten, show

OWN = "spherloc"
"""The distribution whose entry points are spherloc's own, not extensions."""
KINDS = {
    "cameras": "camera",
    "calibrations": "calibration reader",
    "solvers": "solver",
    "estimators": "estimator",
    "datasets": "dataset",
    "layers": "layer",
    "lessons": "lesson",
}
"""Kinds of things that can be registered: the last part of the name of the group of entry points, and the name of one
in messages."""
RANSAC = "ransac-"
"""A solver "p6" is the estimator "ransac-p6" too, unless there is an estimator of that name."""
UNLISTED = {
    ("estimators", "given-pose"): EntryPoint(
        "given-pose", "spherloc.estimators.given_pose:GivenPose", "spherloc.estimators"
    )
}
"""spherloc's own objects that can be used by name but are not listed, by kind and name."""
_AROUND_SOLVER = EntryPoint("around", "spherloc.estimators.ransac_solver:around", "spherloc")
"""Makes that estimator; imported only when one is asked for, since its module is on a higher floor."""


@dataclass(frozen=True)
class Registered:
    """One entry point."""

    kind: str
    """A key of ``KINDS``."""
    name: str
    package: str
    """The distribution that registers it."""
    version: str
    """Version of the distribution; empty if it states none."""
    target: str
    """The object, "module:object"."""
    clash: str = ""
    """Sentence that says why another entry point is used in its place; empty if it is used."""

    @property
    def is_own(self) -> bool:
        """Whether it is spherloc's own."""
        return self.package == OWN


@cache
def names(kind: str) -> tuple[str, ...]:
    """Names registered for ``kind``, a key of ``KINDS``, in alphabetical order; nothing is imported."""
    found = {point.name for point in _points(kind)}
    if kind == "estimators":
        found |= {RANSAC + name for name in names("solvers")}
    return tuple(sorted(found))


@cache
def lookup(kind: str, name: str) -> Any:
    """The object registered under ``name``; spherloc's own if an extension has the same name.

    Raises ``InputError`` naming the known ones if there is none, and naming the extension if it cannot be imported.
    """
    point = _point(kind, name)
    if point is None:
        raise InputError(f"unknown {KINDS[kind]} {show(name)}: choose one of {', '.join(map(shorten, names(kind)))}.")
    if point.group != _group(kind):
        return _AROUND_SOLVER.load()(name, point.name)
    try:
        return point.load()
    except (Exception, SystemExit) as error:  # foreign code can raise anything when it is imported
        if not extension_of(kind, name):
            raise
        what = f"{shorten(type(error).__name__)}: {reason(error)}"
        raise InputError(f"{title(kind, name)} cannot be imported ({what}); repair or uninstall it.") from error


@cache
def extension_of(kind: str, name: str) -> str:
    """The distribution that registered ``name``; empty for spherloc's own and for unknown ones."""
    point = _point(kind, name)
    return "" if point is None or _is_own(point) else shorten(_distribution(point) or point.value)


@cache
def own_module(kind: str, name: str) -> str:
    """Dotted name of spherloc's own module that has ``name``; empty for an extension and for an unknown name."""
    point = _point(kind, name)
    return point.module if point is not None and _is_own(point) else ""


def title(kind: str, name: str) -> str:
    """Its name in messages, with the extension that it comes from."""
    return _titled(kind, name, extension_of(kind, name))


def registered(kind: str, taken: Collection[str] = ()) -> tuple[Registered, ...]:
    """Every entry point of ``kind`` by name, with those in whose place another one is used; nothing is imported.

    ``taken`` are names that spherloc has without an entry point.
    """
    points = sorted(_points(kind), key=lambda point: (point.name, *_rank(point)))
    return tuple(
        Registered(
            kind,
            point.name,
            _distribution(point) or point.value,
            "" if point.dist is None else str(point.dist.version or ""),
            point.value,
            _clash(kind, point, taken),
        )
        for point in points
    )


@contextmanager
def guarded(kind: str, name: str, where: str = "") -> Iterator[None]:
    """Context of a call into an object from ``lookup``: any exception of an extension becomes an ``InputError``.

    ``where`` names the file that it was to read.
    """
    try:
        yield
    except SpherlocError:
        raise
    except Exception as error:
        if not extension_of(kind, name):
            raise
        what = f"{shorten(type(error).__name__)}: {reason(error)}"
        what_failed = f"{where}: {title(kind, name)}" if where else title(kind, name)
        raise InputError(f"{what_failed} failed ({what}); tell its authors, or use another one.") from error


def _titled(kind: str, name: str, extension: str) -> str:
    return f"the {KINDS[kind]} {show(name)}" + (f" of the extension {extension}" if extension else "")


def _clash(kind: str, point: EntryPoint, taken: Collection[str]) -> str:
    """Sentence that says why this one is not used; empty if it is used."""
    mine = _titled(kind, point.name, shorten(_distribution(point) or point.value))
    if _is_own(point):
        return ""
    if point.name in taken:
        return f"{mine} is not used, since spherloc has one of that name; rename it."
    used = _point(kind, point.name)
    if used is not None and _distribution(used) != _distribution(point):
        return f"{mine} is not used, since {_whose(used)} has one of that name; rename it."
    above = _point("estimators", RANSAC + point.name) if kind == "solvers" else None
    if above is not None and above.group == _group("estimators"):
        return f"{mine} is not used, since {_whose(above)} has an estimator {show(above.name)}; rename it."
    return ""


def _whose(point: EntryPoint) -> str:
    return OWN if _is_own(point) else f"the extension {shorten(_distribution(point) or point.value)}"


def _group(kind: str) -> str:
    return f"spherloc.{kind}"


@cache
def _point(kind: str, name: str) -> EntryPoint | None:
    """The entry point that is used for a name; for an estimator it may be that of its solver."""
    found = sorted((point for point in _points(kind) if point.name == name), key=_rank)
    if not found and (kind, name) in UNLISTED:
        return UNLISTED[kind, name]
    if found or kind != "estimators" or not name.startswith(RANSAC):
        return found[0] if found else None
    return _point("solvers", name.removeprefix(RANSAC))


def _rank(point: EntryPoint) -> tuple[bool, str]:
    """Sort key: of several entry points with one name the one with the lowest key is used."""
    return not _is_own(point), _distribution(point)


def _is_own(point: EntryPoint) -> bool:
    return point in UNLISTED.values() or _distribution(point) == OWN


@cache
def _points(kind: str) -> tuple[EntryPoint, ...]:
    """All entry points of a kind; kept, since asking for them reads the list of every installed package."""
    return tuple(entry_points(group=_group(kind)))


def _distribution(point: EntryPoint) -> str:
    return "" if point.dist is None else _name(point.dist)


@cache
def _name(distribution: Distribution) -> str:
    """Name of a distribution; cached, since the whole metadata of the package are parsed for it, readme included."""
    return str(distribution.name or "")


def require(module: str, extra: str, purpose: str) -> Any:
    """The optional module; ``purpose`` says what needs it ("reading COLMAP models").

    Raises ``InputError`` that names the extra which brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        python = shlex.quote(sys.executable)
        raise InputError(
            f"{purpose} needs {module}; install it with: {python} -m pip install 'spherloc[{extra}]'."
        ) from None
