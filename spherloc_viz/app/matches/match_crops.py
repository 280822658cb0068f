"""The surroundings of a match's pixels, enlarged, as pictures in the page's text."""

from pathlib import Path

import cv2
import numpy as np

from spherloc.problem import Problem
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.app.matches.photos import jpeg_uri
from spherloc_viz.layers.photograph import photograph

SIDE_PX, WIDTH_PX, HEIGHT_PX = 48, 156, 104
"""Pixels of the photograph across a crop, and width and height of the picture."""


def crops_html(problem: Problem, number: int) -> str:
    """Crops around the pixels of a match in the query and in its reference, side by side; empty without images."""
    crops = [_crop_html(problem.image, problem.pixels[number], "query")]
    if problem.reference_index is not None and problem.reference_pixels is not None and problem.reference_images:
        path = problem.reference_images[int(problem.reference_index[number])]
        crops.append(_crop_html(path, problem.reference_pixels[number], "reference"))
    if not any(crops):
        return ""
    return f'<div style="display:flex;gap:.6em;padding-top:.5em">{"".join(crops)}</div>'


def _crop_html(path: Path | None, pixel: FloatArray, name: str) -> str:
    photo = photograph(path)
    if photo is None or not np.isfinite(pixel).all():
        return ""
    middle = photo.scale * pixel
    side = max(8, round(photo.scale * SIDE_PX))
    # The middle of the picture is the pixel itself, to a fraction of a pixel; beyond the border it is grey.
    zoom = WIDTH_PX / side
    shift = np.array([WIDTH_PX, HEIGHT_PX]) / 2.0 - zoom * middle + 0.5 * zoom - 0.5
    warp = np.array([[zoom, 0.0, shift[0]], [0.0, zoom, shift[1]]])
    crop = cv2.warpAffine(
        np.asarray(photo.image), warp, (WIDTH_PX, HEIGHT_PX), flags=cv2.INTER_LINEAR, borderValue=(96, 96, 96)
    )
    x, y, arm, gap = WIDTH_PX // 2, HEIGHT_PX // 2, 26, 10
    cross = (
        f'<svg viewBox="0 0 {WIDTH_PX} {HEIGHT_PX}" style="position:absolute;inset:0;width:100%;height:100%">'
        f'<path d="M{x - gap} {y}h{-arm}M{x + gap} {y}h{arm}M{x} {y - gap}v{-arm}M{x} {y + gap}v{arm}" '
        f'stroke="{style.css(style.SELECTED)}" stroke-width="2" fill="none"/></svg>'
    )
    return (
        '<div style="flex:1;min-width:0;max-width:50%"><div style="position:relative;aspect-ratio:3/2">'
        f'<img alt="{name} around the match" src="{jpeg_uri(np.asarray(crop, np.uint8))}" '
        f'style="width:100%;height:100%;border-radius:3px;display:block">{cross}</div>'
        f'<div style="font-size:11.5px;opacity:.65">{name}</div></div>'
    )
