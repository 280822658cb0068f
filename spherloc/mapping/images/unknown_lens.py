"""Calibrates a fisheye by the photographs that it took, where no calibration is known."""

from collections.abc import Sequence
from math import hypot, pi, radians
from pathlib import Path

import numpy as np

from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError, InputError
from spherloc.frontend import retrieval
from spherloc.frontend.features import Features, extract
from spherloc.frontend.matching import match
from spherloc.frontend.view import View
from spherloc.images import read_image
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.images.image_circle import Circle, image_circle
from spherloc.mapping.images.lens_fit import PixelPairs, fit_lens
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.registry import require
from spherloc.types import BoolArray

MIN_IMAGES, MAX_IMAGES = 6, 24
"""Of more images, this many are compared, in rows of neighbours spread over all."""
ROW = 4
"""Length of such a row."""
LOOKED_AT = 8
"""Number of images in which the image circle is looked for."""
RIM_PX = 4.0
NEIGHBOURS, ALIKE = 2, 3
"""An image is compared with so many after it, and with so many that look like it."""
MIN_MATCHES = 40
MAX_PAIRS, MAX_OF_ONE = 24, 4
"""Largest number of pairs by which the lens is fitted, and of those with one image."""
MIN_PAIRS = 6
MAX_OFF_RAD = radians(2.0)
"""Largest angle by which the lenses of two halves of the pairs may differ from that of all."""
MIN_HALF_RAD = radians(45.0)
"""Least angle to the optical axis of the corners or the rim of a wide lens."""


def find_lens(paths: Sequence[Path], size: tuple[int, int], tell: Tell) -> CalibratedLens:
    """The lens of images that one camera took, all of a size (width, height), and how well it is known.

    Where pairs of the images do not tell it, that is said as ``untold``.

    Raises ``InputError`` with a part of a sentence if the images do not tell it.
    """
    pycolmap = require("pycolmap", "colmap", "calibrating by photographs")
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    if len(paths) < MIN_IMAGES:
        raise InputError(f"there are too few to calibrate their lens by them, which takes {MIN_IMAGES} or more")
    paths = _some_of(paths)
    circle = image_circle(read_image(path) for path in paths[:: max(1, len(paths) // LOOKED_AT)])
    rim = circle or Circle(size[0] / 2, size[1] / 2, hypot(*size) / 2)
    pairs = _pairs(_features(paths, size, rim, tell), tell)
    if len(pairs) < MIN_PAIRS:
        raise InputError(f"only {len(pairs)} pairs of them match, too few to calibrate their lens by them: take more")
    try:
        fit, off_rad = fit_lens(pycolmap, pairs, rim, tell, is_circle=circle is not None)
        lens = fit.lens
        camera = KannalaBrandt(*size, lens.f, lens.f, lens.cx, lens.cy, (lens.k1, lens.k2, 0.0, 0.0))
    except (ValueError, CalibrationError):
        raise InputError("no lens fits the matches between them") from None
    half_rad = float(lens.angles(np.array([rim.radius]))[0])
    if half_rad < MIN_HALF_RAD:
        raise InputError(f"their lens seems to see {2.0 * np.degrees(half_rad):.0f}° only, and is no fisheye")
    if off_rad > MAX_OFF_RAD:
        return CalibratedLens(
            camera,
            "There was no calibration, and pairs of the photographs do not tell the lens: lenses that differ by "
            f"{np.degrees(off_rad):.1f}° fit them or halves of them. One of these is tried, and there is a map only if "
            "that tells the lens better.",
            f"they do not tell their lens: lenses that differ by {np.degrees(off_rad):.1f}° fit them or halves of "
            "them, as where a camera only went straight ahead; add some that were taken with the camera turned",
        )
    field_rad = 2.0 * float(lens.angles(np.array([fit.radii_px.max()]))[0])
    return CalibratedLens(
        camera,
        f"There was no calibration, so the lens was calibrated by {fit.matches:,} matches between the photographs, "
        f"which are spread over {np.degrees(field_rad):.0f}° of its view. Lenses that fit as well, or halves of them, "
        f"give directions that differ by {np.degrees(off_rad):.1f}° at most; {np.degrees(MAX_OFF_RAD):.0f}° would be "
        "too much.",
    )


def _some_of(paths: Sequence[Path]) -> list[Path]:
    """All of a few images; of many, rows of neighbours."""
    if len(paths) <= MAX_IMAGES:
        return list(paths)
    starts = np.linspace(0, len(paths) - ROW, MAX_IMAGES // ROW).astype(int)
    return [paths[start + place] for start in starts for place in range(ROW)]


def _features(paths: Sequence[Path], size: tuple[int, int], rim: Circle, tell: Tell) -> list[Features]:
    """SIFT features of the images inside the rim."""
    f = rim.radius / pi  # a lens that sees all pixels within the rim
    anything = KannalaBrandt(*size, f, f, rim.x, rim.y, (0.0, 0.0, 0.0, 0.0))
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    inside: BoolArray = np.hypot(columns - rim.x, rows - rim.y) < rim.radius - RIM_PX
    found: dict[int, Features] = {}
    views = [View(path.name, anything, path, mask=lambda: inside) for path in paths]
    for index, features in as_completed(lambda index: extract(views[index]), range(len(views))):
        found[index] = features
        tell("images searched for features of their lens", len(found), len(paths))
    return [found[index] for index in range(len(paths))]


def _pairs(features: Sequence[Features], tell: Tell) -> list[PixelPairs]:
    """Matched pixels of the pairs of images with most matches, those with most first."""
    count = len(features)
    compared = {(one, other) for one in range(count) for other in range(one + 1, min(count, one + 1 + NEIGHBOURS))}
    described = [retrieval.real_descriptors(one) for one in features]
    if not any(map(len, described)):
        return []
    words = retrieval.vocabulary([one for one in described if len(one)])
    vectors = np.stack([retrieval.vlad(one, words) for one in described])
    for index, vector in enumerate(vectors):
        others = [other for other in retrieval.rank(vector, vectors).tolist() if other != index][:ALIKE]
        compared |= {(min(index, other), max(index, other)) for other in others}
    matched: dict[tuple[int, int], PixelPairs] = {}
    waiting = sorted(compared)
    for done, (pair, found) in enumerate(
        as_completed(lambda pair: match(features[pair[0]], features[pair[1]]), waiting), start=1
    ):
        one, other = (features[index].pixels for index in pair)
        matched[pair] = one[found.query_index], other[found.reference_index]
        tell("pairs matched for the lens", done, len(waiting))
    used = np.zeros(count, dtype=int)
    chosen = []
    for pair in sorted(matched, key=lambda pair: (-len(matched[pair][0]), pair)):
        if len(matched[pair][0]) >= MIN_MATCHES and used[list(pair)].max() < MAX_OF_ONE and len(chosen) < MAX_PAIRS:
            chosen.append(matched[pair])
            used[list(pair)] += 1
    return chosen
