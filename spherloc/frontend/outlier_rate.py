"""A rough guess of the outlier rate from match statistics alone, as the paper suggests for choosing a framework.

Wrong matches come at a steady rate: of the query's features without a true partner, about the same share finds a false
one that passes the ratio test, whatever the images. What exceeds that number is taken to be right.

How rough it is, measured for SIFT and ORB on pairs of images with at least 20 matches (an outlier is more than 8 px
off). For SIFT and the ratio 0.8 the share was 0.021 in real fisheye images of a room (48 pairs), and 0.035, 0.023
and 0.027 in the rendered street, apartment and campus (40 pairs each, changed light, season and camera model); most
single pairs lie within a factor of 1.6. The guess was off by 0.05 on average for the real images, whose rates from 0.04
to 0.42 correlate with it by 0.94, and by 0.10, 0.19 and 0.10 for the rendered ones. It is too low where structure
repeats itself, and where a reference's map points are wrong, which no statistics of matches show. A mixture of
distributions of right and wrong ratios was tried too and was off by twice as much.
"""

import numpy as np

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
