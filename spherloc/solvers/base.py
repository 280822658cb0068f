"""What a pose solver offers to RANSAC, which knows nothing else of it."""

from typing import Protocol

import numpy as np

from spherloc.errors import ProblemError
from spherloc.geometry import pose
from spherloc.types import FloatArray

NO_POSES = np.empty((0, 3, 4))
"""What a solver returns that has found none."""
NO_POSES.setflags(write=False)


class Solver(Protocol):
    """Finds all six degrees of freedom of a pose; it knows no gravity and no outliers."""

    name: str
    """As its paper calls it."""
    sample_size: int
    """Fewest correspondences that it solves."""
    pinhole: bool
    """Whether every bearing must have z > 0: it works on the image plane z = 1 of a pinhole and not on the sphere."""

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """Poses (S, 3, 4), cam_from_map, from unit ``bearings`` (K, 3) and ``points`` (K, 3), metres.

        S is 0 where the correspondences are degenerate. Raises ``ProblemError`` for other shapes, fewer than
        ``sample_size`` correspondences or, if ``pinhole``, a bearing with z <= 0.
        """
        ...


def checked(solver: Solver, bearings: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both arrays as kernels want them, or the ``ProblemError`` of ``Solver.solve``."""
    bearings = np.ascontiguousarray(bearings, dtype=np.float64)
    points = np.ascontiguousarray(points, dtype=np.float64)
    for what, array in (("bearings", bearings), ("points", points)):
        if array.ndim != 2 or array.shape != (len(bearings), 3):
            raise ProblemError(f"{solver.name}: {what} have shape {array.shape}; give ({len(bearings)}, 3).")
    if len(bearings) < solver.sample_size:
        raise ProblemError(f"{solver.name}: {len(bearings)} correspondences; give at least {solver.sample_size}.")
    if solver.pinhole and not (bearings[:, 2] > 0.0).all():
        raise ProblemError(f"{solver.name}: a bearing has z <= 0, which no pinhole sees; leave it out.")
    return bearings, points


def poses(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """One pose (1, 3, 4), or none (0, 3, 4) if a number is not finite."""
    solution = pose(rotation, translation)[None]
    return solution if np.isfinite(solution).all() else NO_POSES
