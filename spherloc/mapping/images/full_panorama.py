"""Tells panoramas of the whole sphere from other images that are about twice as wide as high."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from spherloc.datasets.panorama_tags import says_full_panorama
from spherloc.images import grey, read_eighth, read_image, read_reduced
from spherloc.mapping.advice import advice
from spherloc.mapping.images.image_circle import BLACK
from spherloc.types import ByteArray, FloatArray

MIN_PANORAMA_PX = 200
"""Least length of the longer side of a panorama."""
MIN_REDUCED_PX = 1024
"""Least height of an image that is seen well enough at an eighth of its size."""
NEAR_RATIO, STATED_RATIO = 0.02, 0.05
"""Largest relative difference from 2 to 1 of panoramas that are found by what they show, and of stated ones."""
MAX_LOOKED_AT = 8
"""Largest number of images of a size that are looked at."""
WIDTH_PX, HEIGHT_PX = 256, 128
"""Size at which edges are compared."""
POLE_ROWS = HEIGHT_PX // 10
"""Rows at the top and at the bottom that the comparison of columns leaves out."""
LAG_PX = 8
"""Distance of the pixels of a row that are compared, so that noise counts less than what the row shows."""
MAX_STEP, MAX_STEP_AND_POLES = 0.6, 0.75
"""Limits for the median of images (``ImageEdges``): of the step, and of step and poles together."""
CLEAR_STEP, SHOWN = 0.2, 0.5
"""Whatever lies at the poles, such as a caption, edges with no larger step are a panorama's, if they show as much."""


def near_two_to_one(size: tuple[int, int], tolerance: float = STATED_RATIO) -> bool:
    """Whether an image of that width and height, px, is large enough for a panorama and 2 to 1 up to a relative
    ``tolerance``."""
    width, height = size
    return width >= MIN_PANORAMA_PX and abs(width - 2 * height) <= tolerance * 2 * height


@dataclass(frozen=True)
class FullPanoramas:
    """Which of some images are panoramas."""

    names: Sequence[str]
    raw: Sequence[str]
    """Names of those with the circles of two lenses."""
    resized: Sequence[str]
    """Names of those like panoramas, but too far from 2 to 1: no lens is to be sought in them."""
    remarks: Sequence[str]
    """Why the others are none, or what is assumed, in sentences."""


def full_panoramas(folder: Path, names: Sequence[str], size: tuple[int, int], *, stated: bool) -> FullPanoramas:
    """Those of images in ``folder``, all of one size (width, height), px, about 2 to 1, that are panoramas; all of them
    if that is ``stated``.

    Raises ``InputError`` for an image that cannot be read.
    """
    width, height = size
    raw = [] if stated else [name for name in names if is_raw(folder / name, height)]
    others = [name for name in names if name not in raw]
    images = f"{len(others)} image{'s'[: len(others) != 1]} of {width} x {height} pixels"
    if not others:
        return FullPanoramas((), raw, (), ())
    whole = stated or are_full_panoramas([folder / name for name in others], unclear=width == 2 * height)
    if whole and width == 2 * height:
        return FullPanoramas(others, raw, (), ())
    if whole and (stated or near_two_to_one(size, NEAR_RATIO)):
        scaled = "though not exactly twice as wide as high: the width has 360°, the height 180°"
        return FullPanoramas(others, raw, (), (f"{images}: taken for full panoramas, {scaled}.",))
    if whole:
        why = f"{images}: like panoramas, but these are twice as wide as high; {advice('resized')}."
        return FullPanoramas((), raw, others, (why,))
    if width != 2 * height:
        return FullPanoramas((), raw, (), ())
    edges = "left and right edges do not continue each other, or upper and lower ones are not one colour each"
    why = f"{images}: twice as wide as high, but no full panoramas, since {edges}; {advice('sphere')}."
    return FullPanoramas((), raw, (), (why,))


