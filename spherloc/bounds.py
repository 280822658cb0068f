"""Bounds on the error of a measured bearing: its noise, and the error of the gravity that it was aligned by."""

from dataclasses import dataclass

import numpy as np

from spherloc.errors import InputError, show
from spherloc.problem import AlignedProblem
from spherloc.ranges import MAX_PX, MIN_PX
from spherloc.types import FloatArray

MIN_BOUND_PX, MAX_BOUND_PX = MIN_PX / 100, 100 * MAX_PX
"""What a diagnosis asks for may be some times wider or tighter than what people may give."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """What an inlier's residual may be. M correspondences."""

    noise_px: float
    """Bound on the reprojection error at a pose whose tilt is right, px."""
    pixels: FloatArray
    """(M,) bound on the reprojection error at a pose with the given gravity, px: the noise and the gravity bound."""
    radians: FloatArray
    """(M,) bound on the angular error of the aligned bearing, rad."""


def bounds_of(aligned: AlignedProblem, bound_px: float) -> Bounds:
    """Bounds of every bearing from one pixel bound, through the largest stretch of its unprojection, plus gravity.

    Residuals are measured in the tangent plane, so that ``bound_px`` reaches as far as the angle whose sine it is.
    Raises ``InputError`` for a bound that no estimator can reckon with.
    """
    if not MIN_BOUND_PX <= bound_px <= MAX_BOUND_PX:
        raise InputError(f"bound_px is {show(bound_px)}; give a number of pixels from {MIN_PX:g} to {MAX_PX:,.0f}.")
    gravity_rad = aligned.gravity_bound_rad
    radians = np.arcsin(np.minimum(1.0, bound_px * aligned.radians_per_pixel)) + gravity_rad
    pixels = bound_px + gravity_rad * aligned.pixels_per_radian
    return Bounds(bound_px, pixels, np.minimum(radians, np.pi / 2))
