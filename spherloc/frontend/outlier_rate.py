"""A rough guess of the outlier rate from match statistics alone, as the paper suggests for choosing a framework.

Two statistics, of which the larger counts. First, chance: of the query's features without a true partner, about the
same share finds a false one that passes the ratio test, whatever the images; what exceeds that number is taken to be
right. Second, agreement: where a query feature is matched with several references, right matches name the same map
point. This sees what chance cannot: repeated structure, and references that show another place.

How rough it is (an outlier is more than 8 px off). Chance, for SIFT and the ratio 0.8: the share was 0.021 in real
fisheye images of a room (48 pairs), and 0.035, 0.023 and 0.027 in the rendered street, apartment and campus (40 pairs
each, changed light, season and camera model); most single pairs lie within a factor of 1.6. In the real images the
guess was off by 0.05 on average, for rates from 0.04 to 0.42. Both together, over the eight queries each of the
bundled street_fisheye, apartment_fisheye and campus_panorama with four references a query: off by 0.12 on average,
chance alone by 0.28; mostly too low.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spherloc.types import FloatArray

RATIOS = (0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
"""Bounds on the ratio of the distances to the nearest and the second nearest descriptor."""
SHARES = (0.0039, 0.0095, 0.026, 0.079, 0.136, 0.25)
"""Share of the query's features with a wrong match below each of them: means over the data above, of SIFT."""
BINARY_SHARES = (0.0018, 0.0052, 0.018, 0.075, 0.137, 0.25)
"""Of ORB."""


def wrong_matches(features: int, matches: int, ratio: float | None, binary: bool) -> float:
    """How many of ``matches`` by mutual nearest neighbours are probably wrong, 0 to ``matches``.

    ``features`` counts those of the query image, ``ratio`` is the bound that the matches passed, None for no bound,
    and ``binary`` says that descriptors are bits.
    """
    shares = np.log(BINARY_SHARES if binary else SHARES)
    share = float(np.exp(np.interp(1.0 if ratio is None else ratio, RATIOS, shares)))
    # W = share (features - right), right = matches - W.
    return min(float(matches), share * max(0, features - matches) / (1.0 - share))


SAME_PLACE = 0.05
"""Points of two references agree if they are closer than this share of their distance to the first of them."""
LEAST_SHARED = 10
"""Query features that a reference must share with the others, or nothing is said of it."""
ROUNDS = 100


def right_shares(
    pixels: Sequence[FloatArray], points: Sequence[FloatArray], ranges: Sequence[FloatArray]
) -> FloatArray:
    """Share (R,) of right matches of each of R references, by their agreement; NaN where too little is shared.

    ``pixels`` (N, 2) are in the query, ``points`` (N, 3) in the map, and ``ranges`` (N,) are the points' distances to
    their reference, for every reference. If matches are right independently of each other, of those that references i
    and j share the part p_i p_j agrees, which is solved for p by least squares.
    """
    count = len(pixels)
    label = np.unique(np.concatenate(pixels), axis=0, return_inverse=True)[1].ravel()
    labels = np.split(label, np.cumsum([len(part) for part in pixels])[:-1])
    shared, agreeing = np.zeros((count, count)), np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1, count):
            _, mine, other = np.intersect1d(labels[i], labels[j], return_indices=True)
            apart = np.linalg.norm(points[i][mine] - points[j][other], axis=1)
            shared[i, j] = shared[j, i] = len(mine)
            agreeing[i, j] = agreeing[j, i] = np.count_nonzero(apart <= SAME_PLACE * ranges[i][mine])
    right: NDArray[np.float64] = np.full(count, 0.5)
    for _ in range(ROUNDS):
        for i in range(count):  # one after another: all at once they would swing
            weight = shared[i] @ right**2
            if weight > 0:
                right[i] = min(1.0, agreeing[i] @ right / weight)
    return np.where(shared.sum(axis=1) >= LEAST_SHARED, right, np.nan)
