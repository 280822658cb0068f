"""The query image above the reference image that it agrees with most, as one picture with their matches."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spherloc.problem import Problem
from spherloc_viz.layers.match_view import match_view
from spherloc_viz.layers.photograph import photograph
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
    view, remarks = match_view(problem, colors, inlier_mask), list[str]()
    query, scale = _photograph(problem.image, (problem.camera.width, problem.camera.height), remarks)
    start = scale * problem.pixels
    _dots(query, start[view.own], colors[view.own])
    if view.reference is None or problem.reference_pixels is None:
        return MatchImage(query, " ".join([view.caption, *remarks]))
    reference, reference_scale = _photograph(problem.reference_images[view.reference], None, remarks)
    end = reference_scale * problem.reference_pixels
    _dots(reference, end[view.own], colors[view.own])
    canvas = np.zeros((len(query) + GAP_PX + len(reference), WIDTH_PX, 3), np.uint8)
    canvas[: len(query)], canvas[len(query) + GAP_PX :] = query, reference
    _lines(canvas, start[view.lines], end[view.lines] + [0.0, len(query) + GAP_PX], colors[view.lines])
    return MatchImage(canvas, " ".join([view.caption, *remarks]))


def _photograph(path: Path, size: tuple[int, int] | None, remarks: list[str]) -> tuple[NDArray[np.uint8], float]:
    """A dimmed copy of the image, ``WIDTH_PX`` wide, and its scale."""
    photo = photograph(path)
    if photo is None:
        remarks.append(f"{path.name} cannot be read any more.")
        width, height = size or (WIDTH_PX, WIDTH_PX // 2)
        scale = WIDTH_PX / width
        return np.full((max(1, round(scale * height)), WIDTH_PX, 3), 60, np.uint8), scale
    scale = WIDTH_PX / photo.image.shape[1]
    size = (WIDTH_PX, max(1, round(scale * photo.image.shape[0])))
    image = cv2.resize(photo.image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return (DIM * image).astype(np.uint8), scale * photo.scale


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
