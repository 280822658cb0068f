"""Text files with one record a line, as hloc, COLMAP and kapture write them."""

import math
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from spherloc.errors import InputError, show
from spherloc.files import is_file, open_file, reading
from spherloc.geometry import pose
from spherloc.trajectory import rotation_from_wxyz
from spherloc.types import FloatArray

MAX_BYTES = 1 << 28
"""Largest file, 256 MiB: more than the lists of any dataset, with millions of pairs of images or of poses."""
_MAX_LINE_BYTES = 4096
_LENGTH_TOLERANCE = 0.05
_LARGEST_M = 1e9

_PICKLES = (".pkl", ".pickle", ".pt", ".pth")
_PICKLE_START = re.compile(rb"\x80[\x02-\x05]|\(?[dl]p\d+\n|[}\]]q|c[\w.]+\n\w+\n")
"""First bytes of a pickle: binary protocols have a mark; the older ones begin with a container or a class's name."""


def refuse_pickle(path: Path) -> None:
    """Raise ``InputError`` if a file is a pickle, by its name or its first bytes: reading one runs the code in it.

    Also for a file that is missing or cannot be read.
    """
    with reading(path, "correct its path"), open_file(path) as file:
        start = file.read(256)
    if path.suffix.lower() in _PICKLES or _PICKLE_START.match(start):
        raise InputError(
            f"{path}: is a Python pickle, and reading one runs whatever code is in it; give hloc's HDF5 and text files "
            "instead, which hold the same."
        )


def rows(path: Path, what: str) -> Iterator[tuple[str, str]]:
    """Place ("file, line 3") and text of every line that is neither empty nor a comment.

    ``what`` says what the file should be ("a list of pairs"). Raises ``InputError`` if it is not a text file.
    """
    refuse_pickle(path)
    with reading(path, "correct its path"), open_file(path) as file:
        if os.fstat(file.fileno()).st_size > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES >> 20} MiB, which is too large for {what}; split it.")
        for number, content in enumerate(iter(lambda: file.readline(_MAX_LINE_BYTES), b""), start=1):
            place = f"{path}, line {number}"
            if len(content) == _MAX_LINE_BYTES:
                raise InputError(f"{place}: is longer than {_MAX_LINE_BYTES} bytes; give {what}.")
            try:
                text = content.decode("utf-8-sig" if number == 1 else "utf-8").strip()
            except UnicodeDecodeError:
                raise InputError(f"{place}: not text in UTF-8; give {what}.") from None
            if text and not text.startswith("#"):
                yield place, text


def finite_numbers(words: Sequence[str], place: str) -> list[float]:
    """The words as finite numbers; raises ``InputError``, which quotes the first word that is not one."""
    numbers = []
    for word in words:
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        # Python accepts underscores in numbers, these files do not.
        if not math.isfinite(number) or "_" in word:
            raise InputError(f"{place}: {show(word)} is not a finite number; correct it.")
        numbers.append(number)
    return numbers


def pose_from_words(words: Sequence[str], place: str) -> FloatArray:
    """The pose (3, 4) [R | t], metres, of the seven words qw qx qy qz tx ty tz.

    Raises ``InputError`` for another number of words, and for a quaternion or position that cannot be right.
    """
    if len(words) != 7:
        raise InputError(f"{place}: a pose has {len(words)} numbers; give the seven qw qx qy qz tx ty tz.")
    numbers = np.array(finite_numbers(words, place))
    length = math.hypot(*numbers[:4])
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise InputError(f"{place}: its quaternion has the length {length:.3g} instead of 1; correct it.")
    if np.abs(numbers[4:]).max() > _LARGEST_M:
        raise InputError(f"{place}: its position is beyond {_LARGEST_M:g} m; correct it.")
    return pose(rotation_from_wxyz(numbers[:4]), numbers[4:])


def needed_file(root: Path, name: str, where: str, what: str) -> Path:
    """A file that a dataset's layout requires; raises ``InputError`` that names it if it is missing.

    ``what`` says what it holds ("the calibration of image_02").
    """
    named = root / name
    if not is_file(named):
        raise InputError(f"{where}: {named} is missing, {what}; check that 'root' is the dataset's own folder.")
    return named
