"""Summarizes the rows of the paper's simulations by the paper's own measures of success and error."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from spherloc.experiments.summary import wilson
from spherloc.experiments.sweep_rows import SweepRow
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M
from spherloc.types import FloatArray
from spherloc.verification.experiments import METHODS


@dataclass(frozen=True)
class SweepPoint:
    """A point of a sweep."""

    experiment: str
    """Key of an experiment."""
    camera: str
    """Key of ``SCENES``."""
    method: str
    """Key of ``METHODS``."""
    value: float
    """Value of the property that the sweep varies."""


@dataclass(frozen=True)
class Cell:
    """The runs of a point. Without a pose an error is infinite, and precision, recall and F1 are 0."""

    place: SweepPoint
    """The point of the sweep."""
    rows: tuple[SweepRow, ...]
    """Its runs by seed; not empty."""

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.rows)

    @property
    def successes(self) -> int:
        """Number of runs with a rotation error below 1 degree and |t_true - t| below 0.1 m (Sec. VI-A)."""
        return sum(succeeded(row) for row in self.rows)

    @property
    def rate(self) -> float:
        """Share of successes, 0 to 1."""
        return self.successes / self.runs

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the rate."""
        return wilson(self.successes, self.runs)

    def values(self, name: str) -> FloatArray:
        """A column of the rows (runs,), by name; errors of runs without a pose are inf, unknown scores 0."""
        missing = np.inf if "error" in name else 0.0
        found = [getattr(row, name) for row in self.rows]
        return np.array([missing if value is None else value for value in found], dtype=np.float64)

    def median(self, name: str) -> float:
        """Median of a column: one of its values, never the mean of a finite and an infinite one."""
        return float(np.quantile(self.values(name), 0.5, method="inverted_cdf"))

    def decisive(self, success: bool = False) -> int:
        """Seed of the first run that failed or, with ``success`` or if none failed, succeeded; else of the first."""
        wanted = [row.seed for row in self.rows if succeeded(row) == success]
        return wanted[0] if wanted else self.rows[0].seed


def succeeded(row: SweepRow) -> bool:
    """Whether a run is a success by the paper's definition."""
    rotation_deg, t_m = row.rotation_error_deg, row.t_error_m
    return rotation_deg is not None and t_m is not None and rotation_deg < SUCCESS_DEG and t_m < SUCCESS_M


class Measured:
    """The cells of all experiments."""

    def __init__(self, rows: Mapping[tuple[str, str], Iterable[SweepRow]]) -> None:
        """``rows`` are those of sweeps, by key of the experiment and of the camera."""
        names = {entrant.label: name for name, entrant in METHODS.items()}
        found: defaultdict[SweepPoint, list[SweepRow]] = defaultdict(list)
        for (experiment, camera), some in rows.items():
            for row in some:
                if row.estimator in names:
                    found[SweepPoint(experiment, camera, names[row.estimator], row.value)].append(row)
        self.cells: dict[SweepPoint, Cell] = {
            place: Cell(place, tuple(sorted(some, key=lambda row: row.seed))) for place, some in found.items()
        }
        """Cells by place."""

    def curve(self, experiment: str, camera: str, method: str) -> tuple[Cell, ...]:
        """The cells of a method, by value."""
        wanted = (experiment, camera, method)
        cells = [cell for place, cell in self.cells.items() if (place.experiment, place.camera, place.method) == wanted]
        return tuple(sorted(cells, key=lambda cell: cell.place.value))

    def cell(self, experiment: str, camera: str, method: str, value: float) -> Cell | None:
        """A cell, if it has runs."""
        return self.cells.get(SweepPoint(experiment, camera, method, value))

    def methods(self, experiment: str, camera: str) -> tuple[str, ...]:
        """The methods that have runs, in the order of ``METHODS``."""
        there = {place.method for place in self.cells if (place.experiment, place.camera) == (experiment, camera)}
        return tuple(name for name in METHODS if name in there)

    def values(self, experiment: str, camera: str) -> tuple[float, ...]:
        """The values that have runs, ascending."""
        there = {place.value for place in self.cells if (place.experiment, place.camera) == (experiment, camera)}
        return tuple(sorted(there))


def smaller_share(first: Cell, second: Cell, name: str) -> tuple[float, float]:
    """Share of the common problems on which ``first`` has the smaller value of a column, and a one-sided p-value of it:
    Wilcoxon's signed-rank test on the differences of the logarithms of the ranks."""
    mine = {row.seed: value for row, value in zip(first.rows, first.values(name), strict=True)}
    other = {row.seed: value for row, value in zip(second.rows, second.values(name), strict=True)}
    seeds = sorted(mine.keys() & other.keys())
    pairs = np.array([(mine[seed], other[seed]) for seed in seeds])
    if not len(pairs):
        return 0.5, 1.0
    logs = np.log(np.clip(pairs, 1e-12, 1e12))
    share = float(np.mean(logs[:, 0] < logs[:, 1]) + 0.5 * np.mean(logs[:, 0] == logs[:, 1]))
    if np.allclose(logs[:, 0], logs[:, 1]):
        return share, 1.0
    tested: Any = wilcoxon(logs[:, 0], logs[:, 1], alternative="less")
    return share, float(tested.pvalue)


def at(cells: Sequence[Cell], values: Sequence[float]) -> list[Cell]:
    """The cells whose value is one of ``values``."""
    return [cell for cell in cells if any(abs(cell.place.value - value) < 1e-9 for value in values)]
