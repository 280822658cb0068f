"""How much room recordings may take."""

import math
import sys

from spherloc.errors import InputError

GIGABYTE = 1_000_000_000
KEEP_GIGABYTES = 2.0
"""Size of the recordings beyond which old successes are deleted, if nobody says otherwise."""
KEEP_BYTES = int(KEEP_GIGABYTES * GIGABYTE)


def kept_bytes(gigabytes: float) -> int:
    """The size that recordings may have, in bytes; infinity keeps all. Raises ``InputError`` for what is no size."""
    if math.isnan(gigabytes) or gigabytes <= 0:
        raise InputError(f"{gigabytes:g} gigabytes cannot be kept; give a positive number, or inf to keep all.")
    return sys.maxsize if gigabytes >= sys.maxsize / GIGABYTE else int(gigabytes * GIGABYTE)


def size_words(count: int) -> str:
    """A number of bytes for people."""
    return f"{count / GIGABYTE:.3g} GB" if count >= GIGABYTE / 10 else f"{count / 1e6:.3g} MB"
