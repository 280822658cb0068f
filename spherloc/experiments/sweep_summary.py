"""What the runs at each point of a sweep come to."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from spherloc.experiments.summary import wilson
from spherloc.experiments.sweep_rows import SweepRow, columns, csv_line, row_line


@dataclass(frozen=True)
class Quartiles:
    """Of some runs. A run without a pose has an infinite error."""

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
    """Of what the sweep goes over."""
    runs: int
    """Done by now."""
    successes: int
    """Errors below 1 degree and 0.1 m."""
    rate: float
    """Their ratio, 0 to 1."""
    low: float
    """Lower end of the 95 % Wilson interval of the rate."""
    high: float
    """Its upper end."""
    rotation_error_deg: Quartiles
    """Of all runs, degrees."""
    translation_error_m: Quartiles
    """Of all runs, metres."""
    success_rotation_error_deg: Quartiles | None
    """Of successes, degrees; None if there is none, as the next one."""
    success_translation_error_m: Quartiles | None
    """Of successes, metres."""
    time_ms: Quartiles
    """Of all runs."""
    mean_precision: float | None
    """Of the inliers; None if it is unknown, as the next two."""
    mean_recall: float | None
    """Of the inliers."""
    mean_f1: float | None
    """Of the inliers."""
    proven: int | None
    """Runs whose consensus is proven to be the largest; None if the estimator proves nothing."""


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
    # No mean of two runs: half of a finite and an infinite error is neither.
    lower, median, upper = np.quantile(known, [0.25, 0.5, 0.75], method="inverted_cdf")
    return Quartiles(float(lower), float(median), float(upper))


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def rows_text(over: str, labels: Sequence[str], rows: Iterable[SweepRow]) -> str:
    """The rows as CSV, ordered by seed, value and estimator, whoever was quicker."""
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
