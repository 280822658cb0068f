"""The charts of a step beside the canvas, and those of a sweep with its table."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
import viser

from spherloc.experiments.sweep_rows import Point
from spherloc.types import FloatArray
from spherloc_viz.app.plots import shapes
from spherloc_viz.app.plots.shapes import MINUS, Scale, decade_ticks, round_ticks, tick_texts
from spherloc_viz.app.text import DIM, box, dot_html
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers.primitives import Chart, Curve
from spherloc_viz.layers.sweep import LIMIT, SweepChart, sweep_charts, sweep_colors, sweep_table

WIDTH_PX, HEIGHT_PX = 380.0, 180.0
RIGHT_PX, ROW_PX = 12.0, 15.0
MAX_DOTS = 40
"""Largest number of points of a line that are drawn as dots too."""
MAX_STEPS = 360
HEADROOM = 1.06
ROUNDING = 1e-9
"""Values that differ by less count as equal: the two matches that a pose was computed from are 1e-13 px off."""

Bands = Mapping[str, tuple[FloatArray, FloatArray]]
"""Lower and upper ends (K,), (K,) of the band around a curve, by the curve's label."""


def chart_svg(
    chart: Chart,
    width_px: float = WIDTH_PX,
    height_px: float = HEIGHT_PX,
    x_range: tuple[float, float] | None = None,
    touch: str | None = None,
    bands: Bands | None = None,
) -> str:
    """A chart without its title, as SVG that fits the width of its container.

    ``x_range`` limits the x axis. ``touch`` is the action of a drag across the plot, whose x from 0 to 1 stands for the
    x axis. ``bands`` are drawn behind their curves.
    """
    bands = bands or {}
    low, high = x_range or _span(chart)
    bottom, top = _reach(chart, bands)
    legend = _legend(chart, width_px)
    foot_px = height_px - (33.0 if chart.x_label else 19.0)
    y = Scale(bottom, top, foot_px, 6.0 + ROW_PX * max(1, len(legend)))
    y_ticks = _ticks(y, 22.0, [curve.y for curve in chart.curves])
    texts = tick_texts(y_ticks)
    left_px = 9.0 + max(map(shapes.text_width_px, texts), default=0.0)
    x = Scale(low, high, left_px, width_px - RIGHT_PX)
    x_ticks = _ticks(x, 50.0, [curve.x for curve in chart.curves], degrees="°" in chart.x_label)
    parts = shapes.y_axis(y, left_px, x.high_px, y_ticks, texts)
    parts += shapes.x_axis(x, foot_px, x_ticks, tick_texts(x_ticks), chart.x_label)
    parts += legend_parts(chart.y_label, legend, width_px)
    parts += curve_parts(chart.curves, x, y, bands)
    if touch is not None:
        size = (x.high_px - x.low_px, foot_px - y.high_px)
        parts.append(shapes.rect(x.low_px, y.high_px, *size, 'fill="transparent"' + shapes.touch(touch, drag=True)))
    return shapes.svg(width_px, height_px, parts, f"{chart.title}: {chart.y_label} over {chart.x_label}")


def _ticks(scale: Scale, apart_px: float, values: list[FloatArray], degrees: bool = False) -> tuple[float, ...]:
    """Round numbers at least about ``apart_px`` from each other; whole numbers if all values are whole."""
    most = max(2, int(abs(scale.high_px - scale.low_px) / apart_px))
    few = all(len(value) <= MAX_DOTS and np.array_equal(value, np.round(value)) for value in values)
    if few:
        most = max(2, min(most, int(scale.high - scale.low) + 1))
    return round_ticks(scale.low, scale.high, most, degrees)


def _span(chart: Chart) -> tuple[float, float]:
    """Range of x of all curves; for degrees around the whole circle, the circle."""
    ends = [curve.x[[0, -1]] for curve in chart.curves if len(curve.x)]
    low, high = (float(np.min(ends)), float(np.max(ends))) if ends else (0.0, 1.0)
    if "°" in chart.x_label and low <= -179.0 and high >= 179.0:
        return -180.0, 180.0
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _reach(chart: Chart, bands: Bands) -> tuple[float, float]:
    """Range of y, from 0 or below to a little more than the largest value."""
    values = [curve.y for curve in chart.curves] + [side for band in bands.values() for side in band]
    known = np.concatenate([np.zeros(1), *values])
    known = known[np.isfinite(known)]
    low, high = float(known.min()), float(known.max())
    return low, (low + HEADROOM * (high - low) if high - low > ROUNDING else low + 1.0)


