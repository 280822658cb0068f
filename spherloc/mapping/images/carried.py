"""Finds what moves with the camera below panoramas: a tripod, the hand, the car that carries it.

It is seen in the same direction from the camera in every image, wherever that was taken, and so ties images of
different places to each other. Of the ground that is not so: where the camera moved, it is in another direction.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.frontend.features import Features, extract
from spherloc.frontend.masks import around
from spherloc.frontend.matching import match
from spherloc.frontend.view import View
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.types import BoolArray, FloatArray

BELOW_DEG = 60.0
"""Half the opening angle of the cone around straight down, the camera's +y axis, that is searched."""
SAME_RAD = float(np.radians(2.0))
"""Two features count as in the same direction if they are closer than this."""
MIN_SAME = 4
"""Least number of matches in the same direction by which a pair of images speaks for something that is carried: of
fifty wrong matches, hardly one is."""
MIN_SHARE = 1 / 3
"""Least share of the pairs that must speak for it."""
MIN_IMAGES, MAX_IMAGES = 3, 12
"""Of more images, this many are compared, spread over all."""
QUANTILE, MARGIN_DEG = 0.95, 5.0
"""The cone that is left out holds, in the median of the pairs, this share of the matches in the same direction, and a
margin."""


def carried_nadir_deg(views: Sequence[View], tell: Tell) -> float:
    """Half the opening angle, degrees, of the cone around straight down that holds what moves with the camera.

    0 if nothing is found: where few of the pairs of images have matches in the same direction, where images are not
    panoramas, or where there are fewer than ``MIN_IMAGES``. Raises ``InputError`` for an image that cannot be read.
    """
    panoramas = [view for view in views if isinstance(view.camera, Equirectangular)]
    if len(panoramas) < max(MIN_IMAGES, len(views)):
        return 0.0
    spread = np.unique(np.linspace(0, len(panoramas) - 1, MAX_IMAGES).round().astype(int))
    below: dict[int, tuple[Features, FloatArray]] = {}
    for index, found in as_completed(lambda index: _features_below(panoramas[index]), spread.tolist()):
        below[index] = found
        tell("images searched for what moves with the camera", len(below), len(spread))
    pairs = list(combinations([below[index] for index in spread.tolist()], 2))
    edges_deg = [edge for pair in pairs if (edge := _edge_deg(*pair)) is not None]
    if len(edges_deg) < MIN_SHARE * len(pairs):
        return 0.0
    return float(np.ceil(min(np.median(edges_deg) + MARGIN_DEG, BELOW_DEG)))


def _features_below(view: View) -> tuple[Features, FloatArray]:
    """Features below a panorama, and their bearings (N, 3)."""
    features = extract(replace(view, mask=partial(_below, view)))
    return features, view.camera.unproject(features.pixels)[0]


def _edge_deg(one: tuple[Features, FloatArray], other: tuple[Features, FloatArray]) -> float | None:
    """Angle from straight down, degrees, within which two images have most of their matches in the same direction;
    None if these are few. Each image is given by features and their bearings (N, 3)."""
    (features, rays), (features_there, rays_there) = one, other
    found = match(features, features_there)
    first = rays[found.query_index]
    same = (first * rays_there[found.reference_index]).sum(axis=1) > np.cos(SAME_RAD)
    if np.count_nonzero(same) < MIN_SAME:
        return None
    from_down = np.arccos(np.clip(first[same, 1], -1.0, 1.0))
    return float(np.degrees(np.quantile(from_down, QUANTILE)))


def _below(view: View) -> BoolArray:
    """Mask (H, W) of the pixels of a view that may be used and lie in the cone that is searched."""
    below = ~around(view.camera, BELOW_DEG, 0.0)
    return below if view.mask is None else below & view.mask()
