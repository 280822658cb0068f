"""One exception tree. Every message is one sentence that says what, where, and what to do."""

import reprlib
from typing import Any


class SpherlocError(Exception):
    """Base of every error that a user can cause; the command line shows it as one line and exits with code 2."""

    def __init__(self, message: str) -> None:
        """``message`` may quote a user's file; control characters in it become spaces."""
        super().__init__("".join(character if character.isprintable() else " " for character in message))


def show(value: Any) -> str:
    """A value as it can be quoted in a message: short, whatever it is."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python refuses to print very large integers
        return "a number too large to print"


class InputError(SpherlocError):
    """A file, key or value that the user gave cannot be used."""


class CalibrationError(InputError):
    """A camera calibration is unreadable or describes no usable camera."""


class ProblemError(InputError):
    """Correspondences do not form a localization problem (NaN, wrong shape, too few)."""


class RecordingError(SpherlocError):
    """A recording cannot be written or read."""
