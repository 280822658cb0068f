"""The matches between a query image and one of its references: what is seen where, in pixels of the images."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from spherloc.cameras.base import Camera
from spherloc.problem import Problem
from spherloc.types import BoolArray, ByteArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers.frame import even

CELLS = 129
"""Places a side at which a camera is asked what it can see."""


@dataclass(frozen=True, eq=False)
class MatchView:
    """Which matches a picture of two images shows."""

    reference: int | None
    """Index of the reference image beside the query; None if there is none, so that only the query is shown."""
    own: IntArray
    """Indices of the matches with that reference, or of all."""
    lines: IntArray
    """Of these, the ones to join by a line: inliers of the step at hand and the selected ones, thinned if many."""
    inliers: int
    """How many of ``own`` have the colour of inliers."""
    caption: str
    """What is seen, in a sentence or two."""


def match_view(
    problem: Problem,
    colors: ByteArray,
    inlier_mask: BoolArray,
    selected: tuple[int, ...] = (),
    reference: int | None = None,
) -> MatchView:
    """What to show of the matches of a problem, whose colours (N, 3) are those of a step.

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
    """Inliers and matches (R,) of every reference image; empty without any."""
    count = len(problem.reference_images)
    if problem.reference_index is None or problem.reference_pixels is None or not count:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    index = problem.reference_index
    return np.bincount(index[inlier_mask], minlength=count), np.bincount(index, minlength=count)


@lru_cache(maxsize=16)
def valid_outlines(camera: Camera) -> tuple[FloatArray, ...]:
    """Borders (K, 2), px, of what the camera can see of its image; none where that is all of it."""
    columns, rows = (np.linspace(0.0, size, CELLS) for size in (camera.width, camera.height))
    grid: FloatArray = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    valid = camera.unproject(grid)[1].reshape(CELLS, CELLS)
    if valid.all():
        return ()
    found, _ = cv2.findContours(valid.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    scale = np.array([camera.width, camera.height]) / (CELLS - 1)
    return tuple(contour.reshape(-1, 2) * scale for contour in found if len(contour) > 2)


def inlier_colored(colors: ByteArray) -> BoolArray:
    """Which colours (N, 3) are those of inliers, (N,)."""
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
