"""A frame: one stop on a run's timeline, before it is turned into primitives."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spherloc.geometry import camera_centre, pose
from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.layers.primitives import Chart, ColorArray, FloatArray, SceneItem, Step, Table

SPHERE_SHARE = 0.17
"""Radius at which the unit sphere is drawn, as a share of the map's typical extent."""
FEW_DOTS = 200
"""Up to this many, dots have their full size."""


@dataclass(frozen=True, eq=False)
class Frame:
    """What is known at one step."""

    step: Step
    cam_from_map: FloatArray
    """Pose (3, 4) between the aligned frames: the camera's, or where to stand before a position is known."""
    colors: ColorArray
    """(N, 3) colour of every correspondence."""
    rays: np.ndarray
    """(N,) mask: correspondences whose match is drawn as a line."""
    located: bool = False
    """Whether the position is an estimate (the camera is drawn) or a place to stand (only the sphere is)."""
    sphere_aside: bool = False
    """Whether the sphere stays in the middle of the map, where it does not hide the estimated position."""
    extra: Callable[[], tuple[SceneItem, ...]] = tuple
    """What this stage adds to the canvas."""
    charts: tuple[Chart, ...] = ()
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True, eq=False)
class RunView:
    """A trace and what all of its frames share."""

    trace: Trace

    @cached_property
    def points(self) -> FloatArray:
        """Map points (N, 3) in the aligned map frame, metres."""
        return self.trace.problem.points @ self.trace.problem.aligned.map_turn.T

    @cached_property
    def middle(self) -> FloatArray:
        """Component-wise median (3,) of the map points."""
        return np.median(self.points, axis=0)

    @cached_property
    def sphere_m(self) -> float:
        """Radius at which the unit sphere is drawn, metres."""
        extent = float(np.median(np.linalg.norm(self.points - self.middle, axis=1)))
        return SPHERE_SHARE * max(extent, 1e-3)

    @cached_property
    def dot_m(self) -> float:
        """What dots are measured by, metres: the sphere's radius, less where there are many."""
        return self.sphere_m * min(1.0, (FEW_DOTS / len(self.points)) ** (1 / 3))

    @cached_property
    def truth(self) -> FloatArray | None:
        """True pose (3, 4) between the aligned frames, if known."""
        known = self.trace.problem.truth_cam_from_map
        return None if known is None else self.trace.problem.aligned.align_pose(known)

    def standing(self, rotation: FloatArray) -> FloatArray:
        """A pose (3, 4) in the middle of the map with a given rotation: where to draw before a position is known."""
        return pose(rotation, -rotation @ self.middle)

    def aligned_pose(self, cam_from_map: FloatArray) -> FloatArray:
        """A pose (3, 4) of the trace, between the aligned frames."""
        return self.trace.problem.aligned.align_pose(cam_from_map)

    def colors(self, color: style.RGB, *marks: tuple[np.ndarray, style.RGB]) -> ColorArray:
        """(N, 3): one colour for all, then others for masks or indices, later ones winning."""
        out = np.tile(np.array(color, np.uint8), (len(self.points), 1))
        for where, mark in marks:
            out[where] = mark
        return out

    def nobody(self) -> np.ndarray:
        """An empty mask (N,)."""
        return np.zeros(len(self.points), dtype=bool)

    def position(self, cam_from_map: FloatArray) -> str:
        """Camera position of an aligned pose in the problem's own map frame, as text."""
        x, y, z = camera_centre(self.trace.problem.aligned.unalign_pose(cam_from_map))
        return f"({x:.2f}, {y:.2f}, {z:.2f}) m"


def one_color(color: style.RGB, count: int) -> ColorArray:
    """(count, 3) of one colour."""
    return np.tile(np.array(color, np.uint8), (count, 1))


def even(indices: np.ndarray, count: int) -> np.ndarray:
    """At most ``count`` of the indices, evenly spaced."""
    places = np.unique(np.linspace(0, len(indices) - 1, min(count, len(indices))).round().astype(int))
    return indices[places]
