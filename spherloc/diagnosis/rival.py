"""A rival of a pose: a clearly different one that fits all matches about as well.

Matches far away or near one line leave a whole range of poses. Then a few wrong matches that agree with one end of the
range, and with each other by chance, fix the pose there, with small covariance, though others agree with another pose
as well. So the pose is searched anew without the inliers on which its position depends most.
"""

from dataclasses import dataclass

import numpy as np

from spherloc.bounds import bounds_of
from spherloc.consensus.two_point_search import search_two_point
from spherloc.diagnosis.evidence import FEW, different, subset
from spherloc.diagnosis.information import pivotal
from spherloc.free_gravity import count_distinct
from spherloc.geometry import pose, yaw_rotation
from spherloc.problem import AlignedProblem
from spherloc.refine import RefinementOptions, refine, residuals_px
from spherloc.types import BoolArray, FloatArray

SHARE = 6
"""One inlier in so many is left out."""
MIN_WORSE = 2.0
"""Number of matches, within the noise or not, by which a rival must explain less for the pose to be believed."""
SAMPLES, CONFIDENCE = 2000, 0.99
"""Samples and confidence of the search."""


@dataclass(frozen=True)
class Rival:
    """How a rival compares with the pose."""

    worse: float
    """By how much more its truncated squares are, in matches: one that a pose does not explain counts 1, one that it
    explains the square of its residual in bounds."""
    own: int
    """Number of different matches that agree with the rival alone."""
    lost: int
    """Number of different matches that agree with the pose alone."""

    @property
    def margin(self) -> float:
        """How far it is from the limit below which the pose is doubted, in matches."""
        return self.worse - MIN_WORSE

    @property
    def sentence(self) -> str:
        """What speaks against the pose."""
        return (
            f"Another pose fits all matches about as well: {self.own} different ones agree with it alone, {self.lost} "
            "with this one alone."
        )


def rival_of(
    aligned: AlignedProblem, cam_from_map: FloatArray, inliers: BoolArray, options: RefinementOptions, bound_px: float
) -> Rival | None:
    """The rival of an aligned pose (3, 4) with ``inliers`` (M,) that is found without some of these; None without one,
    and for fewer than ``FEW`` inliers."""
    size = int(np.count_nonzero(inliers))
    if size < FEW:
        return None
    part = subset(aligned, ~pivotal(aligned, cam_from_map, inliers, options, size // SHARE))
    bounds = bounds_of(part, bound_px)
    found = search_two_point(part, bounds.pixels, 0, SAMPLES, CONFIDENCE, local_optimization=True)
    if not found.found:
        return None
    best = int(np.argmax(found.support))
    start = pose(yaw_rotation(found.yaws_rad[best]), found.translations[best])
    other = refine(part, start, bounds, options)[0]
    if not different(cam_from_map, other):
        return None
    this_px, other_px = residuals_px(aligned, cam_from_map), residuals_px(aligned, other)
    squares = np.square(np.minimum([this_px, other_px], bound_px) / bound_px).sum(axis=1)
    return Rival(
        worse=float(squares[1] - squares[0]),
        own=count_distinct(aligned, (other_px <= bound_px) & (this_px > bound_px)),
        lost=count_distinct(aligned, (this_px <= bound_px) & (other_px > bound_px)),
    )
