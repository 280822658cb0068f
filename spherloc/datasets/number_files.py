"""Text files of numbers, one record a line, as datasets have them for poses, calibrations and inertial measurements."""

from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path

import numpy as np

from spherloc.cameras.base import FloatArray
from spherloc.errors import InputError, show

MAX_FILE_BYTES = 1 << 29
"""Larger than an hour of inertial measurements at 1 kHz."""
MAX_LINE_BYTES = 4096
LARGEST = 1e12
"""Larger than any coordinate in metres and any timestamp in seconds."""
ROTATION_TOLERANCE = 1e-3
"""Rotations written with four digits are about this far from orthonormal."""


def records(path: Path, what: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and words, between spaces and commas, of every line that is neither empty nor a comment (#).

    ``what`` says what the file should be ("the poses of a sequence"). Raises ``InputError`` for what is no such text.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB; give {what}.")
        with path.open("rb") as file:
            for line, content in enumerate(iter(lambda: file.readline(MAX_LINE_BYTES), b""), start=1):
                if len(content) == MAX_LINE_BYTES:
                    raise InputError(f"{path}, line {line}: longer than {MAX_LINE_BYTES} bytes; give {what}.")
                # An underscore is no part of a number, though Python reads over it; in a keyword it stays.
                words = content.removeprefix(b"\xef\xbb\xbf").replace(b",", b" ").split()
                if words and not words[0].startswith(b"#"):
                    yield line, [word.decode("ascii") for word in words]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give {what}.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: holds characters that are not ASCII; give {what}.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); give {what}.") from None


def numbers(words: Sequence[str], count: int, place: str) -> list[float]:
    """``count`` finite numbers; raises ``InputError`` that starts with ``place`` (file and line) otherwise."""
    if len(words) != count:
        raise InputError(f"{place}: has {len(words)} numbers instead of {count}; correct or remove the line.")
    values = [_number(word, place) for word in words]
    if not all(isfinite(value) and abs(value) <= LARGEST for value in values):
        raise InputError(f"{place}: holds a number that is not finite or beyond {LARGEST:g}; correct the line.")
    return values


def rigid(values: Sequence[float], place: str) -> FloatArray:
    """The rigid motion (4, 4) of twelve numbers, 3 x 4 row by row, its rotation made exactly orthonormal.

    Raises ``InputError`` that starts with ``place`` if the rotation is farther than ``ROTATION_TOLERANCE`` from one.
    """
    given = np.reshape(np.asarray(values, dtype=np.float64), (3, 4))
    motion = np.eye(4)
    motion[:3] = given
    if np.abs(given[:, :3]).max() <= 2.0:
        left, _, right = np.linalg.svd(given[:, :3])
        motion[:3, :3] = left @ right
    off = np.abs(motion[:3, :3].T @ given[:, :3] - np.eye(3)).max()
    if not off <= ROTATION_TOLERANCE or np.linalg.det(motion[:3, :3]) < 0:
        raise InputError(f"{place}: its 3 x 3 part is no rotation; check the order and number of the values.")
    return motion


def _number(word: str, place: str) -> float:
    try:
        return float(word if "_" not in word else "")
    except ValueError:
        raise InputError(f"{place}: {show(word)} is no number; correct the line.") from None
