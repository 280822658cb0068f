"""Finds camera models, estimators and dataset loaders by entry point: a new kind is one file and one line."""

from functools import cache
from importlib.metadata import entry_points
from typing import Any

from spherloc.errors import InputError, show


@cache
def names(kind: str) -> tuple[str, ...]:
    """Names registered for ``kind`` ("cameras", "estimators", "datasets"), in alphabetical order."""
    return tuple(sorted({point.name for point in entry_points(group=f"spherloc.{kind}")}))


@cache
def lookup(kind: str, name: str) -> Any:
    """The object registered under ``name``.

    Raises ``InputError`` naming the known ones if there is none.
    """
    for point in entry_points(group=f"spherloc.{kind}", name=name):
        return point.load()
    raise InputError(f"unknown {kind[:-1]} {show(name)}: choose one of {', '.join(names(kind))}.")
