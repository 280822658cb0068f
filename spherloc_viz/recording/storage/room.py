"""How much room recordings may take."""

import contextlib
import math
import os
import sys
from pathlib import Path

from spherloc.errors import InputError

GALLERY = "gallery"
"""The folder inside that has the curated cases."""
GIGABYTE = 1_000_000_000
KEEP_GIGABYTES = 2.0
"""Size beyond which old successes are deleted, unless another is given or the recordings take more already."""
KEEP_BYTES = int(KEEP_GIGABYTES * GIGABYTE)


def kept_bytes(gigabytes: float | None, folder: Path) -> int:
    """The size that the recordings in ``folder`` may have, in bytes; infinity keeps all.

    If no size is given, a folder that holds more than usual already keeps that much: a sweep with a larger limit made
    it, and to open it must not delete anything. Raises ``InputError`` for a text that is not a size.
    """
    if gigabytes is None:
        return max(KEEP_BYTES, _held_bytes(folder))
    if math.isnan(gigabytes) or gigabytes <= 0:
        raise InputError(f"{gigabytes:g} gigabytes cannot be kept; give a positive number, or inf to keep all.")
    return sys.maxsize if gigabytes >= sys.maxsize / GIGABYTE else int(gigabytes * GIGABYTE)


def _held_bytes(folder: Path) -> int:
    """Size of the recordings in a folder and in its gallery. What cannot be read counts as 0: a run that is written
    there later reports the error."""
    held = 0
    for place in (folder, folder / GALLERY):
        with contextlib.suppress(OSError), os.scandir(place) as entries:
            for entry in entries:
                if entry.name.lower().endswith(".rrd"):
                    with contextlib.suppress(OSError):  # deleted meanwhile
                        held += entry.stat().st_size
    return held


def size_words(count: int) -> str:
    """A number of bytes for people."""
    return f"{count / GIGABYTE:.3g} GB" if count >= GIGABYTE / 10 else f"{count / 1e6:.3g} MB"
