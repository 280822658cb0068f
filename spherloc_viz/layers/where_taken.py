"""Says in words where a query was taken, compared with the images of its map."""

import numpy as np

from spherloc.datasets.map_scene import MapScene
from spherloc.errors import shorten
from spherloc.geometry import camera_centre
from spherloc.trace import Trace
from spherloc_viz.layers.frame import length_text

NAMED = 2
"""Largest number of references that are named."""
MAX_LETTERS = 30
"""Longest name that is told in full."""


def where_taken(scene: MapScene, trace: Trace) -> str:
    """How far the pose of a run is from the nearest references other than the query itself, and what its truth is;
    empty without a pose."""
    if trace.cam_from_map is None:
        return ""
    here = camera_centre(trace.cam_from_map)
    others = [view for view in scene.references if view.path != trace.problem.image]
    posed = [(view.name, view.cam_from_map) for view in others if view.cam_from_map is not None]
    apart_m = [(float(np.linalg.norm(camera_centre(pose) - here)), name) for name, pose in posed]
    if not apart_m:
        return ""
    told = " and ".join(
        f"{length_text(metres, scene.metric)} from {shorten(name, MAX_LETTERS)}"
        for metres, name in sorted(apart_m)[:NAMED]
    )
    truth = trace.problem.truth_cam_from_map
    more = " It is an image of the map itself." if len(others) < len(scene.references) else ""
    return f"Taken {told}.{more}" + ("" if truth is None else " Its truth is the pose that the map's files give it.")
