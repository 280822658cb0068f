"""Charts of sweeps as PNG."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from spherloc.experiments.sweep_plan import AXES
from spherloc.experiments.sweep_rows import Point
from spherloc_viz.layers.sweep import SweepChart, sweep_charts
from spherloc_viz.plots.saving import png_of
from spherloc_viz.style import RGB, css

SIZE_INCHES, SWEEP_DPI = (10.7, 7.6), 120
"""Size and resolution of a sweep's picture: 1284 pixels wide."""
CURVE_MARKERS = "os^Dv<>Phd"
LIGHTEST = 165.0
"""Largest luminance of a colour on white paper; lighter ones, made for the dark page too, are darkened to it."""


def sweep_png(name: str, over: str, labels: Sequence[str], points: Sequence[Point]) -> bytes:
    """PNG of success, errors and time over the values of a sweep; ``name`` is that of the scene.

    The same points give the same bytes.
    """
    figure = Figure(figsize=SIZE_INCHES, dpi=SWEEP_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    charts = sweep_charts(over, labels, points)
    for axes, chart in zip(figure.subplots(2, 2, sharex=True).flat, charts, strict=True):
        _draw(axes, chart, labels)
    handles, names = _legend(figure)
    if names:
        figure.legend(handles, names, loc="outside lower center", ncols=min(4, len(names)), fontsize=10, frameon=False)
    runs = sorted({point.runs for point in points})
    count = "no runs" if not runs else f"{runs[0]}" + (f" to {runs[-1]}" if runs[1:] else "") + " runs a point"
    figure.suptitle(f"{name}: {AXES[over]}, {count}", parse_math=False, fontsize=12)
    return png_of(figure)


def _legend(figure: Figure) -> tuple[list, list[str]]:
    """Handles and names of all curves of a figure, each name once."""
    found = {}
    for axes in figure.axes:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    return list(found.values()), list(found)


def _draw(axes: Axes, drawn: SweepChart, labels: Sequence[str]) -> None:
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_title(f"{drawn.chart.title}{TITLES.get(drawn.chart.name, QUARTILES)}", fontsize=10.5)
    axes.set_xlabel(drawn.chart.x_label)
    axes.set_ylabel(drawn.chart.y_label)
    for curve in drawn.chart.curves:
        if curve.kind == "level":
            axes.axhline(curve.y[0], color=css(curve.color), linewidth=1.2, linestyle=(0, (4, 3)), label=curve.label)
            continue
        marker = CURVE_MARKERS[labels.index(curve.label) % len(CURVE_MARKERS)]
        color = css(_on_paper(curve.color))
        axes.fill_between(curve.x, *drawn.bands[curve.label], color=color, alpha=0.16, linewidth=0)
        axes.plot(
            curve.x, curve.y, color=color, linewidth=1.8, marker=marker, markersize=5,
            markeredgecolor="0.25", markeredgewidth=0.5, label=curve.label,
        )  # fmt: skip
    if any(np.isnan(curve.y).any() for curve in drawn.chart.curves):
        words = "gaps: half of the runs have no pose"
        paper = {"facecolor": "white", "alpha": 0.8, "linewidth": 0}
        axes.text(0.985, 0.03, words, transform=axes.transAxes, ha="right", fontsize=9, bbox=paper)
    if drawn.log:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(-3.0, 103.0)


def _on_paper(color: RGB) -> RGB:
    luminance = 0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]
    share = min(1.0, LIGHTEST / max(1.0, luminance))
    red, green, blue = (round(share * part) for part in color)
    return red, green, blue


QUARTILES = ": median and quartiles of all runs"
TITLES = {"sweep success": ": within 1 deg and 0.1 m, with 95 % Wilson intervals"}
