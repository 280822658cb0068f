"""SVD: the direct linear transform on bearings, the paper's linear 6-DoF solver for the unified sphere.

    v_i x (A p_i + b) = 0,   [A | b] = alpha [R | t]

Two independent rows a correspondence, twelve unknowns up to scale: six correspondences. The null vector comes from a
singular value decomposition, its sign from positive depths, R is the rotation closest to A, and t solves the rows again
with R given. Works on the whole sphere. The rows weigh far points more than near ones and ignore that A is a rotation,
so it is not statistically optimal.

Degenerate if the points lie in one plane or on a twisted cubic with the camera (noise then decides the pose).

Abdel-Aziz, Karara: Direct linear transformation from comparator coordinates into object space coordinates in
close-range photogrammetry, 1971. Conditioning: Hartley, In defense of the eight-point algorithm, PAMI 1997.
"""

import numpy as np

from spherloc.solvers.base import Many, checked, poses_of_samples
from spherloc.solvers.linear_pose import condition_each, linear_poses, tangents_of
from spherloc.types import FloatArray


class Svd:
    """The direct linear transform on bearings."""

    name = "SVD"
    sample_size = 6
    pinhole = False

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; at most one pose."""
        bearings, points = checked(self, bearings, points)
        return self.solve_each(bearings[None], points[None])[0]

    def solve_each(self, bearings: FloatArray, points: FloatArray) -> Many:
        """At most one pose for each of B samples: ``bearings`` (B, K, 3) and ``points`` (B, K, 3), metres."""
        conditioned, middle, scale, exists = condition_each(points)
        rotations, translations, solved = linear_poses(bearings, conditioned, tangents_of(bearings))
        translations = translations / scale[:, None] - np.einsum("bij,bj->bi", rotations, middle)
        return poses_of_samples(rotations, translations, exists & solved)
