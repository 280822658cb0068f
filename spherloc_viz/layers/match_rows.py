"""All matches of a run as columns that can be sorted and filtered."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import yaw_of
from spherloc.trace import Trace
from spherloc.types import BoolArray, FloatArray, IntArray
from spherloc_viz.layers.agreement import agreement
from spherloc_viz.layers.frame import even
from spherloc_viz.layers.verdicts import run_bounds, verdicts

MOST_PAIRS = 20_000
"""Pairs that are asked whether they agree; of more inliers an even sample is taken."""
LEAST_PARTNERS = 16


@dataclass(frozen=True, eq=False)
class MatchRows:
    """N matches."""

    kept: BoolArray
    """(N,) inliers of the run."""
    right: BoolArray | None
    """(N,) true inliers; None if the truth is unknown."""
    px: FloatArray
    """(N,) residual at the run's pose; inf behind, NaN if unknown."""
    deg: FloatArray
    """(N,) the same as an angle."""
    agree: IntArray
    """(N,) with how many of the ``partners`` it makes a pair that agrees at the run's yaw; -1 if unknown."""
    partners: int
    """Inliers of the run that were asked."""


Filter = Callable[[MatchRows], BoolArray]
FILTERS: dict[str, Filter] = {
    "all": lambda rows: np.ones(len(rows.kept), dtype=bool),
    "inliers": lambda rows: rows.kept,
    "outliers": lambda rows: ~rows.kept,
    "wrongly kept": lambda rows: rows.kept & (_known(rows) == 0),
    "wrongly rejected": lambda rows: ~rows.kept & (_known(rows) == 1),
}
"""Which matches are listed."""


def _known(rows: MatchRows) -> NDArray[np.int8]:
    """1 for true inliers, 0 for true outliers, -1 if the truth is unknown."""
    return np.full(len(rows.kept), -1, np.int8) if rows.right is None else rows.right.astype(np.int8)


SORTS: dict[str, Callable[[MatchRows], NDArray]] = {
    "number": lambda rows: np.arange(len(rows.kept)),
    "run": lambda rows: ~rows.kept,
    "truth": lambda rows: -_known(rows),
    "px": lambda rows: rows.px,
    "deg": lambda rows: rows.deg,
    "agrees": lambda rows: -rows.agree,
}
"""What ascending order means, by the name of the column; ties keep the order of the numbers."""


@lru_cache(maxsize=4)
def match_rows(trace: Trace) -> MatchRows:
    """The matches of a run (cached)."""
    known, count = verdicts(trace), len(trace.problem)
    nothing = np.full(count, np.nan)
    px = nothing if known.estimate is None else known.estimate.px
    deg = nothing if known.estimate is None else np.degrees(known.estimate.rad)
    agree, partners = _agreeing(trace)
    return MatchRows(known.kept, known.right, px, deg, agree, partners)


def order(rows: MatchRows, shown: str, by: str, down: bool) -> IntArray:
    """Indices of the matches that a filter lists, sorted by a column; what is unknown comes last either way."""
    chosen = np.flatnonzero(FILTERS[shown](rows))
    values = SORTS[by](rows)[chosen].astype(np.float64)
    return chosen[np.argsort(-values if down else values, kind="stable")]


def _agreeing(trace: Trace) -> tuple[IntArray, int]:
    aligned, count = trace.problem.aligned, len(trace.problem)
    agree = np.full(count, -1, dtype=np.int64)
    inliers = np.flatnonzero(trace.inlier_mask[aligned.index])
    if trace.cam_from_map is None or not len(inliers):
        return agree, 0
    partners = even(inliers, max(LEAST_PARTNERS, MOST_PAIRS // len(aligned.index)))
    yaw = yaw_of(aligned.align_pose(trace.cam_from_map)[:, :3])
    everybody = np.arange(len(aligned.index))
    pairs = agreement(aligned, run_bounds(trace).radians, yaw, everybody, partners)
    agree[aligned.index] = np.count_nonzero(pairs, axis=1)
    return agree, len(partners)
