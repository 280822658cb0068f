"""Says in words where a query was taken, compared with the images of its map."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spherloc.datasets.map_scene import MapScene
from spherloc.errors import shorten
from spherloc.geometry import camera_centre
from spherloc.metrics import AWAY
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz.layers.frame import length_text

NAMED = 2
"""Largest number of references that are named."""
MAX_LETTERS = 30
"""Longest name that is told in full; names that are alike but for a part in the middle may be longer."""


def where_taken(scene: MapScene, trace: Trace) -> str:
    """How far the pose of a run is from the nearest references other than the query itself, and what its truth is;
    empty without a pose."""
    if trace.cam_from_map is None:
        return ""
    image = trace.problem.image
    told = f"at {AWAY}" if scene.is_away(trace.cam_from_map) else nearest(scene, trace.cam_from_map, image)
    if not told:
        return ""
    truth = ""
    if trace.problem.truth_cam_from_map is not None:
        source = scene.truth_source.partition(":")[0]  # what follows are numbers
        truth = f" Its truth is that of {source}." if source else " Its truth is the pose that the map's files give it."
    more = " It is an image of the map itself." if any(view.path == image for view in scene.references) else ""
    return f"Taken {told}.{more}{truth}"


def nearest(scene: MapScene, cam_from_map: FloatArray, image: Path | None) -> str:
    """How far a pose (3, 4) is from the nearest references other than ``image``; empty if none of them has a pose."""
    here = camera_centre(cam_from_map)
    others = [view for view in scene.references if view.path != image]
    posed = [(view.name, view.cam_from_map) for view in others if view.cam_from_map is not None]
    apart_m = sorted((float(np.linalg.norm(camera_centre(pose) - here)), name) for name, pose in posed)
    names = [name for _, name in apart_m]
    return " and ".join(
        f"{length_text(metres, scene.metric)} from {_shortened(name, names)}" for metres, name in apart_m[:NAMED]
    )


def _shortened(name: str, names: Sequence[str]) -> str:
    """As much of a name as tells it from the other ``names``: those that are times differ in their middle."""
    cuts = ((most, shorten(name, most)) for most in range(MAX_LETTERS, len(name)))
    return next((cut for most, cut in cuts if [shorten(one, most) for one in names].count(cut) == 1), shorten(name))
