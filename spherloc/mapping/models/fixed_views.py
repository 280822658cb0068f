"""Images that were taken together by cameras whose calibration says how they are fixed to each other: what it tells of
pairs of them, and a map of a single moment, where it is all that places them.

Four fisheyes of a car at a single moment share thin parts of their views. Neighbours match there, but no point is seen
by three of them, so that nothing ties the lengths of their baselines to each other. The calibration does.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from spherloc.frontend.view import View
from spherloc.geometry import inverse_pose
from spherloc.mapping.alignment.fixed_images import MIN_BASELINE_M, FixedImages
from spherloc.mapping.models.later import with_images
from spherloc.mapping.models.misplaced import fits
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.two_view.matched import Matched
from spherloc.mapping.two_view.pairs import MIN_MATCHES, relative
from spherloc.mapping.two_view.triangles import Pair, Relative


def fixed_pairs(views: Sequence[View], fixed: FixedImages | None) -> dict[Pair, Relative]:
    """The relative poses of images that were taken together, by the places of both among ``views``; none without a
    calibration, and none of cameras that it has in one place."""
    if fixed is None:
        return {}
    places = {view.name: place for place, view in enumerate(views)}
    found: dict[Pair, Relative] = {}
    for names in fixed.times.values():
        for one, other in combinations(sorted(places[name] for name in names), 2):
            first, second = (fixed.body_from_camera[views[place].name] for place in (one, other))
            second_from_first = np.linalg.inv(second) @ first
            length_m = float(np.linalg.norm(second_from_first[:3, 3]))
            if length_m > MIN_BASELINE_M:
                found[one, other] = second_from_first[:3, :3], second_from_first[:3, 3] / length_m
    return found


def placed_by_calibration(pycolmap: Any, matched: Matched, fixed: FixedImages) -> Reconstruction | None:
    """The map of images of one time where the calibration has them, in the frame of the body, metres, without those
    that match no other one; None if no more of the matches agree with it than contradict it."""
    names, counts = matched.names, matched.counts()
    poses = {name: inverse_pose(matrix[:3]) for name, matrix in fixed.body_from_camera.items()}
    balance = 0
    for (one, other), geometry in matched.verified.items():
        agrees = fits(poses[names[one]], poses[names[other]], relative(geometry)[0])
        balance += len(geometry.inlier_matches) if agrees else -len(geometry.inlier_matches)
    if balance <= 0:
        return None
    every = counts + matched.same_place
    empty = Reconstruction(pycolmap.Reconstruction(), {}, counts, (), every, matched.database, matched.ids)
    matching = [name for name, best in zip(names, counts.max(axis=1).tolist(), strict=True) if best >= MIN_MATCHES]
    made = with_images(empty, {name: poses[name] for name in matching}, adjust=False)
    return made if len(made.model.points3D) >= MIN_MATCHES else None
