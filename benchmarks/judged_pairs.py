"""How sure the poses of pairs of rendered images are, and which of them are right."""

from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pycolmap

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.frontend.features import extract
from spherloc.geometry import rotation_angle
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.parallel import as_completed
from spherloc.mapping.two_view.pairs import SURE, ImagePairs, relative
from spherloc.types import FloatArray
from spherloc_viz.commands.map import how_of

RIGHT_DEG = 3.0, 10.0
"""A pair is right if its rotation and the direction to the second camera are off by no more."""
STEPS = (0.0, SURE / 4.0, SURE / 2.0, SURE, 2.0 * SURE, np.inf)


def judged_pairs(folder: Path, poses: Sequence[FloatArray], features: str) -> list[tuple[float, bool]]:
    """How sure each pair of the images in a folder is, and whether its pose is right; ``poses`` (3, 4) are the true
    ones in the order of the names."""
    how, views = how_of(features), photographs(folder, {}).views
    found = dict(as_completed(lambda index: extract(views[index], how.features), range(len(views))))
    images = [found[index] for index in range(len(views))]
    usable = [
        np.arange(len(image))
        if isinstance(view.camera, Equirectangular)
        else np.flatnonzero(view.camera.unproject(image.pixels)[0][:, 2] > 0.1)
        for image, view in zip(images, views, strict=True)
    ]
    every = list(combinations(range(len(views)), 2))
    cameras = [view.camera for view in views]
    pairs = ImagePairs(pycolmap, cameras, images, usable, [None] * len(views), how.matching, frozenset(every))
    judged = []
    for (first, second), (matches, geometry) in as_completed(lambda pair: pairs.compare(*pair), every):
        if geometry is None or pairs.same_place(geometry):
            continue
        rotation, way = relative(geometry)
        true = poses[second][:, :3] @ poses[first][:, :3].T
        true_way = poses[second][:, 3] - true @ poses[first][:, 3]
        aside = np.degrees(np.arccos(np.clip(way @ true_way / np.linalg.norm(true_way), -1.0, 1.0)))
        right = np.degrees(rotation_angle(rotation @ true.T)) <= RIGHT_DEG[0] and aside <= RIGHT_DEG[1]
        judged.append((pairs.sureness(first, second, matches, geometry), bool(right)))
    return judged


def print_table(found: Sequence[tuple[float, bool]]) -> None:
    """Print how many right and wrong pairs are how sure; they should be by ``SURE``."""
    print("| how sure | right pairs | wrong pairs |\n|---|---|---|")
    for low, high in pairwise(STEPS):
        some = [right for value, right in found if low <= value < high]
        print(f"| {low:g} to {high:g} | {sum(some)} | {len(some) - sum(some)} |")
