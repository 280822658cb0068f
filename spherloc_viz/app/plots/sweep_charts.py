"""A sweep as HTML for the page: charts that grow, and a table."""

from collections.abc import Sequence
from html import escape

import numpy as np

from spherloc.experiments.sweep_rows import Point
from spherloc_viz.app.plots import shapes
from spherloc_viz.app.plots.charts import curve_parts
from spherloc_viz.app.plots.shapes import Scale, decade_ticks, round_ticks, tick_texts
from spherloc_viz.app.text import DIM, box, dot_html
from spherloc_viz.layers.sweep import LIMIT, SweepChart, sweep_charts, sweep_colors, sweep_table

SHOWN = ("sweep success", "sweep rotation", "sweep position", "sweep time")
"""Charts on the page."""
WIDTH_PX, HEIGHT_PX, RIGHT_PX, TOP_PX, FOOT_PX = 380.0, 165.0, 12.0, 20.0, 33.0
MAX_DECADES, MAX_TICKS = 5, 6
TABLE_PX = 260
IN_TABLE = ("success", "position error", "time")
NOTE = (
    "Bands: the success's 95 % Wilson interval, and the quartiles of all runs' errors and times. A run without a pose "
    "has an infinite error. Times are of workers side by side, beside this page."
)


def charts_html(over: str, labels: Sequence[str], points: Sequence[Point]) -> str:
    """The charts and what their colours mean."""
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
    """One chart as wide as what it stands in."""
    chart = drawn.chart
    xs = np.concatenate([curve.x for curve in chart.curves]) if chart.curves else np.array([0.0, 1.0])
    low, high = float(xs.min()), float(xs.max())
    if low == high:
        low, high = low - 0.5, high + 0.5
    y = _height(drawn)
    ticks = decade_ticks(y.low, y.high, MAX_DECADES) if drawn.log else round_ticks(y.low, y.high, MAX_TICKS)
    texts = tick_texts(ticks, drawn.log)
    left = 9.0 + max(map(shapes.text_width_px, texts), default=0.0)
    x = Scale(low, high, left + 4.0, WIDTH_PX - RIGHT_PX)
    x_ticks = round_ticks(low, high, MAX_TICKS)
    parts = shapes.y_axis(y, left, x.high_px, ticks, texts)
    parts += shapes.x_axis(x, y.low_px, x_ticks, tick_texts(x_ticks), chart.x_label)
    parts.append(shapes.text(0.0, 11.0, chart.y_label))
    if any(curve.label == LIMIT for curve in chart.curves):
        parts.append(shapes.text(x.high_px, 11.0, "dashed: limit of success", "end"))
    parts += curve_parts(chart.curves, x, y, drawn.bands)
    return shapes.svg(WIDTH_PX, HEIGHT_PX, parts, f"{chart.title}: {chart.y_label} over {chart.x_label}")


def _height(drawn: SweepChart) -> Scale:
    foot = HEIGHT_PX - FOOT_PX
    if not drawn.log:
        return Scale(0.0, 100.0, foot, TOP_PX)
    values = [curve.y for curve in drawn.chart.curves] + [side for band in drawn.bands.values() for side in band]
    known = np.concatenate([np.zeros(0), *values])
    known = known[np.isfinite(known) & (known > 0.0)]
    if not len(known):
        return Scale(0.1, 10.0, foot, TOP_PX, log=True)
    low, high = float(known.min()), float(known.max())
    # A decade at least, so that there is a tick on the axis.
    margin = max(1.2, (10.0 * low / high) ** 0.5)
    return Scale(low / margin, high * margin, foot, TOP_PX, log=True)


def table_html(over: str, labels: Sequence[str], points: Sequence[Point]) -> str:
    """A row a point, with a bar to scroll if there are many."""
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
    return box(f'<div style="max-height:{TABLE_PX}px;overflow:auto">{body}</div>', css)
