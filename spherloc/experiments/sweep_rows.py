"""One row a run of a sweep, and its text in CSV."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from spherloc.errors import InputError, show
from spherloc.metrics import evaluate
from spherloc.trace import Trace


@dataclass(frozen=True, slots=True)
class SweepRow:
    """The result of one estimator on one problem. What is unknown is None."""

    estimator: str
    """Label of the estimator and its options."""
    value: float
    """Of what the sweep goes over."""
    seed: int
    """Of the simulation and of the estimator."""
    success: bool
    """Rotation error below 1 degree and position error below 0.1 m (Sec. VI-A)."""
    rotation_error_deg: float | None
    """Angle between true and estimated rotation, degrees; None without a pose."""
    translation_error_m: float | None
    """Distance between true and estimated camera position, metres; None without a pose."""
    time_ms: float
    """Wall time of the estimator."""
    inliers: int
    """Correspondences that it took for right."""
    correspondences: int
    """Of the problem."""
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
    """Of the CSV: the value has the name of what the sweep goes over."""
    return tuple(over if name == "value" else name for name in _NAMES)


def csv_line(cells: Iterable[Any]) -> str:
    """One line of CSV with its end: None is empty, numbers keep all their digits."""
    file = io.StringIO(newline="")
    csv.writer(file, lineterminator="\n").writerow([_cell(value) for value in cells])
    return file.getvalue()


def row_line(row: SweepRow) -> str:
    """The row as a line of CSV."""
    return csv_line(getattr(row, name) for name in _NAMES)


def row_of_line(line: str, place: str) -> SweepRow:
    """The row of a line by ``row_line``; ``place`` names its file and number.

    Raises ``InputError`` if it is no such line.
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
    return InputError(f"{place}: {what}, so it is no run of a sweep; delete that line to have the run done again.")