def are_full_panoramas(paths: Sequence[Path], *, unclear: bool = True) -> bool:
    """Whether images of one size, about 2 to 1, are panoramas of the whole sphere: by their tags if most have such,
    else by what they show; ``unclear`` if they have too little contrast to tell.

    Raises ``InputError`` for an image that cannot be read.
    """
    looked_at = [paths[place] for place in np.linspace(0, len(paths) - 1, min(len(paths), MAX_LOOKED_AT)).astype(int)]
    if 2 * sum(says_full_panorama(path) for path in looked_at) > len(looked_at):
        return True
    found = [told for path in looked_at if (told := edges_of(read_reduced(path, WIDTH_PX))) is not None]
    if not found:
        return unclear
    step, poles, shown = np.median([(one.step, one.poles, one.shown) for one in found], axis=0)
    clear = step <= CLEAR_STEP and shown >= SHOWN
    return bool(clear or (step <= MAX_STEP and step + poles <= MAX_STEP_AND_POLES))


@dataclass(frozen=True)
class ImageEdges:
    """How the edges of an image differ from those of a panorama."""

    step: float
    """Between the right edge and the left one: 0 as between neighbouring columns, 1 as between distant ones.
    Differences count from their median along the column, so that lenses of different brightness make no step."""
    poles: float
    """How much the first or the last row, whichever changes more, changes along it: a panorama's is a single direction;
    1 as other rows."""
    shown: float
    """How much the left or the right edge, whichever changes less, changes along it; 1 as other columns."""


def edges_of(image: ByteArray) -> ImageEdges | None:
    """The edges of an image (H, W) or (H, W, 3); None where columns tell nothing, since distant ones hardly differ more
    than neighbours."""
    small = cv2.resize(grey(image), (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA).astype(float)
    between = small[POLE_ROWS:-POLE_ROWS]

    def differences(columns: int) -> FloatArray:
        off = between - np.roll(between, -columns, axis=1)
        return np.abs(off - np.median(off, axis=0)).mean(axis=0)

    *neighbours, seam = differences(1)
    near = float(np.median(neighbours))
    far = float(np.median([differences(columns) for columns in (WIDTH_PX // 6, WIDTH_PX // 4, WIDTH_PX // 3)]))
    if far <= max(1.0, 1.5 * near):
        return None
    along = np.abs(small[:, LAG_PX:] - small[:, :-LAG_PX]).mean(axis=1)
    usual = max(0.5, float(np.median(along[POLE_ROWS:-POLE_ROWS])))
    step, poles = (float(seam) - near) / (far - near), max(along[0], along[-1]) / usual
    down = np.abs(between[LAG_PX:] - between[:-LAG_PX]).mean(axis=0)
    shown = min(down[0], down[-1]) / max(0.5, float(np.median(down)))
    return ImageEdges(*(float(np.clip(one, 0.0, 1.0)) for one in (step, poles, shown)))


def is_raw(path: Path, height: int) -> bool:
    """Whether an image of that height, px, shows two circles (``two_circles``)."""
    return two_circles(read_eighth(path) if height >= MIN_REDUCED_PX else read_image(path))


def two_circles(image: ByteArray) -> bool:
    """Whether an image (H, W) or (H, W, 3) of 2 to 1 shows the raw circles of two fisheyes: both halves are black in
    their corners and not in the rows between. A panorama has its zenith along the whole upper edge, and its nadir along
    the lower one."""
    height = image.shape[0]
    side, middle = max(2, height // 20), height // 2
    for half in np.split(grey(image)[:, : 4 * (height // 2)], 2, axis=1):
        for edge in (half, half[::-1]):
            corners = np.hstack([edge[:side, :side], edge[:side, -side:]])
            between = edge[side // 2 : side, middle - side : middle + side]
            if np.percentile(corners, 90) > BLACK or between.mean() <= 2 * BLACK:
                return False
    return True
