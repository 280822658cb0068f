"""Leaves out images that stand in a map otherwise than most of their matches say.

The rotation between two images with many matches is seldom wrong. COLMAP places an image by the points that are in the
map at the time: if these are of a place that looks alike, or of one plane, the image is put elsewhere, and the pairs
that would say so no longer count. And where clouds or other far things alone tell the distance, an image is put far
away from all others.
"""

from collections.abc import Mapping

import numpy as np

from spherloc.geometry import camera_centre, rotation_angle
from spherloc.mapping.models.model import Reconstruction
from spherloc.types import FloatArray

TURNED_RAD = float(np.radians(8.0))
"""Largest angle between the rotation of a pair and that of its images in the map. Directions say less: along a facade
that repeats itself, they are those of a camera that moved the other way."""

FAR_OFF, MIN_OTHERS = 3.0, 5
"""An image is far off if it is at least that many times as far from the nearest other one as any two of the others,
which are no fewer than the second number, are from each other."""


def without_misplaced(made: Reconstruction, rotations: Mapping[tuple[str, str], FloatArray]) -> Reconstruction:
    """The model without images of whose matches more speak against their place than for it.

    ``rotations`` (3, 3) are those of pairs of all images, the second from the first, by their names. Matches with an
    image of the map speak for the place if the rotation fits, else against it, and so do those with the best image that
    did not get into the map. The worst image is left out first.
    """
    place = {name: index for index, name in enumerate(made.ids)}
    poses, left_out = dict(made.poses), set[str]()
    while len(poses) > 1:
        balance = dict.fromkeys(poses, 0)
        outside = dict.fromkeys(poses, 0)
        for (one, other), rotation in rotations.items():
            count = int(made.matches[place[one], place[other]])
            for name, with_name in ((one, other), (other, one)):
                if name in poses and with_name in poses:
                    right = fits(poses[one], poses[other], rotation)
                    balance[name] += count if right else -count
                elif name in poses:
                    outside[name] = max(outside[name], count)
        worst = min(poses, key=lambda name: balance[name] - outside[name])
        if balance[worst] >= outside[worst]:
            break
        left_out.add(worst)
        del poses[worst]
    return made.without(left_out) if left_out else made


def far_off(poses: Mapping[str, FloatArray]) -> set[str]:
    """Names of images that are much farther from all others than these are from each other.

    ``poses`` (3, 4) are those of all images in a map, by their names.
    """
    names, left_out = sorted(poses), set[str]()
    centres = np.array([camera_centre(poses[name]) for name in names])
    while len(names) - len(left_out) > MIN_OTHERS:
        inside = [index for index, name in enumerate(names) if name not in left_out]
        apart = np.linalg.norm(centres[inside, None] - centres[inside], axis=2)
        nearest = np.where(np.eye(len(inside), dtype=bool), np.inf, apart).min(axis=1)
        farthest = int(nearest.argmax())
        others = np.delete(np.delete(apart, farthest, axis=0), farthest, axis=1)
        if nearest[farthest] <= FAR_OFF * others.max():
            break
        left_out.add(names[inside[farthest]])
    return left_out


def fits(one: FloatArray, other: FloatArray, rotation: FloatArray, bound_rad: float = TURNED_RAD) -> bool:
    """Whether the rotations of poses (3, 4) of two images agree with that of their relative pose (3, 3)."""
    return rotation_angle(other[:, :3] @ one[:, :3].T @ rotation.T) <= bound_rad
