"""What chance alone explains: when it explains as much as the best pose, no method can know the answer."""

from math import lgamma

import numpy as np

from spherloc.kernel_cache import kernel
from spherloc.types import FloatArray

NEIGHBOURHOOD_RAD = 0.2
"""Bearings are counted within this angle, to know how dense they are around each other."""
MAX_BEARINGS = 200
"""More are thinned: the density is a mean."""


def chance_rate(bearings: FloatArray, bound_rad: FloatArray) -> float:
    """Probability that a wrong pose explains a correspondence: that of M bearings one falls within its bound of
    another.

    It is counted in a wider neighbourhood and scaled by the areas of both caps, so that bearings which are all in one
    part of the image meet more often by chance than bearings all around. ``bearings`` (M, 3), ``bound_rad`` (M,).
    """
    some = bearings[:: -(-len(bearings) // MAX_BEARINGS)].copy()
    density = max(2 * _pairs_within(some, np.cos(NEIGHBOURHOOD_RAD)), 1) / (len(some) * max(len(some) - 1, 1))
    cap = np.mean(np.sin(0.5 * bound_rad) ** 2) / np.sin(0.5 * NEIGHBOURHOOD_RAD) ** 2
    return float(min(1.0, density * cap))


@kernel()
def _pairs_within(bearings, cosine):
    """How many pairs of the unit ``bearings`` (M, 3) are closer than the angle with this ``cosine``."""
    near = 0
    for i in range(len(bearings)):
        x, y, z = bearings[i, 0], bearings[i, 1], bearings[i, 2]
        for j in range(i):
            near += x * bearings[j, 0] + y * bearings[j, 1] + z * bearings[j, 2] >= cosine
    return near


def expected_text(sets: float) -> str:
    """An expected number of sets by chance in words, to one digit."""
    if sets < 1e-6:
        return "practically none"
    if sets >= 1e6:
        return "millions"
    return f"{sets:.1g}" if sets < 1.0 else f"{float(f'{sets:.1g}'):,.0f}"


def least_size(count: int, rate: float, expected: float) -> int:
    """The least size whose NFA is at most ``expected``: see ``nfa``."""
    return next((size for size in range(2, count) if nfa(count, size, rate) <= expected), count)


def nfa(count: int, size: int, rate: float) -> float:
    """Expected number of sets of ``size`` among ``count`` correspondences that agree with some pose by chance.

    Two of them fix a pose and each other one is explained with probability ``rate``: C(count, size) rate^(size - 2).
    """
    if size < 2:
        return float(count)
    ways = lgamma(count + 1) - lgamma(size + 1) - lgamma(count - size + 1)
    return float(np.exp(min(700.0, ways + (size - 2) * np.log(rate))))
