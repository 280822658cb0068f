"""Picture of a map from above: its points and images, with the names for which there is room."""

from collections.abc import Mapping
from itertools import groupby

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from spherloc.types import FloatArray
from spherloc_viz.plots.frames import around, corners, frames_of, with_room
from spherloc_viz.plots.labels import PlaceName, write_labels
from spherloc_viz.plots.saving import png_of

TOGETHER, MAX_LINES = 0.02, 4
"""Images that are closer than this share of the extent of all have their names under each other, at most so many."""
MAX_POINTS = 20_000
"""About the largest number of points that are drawn."""
WIDTH_INCHES, WIDE_INCHES = 9.0, 14.0
"""Width of a picture with one panel and with two."""
HEIGHT_INCHES = (5.0, 7.5)


def map_above(points: FloatArray, centres: Mapping[str, FloatArray], joined: bool, unit: str) -> tuple[bytes, int]:
    """PNG of a map from above, and the number of images whose names are not written there, for lack of room.

    ``points`` are (P, 3), ``centres`` those of the images (3,) by name, with z up, in ``unit``; with ``joined`` a line
    joins the images of each folder in the order of their names. Points far from the images are cut. If the images lie
    in a small part of the picture, a second one shows them alone.
    """
    places = np.stack([centre[:2] for centre in centres.values()])
    frames = frames_of(with_room(places, points[:, :2]), around(places))
    width = (WIDE_INCHES if len(frames) > 1 else WIDTH_INCHES) / len(frames)
    height = float(np.clip(width * max(half[1] / half[0] for _, half in frames), *HEIGHT_INCHES))
    frames = [(middle, np.maximum(half, half[::-1] * [width / height, height / width])) for middle, half in frames]
    figure = Figure(figsize=(width * len(frames), height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    panels = [figure.add_subplot(1, len(frames), k + 1, aspect="equal") for k in range(len(frames))]
    for axes, frame in zip(panels, frames, strict=True):
        (left, bottom), (right, top) = corners(frame)
        axes.set(xlim=(left, right), ylim=(bottom, top), xlabel=unit, ylabel=unit)
        axes.scatter(*places.T, s=28, c="#c0392b", zorder=3)
    low, high = corners(frames[0])
    shown = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1), :2]
    shown = shown[:: max(1, len(shown) // MAX_POINTS)]
    panels[0].scatter(*shown.T, s=1.5, c="#8fa3b8", linewidths=0)
    if len(panels) > 1:
        panels[-1].set_title("the cameras alone")
    if joined:
        for _, names in groupby(sorted(centres, key=lambda name: (folder_of(name), name)), folder_of):
            walk = np.stack([centres[name][:2] for name in names])
            panels[-1].plot(*walk.T, color="#d08a1c", linewidth=0.8)
    labels = names_at(places, list(centres))
    without = set(write_labels(panels[-1], labels, places, beside=True))
    named = sum(min(len(label.lines), MAX_LINES) for label in labels if label not in without)
    return png_of(figure), len(centres) - named


def folder_of(name: str) -> str:
    """The folder in an image's name: fixed cameras with the same lens have one each."""
    return name.rpartition("/")[0]


def names_at(places: FloatArray, names: list[str]) -> list[PlaceName]:
    """Names to be written beside images at places (N, 2): those of images at one place are under each other."""
    apart, free = TOGETHER * float(np.ptp(places, axis=0).max()), np.ones(len(names), bool)
    labels = []
    for k in range(len(names)):
        there = np.flatnonzero(free & (np.abs(places - places[k]).max(axis=1) <= apart)) if free[k] else []
        if len(there):
            free[there] = False
            lines = [names[other] for other in there[:MAX_LINES]]
            lines += [f"and {len(there) - MAX_LINES} more"] * (len(there) > MAX_LINES)
            labels.append(PlaceName(tuple(lines), places[k], "black"))
    return labels
