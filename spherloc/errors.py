"""One exception tree, and how messages quote what they did not write.

Every message is one sentence that says what, where, and what to do.
"""

import reprlib
from typing import Any

MAX_QUOTED = 60
"""Characters of a quoted value."""
MAX_REASON = 160
"""Characters of what the system or a library says."""
MAX_UNBROKEN = 300
"""Characters without a space between them, such as a path."""
MAX_MESSAGE = 2000


class SpherlocError(Exception):
    """Base of every error that a user can cause; the command line shows it as one line and exits with code 2."""

    def __init__(self, message: str) -> None:
        """``message`` may quote a user's file: it becomes ``legible``."""
        super().__init__(legible(message))


class InputError(SpherlocError):
    """A file, key or value that the user gave cannot be used."""


class CalibrationError(InputError):
    """A camera calibration is unreadable or describes no usable camera."""


class ProblemError(InputError):
    """Correspondences do not form a localization problem (NaN, wrong shape, too few)."""


class RecordingError(SpherlocError):
    """A recording cannot be written or read."""


def legible(text: str) -> str:
    r"""``text`` as one line of bounded length, control characters written as in Python: ``\x1b``.

    Whatever has no space within ``MAX_UNBROKEN`` characters loses its middle, and so does a text that is longer than
    ``MAX_MESSAGE``.
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
    except Exception:  # an exception of somebody else's whose text cannot be had
        text = ""
    words = _cut(text or type(error).__name__, 4 * MAX_REASON).split()
    return _cut(_escaped(" ".join(words)).rstrip("."), MAX_REASON)


def _escaped(text: str) -> str:
    r"""Printable; others as ``\n``, ``\x1b``, ``\u202e``, and a byte of a name that is no UTF-8 as ``\udcff``."""
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
    """Few items and levels: aliases make a small file of YAML into a tree without end."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxstring = self.maxother = self.maxlong = MAX_QUOTED


_QUOTE = _Quote()
