"""Finds camera models, estimators and dataset loaders by entry point: a new kind is one file and one line.

What another package registers is an extension. One that cannot be imported or fails costs itself only: whoever asks for
it gets one sentence that names it.
"""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from spherloc.errors import InputError, SpherlocError, reason, shorten, show

OWN = "spherloc"
"""The distribution whose entry points are no extensions."""


@cache
def names(kind: str) -> tuple[str, ...]:
    """Names registered for ``kind`` ("cameras", "estimators", "datasets"), by alphabet; nothing is imported."""
    return tuple(sorted({point.name for point in entry_points(group=f"spherloc.{kind}")}))


@cache
def lookup(kind: str, name: str) -> Any:
    """The object registered under ``name``; spherloc's own if an extension has the same name.

    Raises ``InputError`` naming the known ones if there is none, and naming the extension if it cannot be imported.
    """
    point = _point(kind, name)
    if point is None:
        raise InputError(f"unknown {kind[:-1]} {show(name)}: choose one of {', '.join(map(shorten, names(kind)))}.")
    try:
        return point.load()
    except (Exception, SystemExit) as error:  # whatever the code of others does when it is imported
        if not extension_of(kind, name):
            raise
        what = f"{shorten(type(error).__name__)}: {reason(error)}"
        raise InputError(f"{title(kind, name)} cannot be imported ({what}); mend or uninstall it.") from error


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
    """What a sentence calls it, with the extension that it comes from."""
    extension = extension_of(kind, name)
    return f"the {kind[:-1]} {show(name)}" + (f" of the extension {extension}" if extension else "")


@contextmanager
def guarded(kind: str, name: str, where: str = "") -> Iterator[None]:
    """Around a call into what ``lookup`` gave: whatever an extension raises becomes an ``InputError`` that names it.

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


def _point(kind: str, name: str) -> EntryPoint | None:
    found = sorted(entry_points(group=f"spherloc.{kind}", name=name), key=_is_own, reverse=True)
    return found[0] if found else None


def _is_own(point: EntryPoint) -> bool:
    return _distribution(point) == OWN


def _distribution(point: EntryPoint) -> str:
    return "" if point.dist is None else point.dist.name


def require(module: str, extra: str, purpose: str) -> Any:
    """The optional module; ``purpose`` says what needs it ("reading COLMAP models").

    Raises ``InputError`` that names the extra which brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(f"{purpose} needs {module}; install it with: pip install 'spherloc[{extra}]'.") from None
