"""Types of flags, and checks of the words of a command line for what would be lost or is of another flag."""

import typing
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from spherloc.errors import InputError, show

T = TypeVar("T", int, float)


def _number(kind: Callable[[str], T], metavar: str, words: str) -> tyro.constructors.PrimitiveConstructorSpec[T | None]:
    """How an optional number is read, so that a wrong one is called by what it should be."""

    def read(given: list[str]) -> T | None:
        try:
            return kind(given[0])
        except ValueError:
            raise ValueError(f"{show(given[0])} is not {words}") from None

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, int | float),
        str_from_instance=lambda value: [str(value)],
    )


OptionalText = Annotated[str | None, tyro.conf.arg(metavar="STR", help_behavior_hint="")]
OptionalNumber = Annotated[int | None, _number(int, "INT", "a whole number"), tyro.conf.arg(help_behavior_hint="")]
OptionalFloat = Annotated[float | None, _number(float, "FLOAT", "a number"), tyro.conf.arg(help_behavior_hint="")]
_Nine = tuple[float, float, float, float, float, float, float, float, float]
OptionalRotation = Annotated[
    _Nine | None, tyro.conf.arg(metavar="R11 R12 R13 R21 R22 R23 R31 R32 R33", help_behavior_hint="")
]
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
"""Types of optional flags, whose help would otherwise list None beside the type."""
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""A switch without a form that begins with --no-."""
Settings = Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], tyro.conf.arg(metavar="KEY=VALUE ...")]
"""Several values after one flag, or the flag several times."""
RECORDINGS = Path("recordings")
INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""
_APPEND = typing.get_args(tyro.conf.UseAppendAction[int])[1]
HINTS = {
    ("run", "--estimator"): "or compare estimators with: spherloc sweep SCENE --estimator A --estimator B",
}
"""Further advice for a repeated flag, by command and flag."""


def refuse_repeated(words: Sequence[str], commands: Sequence[Callable[..., Any]]) -> None:
    """Raise ``InputError`` for a flag that ``words`` give twice, but for those that gather all that they are given.

    ``words`` are those of the command line; the functions of ``commands`` have the commands' names.
    """
    command = next((command for command in commands if words[:1] == [command.__name__]), None)
    if command is None:
        return
    given = list(words[1 : words.index("--") if "--" in words else None])
    flags = Counter(_flag(word) for word in given if word.startswith("--"))
    for flag, count in flags.items():
        if count > 1 and flag not in _gathering(command):
            hint = HINTS.get((command.__name__, flag), "")
            raise InputError(f"{show(flag)} is given {count} times; give it once{', ' if hint else ''}{hint}.")


def refuse_second_folder(words: Sequence[str]) -> None:
    """Raise ``InputError`` if ``words``, those of the command line, begin with ``map`` and two folders."""
    if words[:1] == ["map"] and len(words) > 2 and not any(word.startswith("-") for word in words[1:3]):
        raise InputError(
            f"map makes a map of one folder, and {show(words[2])} is a second one; give --localize {words[2]} to "
            f"localize its images in the map, or --output {words[2]} to have the map there."
        )


def _flag(word: str) -> str:
    """The flag without "no-": ``--record`` for ``--no-record`` too, which sets the opposite value."""
    name = word.partition("=")[0].replace("_", "-")
    return f"--{name.removeprefix('--no-')}" if name.startswith("--no-") else name


def _gathering(command: Callable[..., Any]) -> set[str]:
    """Flags of a command that may be given several times."""
    hints = typing.get_type_hints(command, include_extras=True)
    return {
        f"--{name.replace('_', '-')}"
        for name, hint in hints.items()
        if typing.get_origin(hint) is Annotated and _APPEND in typing.get_args(hint)
    }
