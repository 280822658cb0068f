"""Drawings as small SVG that is quick to make. Text and axes have the page's own colour, for dark and light pages.

Numbers are pixels of the drawing, which the page scales to the panel's width. Every text is escaped here.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spherloc.types import FloatArray
from spherloc_viz import style

MINUS = "\N{MINUS SIGN}"
ROUND = (1.0, 2.0, 5.0, 10.0)
"""Possible steps between ticks, times a power of ten."""
ROUND_DEGREES = (15.0, 30.0, 45.0, 90.0, 180.0)
"""Possible steps between ticks of angles above 10 degrees; larger steps are round numbers again."""
SMALLEST = 1e-300
"""Least value of which a logarithm is taken."""
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
    """Whether the scale is logarithmic; ``low`` must then be above 0."""

    def px(self, values: ArrayLike) -> FloatArray:
        """Pixels of numbers (any shape): at most the length of the axis beyond its ends; before the axis for NaN."""
        values = np.asarray(values, dtype=np.float64)
        low, high = self.low, self.high
        if self.log:
            values, low, high = np.log10(np.fmax(values, SMALLEST)), math.log10(low), math.log10(high)
        share = np.fmin(np.fmax((values - low) / (high - low), -1.0), 2.0)
        return self.low_px + (self.high_px - self.low_px) * share

    def at(self, value: float) -> float:
        """Pixel of one finite number."""
        low, high = self.low, self.high
        if self.log:
            value, low, high = math.log10(max(value, SMALLEST)), math.log10(low), math.log10(high)
        return self.low_px + (self.high_px - self.low_px) * min(max((value - low) / (high - low), -1.0), 2.0)


def round_ticks(low: float, high: float, most: int, degrees: bool = False) -> tuple[float, ...]:
    """At most ``most`` (2 or more) numbers from ``low`` to ``high``: multiples of 1, 2 or 5 times a power of ten.

    With ``degrees``, steps between 10 and 180 are 15, 30, 45, 90 or 180. Empty if the range is empty.
    """
    span = high - low
    if not (math.isfinite(span) and span > 0.0):
        return ()
    step = _round_step(span / most, degrees)
    while math.floor(high / step + 1e-9) - math.ceil(low / step - 1e-9) + 1 > most:
        step = _round_step(1.01 * step, degrees)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    # Rounded to 12 digits, so that multiples of 0.1 print without rounding errors.
    digits = 12 - math.floor(math.log10(max(abs(low), abs(high), step)))
    return tuple(round(k * step, digits) + 0.0 for k in range(first, last + 1))


def _round_step(least: float, degrees: bool) -> float:
    """The smallest round step that is not below ``least``."""
    if degrees and ROUND[-1] < least <= ROUND_DEGREES[-1]:
        return next(step for step in ROUND_DEGREES if step >= least)
    power = 10.0 ** math.floor(math.log10(least))
    return next(step * power for step in (*ROUND, 20.0) if step * power >= least * (1.0 - 1e-12))


def decade_ticks(low: float, high: float, most: int) -> tuple[float, ...]:
    """Powers of ten from ``low`` (above 0) to ``high``: all, or every n-th so that there are at most ``most``."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    stride = max(1, -(-(last - first + 1) // most))
    return tuple(10.0**power for power in range(first, last + 1, stride))


def tick_texts(ticks: tuple[float, ...], log: bool = False) -> list[str]:
    """Ticks as text, all with the decimals that their distance needs; from five digits on as powers of ten if
    ``log``."""
    if log:
        return [_power_text(tick) for tick in ticks]
    step = ticks[1] - ticks[0] if len(ticks) > 1 else 1.0
    decimals = max(0, -math.floor(math.log10(step) + 1e-9)) if step > 0 else 0
    return [f"{tick:,.{decimals}f}".replace("-", MINUS) for tick in ticks]


def _power_text(tick: float) -> str:
    power = round(math.log10(tick))
    return f"{tick:g}" if -3 <= power <= 4 else "10" + str(power).translate(SHOWN_SUPERSCRIPTS)


def wrapped_deg(angle_deg: Any) -> Any:
    """Angles wrapped into [-180, 180), for the numbers of an axis that crosses +-180 degrees."""
    return (angle_deg + 180.0) % 360.0 - 180.0


FONT_PX = 13.0
MAX_CORNERS = 400
"""Largest number of points of a line: about one per pixel."""
TEXT_OPACITY, GRID_OPACITY, AXIS_OPACITY = 0.7, 0.12, 0.4


def number(value: float) -> str:
    """A coordinate as text, to 0.1 px."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def svg(width_px: float, height_px: float, parts: Sequence[str], label: str) -> str:
    """A drawing as wide as its container; ``label`` is for screen readers."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {number(width_px)} {number(height_px)}" role="img" '
        f'aria-label="{escape(label)}" font-size="{FONT_PX:g}" fill="currentColor" '
        f'style="display:block;width:100%;height:auto;overflow:visible">{"".join(parts)}</svg>'
    )


def text(x: float, y: float, words: str, anchor: str = "start", more: str = "") -> str:
    """Words whose baseline begins, ends ("end") or is centred ("middle") at a place; ``more`` are other attributes."""
    at = "" if anchor == "start" else f' text-anchor="{anchor}"'
    return f'<text x="{number(x)}" y="{number(y)}"{at} opacity="{TEXT_OPACITY}"{more}>{escape(words)}</text>'


def text_width_px(words: str) -> float:
    """Approximate width of a text, px."""
    return 0.6 * FONT_PX * len(words)


