"""The images of the problem with their matches, or where the camera sees them if there are no images."""

import base64
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.types import ByteArray
from spherloc_viz import style
from spherloc_viz.app.matches import match_drawing as drawing
from spherloc_viz.app.matches.match_drawing import Overlay, overlay
from spherloc_viz.app.matches.match_table import chips_html
from spherloc_viz.app.text import box, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.layers.frame import one_color
from spherloc_viz.layers.matches import MatchView, match_view
from spherloc_viz.layers.primitives import Picture, Points
from spherloc_viz.layers.query_image import modified, photograph, shrunk

GONE = "cannot be read: it is still being drawn, or it is gone."
QUALITIES = (82, 70, 55, 40)
MAX_BYTES = 85_000
"""Largest JPEG; its quality is lowered until it fits. As text it takes a third more."""


def photo_uri(path: Path | None, width_px: int) -> str | None:
    """The image of a file, at most ``width_px`` wide, as a data URI (cached); None without a file."""
    return None if path is None else _photo_uri(path, modified(path), width_px)


@lru_cache(maxsize=16)
def _photo_uri(path: Path, changed_ns: int, width_px: int) -> str | None:
    photo = photograph(path)
    return None if photo is None else jpeg_uri(shrunk(photo.image, width_px / photo.image.shape[1]))


def jpeg_uri(image: NDArray[np.uint8]) -> str:
    """An image (H, W, 3) sRGB as a data URI."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    data = b""
    for quality in QUALITIES:
        data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= MAX_BYTES:
            break
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


PHOTO_PX = 900
"""Largest width of a photograph in the panel."""


class ImagePanel:
    """Query and reference with the matches in the colours of the step at hand.

    Without images it shows the camera's view: measured pixels, and crosses where the estimated pose puts the points.
    """

    def __init__(self, gui: viser.GuiApi, touches: Touches, changed: Callable[[object], None]) -> None:
        self._backgrounds = gui.add_html("")
        self._drawing = gui.add_html("")
        self._touches, self._changed = touches, changed
        self._wanted: int | None = None
        self._followed: tuple = ()
        self._shown: Overlay | None = None
        self._drawn: tuple[Trace, tuple] | None = None
        touches.on("image-pick", self._pick)
        touches.on("image-reference", self._want)

    def draw(
        self, trace: Trace, picture: Picture, selected: tuple[int, ...], kept: NDArray, hidden: bool = False
    ) -> None:
        """Show the images of a run at a step. ``selected`` are indices in the problem, ``kept`` (N,) the original
        numbers of the matches; ``hidden`` leaves out the numbers of inliers of the references."""
        problem = trace.problem
        followed = (problem.name, problem.reference_images, kept[list(selected)].tolist())
        if followed != self._followed:
            self._followed, self._wanted = followed, None
        colors = match_colors(picture, len(problem))
        written = [modified(path) for path in (problem.image, *problem.reference_images) if path is not None]
        drawn = (selected, self._wanted, colors.tobytes(), kept.tobytes(), hidden, written)
        if self._drawn is not None and self._drawn[0] is trace and self._drawn[1] == drawn:
            return
        self._drawn = (trace, drawn)
        view = match_view(problem, colors, trace.inlier_mask, selected, self._wanted)
        paths = [problem.image] + ([] if view.reference is None else [problem.reference_images[view.reference]])
        places, height = drawing.arrange([(problem.camera.width, problem.camera.height), *image_sizes(problem, view)])
        shares = [place.width / drawing.WIDTH for place in places]
        uris = [photo_uri(path, round(PHOTO_PX * share)) for path, share in zip(paths, shares, strict=True)]
        self._shown = shown = overlay(trace, view, colors, places, selected, kept, uris[0] is not None)
        gone = [path.name for path, uri in zip(paths, uris, strict=True) if path is not None and uri is None]
        caption = " ".join([shown.caption, *(f"{name} {GONE}" for name in gone)])
        html = drawing.frame_html(places, height, [uri is not None for uri in uris], shown.parts, caption)
        votes = "" if hidden else chips_html(problem, trace.inlier_mask, view.reference)
        html = box(html) + status_html(caption) + votes
        _assign(self._backgrounds, drawing.backgrounds_html(uris))
        _assign(self._drawing, html)

    def show_reference(self, number: int | None) -> None:
        """Show the query with that reference from now on, or None for the one that the selection suggests."""
        self._wanted = number
        self._changed(None)

    def _want(self, touch: Touch) -> None:
        self.show_reference(int(touch.argument) if touch.argument.isdecimal() else None)

    def _pick(self, touch: Touch) -> None:
        """Select the match nearest to a press, if one is near."""
        number = None if self._shown is None else self._shown.nearest(touch.argument, touch.x, touch.y)
        if number is not None:
            self._touches.deliver(replace(touch, action="select", argument=str(number)))


def _assign(handle: viser.GuiHtmlHandle, html: str) -> None:
    update_widget(handle, content=html)


def match_colors(picture: Picture, count: int) -> ByteArray:
    """Colours (N, 3) of the matches at a step: those of the map's points."""
    colors = one_color(style.UNDECIDED, count)
    for item in picture.scene:
        if isinstance(item, Points) and item.name == "map/points" and item.ids is not None:
            colors[item.ids] = item.colors
    return colors


def image_sizes(problem: Problem, view: MatchView) -> list[tuple[float, float]]:
    """Width and height of the reference image, px."""
    if view.reference is None or problem.reference_pixels is None:
        return []
    photo = photograph(problem.reference_images[view.reference])
    if photo is not None:
        height, width = photo.image.shape[:2]
        return [(width / photo.scale, height / photo.scale)]
    # The image file is missing: the size is that of a frame around its keypoints.
    most = np.nanmax(np.append(problem.reference_pixels[view.own], [[1.0, 1.0]], axis=0), axis=0)
    return [(float(most[0]), float(most[1]))]
