"""What a run says about yaw, as curves over the whole circle, and windows of the circle."""

from dataclasses import dataclass

import numpy as np

from spherloc.geometry import yaw_of
from spherloc.trace import ConsensusStage, RansacStage, Trace, YawStage
from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.frame import RunView
from spherloc_viz.layers.primitives import Curve

Window = tuple[float, float]
"""Yaws from the first, in [-180, 180) degrees, to the second, which exceeds 180 where the window crosses the seam."""

ALL: Window = (-180.0, 180.0)
LEAST_WIDTH_DEG = 0.02


@dataclass(frozen=True, eq=False)
class YawStory:
    """What a run says about yaw, as curves over -180 to 180 degrees."""

    title: str
    y_label: str
    curves: tuple[Curve, ...]
    """Steps and levels over the whole circle; no markers."""
    hypotheses: tuple[tuple[float, int, str, str], ...]
    """Yaw (degrees), correspondences explained, name and key of the step (or "") of every pose that was tried."""
    top: float
    """The largest value."""
    estimate_deg: float | None
    truth_deg: float | None
    note: str
    """What is left out, as a sentence; may be empty."""


def yaw_story(trace: Trace) -> YawStory:
    """The curves of a run."""
    truth, estimate = _truth_deg(trace), None
    if trace.cam_from_map is not None:
        estimate = _yaw_deg(trace, trace.cam_from_map)
    yaw, exact, ransac = trace.stage(YawStage), trace.stage(ConsensusStage), trace.stage(RansacStage)
    curves: tuple[Curve, ...] = ()
    tried: tuple[tuple[float, int, str, str], ...] = ()
    note = ""
    title, y_label = "No stage of this run looked at the yaw", "matches"
    if yaw is not None:
        title, y_label = "Arcs that overlap at each yaw", "arcs"
        curves = (ring.step_curve("arcs that overlap", yaw.overlap),)
        estimate = float(np.degrees(yaw.yaw_rad))
    elif exact is not None:
        title, best = (
            "What a pose can explain at each yaw",
            int(exact.support.max(initial=exact.seed_support)),
        )
        ends = np.array(ALL)
        level = Curve("best pose", ends, np.full(2, float(best)), style.INLIER, "level")
        curves = (ring.step_curve("bound", exact.bound), level)
        poses = list(zip(exact.cam_from_map, exact.support.tolist(), strict=True))[: 1 + style.MAX_DRAWN_ALTERNATIVES]
        tried = tuple((_yaw_deg(trace, pose), support, "verified pose", "") for pose, support in poses)
        if len(poses) < len(exact.support):
            note = f"Of {len(exact.support):,} verified poses, the best {len(poses)} are shown as stems."
    elif ransac is not None:
        title = "Yaw of each best hypothesis so far"
        counts = np.count_nonzero(ransac.inlier_masks, axis=1).tolist()
        rows = zip(ransac.cam_from_map, counts, ransac.improved_at.tolist(), strict=True)
        tried = tuple(
            (_yaw_deg(trace, pose), count, f"sample {at + 1:,}", f"sample-{k}")
            for k, (pose, count, at) in enumerate(rows, 1)
        )
    values = [float(curve.y.max(initial=0.0)) for curve in curves] + [float(count) for _, count, *_ in tried]
    return YawStory(title, y_label, curves, tried, max([1.0, *values]), estimate, truth, note)


def _yaw_deg(trace: Trace, cam_from_map: FloatArray) -> float:
    return float(np.degrees(yaw_of(trace.problem.aligned.align_pose(cam_from_map)[:, :3])))


def _truth_deg(trace: Trace) -> float | None:
    truth = RunView(trace).truth
    return None if truth is None else float(np.degrees(yaw_of(truth[:, :3])))


def window_around(middle_deg: float, width_deg: float) -> Window:
    """The window of that middle and width, at most the circle."""
    if not width_deg < 359.0:
        return ALL
    width = max(width_deg, LEAST_WIDTH_DEG)
    low = round((middle_deg - 0.5 * width + 180.0) % 360.0 - 180.0, 9)
    return low, low + width


def places_of(yaw_deg: float, window: Window) -> list[float]:
    """Where a yaw is in a window: none, one, or two if it is at both ends of the circle."""
    low, high = window
    return [yaw for yaw in (yaw_deg - 360.0, yaw_deg, yaw_deg + 360.0) if low <= yaw <= high]
