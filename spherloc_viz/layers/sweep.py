"""The charts of a sweep (as Figs. 5 to 7): success, errors and time, with a curve and a band for each estimator."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spherloc.experiments.sweep_plan import AXES
from spherloc.experiments.sweep_rows import Point, Quartiles
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.comparison import PALETTE, color_of
from spherloc_viz.layers.primitives import Chart, Curve, Table

NO_VALUE = "–"
LIMIT = "limit of success"


@dataclass(frozen=True, eq=False)
class SweepChart:
    """A chart with bands."""

    chart: Chart
    """The chart: a curve for each estimator that has a run, and in some charts the limit of success as a level."""
    bands: Mapping[str, tuple[FloatArray, FloatArray]]
    """Lower and upper ends (K,) of the band around a curve, by the curve's label."""
    log: bool
    """Whether the y axis is logarithmic."""


def sweep_colors(labels: Sequence[str]) -> dict[str, style.RGB]:
    """A colour for each label: that of its estimator for the first label of an estimator, another one for the next."""
    taken: dict[str, style.RGB] = {}
    for label in labels:
        color = color_of(label.split()[0])
        if color not in taken.values():
            taken[label] = color
    free = [color for color in PALETTE if color not in taken.values()]
    rest = [label for label in labels if label not in taken]
    taken |= {label: (free or PALETTE)[place % len(free or PALETTE)] for place, label in enumerate(rest)}
    return {label: taken[label] for label in labels}


def sweep_charts(over: str, labels: Sequence[str], points: Sequence[Point]) -> tuple[SweepChart, ...]:
    """Success with its 95 % interval; errors of all runs and time with their quartiles."""
    return (
        _chart(over, labels, points, "success", "Success", "success (%)", _success, log=False),
        _chart(
            over, labels, points, "position", "Position error", "position error (m)",
            lambda point: _three(point.translation_error_m), limit=SUCCESS_M,
        ),
        _chart(
            over, labels, points, "rotation", "Rotation error", "rotation error (deg)",
            lambda point: _three(point.rotation_error_deg), limit=SUCCESS_DEG,
        ),
        _chart(over, labels, points, "time", "Time", "time (ms)", lambda point: _three(point.time_ms)),
    )  # fmt: skip


Three = tuple[float, float, float]
"""Lower end, middle and upper end."""


def _chart(
    over: str,
    labels: Sequence[str],
    points: Sequence[Point],
    name: str,
    title: str,
    y_label: str,
    three: Callable[[Point], Three],
    *,
    limit: float | None = None,
    log: bool = True,
) -> SweepChart:
    colors = sweep_colors(labels)
    table = {label: np.array([(p.value, *three(p)) for p in points if p.estimator == label]) for label in labels}
    table = {label: rows for label, rows in table.items() if len(rows)}
    drawable = [rows[:, 1:][np.isfinite(rows[:, 1:]) & (rows[:, 1:] > 0.0)] for rows in table.values()]
    known = np.concatenate([np.zeros(0), *drawable])
    least, most = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    curves: list[Curve] = []
    bands: dict[str, tuple[FloatArray, FloatArray]] = {}
    for label, rows in table.items():
        value, low, middle, high = rows.T
        # A run without a pose has an infinite error, which cannot be drawn: bands end at the largest known error, and
        # curves are interrupted. The logarithm of zero cannot be drawn either.
        bands[label] = np.clip(low, least if log else 0.0, most), np.clip(high, least if log else 0.0, most)
        middle = np.where(np.isfinite(middle), np.maximum(middle, least) if log else middle, np.nan)
        curves.append(Curve(label, value, middle, colors[label]))
    if limit is not None and curves:
        ends = np.array([min(c.x[0] for c in curves), max(c.x[-1] for c in curves)])
        curves.append(Curve(LIMIT, ends, np.full(2, limit), style.UNDECIDED, "level"))
    return SweepChart(Chart(f"sweep {name}", title, AXES[over], y_label, tuple(curves)), bands, log)


def _success(point: Point) -> Three:
    return 100.0 * point.low, 100.0 * point.rate, 100.0 * point.high


def _three(found: Quartiles) -> Three:
    return found.lower, found.median, found.upper


def sweep_table(over: str, points: Sequence[Point]) -> Table:
    """A table with a row for each point."""
    columns = (
        "estimator", AXES[over], "success", "95 %", "position error", "rotation error", "time", "precision", "recall",
    )  # fmt: skip
    return Table("sweep", columns, tuple(_row(point) for point in points))


def _row(point: Point) -> tuple[str, ...]:
    return (
        point.estimator,
        f"{point.value:g}",
        f"{point.successes} of {point.runs}",
        f"{100 * point.low:.0f} to {100 * point.high:.0f} %",
        _number(100.0 * point.translation_error_m.median, "cm"),
        _number(point.rotation_error_deg.median, "deg"),
        _number(point.time_ms.median, "ms"),
        NO_VALUE if point.mean_precision is None else f"{point.mean_precision:.3f}",
        NO_VALUE if point.mean_recall is None else f"{point.mean_recall:.3f}",
    )


def _number(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}" if math.isfinite(value) else "no pose"
