"""Sentences about what is being checked."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


class Saying:
    """Makes sentences about what is being checked."""

    def __init__(self, what: str) -> None:
        self._what = what

    def need(self, true: Any, otherwise: str) -> None:
        """Raise ``AssertionError`` with ``otherwise`` unless it is true."""
        if not true:
            self.fail(otherwise)

    def fail(self, otherwise: str) -> None:
        """Raise ``AssertionError`` with a sentence that ends with ``otherwise``."""
        raise AssertionError(f"{self._what} {otherwise}.")

    def raises(self, kind: type[Exception], call: Callable[[], Any], of: str) -> None:
        """Raise ``AssertionError`` unless ``call`` raises this kind of error; ``of`` says of what."""
        try:
            call()
        except kind:
            return
        except Exception as error:
            self.fail(f"raises {error!r} {of}, not {kind.__name__}")
        self.fail(f"does not raise {kind.__name__} {of}")


def name_of(thing: Any) -> str:
    """What to call it: its name, or that of its type."""
    return str(getattr(thing, "name", getattr(thing, "__name__", type(thing).__name__)))


def difference(one: Any, other: Any, path: str) -> str:
    """Where two traces, stages or problems differ in anything but times; empty if they do not."""
    if isinstance(one, np.ndarray):
        alike = isinstance(other, np.ndarray) and one.dtype == other.dtype and one.tobytes() == other.tobytes()
        return "" if alike and one.shape == other.shape else path
    if is_dataclass(one) and not isinstance(one, type):
        names = [item.name for item in fields(one) if item.name != "timings_ms"] if type(one) is type(other) else [""]
        parts = (difference(getattr(one, name), getattr(other, name), f"{path}.{name}") for name in names if name)
        return path if names == [""] else next(filter(None, parts), "")
    if isinstance(one, tuple) and isinstance(other, tuple):
        if len(one) != len(other):
            return path
        pairs = enumerate(zip(one, other, strict=True))
        return next(filter(None, (difference(*pair, f"{path}[{number}]") for number, pair in pairs)), "")
    return "" if one == other or (one != one and other != other) else path