def _legend(chart: Chart, width_px: float) -> list[list[tuple[Curve, float]]]:
    """Rows of curves with the x of their sample in the legend; none if the only curve needs no name."""
    if len(chart.curves) < 2:
        return []
    start = 14.0 + shapes.text_width_px(chart.y_label)
    rows, place = [[]], start
    for curve in chart.curves:
        width = 30.0 + shapes.text_width_px(curve.label)
        if place + width > width_px and rows[-1]:
            rows.append([])
            place = start
        rows[-1].append((curve, place))
        place += width
    return rows


def legend_parts(y_label: str, rows: list[list[tuple[Curve, float]]], width_px: float) -> list[str]:
    """The label of the y axis, at the upper left, and the meaning of each colour, to its right."""
    parts = [shapes.text(0.0, 11.0, y_label)]
    for k, row in enumerate(rows):
        last, place = row[-1]
        shift = max(0.0, width_px - RIGHT_PX - (place + 17.0 + shapes.text_width_px(last.label)))
        for curve, left in row:
            y = 11.0 + ROW_PX * k
            dashes = ' stroke-dasharray="3 3"' if curve.kind == "level" else ""
            width = 3.0 if curve.kind == "marker" else 2.0
            parts.append(
                shapes.line(left + shift, y - 4, left + shift + 13, y - 4, shapes.stroke(curve.color, width, dashes))
            )
            parts.append(shapes.text(left + shift + 17, y, curve.label))
    return parts


def curve_parts(curves: tuple[Curve, ...], x: Scale, y: Scale, bands: Bands | None = None) -> list[str]:
    """The curves within the x axis: bands below, then lines, then markers. Of several, the first are broad and later
    ones thin, so that all are seen where they coincide; later markers are dashed too."""
    bands = bands or {}
    under = sum(curve.kind == "line" and len(curve.x) > 0 for curve in curves)
    step_px = min(1.25, 5.0 / max(1, under - 1))
    parts = [_band(curve, x, y, *bands[curve.label]) for curve in curves if curve.label in bands]
    marked = False
    for curve in curves:
        if len(curve.x) == 0:
            continue
        if curve.kind == "marker":
            if x.low <= curve.x[0] <= x.high:
                parts.append(_marker(curve, x, y, marked))
            marked = True
        elif curve.kind == "level":
            px, height = x.px(curve.x), y.at(curve.y[0])
            ends = np.clip(px, x.low_px, x.high_px).tolist()
            parts.append(shapes.line(ends[0], height, ends[-1], height, shapes.stroke(curve.color, 1.5, LEVEL_DASHES)))
        elif curve.kind == "step":
            parts += step_parts(curve, x, y)
        else:
            under -= 1
            parts += _line(curve, x, y, under * step_px)
    return parts


LEVEL_DASHES = ' stroke-dasharray="3 3"'


def _marker(curve: Curve, x: Scale, y: Scale, second: bool) -> str:
    place, name = x.at(curve.x[0]), f"{curve.label}: {curve.x[0]:.2f}".replace("-", MINUS)
    look = shapes.stroke(curve.color, 2.0, ' stroke-dasharray="5 5"') if second else shapes.stroke(curve.color, 4.0)
    return f"<g>{shapes.tooltip(name)}{shapes.line(place, y.at(0.0), place, y.at(curve.y[0]), look)}</g>"


def step_parts(curve: Curve, x: Scale, y: Scale) -> list[str]:
    """A step curve and the area below it, within the ends of the x axis."""
    first = max(0, int(np.searchsorted(curve.x, x.low, "right")) - 1)
    last = int(np.searchsorted(curve.x, x.high, "left"))
    xs, ys = shapes.thin_steps(curve.x[first:last], curve.y[first:last], MAX_STEPS)
    if len(xs) == 0:
        return []
    # The last step of the whole curve ends where it begins; that of a part ends where the next one begins.
    end = min(float(curve.x[min(last, len(curve.x) - 1)]), x.high)
    left, foot = max(x.low, float(xs[0])), y.at(max(0.0, y.low))
    x_px = x.px(np.maximum(xs, left))
    # One path for line and area: it begins and ends at y = 0, where the fill closes it.
    data = shapes.steps(x_px, y.px(ys), x.at(end), foot)
    return [f'<path d="{data}" {shapes.stroke(curve.color, 1.25, fill=shapes.fill(curve.color, 0.22))}/>']


