"""A rough guess of the outlier rate from match statistics alone, as the paper suggests for choosing a framework.

Wrong matches come at a steady rate: of the query's features without a true partner, about the same share finds a false
one that passes the ratio test, whatever the images. What exceeds that number is taken to be right.

TODO
"""

import numpy as np

SHARES = ((0.6, 0.7, 0.8, 0.9, 0.95, 1.0), (0.0029, 0.0082, 0.0235, 0.0723, 0.125, 0.25))
"""Bound on the ratio, and share of the query's features with a wrong match below it."""


def wrong_matches(features: int, matches: int, ratio: float | None) -> float:
    """How many of ``matches`` by mutual nearest neighbours are probably wrong, 0 to ``matches``.

    ``features`` counts those of the query image, ``ratio`` is the bound that the matches passed, None for no bound.
    """
    share = float(np.exp(np.interp(1.0 if ratio is None else ratio, SHARES[0], np.log(SHARES[1]))))
    # W = share (features - right), right = matches - W.
    return min(float(matches), share * max(0, features - matches) / (1.0 - share))
