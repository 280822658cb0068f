"""The exceptions of this package, and functions that quote foreign text in their messages.

Every message is one sentence that says what, where, and what to do.
"""

import reprlib
from typing import Any

MAX_QUOTED = 60
"""Largest number of characters of a quoted value."""
MAX_REASON = 160
"""Largest number of characters of a message of the system or a library."""
MAX_UNBROKEN = 300
"""Largest number of characters without a space between them, such as those of a path."""
MAX_MESSAGE = 2000


class SpherlocError(Exception):
    """Base of every error that a user can cause; the command line shows it as one line and exits with code 2."""

    def __init__(self, message: str) -> None:
        """``message`` may quote a user's file; it is made ``legible``."""
        super().__init__(legible(message))


class InputError(SpherlocError):
    """A file, key or value that the user gave cannot be used."""


class StoppedError(InputError):
    """Work stopped on the way; what is done is kept, and the same command goes on from there."""


class CalibrationError(InputError):
    """A camera calibration is unreadable or does not describe a usable camera."""


class ProblemError(InputError):
    """Correspondences do not form a localization problem (NaN, wrong shape, too few)."""


class RecordingError(SpherlocError):
    """A recording cannot be written or read."""


def legible(text: str) -> str:
    r"""``text`` as one line of bounded length, control characters written as in Python: ``\x1b``.

    The middle of a word that is longer than ``MAX_UNBROKEN`` characters is cut out, and so is that of a text longer
    than ``MAX_MESSAGE``.
    """
    line = _escaped(_cut(text, MAX_MESSAGE))
    return _cut(" ".join(_cut(word, MAX_UNBROKEN) for word in line.split(" ")), MAX_MESSAGE)


def show(value: Any) -> str:
    """A value as it can be quoted in a message, at most ``MAX_QUOTED`` characters: texts in quotation marks."""
    try:
        return _cut(_escaped(_QUOTE.repr(value)), MAX_QUOTED)
    except ValueError:  # Python refuses to print very large integers
        return "a number too large to print"


def shorten(text: str, most: int = MAX_QUOTED) -> str:
    """A name or words from a file as they can be quoted without quotation marks, at most ``most`` characters."""
    return _cut(_escaped(_cut(text, most)), most)


def reason(error: BaseException) -> str:
    """Why the system or a library refused something, as a part of a sentence of at most ``MAX_REASON`` characters."""
    try:
        text = getattr(error, "strerror", None) or str(error)
    except Exception:  # a foreign exception whose text cannot be made
        text = ""
    words = _cut(text or type(error).__name__, 4 * MAX_REASON).split()
    return _cut(_escaped(" ".join(words)).rstrip("."), MAX_REASON)


def _escaped(text: str) -> str:
    r"""The text with escapes for what is not printable: ``\n``, ``\x1b``, ``\u202e``; ``\udcff`` for a byte of a name
    that is not UTF-8."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def _cut(text: str, most: int) -> str:
    """``text`` without its middle if it is longer than ``most``."""
    if len(text) <= most:
        return text
    head = (most - 3 + 1) // 2
    return f"{text[:head]}...{text[len(text) - (most - 3 - head) :]}"


class _Quote(reprlib.Repr):
    """Shows few items and levels of a value: with aliases, a small YAML file can be an endless tree."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxstring = self.maxother = self.maxlong = MAX_QUOTED


_QUOTE = _Quote()
