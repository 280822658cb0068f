"""Draws charts as plots beside the canvas."""

from typing import Any

import numpy as np
import viser
from viser import uplot

from spherloc_viz import style
from spherloc_viz.layers.primitives import Chart, Curve, FloatArray

HEIGHT_PX = 190
MOST_STEPS = 360
DEGREES = (-180.0, -90.0, 0.0, 90.0, 180.0)


class ChartPanel:
    """The charts of a picture, one under the other."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._folder = gui.add_folder(None)
        self._plots: dict[str, tuple[Any, tuple]] = {}

    def draw(self, charts: tuple[Chart, ...]) -> None:
        """Show these charts and no others."""
        for name in set(self._plots) - {chart.name for chart in charts}:
            self._plots.pop(name)[0].remove()
        for order, chart in enumerate(charts):
            self._put(chart, float(order))

    def _put(self, chart: Chart, order: float) -> None:
        data, look = aligned_data(chart), _look(chart)
        plot, known = self._plots.get(chart.name, (None, None))
        if plot is not None and known == look:
            plot.data = data
            plot.scales = _scales(chart)
            return
        if plot is not None:
            plot.remove()
        with self._folder:
            plot = self._gui.add_uplot(
                data,
                _series(chart),
                title=chart.title,
                scales=_scales(chart),
                axes=_axes(chart),
                legend=uplot.Legend(show=len(chart.curves) > 1, live=False),
                cursor=uplot.Cursor(show=True, x=True, y=False),
                height=HEIGHT_PX,
                padding=(4, 16, 0, 0),
                order=order,
            )
        self._plots[chart.name] = (plot, look)


def aligned_data(chart: Chart) -> tuple[np.ndarray, ...]:
    """One x for all curves and a y for each.

    uPlot wants a common x. Lines are interpolated there and steps held, so that a marker does not tear them;
    a marker is NaN but for the two ends of its line.
    """
    parts = [_outline(curve) for curve in chart.curves]
    xs = np.concatenate([x for x, _ in parts])
    order = np.argsort(xs, kind="stable")
    owner = np.repeat(np.arange(len(parts)), [len(x) for x, _ in parts])[order]
    columns = []
    for k, (curve, (x, y)) in enumerate(zip(chart.curves, parts, strict=True)):
        if curve.kind == "marker":
            column = np.full(len(xs), np.nan)
        else:
            column = np.interp(xs[order], x, y, left=np.nan, right=np.nan)
        column[owner == k] = y
        columns.append(column)
    return (xs[order], *columns)


def _outline(curve: Curve) -> tuple[FloatArray, FloatArray]:
    """The corners of the line that shows a curve."""
    x, y = np.asarray(curve.x, dtype=np.float64), np.asarray(curve.y, dtype=np.float64)
    if curve.kind == "marker":
        return np.repeat(x[:1], 2), np.array([0.0, y[0]])
    if curve.kind == "step":
        x, y = _binned(x, y)
        return np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
    return x, y


def _binned(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """At most ``MOST_STEPS`` steps, each the highest of those that it stands for.

    Beyond four corners a pixel uPlot draws columns of extremes, in which a NaN beside a marker wipes it out.
    """
    stride = -(-len(x) // MOST_STEPS)
    starts = np.arange(0, len(x), max(1, stride))
    return x[starts], np.maximum.reduceat(y, starts) if len(y) else y


def _look(chart: Chart) -> tuple:
    return (
        chart.title,
        _digits(chart),
        *((curve.label, curve.color, curve.kind) for curve in chart.curves),
    )


def _series(chart: Chart) -> tuple[uplot.Series, ...]:
    """The first marker broad, those after it thin and dashed, so that both show where they coincide."""
    lines, marked = [uplot.Series(label=chart.x_label)], False
    for curve in chart.curves:
        color = style.css(curve.color)
        line = uplot.Series(label=curve.label, stroke=color, points={"show": False})
        line["width"] = 4.0 if curve.kind == "marker" else 1.5
        if curve.kind == "marker" and marked:
            line["width"], line["dash"] = 2.0, (5, 5)
        elif curve.kind == "level":
            line["dash"] = (3, 3)
        elif curve.kind == "step":
            line["fill"] = f"{color}40"
        marked = marked or curve.kind == "marker"
        lines.append(line)
    return tuple(lines)


def _scales(chart: Chart) -> dict[str, uplot.Scale]:
    top = _top(chart)
    return {"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, 1.06 * top if top > 0 else 1.0))}


def _axes(chart: Chart) -> tuple[uplot.Axis, ...]:
    x = uplot.Axis(label=chart.x_label, labelSize=18, size=28, labelGap=0)
    if "°" in chart.x_label:
        x["splits"] = DEGREES
    # Room for the tick labels, which uPlot would cut off: a digit is about 7 px wide.
    return x, uplot.Axis(label=chart.y_label, labelSize=18, size=22 + 7 * _digits(chart), labelGap=0)


def _digits(chart: Chart) -> int:
    """Characters that the tick labels take; at least so many that few runs need another plot than the one before."""
    return max(3, len(f"{_top(chart):,.0f}"))


def _top(chart: Chart) -> float:
    return max((float(np.max(curve.y)) for curve in chart.curves if len(curve.y)), default=1.0)
