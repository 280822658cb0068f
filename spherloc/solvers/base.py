"""What a pose solver offers to RANSAC, which knows nothing else of it."""

from numbers import Integral
from typing import Any, Protocol

import numpy as np

from spherloc import registry
from spherloc.errors import InputError, ProblemError, show
from spherloc.geometry import pose
from spherloc.types import BoolArray, FloatArray, IntArray

NO_POSES = np.empty((0, 3, 4))
"""What a solver returns that has found none."""
NO_POSES.setflags(write=False)
LARGEST_SAMPLE = 100
"""Correspondences; no minimal solver needs that many, and RANSAC could not find a clean sample of them."""


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
    """``bearings`` (N, 3) and ``points`` (N, 3), metres, as kernels want them: contiguous, float64.

    Raises ``ProblemError`` for other shapes, too few correspondences, or bearings behind a pinhole.
    """
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


Many = tuple[FloatArray, IntArray]
"""Poses (P, 3, 4), cam_from_map, and the sample (P,) that each is a solution of, ascending."""


def solve_each(
    solver: Solver, bearings: FloatArray, points: FloatArray, pixel_from_bearing: FloatArray | None = None
) -> Many:
    """The solver's poses of each of B samples: ``bearings`` (B, K, 3) and ``points`` (B, K, 3), metres.

    A solver may have a method ``solve_each`` that does the same at once, for a fraction of the time. One that weighs
    correspondences by their covariances takes ``pixel_from_bearing`` (B, K, 2, 3) there too: the derivative of the
    pixel by the unit bearing.
    """
    at_once = getattr(solver, "solve_each", None)
    if at_once is not None:
        return at_once(bearings, points, *(() if pixel_from_bearing is None else (pixel_from_bearing,)))
    found = [solver.solve(one, some) for one, some in zip(bearings, points, strict=True)]
    sample = np.repeat(np.arange(len(found)), [len(solutions) for solutions in found])
    return np.concatenate([NO_POSES, *found]), sample


def poses_of_samples(rotations: FloatArray, translations: FloatArray, exists: BoolArray) -> Many:
    """One pose a sample from R (B, 3, 3) and t (B, 3) where it ``exists`` (B,) and all its numbers are finite."""
    found = np.concatenate([rotations, translations[:, :, None]], axis=2)
    sample = np.flatnonzero(exists & np.isfinite(found).all(axis=(1, 2)))
    return found[sample], sample


def poses(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """One pose (1, 3, 4), or none (0, 3, 4) if a number is not finite."""
    solution = pose(rotation, translation)[None]
    return solution if np.isfinite(solution).all() else NO_POSES


def solver_of(name: str) -> Solver:
    """The solver registered as ``name``: an object of its class, which is made without arguments.

    Raises ``InputError`` if there is none of that name, or if it is an extension that is no ``Solver``.
    """
    kind = registry.lookup("solvers", name)
    what = registry.title("solvers", name)
    if not isinstance(kind, type):
        raise InputError(f"{what} is {show(kind)}, which is no class; tell its authors.")
    with registry.guarded("solvers", name):
        solver: Any = kind()
    size = getattr(solver, "sample_size", None)
    good = {
        "name": isinstance(getattr(solver, "name", None), str),
        "sample_size": isinstance(size, Integral) and 1 <= int(size) <= LARGEST_SAMPLE,
        "pinhole": isinstance(getattr(solver, "pinhole", None), bool),
        "solve()": callable(getattr(solver, "solve", None)),
    }
    wrong = [part for part, fits in good.items() if not fits]
    if wrong:
        raise InputError(f"{what} has no usable {' and no '.join(wrong)}; tell its authors.")
    return _Checked(solver, what) if registry.extension_of("solvers", name) else solver


class _Checked:
    """An extension's solver, whose answers are looked at before they are believed."""

    def __init__(self, solver: Solver, what: str) -> None:
        self.name, self.sample_size, self.pinhole = solver.name, int(solver.sample_size), solver.pinhole
        self._solve, self._what = solver.solve, what

    def solve(self, bearings: FloatArray, points: FloatArray) -> FloatArray:
        """See ``Solver.solve``; poses with a number that is not finite are left out.

        Raises ``InputError`` for what are no poses.
        """
        found = np.asarray(self._solve(bearings, points), dtype=np.float64)
        if found.ndim != 3 or found.shape[1:] != (3, 4):
            raise InputError(f"{self._what} returned an array of shape {found.shape}, not (S, 3, 4); tell its authors.")
        return found[np.isfinite(found).all(axis=(1, 2))]
