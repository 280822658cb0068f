"""The row of a run of a sweep, its text in CSV, and the summary of the runs at each point."""

import csv
import io
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from spherloc.errors import InputError, show
from spherloc.experiments.summary import wilson
from spherloc.metrics import evaluate
from spherloc.trace import Trace


@dataclass(frozen=True, slots=True)
class SweepRow:
    """The result of one estimator on one problem; unknown values are None."""

    estimator: str
    """Label of the estimator and its options."""
    value: float
    """Value of the varied property."""
    seed: int
    """Seed of the simulation and of the estimator."""
    success: bool
    """Rotation error below 1 degree and position error below 0.1 m (Sec. VI-A)."""
    rotation_error_deg: float | None
    """Angle between true and estimated rotation, degrees; None without a pose."""
    translation_error_m: float | None
    """Distance between true and estimated camera position, metres; None without a pose."""
    t_error_m: float | None
    """|t_true - t| of the poses, metres: the paper's error (Sec. VI-A); None without a pose."""
    time_ms: float
    """Wall time of the estimator."""
    inliers: int
    """Number of correspondences that agree with its pose."""
    correspondences: int
    """Number of correspondences of the problem."""
    precision: float | None
    """Share of the inliers that are right."""
    recall: float | None
    """Share of the right correspondences that are inliers."""
    f1: float | None
    """Harmonic mean of both."""
    upper_bound: int | None
    """Certificate: no pose explains more correspondences. None if the estimator proves nothing, as the next two."""
    lower_bound: int | None
    """Certificate: some pose explains as many."""
    nfa: float | None
    """Certificate: expected number of false sets of that size."""


def row_of(trace: Trace, label: str, value: float) -> SweepRow:
    """The row of a run whose truth is known."""
    metrics, certificate = evaluate(trace), trace.certificate
    return SweepRow(
        estimator=label,
        value=value,
        seed=trace.seed,
        success=bool(metrics.success),
        rotation_error_deg=metrics.rotation_error_deg,
        translation_error_m=metrics.translation_error_m,
        t_error_m=metrics.t_error_m,
        time_ms=float(trace.timings_ms["total"]),
        inliers=int(np.count_nonzero(trace.inlier_mask)),
        correspondences=len(trace.problem),
        precision=metrics.precision,
        recall=metrics.recall,
        f1=metrics.f1,
        upper_bound=None if certificate is None else int(certificate.upper_bound),
        lower_bound=None if certificate is None else int(certificate.lower_bound),
        nfa=None if certificate is None else float(certificate.nfa),
    )


def lost_row(label: str, value: float, seed: int, time_ms: float, correspondences: int) -> SweepRow:
    """The row of a run that ended without a trace."""
    return SweepRow(
        label, value, seed, False, None, None, None, time_ms, 0, correspondences, 0.0, 0.0, 0.0, None, None, None
    )


def _truth(text: str) -> bool:
    return {"true": True, "false": False}[text]


def _real(text: str) -> float:
    if math.isnan(value := float(text)):
        raise ValueError(text)
    return value


_PARSERS: dict[str, Callable[[str], Any]] = {
    "estimator": str,
    "value": _real,
    "seed": int,
    "success": _truth,
    "time_ms": _real,
    "inliers": int,
    "correspondences": int,
    "upper_bound": int,
    "lower_bound": int,
}
_NEEDED = {"estimator", "value", "seed", "success", "time_ms", "inliers", "correspondences"}
_NAMES = tuple(item.name for item in fields(SweepRow))


def columns(over: str) -> tuple[str, ...]:
    """Columns of the CSV; the column of the value has the name of the varied property."""
    return tuple(over if name == "value" else name for name in _NAMES)


def csv_line(cells: Iterable[Any]) -> str:
    """One line of CSV with its line end; None is empty, numbers keep all their digits."""
    file = io.StringIO(newline="")
    csv.writer(file, lineterminator="\n").writerow([_cell(value) for value in cells])
    return file.getvalue()


def row_line(row: SweepRow) -> str:
    """The row as a line of CSV."""
    return csv_line(getattr(row, name) for name in _NAMES)


def row_of_line(line: str, place: str) -> SweepRow:
    """The row of a line that ``row_line`` wrote; ``place`` names the file and the line number.

    Raises ``InputError`` for any other line.
    """
    try:
        cells: Sequence[str] = next(csv.reader([line]), [])
    except csv.Error:
        cells = []
    if len(cells) != len(_NAMES):
        raise _damaged(place, f"has {len(cells)} cells, not {len(_NAMES)}")
    values: dict[str, Any] = {}
    for name, cell in zip(_NAMES, cells, strict=True):
        try:
            values[name] = None if cell == "" and name not in _NEEDED else _PARSERS.get(name, _real)(cell)
        except (ValueError, KeyError):
            raise _damaged(place, f"has {show(cell)} for {name}") from None
    return SweepRow(**values)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else repr(value)


