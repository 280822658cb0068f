"""Finds posed images that see the same places from other positions, so that points can be triangulated between them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from spherloc.cameras.base import Camera, in_image
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.triangulation import TriangulationLift
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre
from spherloc.types import BoolArray, FloatArray

_NEIGHBOURS = 64
"""Number of nearest views among which partners are chosen."""
_OTHERS = 4
"""Largest number of partners of a view; each costs one matching, once."""
_GROWTH = 2.0
"""Least ratio of a partner's distance to that of the one before: near things need a short baseline, far things a long
one."""
_MIN_SHARED = 0.25
"""Least share of a view's directions that a partner must see too."""
_DIRECTIONS = 300


def with_triangulation(
    views: Sequence[View], options: FrontendOptions, together: Sequence[Sequence[int]] | None = None
) -> tuple[View, ...]:
    """The views, all with poses; those without a lift get one that triangulates with other views.

    ``together`` has, for each view, the indices of views that are always used if they look the same way, such as those
    of its rig.
    """
    with_lifts = []
    for view, places in zip(views, partners(views, together), strict=True):
        others = tuple(views[at] for at in places)
        lift = view.lift or TriangulationLift(view, others, options.features, options.matching)
        with_lifts.append(replace(view, lift=lift))
    return tuple(with_lifts)


def partners(views: Sequence[View], together: Sequence[Sequence[int]] | None = None) -> list[list[int]]:
    """For each of R views with poses, the indices of its partners: views that see the same from other positions."""
    if len(views) < 2:
        return [[] for _ in views]
    from scipy.spatial import KDTree  # takes half a second

    poses = np.array([view.cam_from_map for view in views])
    centres = np.stack([camera_centre(pose) for pose in poses])
    distances, nearest = map(np.asarray, KDTree(centres).query(centres, k=min(_NEIGHBOURS, len(views))))
    chosen = []
    for index in range(len(views)):
        alike = partial(_sees_the_same, index, views=views, poses=poses)
        first = [at for at in (together[index] if together is not None else ()) if at != index]
        near = zip(distances[index].tolist(), nearest[index].tolist(), strict=True)
        rest = [(distance, at) for distance, at in near if at not in first and at != index]
        chosen.append([at for at in first if alike(at)] + spread(rest, alike))
    return chosen


def _sees_the_same(index: int, other: int, views: Sequence[View], poses: FloatArray) -> bool:
    """Whether view ``other`` sees enough of the directions that view ``index`` sees; ``poses`` is (R, 3, 4)."""
    directions = _lattice()[_sees(views[index].camera)] @ poses[index, :, :3]
    pixels, seen = views[other].camera.project(directions @ poses[other, :, :3].T)
    seen &= in_image(views[other].camera, pixels)
    return len(directions) > 0 and bool(seen.mean() >= _MIN_SHARED)


@lru_cache(maxsize=1)
def _lattice() -> FloatArray:
    """Unit vectors (D, 3), spread evenly over the sphere: a Fibonacci lattice."""
    height = 1.0 - 2.0 * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    turn = np.arange(_DIRECTIONS) * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    return np.column_stack([radius * np.cos(turn), height, radius * np.sin(turn)])


@lru_cache(maxsize=64)
def _sees(camera: Camera) -> BoolArray:
    """Mask (D,) of the directions of the lattice that lie in the camera's image."""
    pixels, seen = camera.project(_lattice())
    return seen & in_image(camera, pixels)


def spread(near: Sequence[tuple[float, int]], alike: Callable[[int], bool]) -> list[int]:
    """At most ``_OTHERS`` of the ``alike`` ones among ``near``, (distance, index) by rising distance, whose distances
    grow by ``_GROWTH``."""
    found, last = [], 0.0
    for distance, other in near:
        if distance > 0.0 and distance >= _GROWTH * last and len(found) < _OTHERS and alike(other):
            found.append(other)
            last = distance
    return found
