"""A map of runs: runs with similar evidence are near each other (principal components of their measures)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from spherloc.diagnosis import Measures
from spherloc.types import FloatArray

FEATURES = tuple(item.name for item in fields(Measures))
"""Columns from which the map is computed."""
LOGARITHMIC = ("tilt_deg", "rotation_sd_deg", "position_sd_m")
"""Columns whose logarithm is used, since they vary over orders of magnitude."""
LOGARITHM_OFFSET = 1e-6
"""Added before the logarithm is taken."""
MAX_SDS = 3.0
"""Largest distance from the median, in standard deviations; values are limited to it, so that one outlier does not
squeeze all other runs into a corner."""
NAMED = 2
"""Number of columns in the name of an axis."""


@dataclass(frozen=True, eq=False)
class RunMap:
    """The places of N runs on the map."""

    x: FloatArray
    """(N,), in standard deviations along the first component."""
    y: FloatArray
    """(N,), along the second one."""
    x_words: str
    """The quantities with the largest weights in the first component."""
    y_words: str
    """The quantities with the largest weights in the second component."""


def run_map(columns: Mapping[str, Sequence[Any]]) -> RunMap:
    """The map of all runs of ``columns``; unknown measures count as the median."""
    values = np.array([columns[name] for name in FEATURES], dtype=np.float64).T.reshape(-1, len(FEATURES))
    for name in LOGARITHMIC:
        k = FEATURES.index(name)
        values[:, k] = np.log10(np.maximum(values[:, k], 0.0) + LOGARITHM_OFFSET)
    known = np.isfinite(values)
    usable = np.flatnonzero(known.any(axis=0))
    if len(values) < 2 or not usable.size:
        zero = np.zeros(len(values))
        return RunMap(zero, zero, "", "")
    values, known = values[:, usable], known[:, usable]
    median = np.nanmedian(np.where(known, values, np.nan), axis=0)
    values = np.where(known, values, median) - median
    spread = values.std(axis=0)
    values = np.clip(values / np.where(spread > 0.0, spread, 1.0), -MAX_SDS, MAX_SDS)
    values -= values.mean(axis=0)
    _, vectors = np.linalg.eigh(values.T @ values)
    axes = vectors[:, ::-1][:, :2]
    # An eigenvector's sign is arbitrary: its largest part is made positive, so that the map is the same every time.
    axes = axes * np.where(axes[np.abs(axes).argmax(axis=0), np.arange(axes.shape[1])] < 0.0, -1.0, 1.0)
    places = values @ axes
    places = np.column_stack([places, np.zeros((len(values), 2 - places.shape[1]))])
    words = [_words(axes[:, k], usable) if k < axes.shape[1] else "" for k in range(2)]
    return RunMap(places[:, 0], places[:, 1], *words)


def _words(axis: FloatArray, usable: Any) -> str:
    strongest = np.argsort(-np.abs(axis))[:NAMED]
    return ", ".join(f"{'−' if axis[k] < 0.0 else '+'} {FEATURES[usable[k]]}" for k in strongest)
