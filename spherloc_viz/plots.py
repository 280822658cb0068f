"""Charts of sweeps and trajectories of sequences as PNG."""

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from spherloc.experiments.results import DOUBTFUL, FAILED, SequenceResults
from spherloc.experiments.summary import timed
from spherloc.experiments.sweep_plan import AXES
from spherloc.experiments.sweep_rows import Point
from spherloc.geometry import align_to_down
from spherloc.types import BoolArray, FloatArray
from spherloc_viz.layers.sweep import SweepChart, sweep_charts
from spherloc_viz.style import ERROR_RAMP, ESTIMATE, OUTLIER, RGB, TRUTH, css, error_scale

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
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


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


WIDTH_INCHES = 9.0
HEIGHT_INCHES = (4.0, 9.0)
DPI = 150
MARGIN = 0.08
MIN_EXTENT_M = 1.0
"""Least extent of the picture, so that a camera that stands still is not magnified to its noise."""


MAX_POSES_NAMED = 12
"""Largest number of poses whose queries are named where no error is known."""
FEWEST_FRAMED = 3
"""Number of believed poses from which on the picture is framed by them, and not by doubtful ones too."""


def trajectory_png(results: SequenceResults) -> bytes:
    """PNG of the estimated positions coloured by their error, the true path as a line, and failures as crosses.

    Errors beyond the loosest limit of success have one colour. Where the truth is unknown, errors are those of the
    registration, if there are any; without any, doubtful poses are circles, and few queries are named. The same results
    give the same bytes.
    """
    places = _from_above(results, results.positions_m)
    true_places = _from_above(results, results.true_positions_m)
    believed = np.where(_are_doubtful(results)[:, None], np.nan, places)
    framed = believed if np.isfinite(believed).all(axis=1).sum() >= FEWEST_FRAMED else places
    # About as high as the picture of the map, so that the bar of colours beside it is not longer.
    figure, axes = _from_above_figure(results, _frame(framed, true_places), 0.75, 1.1)
    _truth(axes, true_places, timed(results))
    _estimates(figure, axes, results, places, true_places)
    _without_place(axes, results, places, true_places)
    axes.set_title(_title(results), parse_math=False, fontsize=11)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="best", fontsize=9)
    return _png(figure)


