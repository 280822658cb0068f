"""Names beside places of a picture, none over another or over the edge."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from spherloc.errors import shorten
from spherloc.types import FloatArray
from spherloc_viz.plots.saving import fix_layout

FONT_SIZE = 8
MAX_LETTERS = 40
DOT_PX = 8.0
"""Half the width of the square around each place that names leave free."""
NEAR, FAR = 7.0, 18.0
"""Distances of a name from its place, points."""
BESIDE = (
    (NEAR, 0.0), (-NEAR, 0.0), (NEAR, NEAR), (NEAR, -NEAR), (-NEAR, NEAR), (-NEAR, -NEAR), (0.0, NEAR), (0.0, -NEAR),
)  # fmt: skip
ANYWHERE = (
    *BESIDE, (NEAR, FAR), (NEAR, -FAR), (-NEAR, FAR), (-NEAR, -FAR), (NEAR, 1.6 * FAR), (NEAR, -1.6 * FAR),
)  # fmt: skip
"""Where a name is tried, right and up of its place, points; ``BESIDE`` where it is clear which place it names."""
COVERED = 0.1
"""Share of a name beside its place that may lie over other places."""
_TOUCHING_PX2 = 1.0
"""Area that a name may have in common with another one, or beyond the edge."""


@dataclass(frozen=True, eq=False)
class PlaceName:
    """A name to be written beside a place."""

    lines: tuple[str, ...]
    """The name, or those of several things at one place, which are written under each other."""
    place: FloatArray
    """(2,) in the coordinates of the axes."""
    color: str


def write_labels(
    axes: Axes, labels: Sequence[PlaceName], dots: FloatArray, beside: bool = False
) -> tuple[PlaceName, ...]:
    """Write the labels after all else is drawn; ``dots`` (N, 2) are places that no name should cover.

    Returns those that are not written, since they would lie over others or over the edge; earlier ones come first. With
    ``beside`` nor are those that would be away from their places or over others.
    """
    figure = axes.figure
    assert isinstance(figure, Figure) and isinstance(figure.canvas, FigureCanvasAgg)
    fix_layout(figure)
    renderer, edge = figure.canvas.get_renderer(), np.asarray(axes.get_window_extent().extents)
    centres = axes.transData.transform(np.reshape(dots, (-1, 2)))
    covered = np.concatenate([centres - DOT_PX, centres + DOT_PX], axis=1)
    taken, left_out = np.zeros((0, 4)), list[PlaceName]()
    for label in labels:
        words = "\n".join(shorten(line, MAX_LETTERS) for line in label.lines)
        text = axes.annotate(
            words, tuple(label.place.tolist()), xytext=BESIDE[0], textcoords="offset points", fontsize=FONT_SIZE,
            color=label.color, parse_math=False, annotation_clip=False,
        )  # fmt: skip
        text.set_in_layout(False)
        tried = []
        for spot in BESIDE if beside else ANYWHERE:
            _move(text, spot)
            box = np.asarray(text.get_window_extent(renderer).extents)
            tried.append((_outside(box, edge) + _common(box, taken), _common(box, covered), spot, box))
        bad, over, spot, box = min(tried, key=lambda one: one[:2])
        if bad > _TOUCHING_PX2 or (beside and over > COVERED * np.prod(box[2:] - box[:2])):
            text.remove()
            left_out.append(label)
        else:
            _move(text, spot)
            taken = np.concatenate([taken, box[None]])
    return tuple(left_out)


def _move(text, spot: tuple[float, float]) -> None:
    right, up = spot
    text.set_position(spot)
    text.set_horizontalalignment("center" if right == 0.0 else "left" if right > 0.0 else "right")
    text.set_verticalalignment("center" if up == 0.0 else "bottom" if up > 0.0 else "top")


def _common(box: FloatArray, others: FloatArray) -> float:
    """Area that a box (left, bottom, right, top) has in common with others (N, 4), px^2."""
    size = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    return float(np.prod(np.maximum(size, 0.0), axis=1).sum())


def _outside(box: FloatArray, edge: FloatArray) -> float:
    """Area of a box beyond the edge, px^2."""
    return float(np.prod(box[2:] - box[:2])) - _common(box, edge[None])