def _damaged(place: str, what: str) -> InputError:
    return InputError(f"{place}: {what}, so it is not a run of a sweep; delete that line to have the run done again.")


@dataclass(frozen=True)
class Quartiles:
    """Quartiles of a number of some runs. A run without a pose has an infinite error."""

    lower: float
    """A quarter of the runs is below."""
    median: float
    """Half of them are below."""
    upper: float
    """Three quarters of them are below."""


@dataclass(frozen=True)
class Point:
    """One estimator at one value."""

    estimator: str
    """Label of the estimator and its options."""
    value: float
    """Value of the varied property."""
    runs: int
    """Number of runs so far."""
    successes: int
    """Number of runs with errors below 1 degree and 0.1 m."""
    rate: float
    """Ratio of both, 0 to 1."""
    low: float
    """Lower end of the 95 % Wilson interval of the rate."""
    high: float
    """Its upper end."""
    rotation_error_deg: Quartiles
    """Rotation errors of all runs, degrees."""
    translation_error_m: Quartiles
    """Position errors of all runs, metres."""
    success_rotation_error_deg: Quartiles | None
    """Rotation errors of the successes, degrees; None if there are none."""
    success_translation_error_m: Quartiles | None
    """Position errors of the successes, metres; None if there are none."""
    time_ms: Quartiles
    """Times of all runs."""
    mean_precision: float | None
    """Mean precision of the inliers; None if it is unknown, as the next two."""
    mean_recall: float | None
    """Mean recall of the inliers."""
    mean_f1: float | None
    """Mean F1 of the inliers."""
    proven: int | None
    """Number of runs whose consensus is proven to be the largest; None if the estimator proves nothing."""


def summarize(labels: Sequence[str], rows: Iterable[SweepRow]) -> tuple[Point, ...]:
    """The points that have a run, by estimator in the order of ``labels`` and then by value."""
    found: defaultdict[tuple[str, float], list[SweepRow]] = defaultdict(list)
    for row in rows:
        found[row.estimator, row.value].append(row)
    place = {label: number for number, label in enumerate(labels)}
    return tuple(point_of(found[key]) for key in sorted(found, key=lambda key: (place[key[0]], key[1])))


def point_of(rows: Sequence[SweepRow]) -> Point:
    """The point of one or more rows that share estimator and value."""
    good = [row for row in rows if row.success]
    low, high = wilson(len(good), len(rows))
    certified = [row for row in rows if row.upper_bound is not None]
    return Point(
        estimator=rows[0].estimator,
        value=rows[0].value,
        runs=len(rows),
        successes=len(good),
        rate=len(good) / len(rows),
        low=low,
        high=high,
        rotation_error_deg=_quartiles(row.rotation_error_deg for row in rows),
        translation_error_m=_quartiles(row.translation_error_m for row in rows),
        success_rotation_error_deg=_quartiles(row.rotation_error_deg for row in good) if good else None,
        success_translation_error_m=_quartiles(row.translation_error_m for row in good) if good else None,
        time_ms=_quartiles(row.time_ms for row in rows),
        mean_precision=_mean(row.precision for row in rows),
        mean_recall=_mean(row.recall for row in rows),
        mean_f1=_mean(row.f1 for row in rows),
        proven=sum(row.upper_bound == row.lower_bound for row in certified) if certified else None,
    )


def _quartiles(values: Iterable[float | None]) -> Quartiles:
    known = np.array([math.inf if value is None else value for value in values])
    # Not the mean of two runs, since the mean of a finite and an infinite error makes no sense.
    lower, median, upper = np.quantile(known, [0.25, 0.5, 0.75], method="inverted_cdf")
    return Quartiles(float(lower), float(median), float(upper))


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def rows_text(over: str, labels: Sequence[str], rows: Iterable[SweepRow]) -> str:
    """The rows as CSV, ordered by seed, value and estimator, whatever their order of completion was."""
    place = {label: number for number, label in enumerate(labels)}
    ordered = sorted(rows, key=lambda row: (row.seed, row.value, place[row.estimator]))
    return "".join([csv_line(columns(over)), *map(row_line, ordered)])


def summary_text(over: str, points: Iterable[Point]) -> str:
    """The points as CSV, a line each."""
    names = [item.name for item in fields(Point)]
    quartiles = {name for name in names if "error" in name or name == "time_ms"}
    heading: list[str] = []
    for name in names:
        heading += [f"{part}_{name}" for part in ("lower", "median", "upper")] if name in quartiles else [name]
    lines = [csv_line(over if name == "value" else name for name in heading)]
    for point in points:
        cells: list[object] = []
        for name in names:
            value = getattr(point, name)
            if name not in quartiles:
                cells.append(value)
            else:
                cells += [None] * 3 if value is None else [value.lower, value.median, value.upper]
        lines.append(csv_line(cells))
    return "".join(lines)
