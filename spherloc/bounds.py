"""Bounds on the error of a measured bearing: its noise, and the error of the gravity by which it was aligned."""

from dataclasses import dataclass

import numpy as np

from spherloc.errors import InputError, show
from spherloc.problem import AlignedProblem
from spherloc.ranges import MAX_PX, MIN_PX
from spherloc.types import FloatArray

MIN_BOUND_PX, MAX_BOUND_PX = MIN_PX / 100, 100 * MAX_PX
"""Limits of ``bound_px``: wider than those for users, since a diagnosis tries other bounds."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of an inlier's residual, for M correspondences."""

    noise_px: float
    """Bound on the reprojection error at a pose whose tilt is right, px."""
    pixels: FloatArray
    """(M,) bound on the reprojection error at a pose with the given gravity, px: the noise and the gravity bound."""
    radians: FloatArray
    """(M,) bound on the angular error of the aligned bearing, rad."""


def bounds_of(aligned: AlignedProblem, bound_px: float) -> Bounds:
    """Bounds of every bearing from one pixel bound: times the largest singular value of the unprojection's Jacobian,
    plus the gravity bound.

    Residuals are measured in the tangent plane, so that the angle is the arcsine of that product. Raises ``InputError``
    for a bound that the estimators cannot compute with.
    """
    if not MIN_BOUND_PX <= bound_px <= MAX_BOUND_PX:
        raise InputError(f"bound_px is {show(bound_px)}; give a number of pixels from {MIN_PX:g} to {MAX_PX:,.0f}.")
    gravity_rad = aligned.gravity_bound_rad
    radians = np.arcsin(np.minimum(1.0, bound_px * aligned.radians_per_pixel)) + gravity_rad
    pixels = bound_px + gravity_rad * aligned.pixels_per_radian
    return Bounds(bound_px, pixels, np.minimum(radians, np.pi / 2))
