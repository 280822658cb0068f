"""The pictures that a paper would show: success and time against the outlier rate, and time against N."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.cases import ADAPTIVE, PLAIN
from benchmarks.table import Row, Series, growth_slopes, series

GREY = "#9a9a9a"


@dataclass(frozen=True)
class Look:
    """How a method is drawn: ours in strong warm colours, peers in cool ones, the paper's baselines in grey."""

    colour: str
    marker: str
    line: str = "-"


LOOKS = {
    "mc-exact": Look("#d55e00", "o"),
    ADAPTIVE: Look("#e69f00", "s"),
    PLAIN: Look("#e69f00", "s", ":"),
    "mc": Look("#d55e00", "o", ":"),
    "PoseLib rig": Look("#0072b2", "^"),
    "PoseLib fisheye": Look("#0072b2", "v", "--"),
    "pycolmap rig": Look("#009e73", "D"),
    "pycolmap panorama": Look("#009e73", "d", "--"),
    "OpenCV USAC": Look("#cc79a7", "P", "--"),
}
"""Okabe and Ito's colours, told apart with any colour vision; markers and dashes tell the rest."""


def draw_all(rows: list[Row], folder: Path) -> list[Path]:
    """Draw what the rows allow, each as PNG and SVG; returns the files."""
    rates = series(rows, "outlier_rate", "correspondences", 100)
    sizes = series(rows, "correspondences", "outlier_rate", 0.9)
    written = []
    if any(len(points) > 1 for points in rates.values()):
        written += _save(
            _over_rate(rates, "Success, %", lambda found: 100 * found["success"], log=False), folder, "success"
        )
        written += _save(
            _over_rate(rates, "Median time, ms", lambda found: found["median_ms"], log=True), folder, "time"
        )
    if any(len(points) > 1 for points in sizes.values()):
        written += _save(_over_size(sizes, growth_slopes(rows)), folder, "growth")
    return written


def _over_rate(found: Series, title: str, value: Callable[[dict[str, Any]], float], log: bool) -> Figure:
    figure, axes = _blank(title + "  (N = 100, 1 px noise)")
    for name, points in found.items():
        _line(axes, name, [100 * rate for rate, _ in points], [value(summary) for _, summary in points])
    axes.set_xlabel("Outliers, %")
    axes.set_xticks(sorted({100 * rate for points in found.values() for rate, _ in points}))
    if log:
        _log_times(axes)
    else:
        axes.set_ylim(-3, 103)
    _name_lines(axes)
    return figure


def _over_size(found: Series, slopes: dict[str, tuple[float, float, float]]) -> Figure:
    figure, axes = _blank("Median time, ms  (90 % outliers, 1 px noise; with the slope of log time over log N)")
    for name, points in found.items():
        label = f"{name}  {slopes[name][0]:.1f}" if name in slopes else name
        if len(points) > 1:
            _line(axes, name, [size for size, _ in points], [summary["median_ms"] for _, summary in points], label)
    axes.set_xlabel("Correspondences N")
    axes.set_xscale("log")
    ticks = sorted({size for points in found.values() for size, _ in points})
    axes.set_xticks(ticks, [f"{tick:,.0f}" for tick in ticks], minor=False)
    axes.minorticks_off()
    _log_times(axes)
    _name_lines(axes)
    return figure


def _blank(title: str) -> tuple[Figure, Axes]:
    figure, axes = plt.subplots(figsize=(8.6, 4.8))
    figure.subplots_adjust(left=0.08, right=0.72, top=0.91, bottom=0.11)
    axes.set_title(title, loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e6e6e6", linewidth=0.8)
    axes.set_axisbelow(True)
    return figure, axes


def _line(axes: Axes, name: str, x: list[float], y: list[float], label: str = "") -> None:
    look = LOOKS.get(name, Look(GREY, ".", "-"))
    strong = look.colour in ("#d55e00", "#e69f00")
    axes.plot(
        x,
        y,
        look.line,
        color=look.colour,
        marker=look.marker,
        markersize=5,
        linewidth=2.0 if strong else 1.3,
        zorder=3 if strong else 2,
        label=label or name,
    )


def _log_times(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _name_lines(axes: Axes) -> None:
    """Write each name beside the end of its line, moved apart where ends meet, with a thin line to its end."""
    lines = [line for line in axes.get_lines() if len(np.atleast_1d(line.get_xdata()))]
    ends = [(float(np.asarray(line.get_xdata())[-1]), float(np.asarray(line.get_ydata())[-1])) for line in lines]
    places = axes.transAxes.inverted().transform(axes.transData.transform(ends))
    order = np.argsort(places[:, 1])
    heights = _apart(places[order, 1], 0.052)
    for index, height in zip(order, heights, strict=True):
        line = lines[index]
        axes.annotate(
            str(line.get_label()),
            xy=ends[index],
            xytext=(1.05, height),
            textcoords="axes fraction",
            color="#333333",
            fontsize=9,
            va="center",
            arrowprops={
                "arrowstyle": "-",
                "color": line.get_color(),
                "linewidth": 1.0,
                "relpos": (0, 0.5),
                "shrinkA": 1,
                "shrinkB": 4,
            },
        )


def _apart(heights: np.ndarray, gap: float) -> np.ndarray:
    """Ascending heights from 0 to 1, moved as little as is needed to be ``gap`` apart: neighbours around their mean."""
    pools: list[tuple[float, int]] = []  # (mean of height - rank * gap, members)
    for rank, height in enumerate(heights):
        mean, size = float(height - rank * gap), 1
        while pools and pools[-1][0] > mean:
            other, members = pools.pop()
            mean, size = (other * members + mean * size) / (members + size), members + size
        pools.append((mean, size))
    top = 1.0 - gap * (len(heights) - 1)
    base = np.concatenate([np.full(size, mean) for mean, size in pools]) if pools else np.empty(0)
    return np.clip(base, 0.0, max(top, 0.0)) + gap * np.arange(len(heights))


def _save(figure: Figure, folder: Path, name: str) -> list[Path]:
    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    figure.savefig(paths[0], dpi=160)
    figure.savefig(paths[1], metadata={"Date": None})
    plt.close(figure)
    return paths
