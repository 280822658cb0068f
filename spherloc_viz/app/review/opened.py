"""A recorded run that is open in the playground, and the cameras that stay on the canvas while other runs are tried."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spherloc import registry
from spherloc.geometry import camera_centre
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.app.catalog import Run, RunRequest
from spherloc_viz.layers.comparison import color_of
from spherloc_viz.layers.frame import RunView
from spherloc_viz.layers.primitives import Label, SceneItem
from spherloc_viz.layers.scene import camera
from spherloc_viz.recording.run_row import RunRow

SIZE, TOWER, STOREY = 1.55, 1.5, 1.0
"""Size of a recorded camera, and heights of the lowest name and of each above it, in sphere radii."""
SAME = 1e-9
"""Poses whose numbers differ by no more are one pose, which is drawn once."""
AS_RECORDED = "as recorded"


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded run to look at beside the one on the page."""

    row: RunRow
    cam_from_map: FloatArray | None
    """Its pose (3, 4), if it had one."""
    name: str = AS_RECORDED
    """What its camera is called."""


@dataclass(frozen=True, eq=False)
class Opened:
    """The run that is open, and what asks for it."""

    recorded: Recorded
    path: Path
    """Its file."""
    request: RunRequest
    """Request that gives the same run again."""
    truth_cam_from_map: FloatArray | None = None
    """The recorded problem's true pose (3, 4), if known."""
    sentence: str = ""
    """Why the page shows less than the scene would; empty if it shows the scene itself."""
    story: str = ""
    """What a curated case shows."""
    other: Recorded | None = None
    """A run of the same problem that it is compared with."""


def is_its_world(opened: Opened, run: Run) -> bool:
    """Whether places of the run that was opened mean something in the run on the page: another seed of a simulation
    draws another map, and with it another true camera."""
    one, other = opened.request.scene, run.request.scene
    truth, now = opened.truth_cam_from_map, run.trace.problem.truth_cam_from_map
    if truth is not None and is_same_pose(truth, now):
        return True
    same_scene = (one.scene, one.query) == (other.scene, other.query)
    return same_scene and (one.seed == other.seed or (truth is None and now is None))


def is_same_pose(one: FloatArray | None, other: FloatArray | None) -> bool:
    """Whether both are one pose, or both none."""
    if one is None or other is None:
        return one is other
    return bool(np.abs(one - other).max() <= SAME)


def reference_items(opened: Opened, run: Run) -> tuple[SceneItem, ...]:
    """The recorded cameras, with their names, where they differ from the one on the page."""
    if not is_its_world(opened, run):
        return ()
    view = RunView(run.trace)
    items: list[SceneItem] = []
    place = 0
    for one in (opened.recorded, opened.other):
        if (
            one is not None
            and one.cam_from_map is not None
            and not is_same_pose(one.cam_from_map, run.trace.cam_from_map)
        ):
            items += _camera(view, one, one.cam_from_map, place)
            place += 1
    return tuple(items)


def _camera(view: RunView, one: Recorded, cam_from_map: FloatArray, place: int) -> Sequence[SceneItem]:
    """A camera whose name stands above it, higher than those drawn before."""
    pose, color = view.aligned_pose(cam_from_map), _color(one.row.estimator)
    top = camera_centre(pose) - np.array([0.0, (TOWER + STOREY * place) * view.sphere_m, 0.0])
    lines = camera(f"recorded/{place}", pose, SIZE * view.sphere_m, color, 2.5)
    return lines, Label(f"recorded-names/{place}", "cameras", top, one.name)


def _color(estimator: str) -> style.RGB:
    """That of the estimator; one that is not installed has none."""
    return color_of(estimator) if estimator in registry.names("estimators") else style.UNDECIDED
