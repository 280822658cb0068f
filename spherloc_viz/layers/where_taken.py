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
    apart_m = np.array([float(np.linalg.norm(camera_centre(pose) - here)) for _, pose in posed])
    nearest = np.argsort(apart_m, kind="stable")[:NAMED].tolist()
    if not nearest:
        return ""
    told = " and ".join(
        f"{length_text(apart_m[k], scene.metric)} from {shorten(posed[k][0], MAX_LETTERS)}" for k in nearest
    )
    truth = trace.problem.truth_cam_from_map
    more = " It is an image of the map itself." if len(others) < len(scene.references) else ""
    return f"Taken {told}.{more}" + ("" if truth is None else " Its truth is the pose that the map's files give it.")