def _from_above_figure(
    results: SequenceResults, frame: tuple[FloatArray, FloatArray], share: float, more_inches: float
) -> tuple[Figure, Axes]:
    """An empty picture of the map from above. ``frame`` has its middle and half extent; the height follows from it and
    from the ``share`` of the width that the map takes, plus ``more_inches``."""
    middle, half = frame
    height = float(np.clip(share * WIDTH_INCHES * half[1] / half[0] + more_inches, *HEIGHT_INCHES))
    figure = Figure(figsize=(WIDTH_INCHES, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(aspect="equal", axisbelow=True)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.set_xlabel(f"{_unit(results)}, in the map")
    axes.set_ylabel(f"{_unit(results)}, in the map")
    return figure, axes


def _unit(results: SequenceResults) -> str:
    return "metres" if results.configuration.metric else "units (scale unknown)"


def _png(figure: Figure) -> bytes:
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names in scripts that the font lacks
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


SEVERAL_COLORS = ("#1b6ca8", "#c77d0a", "#7b2d8b", "#3a8a3a", "#b02a30", "#5fb3e6", "#8c6d31", "#555555")
LARGEST_MARKER = 10.0
MAX_NAMED = 6
"""Largest number of failures of an estimator whose names are written into the picture."""


def trajectories_png(several: Sequence[tuple[str, SequenceResults]]) -> bytes:
    """PNG of one sequence as several estimators localized it: positions and headings by colour, and the true path.

    ``several`` are labels with results of the same scene. A query whose pose is outside the picture or missing is a
    cross at its true position, named if there are few; a wrong position is joined to the true one. Positions are joined
    only where the queries follow each other in time. The same results give the same bytes.
    """
    first = several[0][1]
    true_places = _from_above(first, first.true_positions_m)
    places = [_from_above(results, results.positions_m) for _, results in several]
    below = 0.25 * ((len(several) + 2) // 2)
    figure, axes = _from_above_figure(first, _frame(np.concatenate(places), true_places), 0.9, 1.3 + below)
    _truth(axes, true_places, timed(first))
    for number, ((label, results), seen) in enumerate(zip(several, places, strict=True)):
        style = _Style(
            SEVERAL_COLORS[number % len(SEVERAL_COLORS)],
            CURVE_MARKERS[number % len(CURVE_MARKERS)],
            LARGEST_MARKER - (LARGEST_MARKER - 3.0) * number / max(1, len(several) - 1),
        )
        _one_of_several(axes, label, results, seen, style)
    axes.set_title(first.configuration.name, parse_math=False, fontsize=11)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return _png(figure)


@dataclass(frozen=True)
class _Style:
    """How an estimator's positions are drawn: sizes differ, so that several at one place can all be seen."""

    color: str
    marker: str
    size: float
    """Size of its markers, points."""


def _one_of_several(axes: Axes, label: str, results: SequenceResults, seen: FloatArray, style: _Style) -> None:
    """Draw one estimator's positions ``seen`` from above (Q, 2), its headings and failures."""
    true_places = _from_above(results, results.true_positions_m)
    errors_m, _, limit_m = _errors(results)
    inside = np.isfinite(seen).all(axis=1) & _inside(axes, seen)
    with_truth = np.isfinite(true_places).all(axis=1)
    limit = f"{limit_m:g} {results.configuration.unit}"
    words = f"{label}: {np.count_nonzero(errors_m <= limit_m)} of {len(seen)} within {limit}"
    line, color = "-" if timed(results) else "none", style.color
    axes.plot(
        *seen[inside].T, color=color, linestyle=line, linewidth=0.9, marker=style.marker, markersize=style.size,
        fillstyle="none", label=words,
    )  # fmt: skip
    ahead = _headings(results)[inside]
    axes.quiver(
        *seen[inside].T,
        *ahead.T,
        color=color,
        scale=38.0,
        width=0.002,
        headwidth=1.0,
        headlength=0.0,
        headaxislength=0.0,
    )
    wrong = inside & with_truth & (errors_m > limit_m)
    for start, end in zip(true_places[wrong], seen[wrong], strict=True):
        axes.plot(*np.stack([start, end]).T, color=color, linewidth=0.7, linestyle=(0, (4, 3)))
    lost = ~inside & with_truth
    if lost.any():
        axes.plot(*true_places[lost].T, "x", color=color, markersize=8.0, markeredgewidth=1.4)
    if 0 < np.count_nonzero(lost) <= MAX_NAMED:
        for place in np.flatnonzero(lost):
            name = results.rows[place].query
            axes.annotate(name, true_places[place], xytext=(5, 4), textcoords="offset points", fontsize=7, color=color)


def _headings(results: SequenceResults) -> FloatArray:
    """Directions (Q, 2) of the optical axes, seen from above; zero without a pose."""
    ahead = np.zeros((len(results.rows), 3))
    for place, row in enumerate(results.rows):
        if row.cam_from_map is not None:
            ahead[place] = row.cam_from_map[2, :3]
    return _from_above(results, ahead)


def _from_above(results: SequenceResults, positions_m: FloatArray) -> FloatArray:
    """Positions (Q, 2) on the page, right and up: seen from above, in the direction of gravity, not mirrored."""
    turned = positions_m @ align_to_down(results.configuration.gravity_map).T
    return turned[:, [0, 2]]


def _frame(places: FloatArray, true_places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middle (2,) and half the extent (2,) of the picture, metres.

    They are those of the true path if it is known: one wrong pose far away must not shrink all others to a dot.
    """
    known = true_places[np.isfinite(true_places).all(axis=1)]
    shown = known if len(known) else places[np.isfinite(places).all(axis=1)]
    if not len(shown):
        return np.zeros(2), np.full(2, 0.5 * MIN_EXTENT_M)
    low, high = shown.min(axis=0), shown.max(axis=0)
    half = 0.5 * np.maximum(high - low, MIN_EXTENT_M)
    return 0.5 * (low + high), np.maximum(half, 0.3 * half.max()) + 2.0 * MARGIN * half.max()


def _truth(axes: Axes, true_places: FloatArray, ordered: bool) -> None:
    """Draw the true positions, joined where they follow each other in time."""
    if np.isfinite(true_places).any():
        line, size = ("-", 3.0) if ordered else ("none", 6.0)
        axes.plot(
            *true_places.T, color=css(TRUTH), linestyle=line, linewidth=1.4, marker=".", markersize=size, label="truth",
            zorder=2,
        )  # fmt: skip


def _estimates(
    figure: Figure, axes: Axes, results: SequenceResults, places: FloatArray, true_places: FloatArray
) -> None:
    errors_m, what, limit_m = _errors(results)
    plain = np.isfinite(places).all(axis=1) & np.isnan(errors_m)
    doubtful = plain & _are_doubtful(results)
    looks = ((plain & ~doubtful, ESTIMATE, "full", "localized"), (doubtful, OUTLIER, "none", "doubtful"))
    for mask, color, fill, what in looks:
        if mask.any():
            label = f"{what}, error unknown: {np.count_nonzero(mask)}"
            axes.plot(*places[mask].T, "o", color=css(color), fillstyle=fill, markersize=5, label=label, zorder=3)
    if 0 < np.count_nonzero(plain) <= MAX_POSES_NAMED:
        for k in np.flatnonzero(plain & _inside(axes, places)):
            x, y = places[k]
            axes.text(x, y, f"  {results.rows[k].query}", fontsize=8, va="center", parse_math=False, clip_on=True)
    coloured = np.isfinite(places).all(axis=1) & ~np.isnan(errors_m)
    if not coloured.any():
        return
    good, bad = coloured & (errors_m <= limit_m), coloured & ~(errors_m <= limit_m)
    ramp = LinearSegmentedColormap.from_list("errors", [css(color) for color in ERROR_RAMP])
    dots = axes.scatter(
        *places[good].T, c=errors_m[good], vmin=0.0, vmax=error_scale(errors_m[coloured], limit_m), s=30,
        cmap=ramp, edgecolors="0.2", linewidths=0.4, label="estimate" if good.any() else None, zorder=3,
    )  # fmt: skip
    figure.colorbar(dots, ax=axes, shrink=0.85).set_label(f"{what}, {_unit(results)}")
    if bad.any():
        unit = results.configuration.unit
        label = f"{np.count_nonzero(bad)} beyond {limit_m:g} {unit}, up to {errors_m[bad].max():.3g} {unit}"
        axes.plot(*places[bad].T, "o", color=css(OUTLIER), markersize=5.5, label=label, zorder=3)
        for start, end in zip(true_places[bad], places[bad], strict=True):
            axes.plot(*np.stack([start, end]).T, color=css(OUTLIER), linewidth=0.8, zorder=1)


def _are_doubtful(results: SequenceResults) -> BoolArray:
    """(Q,) whether a query's pose is not believed."""
    return np.array([status == DOUBTFUL for status in results.status], dtype=bool)


def _errors(results: SequenceResults) -> tuple[FloatArray, str, float]:
    """(Q,) errors in metres, what they are, and the loosest limit of success."""
    setting = results.configuration
    limits_m = setting.registration_thresholds_m
    if limits_m and not np.isfinite(results.translation_errors_m).any():
        return results.registration_errors_m, "registration error", max(limits_m)
    return results.translation_errors_m, "position error", max(metres for _, metres in setting.thresholds)


def _without_place(axes: Axes, results: SequenceResults, places: FloatArray, true_places: FloatArray) -> None:
    """Mark the true positions of queries without a pose, or with one outside the picture; others are only counted."""
    failed = np.array([status == FAILED for status in results.status], dtype=bool)
    outside = np.isfinite(places).all(axis=1) & ~_inside(axes, places)
    known = np.isfinite(true_places).all(axis=1)
    marks = ((failed, "x", "without a pose"), (outside, "s", "with a pose outside the picture"))
    for mask, marker, what in marks:
        style = {"markersize": 7, "markeredgewidth": 1.8, "fillstyle": "none", "color": css(OUTLIER), "zorder": 4}
        if (mask & known).any():
            label = f"{what}: {np.count_nonzero(mask & known)}"
            axes.plot(*true_places[mask & known].T, marker, label=label, **style)
        if (mask & ~known).any():
            axes.plot([], [], " ", label=f"{what}, place unknown: {np.count_nonzero(mask & ~known)}")


def _inside(axes: Axes, places: FloatArray) -> BoolArray:
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    return (places[:, 0] >= left) & (places[:, 0] <= right) & (places[:, 1] >= bottom) & (places[:, 1] <= top)


def _title(results: SequenceResults) -> str:
    setting = results.configuration
    return f"{setting.name}: {setting.estimator}, seed {setting.seed}, {len(results.rows)} of {setting.queries} queries"
