"""A localized sequence in the map: where the camera was found, coloured by error, and where it truly was (Fig. 10)."""

from collections.abc import Sequence

import numpy as np

from spherloc.experiments.results import QueryResult
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import one_color
from spherloc_viz.layers.primitives import Points, SceneItem, Segments

LAYER = "trajectory"


DOT_SHARE = 0.06
"""Radius of a dot as a share of the usual distance between neighbours, so that dots do not hide each other."""


def trajectory_items(rows: Sequence[QueryResult], map_turn: FloatArray, limit_m: float) -> tuple[SceneItem, ...]:
    """What a sequence adds to the canvas.

    ``rows`` are in the order of the sequence, ``map_turn`` (3, 3) turns the map to the aligned map, and ``limit_m``
    is the loosest limit of success. Poses whose truth is unknown have the estimate's colour; a query without a pose is
    a dot in the outliers' colour where it truly was.
    """
    truth = np.array([row.true_position_m for row in rows]).reshape(-1, 3) @ map_turn.T
    found = np.array([row.position_m for row in rows]).reshape(-1, 3) @ map_turn.T
    errors: FloatArray = np.linalg.norm(found - truth, axis=1)
    known, located = np.isfinite(truth[:, 0]), np.isfinite(found[:, 0])
    colors = np.where(known[:, None], style.error_colors(errors, limit_m), np.array(style.ESTIMATE, np.uint8))
    places = np.where(located[:, None], found, truth)
    colors[~located] = style.OUTLIER
    shown = located | known
    followed = known[:-1] & known[1:]
    legs = np.stack([truth[:-1], truth[1:]], axis=1)[followed]
    both = known & located
    offsets = np.stack([truth, found], axis=1)[both]
    ids = np.flatnonzero(shown)
    steps = np.linalg.norm(np.diff(places[shown], axis=0), axis=1)
    dot_m = DOT_SHARE * float(np.median(steps)) if len(steps) else limit_m
    return (
        Points("trajectory/queries", LAYER, places[shown], colors[shown], dot_m, ids),
        Segments("trajectory/truth", LAYER, legs, one_color(style.TRUTH, len(legs)), 2.0),
        Segments("trajectory/errors", LAYER, offsets, colors[both], 2.0),
    )
