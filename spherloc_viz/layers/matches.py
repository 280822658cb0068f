"""The matches of a run: as rows that can be sorted and filtered, and as seen in the query and a reference image."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.geometry import yaw_of
from spherloc.problem import Problem
from spherloc.trace import ConsensusStage, Trace, TranslationStage
from spherloc.types import BoolArray, ByteArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.agreement import agreement
from spherloc_viz.layers.frame import even
from spherloc_viz.layers.residuals import run_bounds, verdicts

MAX_PAIRS = 20_000
"""Largest number of pairs for which agreement is computed; with more inliers an even sample of them is used."""
MIN_PARTNERS = 16


@dataclass(frozen=True, eq=False)
class MatchColumns:
    """The values of the columns for N matches."""

    kept: BoolArray
    """(N,) inliers of the run."""
    right: BoolArray | None
    """(N,) true inliers; None if the truth is unknown."""
    px: FloatArray
    """(N,) residual at the run's pose, px; inf for points behind the bearing, NaN if unknown."""
    deg: FloatArray
    """(N,) the same as an angle, degrees."""
    agree: IntArray
    """(N,) number of ``partners`` with which it makes a pair that agrees at the run's yaw; -1 if unknown."""
    partners: int
    """Number of inliers of the run with which pairs were computed."""
    clique: BoolArray | None
    """(N,) members of the maximum clique: matches, or those of its balls; None if the run looked for no clique."""
    of_balls: bool
    """Whether it is one of balls."""


Filter = Callable[[MatchColumns], BoolArray]
IN_CLIQUE = "in the maximum clique"
FILTERS: dict[str, Filter] = {
    "all": lambda rows: np.ones(len(rows.kept), dtype=bool),
    "inliers": lambda rows: rows.kept,
    "outliers": lambda rows: ~rows.kept,
    IN_CLIQUE: lambda rows: np.zeros(len(rows.kept), dtype=bool) if rows.clique is None else rows.clique,
    "wrongly kept": lambda rows: rows.kept & (_known(rows) == 0),
    "wrongly rejected": lambda rows: ~rows.kept & (_known(rows) == 1),
}
"""The filters of the table: which matches are listed, by name."""


def offered(rows: MatchColumns) -> tuple[str, ...]:
    """The filters that can be told of these matches."""
    untold = {"wrongly kept", "wrongly rejected"} if rows.right is None else set()
    untold |= {IN_CLIQUE} if rows.clique is None else set()
    return tuple(name for name in FILTERS if name not in untold)


def _known(rows: MatchColumns) -> NDArray[np.int8]:
    """(N,) 1 for true inliers, 0 for true outliers, -1 if the truth is unknown."""
    return np.full(len(rows.kept), -1, np.int8) if rows.right is None else rows.right.astype(np.int8)


SORTS: dict[str, Callable[[MatchColumns], NDArray]] = {
    "number": lambda rows: np.arange(len(rows.kept)),
    "run": lambda rows: ~rows.kept,
    "truth": lambda rows: -_known(rows),
    "px": lambda rows: rows.px,
    "deg": lambda rows: rows.deg,
    "agrees": lambda rows: -rows.agree,
}
"""Values for the ascending order, by the name of the column; equal ones keep the order of the numbers."""


@lru_cache(maxsize=4)
def match_rows(trace: Trace) -> MatchColumns:
    """The matches of a run (cached)."""
    known, count = verdicts(trace), len(trace.problem)
    nothing = np.full(count, np.nan)
    px = nothing if known.estimate is None else known.estimate.px
    deg = nothing if known.estimate is None else np.degrees(known.estimate.rad)
    agree, partners = _agreeing(trace)
    of_balls = trace.stage(TranslationStage) is not None
    return MatchColumns(known.kept, known.right, px, deg, agree, partners, _in_clique(trace), of_balls)


def _in_clique(trace: Trace) -> BoolArray | None:
    """Members (N,) of the maximum clique that the run found; None if it looked for none."""
    balls, consensus = trace.stage(TranslationStage), trace.stage(ConsensusStage)
    if balls is None and consensus is None:
        return None
    members = np.zeros(len(trace.problem), dtype=bool)
    if balls is not None:
        members[balls.pairs[balls.clique]] = True
    if consensus is not None:
        members[consensus.clique] = True
    return members


def order(rows: MatchColumns, shown: str, by: str, down: bool) -> IntArray:
    """Indices of the matches that a filter lists, sorted by a column; unknown values come last in both directions."""
    chosen = np.flatnonzero(FILTERS[shown](rows))
    values = SORTS[by](rows)[chosen].astype(np.float64)
    return chosen[np.argsort(-values if down else values, kind="stable")]


