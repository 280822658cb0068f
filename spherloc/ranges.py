"""Limits of numbers in problems and options: beyond them, powers that the estimators compute under- or overflow."""

import math
from dataclasses import fields
from numbers import Integral, Real
from typing import Any

from spherloc.errors import InputError, show

MIN_PX, MAX_PX = 1e-6, 1e6
"""Limits of pixel bounds and noise."""
MIN_M, MAX_M = 1e-12, 1e12
"""Limits of the largest distance of a point from the origin; all points may also be in the origin."""
MIN_OTHER, MAX_OTHER = 1e-12, 1e12
"""Limits of other options that are neither 0 nor infinite."""
MAX_SEED = 2**63 - 1


def check_option(name: str, value: Any) -> None:
    """Raise ``InputError`` for a number of an option that is NaN or too small or too large to calculate with; other
    limits are checked by the options themselves."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return
    least, most = (MIN_PX, MAX_PX) if name.endswith("_px") else (MIN_OTHER, MAX_OTHER)
    try:
        size = abs(float(value))
    except OverflowError:  # an integer beyond all floats
        size = 2.0 * most
    if math.isnan(size) or (size and math.isfinite(size) and not least <= size <= most):
        raise InputError(f"option {name} is {show(value)}; give a number from {least:g} to {most:g}.")


def check_options(options: Any) -> None:
    """``check_option`` for every field of a dataclass of options."""
    for item in fields(options):
        check_option(item.name, getattr(options, item.name))


def is_number(value: Any) -> bool:
    """Whether a value is a real number of Python or numpy, and not a bool."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_seed(seed: Any) -> None:
    """Raise ``InputError`` unless the seed is a whole number from 0 to ``MAX_SEED``."""
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= int(seed) <= MAX_SEED:
        raise InputError(f"seed is {show(seed)}; give a whole number from 0 to 2^63 - 1.")