def tooltip(words: str) -> str:
    """Text that the page shows while the pointer rests on the element that contains this."""
    return f"<title>{escape(words)}</title>"


def rect(x: float, y: float, width: float, height: float, look: str, inside: str = "") -> str:
    """A box; ``look`` are its other attributes, ``inside`` a tooltip."""
    place = f'x="{number(x)}" y="{number(y)}" width="{number(max(width, 0.0))}" height="{number(max(height, 0.0))}"'
    return f"<rect {place} {look}>{inside}</rect>" if inside else f"<rect {place} {look}/>"


def line(x0: float, y0: float, x1: float, y1: float, look: str) -> str:
    """A straight line."""
    return f'<path d="M{number(x0)} {number(y0)}L{number(x1)} {number(y1)}" {look}/>'


def dot(x: float, y: float, radius: float, look: str, inside: str = "") -> str:
    """A circle; ``inside`` may be a tooltip."""
    place = f'cx="{number(x)}" cy="{number(y)}" r="{number(radius)}"'
    return f"<circle {place} {look}>{inside}</circle>" if inside else f"<circle {place} {look}/>"


def stroke(color: style.RGB | None, width_px: float, more: str = "", fill: str = 'fill="none"') -> str:
    """Attributes of an outline in a colour, or in the page's own for None."""
    paint = "currentColor" if color is None else style.css(color)
    return f'{fill} stroke="{paint}" stroke-width="{width_px:g}" stroke-linejoin="round"{more}'


def fill(color: style.RGB, opacity: float = 1.0) -> str:
    """Attributes of a surface."""
    return f'fill="{style.css(color)}"' + (f' fill-opacity="{opacity:g}"' if opacity < 1.0 else "")


def touch(action: str, drag: bool = False) -> str:
    """Attributes of an element that can be pressed or, with ``drag``, dragged across."""
    return f' data-touch="{escape(action)}"' + (" data-drag=''" if drag else "")


def corners(x: ArrayLike, y: ArrayLike) -> str:
    """Data of a path that joins points by straight lines; empty if there are none."""
    flat = np.column_stack([np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)]).ravel().tolist()
    return "M" + ("%.1f %.1fL" * (len(flat) // 2) % tuple(flat))[:-1] if flat else ""


def thin(x: FloatArray, y: FloatArray, most: int = MAX_CORNERS) -> tuple[FloatArray, FloatArray]:
    """At most ``most`` (4 or more) of a line's points (K,): both ends, and the lowest and highest of each piece."""
    if len(x) <= most:
        return x, y
    inner = y[1:-1]
    stretches = (most - 2) // 2
    bounds = np.linspace(0, len(inner), stretches + 1).astype(np.int64)
    keep = {0, len(x) - 1}
    for start, end in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        if end > start:
            part = inner[start:end]
            keep |= {1 + start + int(np.argmin(part)), 1 + start + int(np.argmax(part))}
    places = np.array(sorted(keep))
    return x[places], y[places]


def thin_steps(x: FloatArray, y: FloatArray, most: int = MAX_CORNERS) -> tuple[FloatArray, FloatArray]:
    """At most ``most`` steps (K,), each with the largest value of the steps that it replaces."""
    stride = -(-len(x) // most)
    if stride <= 1:
        return x, y
    starts = np.arange(0, len(x), stride)
    return x[starts], np.maximum.reduceat(y, starts)


def steps(x_px: FloatArray, y_px: FloatArray, end_px: float, foot_px: float) -> str:
    """Data of a path from the base line ``foot_px`` up, over steps with y[k] from x[k] to x[k + 1], the last one until
    ``end_px``, and back to the base line. Steps of equal height are joined.
    """
    if len(x_px) == 0:
        return ""
    x, y = np.round(x_px, 1), np.round(y_px, 1)
    turns = np.flatnonzero(np.diff(y)) + 1
    flat = np.column_stack([x[turns], y[turns]]).ravel().tolist()
    return (
        f"M{x[0]:.1f} {foot_px:.1f}V{y[0]:.1f}"
        + "H%.1fV%.1f" * len(turns) % tuple(flat)
        + f"H{end_px:.1f}V{foot_px:.1f}"
    )


def x_axis(scale: Scale, foot_px: float, ticks: Sequence[float], texts: Sequence[str], label: str = "") -> list[str]:
    """The x axis under a plot with its ticks, their numbers, and the label below the middle."""
    faint = stroke(None, 1, f' opacity="{AXIS_OPACITY}"')
    places = scale.px(ticks).tolist()
    data = "".join(f"M{number(x)} {number(foot_px)}v4" for x in places)
    parts = [f'<path d="M{number(scale.low_px)} {number(foot_px)}H{number(scale.high_px)}{data}" {faint}/>']
    parts += [text(x, foot_px + 15, words, "middle") for x, words in zip(places, texts, strict=True)]
    if label:
        parts.append(text(0.5 * (scale.low_px + scale.high_px), foot_px + 29, label, "middle"))
    return parts


def y_axis(scale: Scale, left_px: float, right_px: float, ticks: Sequence[float], texts: Sequence[str]) -> list[str]:
    """Faint lines across a plot at its ticks, and their numbers to the left."""
    places = scale.px(ticks).tolist()
    data = "".join(f"M{number(left_px)} {number(y)}H{number(right_px)}" for y in places)
    faint = stroke(None, 1, f' opacity="{GRID_OPACITY}"')
    grid = [f'<path d="{data}" {faint}/>'] if data else []
    return grid + [text(left_px - 5, y + 4, words, "end") for y, words in zip(places, texts, strict=True)]
