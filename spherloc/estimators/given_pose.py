"""A pose that another program found, as a run: nothing is searched, only its inliers are counted.

It is not offered in lists of estimators (``registry.UNLISTED``): ``spherloc diagnose`` asks for it.
"""

from dataclasses import dataclass

import numpy as np

from spherloc.bounds import Bounds
from spherloc.errors import InputError
from spherloc.estimators.base import Clock, Estimate
from spherloc.geometry import pose
from spherloc.problem import AlignedProblem
from spherloc.ranges import is_number
from spherloc.refine import RefinementOptions, residuals_px
from spherloc.trajectory import rotation_from_wxyz
from spherloc.types import FloatArray

LENGTH_TOLERANCE = 1e-3
"""Of the quaternion."""
LEAST = 1e-12
"""Smaller numbers of a pose are rounding, and 0."""


@dataclass(frozen=True)
class GivenPoseOptions(RefinementOptions):
    """The pose ``cam_from_map`` in the problem's own frames: x_cam = R x_map + t."""

    bound_px: float = 3.0
    """Bound on the noise of an inlier, px."""
    qw: float = 1.0
    """Real part of the unit quaternion of R."""
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0
    tx: float = 0.0
    """First coordinate of t, in the map's unit."""
    ty: float = 0.0
    tz: float = 0.0

    def __post_init__(self) -> None:
        """Raises ``InputError`` for what is no pose."""
        super().__post_init__()
        numbers = [self.bound_px, *self.quaternion, self.tx, self.ty, self.tz]
        if not all(is_number(number) and np.isfinite(number) for number in numbers) or self.bound_px <= 0.0:
            raise InputError("a given pose needs seven finite numbers and a positive bound_px.")
        if abs(np.linalg.norm(self.quaternion) - 1.0) > LENGTH_TOLERANCE:
            raise InputError("the quaternion of a given pose must have the length 1.")

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """w, x, y, z."""
        return self.qw, self.qx, self.qy, self.qz

    @property
    def cam_from_map(self) -> FloatArray:
        """(3, 4)."""
        return pose(rotation_from_wxyz(np.array(self.quaternion)), np.array([self.tx, self.ty, self.tz]))


class GivenPose:
    """Found under "given-pose"."""

    Options = GivenPoseOptions

    @staticmethod
    def run(aligned: AlignedProblem, options: GivenPoseOptions, bounds: Bounds, seed: int, clock: Clock) -> Estimate:
        """Count the correspondences within the bound of the given pose."""
        with clock.stage("inliers"):
            cam_from_map = aligned.align_pose(options.cam_from_map)
            inliers = residuals_px(aligned, cam_from_map) <= options.bound_px
        return Estimate((), cam_from_map, inliers, note="The pose was given, not searched for.")
