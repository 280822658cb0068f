"""The search over camera positions: boxes that close in on the camera, coloured by what each could still explain."""

from functools import partial

import numpy as np

from spherloc.geometry import camera_centre
from spherloc.trace import ConsensusStage, PositionStage
from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.layers.frame import Frame, Plan, RunView, length
from spherloc_viz.layers.primitives import Focus, Segments

EDGES = np.array([(a, a | 1 << axis) for axis in range(3) for a in range(8) if not a >> axis & 1])
"""(12, 2) corners that the edges of a box join; bit k of a corner's number says at which end of axis k it is."""
FAINT, STRONG = np.array(style.UNDECIDED, float), np.array(style.CLIQUE, float)


def plans(view: RunView, stage: PositionStage) -> list[Plan]:
    """One step a level, from the box around the map to those around the camera."""
    out = []
    for rank, level in enumerate(np.unique(stage.level).tolist(), 1):
        left = int(stage.left[stage.level == level][0])
        title = f"{left:,} boxes could hold a better camera" if left != 1 else "One box could hold a better camera"
        out.append(Plan(f"positions-{rank}", title, partial(_level, view, stage, level)))
    return out


def _level(view: RunView, stage: PositionStage, level: int) -> Frame:
    mine = stage.level == level
    boxes, bound, left = stage.boxes_m[mine].astype(float), stage.bound[mine], int(stage.left[mine][0])
    most, count = int(bound.max()), len(view.points)
    size = np.sort(boxes[0, 1] - boxes[0, 0])
    pose = _best_pose(view)
    inside = "" if pose is None else _camera_inside(boxes, camera_centre(pose))
    last = level == stage.level[-1]
    end = (
        f" Smaller boxes are divided in yaw as well: in the end no pose explains more than {stage.upper_bound}."
        if last
        else " Each is halved, and halves that cannot explain more than the best pose are dropped."
    )
    drawn = f" The {len(boxes)} of them that could explain most are drawn." if len(boxes) < left else ""
    boxes_text = "box is" if left == 1 else "boxes are"
    return Frame(
        f"{left:,} {boxes_text} left, {length(size[0])} to {length(size[2])} long, in which a camera might explain "
        f"more than the {stage.support} matches of the best pose; one of them up to {most} of {count}.{end}",
        f"max over C ∈ box, θ of Σ 1(|el(p − C) − el(v)| ≤ β + ε) · 1(θ ∈ interval) = {most} > {stage.support}",
        view.standing(np.eye(3)) if pose is None else pose,
        view.colors(style.UNDECIDED),
        view.nobody(),
        note=f"Colour: from grey, one match more than the best pose, to gold, {most}.{inside}{drawn}",
        located=pose is not None,
        items=(_edges(boxes, _shades(bound, stage.support)),),
        focus=Focus("Overview", boxes.reshape(-1, 3)),
    )


def _best_pose(view: RunView) -> FloatArray | None:
    """The best pose (3, 4) of the search, between the aligned frames."""
    stage = view.trace.stage(ConsensusStage)
    return None if stage is None or not len(stage.cam_from_map) else view.aligned_pose(stage.cam_from_map[0])


def _camera_inside(boxes: FloatArray, centre: FloatArray) -> str:
    inside = ((boxes[:, 0] <= centre) & (centre <= boxes[:, 1])).all(axis=1).any()
    return " The best pose's camera is in one of them." if inside else ""


def _shades(bound: np.ndarray, support: int) -> ByteArray:
    """(B, 3): grey for the least that could beat the best pose, gold for the largest bound."""
    share = (bound - support) / max(1, int(bound.max()) - support)
    return np.round(FAINT + share[:, None] * (STRONG - FAINT)).astype(np.uint8)


def _edges(boxes: FloatArray, colors: ByteArray) -> Segments:
    ends = np.array([[corner >> axis & 1 for axis in range(3)] for corner in range(8)])
    corners = np.stack([boxes[:, ends[:, axis], axis] for axis in range(3)], axis=2)
    return Segments("boxes/positions", "boxes", corners[:, EDGES].reshape(-1, 2, 3), np.repeat(colors, 12, axis=0), 1.0)
