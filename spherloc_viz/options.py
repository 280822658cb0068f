"""Options of estimators as people type them and as JSON holds them.

JSON has no word for infinity, which some options mean: there it is the text "inf", and None is null.
"""

import ast
import dataclasses
import inspect
import json
import math
import textwrap
import threading
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np

from spherloc import registry
from spherloc.errors import InputError, show
from spherloc.estimators import options_type
from spherloc.ranges import check_option
from spherloc.refine import RefinementOptions

NONE = "none"
"""What is typed for None."""

_parsing = threading.Lock()
"""Python's parser fails when several threads use it at once (3.11: "AST constructor recursion depth mismatch")."""


@dataclass(frozen=True)
class OptionField:
    """One field of an options dataclass."""

    name: str
    default: Any
    kind: type
    """bool, int, float or str."""
    choices: tuple[str, ...]
    """The only texts that it takes; empty if there is no such list."""
    optional: bool
    """Whether None is a value."""
    doc: str
    """The docstring under the field, on one line."""
    shared: bool
    """Whether every estimator has it, since the refinement asks for it."""

    def parse(self, text: str) -> Any:
        """The value that ``text`` says.

        Raises ``InputError``, which names what may be typed, if it says none.
        """
        text = text.strip()
        try:
            if self.optional and text.lower() == NONE:
                return None
            if self.choices:
                return self.choices[self.choices.index(text)]
            if self.kind is bool:
                return {"true": True, "false": False}[text.lower()]
            value = self.kind(text)
        except (ValueError, KeyError):
            value = math.nan
        if isinstance(value, float) and math.isnan(value):
            raise InputError(f"option {self.name} is {show(text)}; give {self._accepted()}.")
        check_option(self.name, value)
        return value

    def _accepted(self) -> str:
        if self.choices:
            words = list(self.choices)
        elif self.kind is bool:
            words = ["true", "false"]
        else:
            words = ["a whole number" if self.kind is int else "a number"]
        words += [NONE] * self.optional
        return ", ".join(words[:-1]) + (" or " if words[1:] else "") + words[-1]


def typed(value: Any) -> str:
    """A value as people type it: ``OptionField.parse`` gives it back, to the last bit."""
    if value is None:
        return NONE
    return str(value).lower() if isinstance(value, bool) else value if isinstance(value, str) else repr(value)


@cache
def usable_estimators() -> tuple[str, ...]:
    """Names of the registered estimators without the extensions that cannot be imported or have no form."""
    return tuple(name for name in registry.names("estimators") if not _why_unusable(name))


@cache
def _why_unusable(name: str) -> str:
    try:
        option_fields(options_type(name))
    except InputError as error:
        named = registry.extension_of("estimators", name) in str(error)
        return str(error) if named else f"{registry.title('estimators', name)} {error}"
    return ""


@cache
def option_fields(kind: type) -> tuple[OptionField, ...]:
    """The fields of an options dataclass: the estimator's own first, then those that all estimators share.

    Raises ``InputError`` for a field of a type that cannot be typed or shown.
    """
    hints, docs = typing.get_type_hints(kind), field_docs(kind)
    shared = {item.name for item in dataclasses.fields(RefinementOptions)}
    found = [
        OptionField(item.name, item.default, *_form(hints[item.name]), docs.get(item.name, ""), item.name in shared)
        for item in dataclasses.fields(kind)
    ]
    return tuple(sorted(found, key=lambda item: item.shared))


def _form(hint: Any) -> tuple[type, tuple[str, ...], bool]:
    """Type, choices and whether None is a value, of a type hint.

    Raises ``InputError`` for one that neither the page nor the command line has a form for.
    """
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        inner = [part for part in typing.get_args(hint) if part is not type(None)]
        if len(inner) == 1:
            kind, choices, _ = _form(inner[0])
            return kind, choices, True
    if typing.get_origin(hint) is Literal and all(isinstance(choice, str) for choice in typing.get_args(hint)):
        return str, typing.get_args(hint), False
    if hint in (bool, int, float):
        return hint, (), False
    raise InputError(f"has an option of type {show(hint)}; options are bool, int, float, Literal of texts, or None.")


def field_docs(kind: type) -> dict[str, str]:
    """The docstring under each field of a dataclass, inherited ones too, which Python itself does not keep."""
    docs: dict[str, str] = {}
    for owner in reversed(kind.__mro__[:-1]):
        try:
            with _parsing:
                body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0]
        except (OSError, TypeError, SyntaxError):  # an extension whose source is not there
            continue
        if not isinstance(body, ast.ClassDef):
            continue
        for field, text in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
                docs[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return docs


def json_text(value: Any) -> str:
    """``value`` as JSON that every reader takes: infinity and NaN become the texts "inf", "-inf" and "nan"."""
    return json.dumps(plain(value, str), allow_nan=False)


def plain(value: Any, not_finite: Callable[[float], Any]) -> Any:
    """``value`` without arrays, other mappings than dict, and numbers that are not finite, which are replaced."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        return not_finite(value)
    if isinstance(value, Mapping):
        return {name: plain(part, not_finite) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part, not_finite) for part in value]
    return value
