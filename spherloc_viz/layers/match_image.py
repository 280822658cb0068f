"""The query image above the reference image that it agrees with most, and the matches between the two."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError
from spherloc.images import read_image
from spherloc.problem import Problem
from spherloc_viz import style
from spherloc_viz.layers.primitives import ColorArray, FloatArray

WIDTH_PX = 900
GAP_PX = 8
DOT_PX = 3
DIM = 0.75
"""Brightness that the photographs keep, so that dots and lines stand out."""


@dataclass(frozen=True, eq=False)
class MatchImage:
    """A picture of the matches between two images."""

    image: NDArray[np.uint8]
    """(H, W, 3) sRGB."""
    caption: str
    """What is seen, in a sentence."""


def match_image(problem: Problem, colors: ColorArray, inlier_mask: NDArray[np.bool_]) -> MatchImage | None:
    """The images of a problem with its correspondences as dots of the given colours (N, 3); None if it has no image.

    Of several references, the one with the most inliers is shown; lines join what has the colour of inliers. An image
    that cannot be read any more is left grey, and the caption says so.
    """
    if problem.image is None:
        return None
    size = (problem.camera.width, problem.camera.height)
    remarks: list[str] = []
    query, scale = _photograph(problem.image, size, remarks)
    if problem.reference_index is None or problem.reference_pixels is None or not problem.reference_images:
        _dots(query, scale * problem.pixels, colors)
        return MatchImage(query, " ".join([f"{problem.image.name} with its {len(problem)} matches.", *remarks]))
    count = len(problem.reference_images)
    votes = np.bincount(problem.reference_index[inlier_mask], minlength=count)
    shown = int(np.argmax(votes if votes.any() else np.bincount(problem.reference_index, minlength=count)))
    path = problem.reference_images[shown]
    reference, reference_scale = _photograph(path, None, remarks)
    own = problem.reference_index == shown
    start, end = scale * problem.pixels, reference_scale * problem.reference_pixels
    _dots(query, start[own], colors[own])
    _dots(reference, end[own], colors[own])
    canvas = np.zeros((len(query) + GAP_PX + len(reference), WIDTH_PX, 3), np.uint8)
    canvas[: len(query)], canvas[len(query) + GAP_PX :] = query, reference
    inliers = np.flatnonzero(own & (colors == style.INLIER).all(axis=1))
    drawn = inliers[:: -(-len(inliers) // style.MAX_DRAWN_MATCHES) or 1]
    _lines(canvas, start[drawn], end[drawn] + [0.0, len(query) + GAP_PX], colors[drawn])
    rest = f", one of {count} references" if count > 1 else ""
    thinned = f" Lines for {len(drawn)} of its {len(inliers)} inliers." if len(drawn) < len(inliers) else ""
    caption = f"{problem.image.name} above {path.name}{rest}: {np.count_nonzero(own)} matches.{thinned}"
    return MatchImage(canvas, " ".join([caption, *remarks]))


def _photograph(path: Path, size: tuple[int, int] | None, remarks: list[str]) -> tuple[NDArray[np.uint8], float]:
    """A dimmed copy of the image, ``WIDTH_PX`` wide, and its scale."""
    try:
        image, scale = _scaled(path, path.stat().st_mtime_ns if path.is_file() else 0)
    except InputError:
        remarks.append(f"{path.name} cannot be read any more.")
        width, height = size or (WIDTH_PX, WIDTH_PX // 2)
        scale = WIDTH_PX / width
        image = np.full((max(1, round(scale * height)), WIDTH_PX, 3), 60, np.uint8)
    return image.copy(), scale


@lru_cache(maxsize=8)
def _scaled(path: Path, changed_ns: int) -> tuple[NDArray[np.uint8], float]:
    """``changed_ns`` has a file that was written anew read anew."""
    image = read_image(path)
    scale = WIDTH_PX / image.shape[1]
    size = (WIDTH_PX, max(1, round(scale * image.shape[0])))
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)
    return (DIM * image).astype(np.uint8), scale


def _dots(image: NDArray[np.uint8], pixels: FloatArray, colors: ColorArray) -> None:
    for (x, y), color in zip(_places(pixels), colors.tolist(), strict=True):
        cv2.circle(image, (x, y), DOT_PX, color, -1, cv2.LINE_AA)


def _lines(image: NDArray[np.uint8], starts: FloatArray, ends: FloatArray, colors: ColorArray) -> None:
    for start, end, color in zip(_places(starts), _places(ends), colors.tolist(), strict=True):
        cv2.line(image, start, end, color, 1, cv2.LINE_AA)


def _places(pixels: FloatArray) -> list[tuple[int, int]]:
    """Whole pixels that OpenCV can draw at; unknown ones lie outside."""
    whole = np.nan_to_num(np.clip(np.floor(pixels), -10_000, 10_000), nan=-10_000).astype(int)
    return [(x, y) for x, y in whole.tolist()]