def _known(curve: Curve, *values: FloatArray) -> tuple[FloatArray, ...]:
    """The curve's x and the values, each (K,), where all of them are finite."""
    known = np.all([np.isfinite(value) for value in (curve.x, *values)], axis=0)
    return curve.x[known], *(value[known] for value in values)


def _clipped(x: Scale, xs: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """A line's points within the x axis, cut where the line leaves it."""
    if len(xs) == 0 or (xs[0] >= x.low and xs[-1] <= x.high):
        return xs, *values
    inside = (xs > x.low) & (xs < x.high)
    ends = [end for end in (x.low, x.high) if xs[0] <= end <= xs[-1]]
    cut = np.sort(np.concatenate([xs[inside], ends]))
    return cut, *(np.interp(cut, xs, value) for value in values)


def _line(curve: Curve, x: Scale, y: Scale, wider_px: float) -> list[str]:
    """A line with dots at its points, ``wider_px`` broader than a single one."""
    known = _known(curve, curve.y)
    xs, ys = _clipped(x, *known)
    xs, ys = shapes.thin(xs, ys)
    if len(xs) == 0:
        return []
    parts = [f'<path d="{shapes.corners(x.px(xs), y.px(ys))}" {shapes.stroke(curve.color, 1.75 + wider_px)}/>']
    if len(known[0]) <= MAX_DOTS:
        radius = shapes.number(2.5 + 0.5 * wider_px)
        inside = (known[0] >= x.low) & (known[0] <= x.high)
        for left, top in zip(x.px(known[0][inside]).tolist(), y.px(known[1][inside]).tolist(), strict=True):
            parts.append(
                f'<circle cx="{shapes.number(left)}" cy="{shapes.number(top)}" r="{radius}" '
                f"{shapes.fill(curve.color)}/>"
            )
    return parts


def _band(curve: Curve, x: Scale, y: Scale, lower: FloatArray, upper: FloatArray) -> str:
    xs, low, high = _clipped(x, *_known(curve, lower, upper))
    there, back = shapes.thin(xs, high), shapes.thin(xs, low)
    outline = [np.concatenate([there[k], back[k][::-1]]) for k in (0, 1)]
    data = shapes.corners(x.px(outline[0]), y.px(outline[1]))
    return f'<path d="{data}" {shapes.fill(curve.color, 0.18)}/>'


NONE_YET = "No chart yet: the first one comes with a later step, and then it stays."


class ChartPanel:
    """The charts of a picture, one under the other."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html("")
        self._shown: tuple[Chart, ...] | None = None

    def draw(self, charts: tuple[Chart, ...]) -> None:
        """Show these charts and no others."""
        if (
            self._shown is not None
            and len(charts) == len(self._shown)
            and all(a is b for a, b in zip(charts, self._shown, strict=True))
        ):
            return
        self._shown = charts
        content = "".join(map(chart_html, charts)) or box(escape(NONE_YET))
        update_widget(self._html, content=content)


def chart_html(chart: Chart) -> str:
    """A chart under its title."""
    return box(f'<div style="font-weight:600;padding-bottom:.3em">{escape(chart.title)}</div>{chart_svg(chart)}')


SHOWN = ("sweep success", "sweep rotation", "sweep position", "sweep time")
"""Charts of a sweep that the page shows."""
CURVE_WIDTH_PX, CURVE_HEIGHT_PX, CURVE_RIGHT_PX, TOP_PX, FOOT_PX = 380.0, 165.0, 12.0, 20.0, 33.0
MAX_DECADES, MAX_TICKS = 5, 6
TABLE_PX = 260
IN_TABLE = ("success", "position error", "time")
NOTE = (
    "Curves: the success, and the medians of all runs' errors and times. Bands: the success's 95 % Wilson interval, "
    "and the quartiles. A run without a pose has an infinite error. Times are of workers side by side, beside this "
    "page."
)


def charts_html(over: str, labels: Sequence[str], points: Sequence[Point]) -> str:
    """The charts of a sweep, with the meaning of their colours."""
    colors = sweep_colors(labels)
    names = "".join(
        f'<span style="white-space:nowrap;margin-right:.9em">{dot_html(colors[label])}{escape(label)}</span>'
        for label in labels
    )
    drawn = "".join(
        f'<div style="padding-top:.7em">{sweep_svg(item)}</div>'
        for item in sweep_charts(over, labels, points)
        if item.chart.name in SHOWN
    )
    return box(f'<div style="font-size:12px">{names}</div>{drawn}') + box(
        f'<div style="{DIM}">{escape(NOTE)}</div>', "font-size:12px"
    )


def sweep_svg(drawn: SweepChart) -> str:
    """One chart of a sweep, as wide as its container."""
    chart = drawn.chart
    xs = np.concatenate([curve.x for curve in chart.curves]) if chart.curves else np.array([0.0, 1.0])
    low, high = float(xs.min()), float(xs.max())
    if low == high:
        low, high = low - 0.5, high + 0.5
    y = _height(drawn)
    ticks = decade_ticks(y.low, y.high, MAX_DECADES) if drawn.log else round_ticks(y.low, y.high, MAX_TICKS)
    texts = tick_texts(ticks, drawn.log)
    left = 9.0 + max(map(shapes.text_width_px, texts), default=0.0)
    x = Scale(low, high, left + 4.0, CURVE_WIDTH_PX - CURVE_RIGHT_PX)
    x_ticks = round_ticks(low, high, MAX_TICKS)
    parts = shapes.y_axis(y, left, x.high_px, ticks, texts)
    parts += shapes.x_axis(x, y.low_px, x_ticks, tick_texts(x_ticks), chart.x_label)
    parts.append(shapes.text(0.0, 11.0, chart.y_label))
    if any(curve.label == LIMIT for curve in chart.curves):
        parts.append(shapes.text(x.high_px, 11.0, "dashed: limit of success", "end"))
    parts += curve_parts(chart.curves, x, y, drawn.bands)
    return shapes.svg(CURVE_WIDTH_PX, CURVE_HEIGHT_PX, parts, f"{chart.title}: {chart.y_label} over {chart.x_label}")


def _height(drawn: SweepChart) -> Scale:
    foot = CURVE_HEIGHT_PX - FOOT_PX
    if not drawn.log:
        return Scale(0.0, 100.0, foot, TOP_PX)
    values = [curve.y for curve in drawn.chart.curves] + [side for band in drawn.bands.values() for side in band]
    known = np.concatenate([np.zeros(0), *values])
    known = known[np.isfinite(known) & (known > 0.0)]
    if not len(known):
        return Scale(0.1, 10.0, foot, TOP_PX, log=True)
    low, high = float(known.min()), float(known.max())
    # At least a decade, so that there is a tick on the axis.
    margin = max(1.2, (10.0 * low / high) ** 0.5)
    return Scale(low / margin, high * margin, foot, TOP_PX, log=True)


def table_html(over: str, labels: Sequence[str], points: Sequence[Point]) -> str:
    """A table with a row for each point, which can be scrolled if there are many."""
    colors, table = sweep_colors(labels), sweep_table(over, points)
    places = [table.columns.index(name) for name in IN_TABLE]
    name = "padding:.12em 0 .12em .6em;text-align:right"
    cell = f"{name};white-space:nowrap"
    name += f";vertical-align:bottom;{DIM}"
    head = "".join(f'<td style="{name}">{escape(table.columns[k])}</td>' for k in (1, *places))
    rows = "".join(
        f'<tr><td style="white-space:nowrap">{dot_html(colors[row[0]])}{escape(row[0])}</td>'
        + "".join(f'<td style="{cell}">{escape(row[k])}</td>' for k in (1, *places))
        + "</tr>"
        for row in table.rows
    )
    body = f'<table style="border-collapse:collapse;width:100%"><tr><td></td>{head}</tr>{rows}</table>'
    css = "font-size:12px;font-variant-numeric:tabular-nums"
    return box(f'<div tabindex="0" style="max-height:{TABLE_PX}px;overflow:auto">{body}</div>', css)
