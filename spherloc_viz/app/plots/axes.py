"""Where numbers lie on a drawing, and the round numbers that are written beside it."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spherloc.types import FloatArray

MINUS = "\N{MINUS SIGN}"
ROUND = (1.0, 2.0, 5.0, 10.0)
"""Steps between ticks, times a power of ten."""
ROUND_DEGREES = (15.0, 30.0, 45.0, 90.0, 180.0)
"""Steps between ticks of angles above 10 degrees; above these, they are round numbers again."""
SMALLEST = 1e-300
"""Below this, a logarithm is not taken."""
SHOWN_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Scale:
    """Numbers along one axis of a drawing."""

    low: float
    """The number at ``low_px``."""
    high: float
    """The number at ``high_px``; larger than ``low``."""
    low_px: float
    high_px: float
    log: bool = False
    """Whether equal factors, not equal differences, are equally far apart; ``low`` must be above 0."""

    def px(self, values: ArrayLike) -> FloatArray:
        """Where numbers (any shape) lie: at most an axis' length beyond its ends, and before it if unknown."""
        values = np.asarray(values, dtype=np.float64)
        low, high = self.low, self.high
        if self.log:
            values, low, high = np.log10(np.fmax(values, SMALLEST)), math.log10(low), math.log10(high)
        share = np.fmin(np.fmax((values - low) / (high - low), -1.0), 2.0)
        return self.low_px + (self.high_px - self.low_px) * share

    def at(self, value: float) -> float:
        """Where one finite number lies."""
        low, high = self.low, self.high
        if self.log:
            value, low, high = math.log10(max(value, SMALLEST)), math.log10(low), math.log10(high)
        return self.low_px + (self.high_px - self.low_px) * min(max((value - low) / (high - low), -1.0), 2.0)


def round_ticks(low: float, high: float, most: int, degrees: bool = False) -> tuple[float, ...]:
    """At most ``most`` (2 or more) numbers from ``low`` to ``high``: multiples of 1, 2 or 5 times a power of ten.

    ``degrees`` takes 15, 30, 45, 90 or 180 for steps between 10 and 180. Empty if the range is.
    """
    span = high - low
    if not (math.isfinite(span) and span > 0.0):
        return ()
    step = _round_step(span / most, degrees)
    while math.floor(high / step + 1e-9) - math.ceil(low / step - 1e-9) + 1 > most:
        step = _round_step(1.01 * step, degrees)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    # Half a unit of the 12th digit: multiples of 0.1 print as people write them.
    digits = 12 - math.floor(math.log10(max(abs(low), abs(high), step)))
    return tuple(round(k * step, digits) + 0.0 for k in range(first, last + 1))


def _round_step(least: float, degrees: bool) -> float:
    """The smallest round step that is not below ``least``."""
    if degrees and ROUND[-1] < least <= ROUND_DEGREES[-1]:
        return next(step for step in ROUND_DEGREES if step >= least)
    power = 10.0 ** math.floor(math.log10(least))
    return next(step * power for step in (*ROUND, 20.0) if step * power >= least * (1.0 - 1e-12))


def decade_ticks(low: float, high: float, most: int) -> tuple[float, ...]:
    """Powers of ten from ``low`` (above 0) to ``high``, every one or every so many that there are at most ``most``."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    stride = max(1, -(-(last - first + 1) // most))
    return tuple(10.0**power for power in range(first, last + 1, stride))


def tick_texts(ticks: tuple[float, ...], log: bool = False) -> list[str]:
    """Ticks as text, all with the decimals that their distance needs; powers of ten beyond four digits as such."""
    if log:
        return [_power_text(tick) for tick in ticks]
    step = ticks[1] - ticks[0] if len(ticks) > 1 else 1.0
    decimals = max(0, -math.floor(math.log10(step) + 1e-9)) if step > 0 else 0
    return [f"{tick:,.{decimals}f}".replace("-", MINUS) for tick in ticks]


def _power_text(tick: float) -> str:
    power = round(math.log10(tick))
    return f"{tick:g}" if -3 <= power <= 4 else "10" + str(power).translate(SHOWN_SUPERSCRIPTS)


def wrapped_deg(angle_deg: Any) -> Any:
    """Angles brought into [-180, 180), as they are written beside an axis that crosses the seam."""
    return (angle_deg + 180.0) % 360.0 - 180.0
