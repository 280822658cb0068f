"""Judges a pose without a trusted truth, by how well the query's own depth fits the map (Sec. VI-B.2).

The paper does not say how it turns a registration into a number. Here the query's depth is carried into the map by the
estimated pose, and point-to-plane ICP (Chen and Medioni, 1992) moves it to where it fits best: how far its points are
moved is the error. Where they do not fit even then, the pose is wrong and the error infinite.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera, in_image
from spherloc.errors import InputError
from spherloc.frontend.view import Lift, View
from spherloc.geometry import pose, so3_exp, transform
from spherloc.types import FloatArray

SAMPLES = 6000
"""Number of directions, spread evenly over the sphere, in which a depth map is sampled."""
NORMAL_STEP_PX = 3.0
"""Distance of the neighbours that a surface's normal is taken from."""
ROUNDS = 40
GATES_M = (1.0, 0.2)
"""Points farther from the map than this are left out: the limit of the first and of the last round, between which it
shrinks."""
STILL_M = 1e-4
FITS_M = 0.1
MIN_FIT = 0.4
"""Share of the query's upright surfaces that must lie within ``FITS_M`` of the map: floors fit anywhere."""
UPRIGHT = 0.7
"""A surface counts as upright if the component of its unit normal along gravity is less than this."""


class Registration(Protocol):
    """Registers the point clouds of a query and of the references that it was matched with."""

    @property
    def thresholds_m(self) -> tuple[float, ...]:
        """Registration errors below which a localization counts as a success, strictest first."""
        ...

    def __call__(self, query: View, cam_from_map: FloatArray, references: tuple[View, ...]) -> float:
        """Registration error, metres, of the query's depth at an estimated pose (3, 4); inf if it does not fit.

        Raises ``InputError`` if a depth map cannot be read.
        """
        ...


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of surfaces and their normals."""

    points: FloatArray
    """(K, 3), metres."""
    normals: FloatArray
    """(K, 3), unit."""


@dataclass(frozen=True)
class DepthRegistration:
    """Registers depth maps."""

    thresholds_m: tuple[float, ...]
    """See ``Registration``."""
    gravity_map: tuple[float, float, float]
    """Unit vector pointing down in the map frame."""
    query_lift: Callable[[View], Lift]
    """Lift of a query that gives points in its camera frame."""

    def __call__(self, query: View, cam_from_map: FloatArray, references: tuple[View, ...]) -> float:
        """See ``Registration``."""
        own = surfaces(query.camera, self.query_lift(query))
        maps = [surfaces(view.camera, view.lift) for view in references if view.lift is not None]
        if not len(own.points) or not sum(len(found.points) for found in maps):
            raise InputError(f"{query.name}: no depth to register; give depth maps of the query and its references.")
        points = np.concatenate([found.points for found in maps])
        normals = np.concatenate([found.normals for found in maps])
        rotation = cam_from_map[:, :3].T
        start = SurfacePoints(
            transform(pose(rotation, -rotation @ cam_from_map[:, 3]), own.points), own.normals @ rotation.T
        )
        return registration_error_m(start, SurfacePoints(points, normals), np.array(self.gravity_map))


def surfaces(camera: Camera, lift: Lift) -> SurfacePoints:
    """The surfaces around a camera that a lift gives points of, in the lift's own frame."""
    pixels, seen = camera.project(_sphere(SAMPLES))
    pixels = pixels[seen & in_image(camera, pixels)]
    corners = [lift(pixels + step) for step in ([0.0, 0.0], [NORMAL_STEP_PX, 0.0], [0.0, NORMAL_STEP_PX])]
    (here, known), (right, right_known), (below, below_known) = corners
    across = np.cross(right - here, below - here)
    length = np.linalg.norm(across, axis=1)
    good = known & right_known & below_known & (length > 0)
    return SurfacePoints(here[good], across[good] / length[good, None])


def registration_error_m(start: SurfacePoints, fixed: SurfacePoints, down: FloatArray) -> float:
    """RMS distance (metres) by which ICP moves ``start`` until it fits ``fixed``; inf if it does not fit.

    ``down`` is the unit vector (3,) of gravity.
    """
    from scipy.spatial import KDTree  # takes half a second

    tree = KDTree(fixed.points)
    points, normals = start.points, start.normals
    for gate in np.geomspace(*GATES_M, ROUNDS):
        distance, nearest = tree.query(points, distance_upper_bound=gate)
        near = np.isfinite(distance)
        if near.sum() < 6:
            return np.inf
        found = np.asarray(nearest)[near]
        motion = _step(points[near], fixed.points[found], fixed.normals[found])
        moved = transform(motion, points)
        normals = normals @ motion[:, :3].T
        still = float(np.abs(moved - points).max()) < STILL_M
        points = moved
        if still and gate <= 2 * GATES_M[1]:
            break
    upright = np.abs(normals @ down) < UPRIGHT
    if not upright.any() or np.mean(tree.query(points[upright])[0] < FITS_M) < MIN_FIT:
        return np.inf
    return float(np.sqrt(np.mean(np.sum((points - start.points) ** 2, axis=1))))


def _step(points: FloatArray, targets: FloatArray, normals: FloatArray) -> FloatArray:
    """The small motion (3, 4) that brings points (K, 3) closest to the planes through their targets."""
    middle = points.mean(axis=0)
    rows = np.column_stack([np.cross(points - middle, normals), normals])
    offset = np.einsum("ni,ni->n", targets - points, normals)
    solved = np.asarray(np.linalg.lstsq(rows, offset, rcond=1e-6)[0], np.float64)
    rotation = so3_exp(solved[:3])
    return pose(rotation, middle - rotation @ middle + solved[3:])


def _sphere(count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3) spread evenly: a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    height, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - height**2)
    return np.column_stack([across * np.cos(angle), height, across * np.sin(angle)])
