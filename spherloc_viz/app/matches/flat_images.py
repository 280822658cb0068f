"""Query and reference with their matches as a picture of its own, SVG: for the lessons."""

from collections.abc import Callable
from html import escape
from pathlib import Path

import numpy as np

from spherloc.errors import InputError
from spherloc.trace import Trace
from spherloc_viz.app.matches import match_drawing as drawing
from spherloc_viz.app.matches.image_panel import image_sizes, match_colors, photo_uri
from spherloc_viz.layers.matches import match_view
from spherloc_viz.layers.primitives import Picture

PHOTO_PX = 640
"""Width of both images together."""


def images_svg(trace: Trace, picture: Picture, draw: Callable[[Path], None]) -> str:
    """The images of a run at a step; ``draw`` is asked to make the file of each, if it is not there.

    Raises ``InputError`` for a problem without images.
    """
    problem = trace.problem
    if problem.image is None:
        raise InputError(f"{problem.name}: has no images.")
    colors = match_colors(picture, len(problem))
    view = match_view(problem, colors, trace.inlier_mask, (), None)
    paths = [problem.image] + ([] if view.reference is None else [problem.reference_images[view.reference]])
    for path in paths:
        draw(path)
    places, height = drawing.arrange([(problem.camera.width, problem.camera.height), *image_sizes(problem, view)])
    photos = [
        f'<image href="{escape(uri)}" x="{place.x:.0f}" y="{place.y:.1f}" width="{place.width:.0f}" '
        f'height="{place.height:.1f}" preserveAspectRatio="none"/>'
        for path, place in zip(paths, places, strict=True)
        if (uri := photo_uri(path, round(PHOTO_PX * place.width / drawing.WIDTH))) is not None
    ]
    parts = drawing.overlay(trace, view, colors, places, (), np.arange(len(problem)), bool(photos)).parts
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {drawing.WIDTH:.0f} {height:.1f}" '
        f'width="{drawing.WIDTH:.0f}" height="{height:.1f}">{"".join(photos)}{"".join(parts)}</svg>'
    )