def _agreeing(trace: Trace) -> tuple[IntArray, int]:
    aligned, count = trace.problem.aligned, len(trace.problem)
    agree = np.full(count, -1, dtype=np.int64)
    inliers = np.flatnonzero(trace.inlier_mask[aligned.index])
    if trace.cam_from_map is None or not len(inliers):
        return agree, 0
    partners = even(inliers, max(MIN_PARTNERS, MAX_PAIRS // len(aligned.index)))
    yaw = yaw_of(aligned.align_pose(trace.cam_from_map)[:, :3])
    everybody = np.arange(len(aligned.index))
    pairs = agreement(aligned, run_bounds(trace).radians, yaw, everybody, partners)
    agree[aligned.index] = np.count_nonzero(pairs, axis=1)
    return agree, len(partners)


CELLS = 129
"""Number of points per side of the grid on which the visible part of an image is determined."""


@dataclass(frozen=True, eq=False)
class MatchView:
    """The matches in a picture of two images."""

    reference: int | None
    """Index of the reference image beside the query; None if there is none, so that only the query is shown."""
    own: IntArray
    """Indices of the matches with that reference, or of all."""
    lines: IntArray
    """The ones of ``own`` that are drawn with a line: inliers of the step and selected ones, a sample if many."""
    inliers: int
    """Number of ``own`` matches that have the colour of inliers."""
    caption: str
    """Caption of the picture, a sentence or two."""


def match_view(
    problem: Problem,
    colors: ByteArray,
    inlier_mask: BoolArray,
    selected: tuple[int, ...] = (),
    reference: int | None = None,
) -> MatchView:
    """The matches of a problem to show; their colours (N, 3) are those of a step.

    Of several references it is ``reference``, else that of the first of the ``selected`` matches, else the one with
    most inliers.
    """
    shown = _reference(problem, inlier_mask, selected, reference)
    is_inlier: BoolArray = inlier_colored(colors)
    index, pixels = problem.reference_index, problem.reference_pixels
    if shown is None or index is None or pixels is None:
        return MatchView(None, np.arange(len(problem)), np.empty(0, np.int64), int(is_inlier.sum()), _alone(problem))
    own = np.flatnonzero(index == shown)
    known: BoolArray = np.isfinite(pixels[:, 0]) & np.isfinite(pixels[:, 1])
    inliers = own[is_inlier[own]]
    joined = even(inliers[known[inliers]], style.MAX_DRAWN_MATCHES)
    chosen = np.array([k for k in selected if index[k] == shown and known[k]], dtype=np.int64)
    caption = _caption(problem, shown, len(own), len(inliers), len(joined))
    return MatchView(shown, own, np.union1d(joined, chosen), len(inliers), caption)


def reference_votes(problem: Problem, inlier_mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Numbers of inliers (R,) and of matches (R,) of every reference image; empty without references."""
    count = len(problem.reference_images)
    if problem.reference_index is None or problem.reference_pixels is None or not count:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    index = problem.reference_index
    return np.bincount(index[inlier_mask], minlength=count), np.bincount(index, minlength=count)


@lru_cache(maxsize=16)
def valid_outlines(camera: Camera) -> tuple[FloatArray, ...]:
    """Borders (K, 2), px, of the visible part of a camera's image; empty if all of the image is visible."""
    columns, rows = (np.linspace(0.0, size, CELLS) for size in (camera.width, camera.height))
    grid: FloatArray = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    valid = camera.unproject(grid)[1].reshape(CELLS, CELLS)
    if valid.all():
        return ()
    found, _ = cv2.findContours(valid.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    scale = np.array([camera.width, camera.height]) / (CELLS - 1)
    return tuple(contour.reshape(-1, 2) * scale for contour in found if len(contour) > 2)


def inlier_colored(colors: ByteArray) -> BoolArray:
    """Mask (N,) of the colours (N, 3) that mean inlier."""
    return np.asarray(np.equal(colors, np.array(style.INLIER, np.uint8)).all(axis=1))


def _reference(problem: Problem, inlier_mask: BoolArray, selected: tuple[int, ...], wanted: int | None) -> int | None:
    inliers, matches = reference_votes(problem, inlier_mask)
    if not len(matches) or problem.reference_index is None:
        return None
    if wanted is not None and 0 <= wanted < len(matches):
        return wanted
    if selected:
        return int(problem.reference_index[selected[0]])
    return int(np.argmax(inliers if inliers.any() else matches))


def _alone(problem: Problem) -> str:
    name = "The camera's view" if problem.image is None else problem.image.name
    return f"{name} with its {len(problem):,} matches."


def _caption(problem: Problem, shown: int, own: int, inliers: int, lines: int) -> str:
    count = len(problem.reference_images)
    rest = f", one of {count} references" if count > 1 else ""
    thinned = f" Lines for {lines} of its {inliers:,} inliers." if lines < inliers else ""
    return f"{_name(problem.image)} and {problem.reference_images[shown].name}{rest}: {own:,} matches.{thinned}"


def _name(path: Path | None) -> str:
    return "the query" if path is None else path.name
