"""Checks which matches between two images agree with one motion of the camera; no map points are needed.

A match of bearings b (query) and c (reference) fits an essential matrix E if c lies in the plane of b: c . E b = 0.
That is linear in E, so eight matches fix it (the null space of their equations).
"""

import numpy as np

from spherloc.consensus.chance import nfa
from spherloc.types import BoolArray, FloatArray

SAMPLE_SIZE = 8
MAX_SAMPLES, BATCH = 2000, 250
"""Largest number of samples, and samples at once: with 51 % right matches, one of the samples is clean with 99 %
probability."""
CONFIDENCE = 0.99
BOUND_RAD = np.radians(0.5)
"""Largest angle of a bearing to its epipolar plane."""
REFITS = 3
MIN_AGREEING = 15
"""Least number of agreeing matches."""
MAX_NFA = 1e-3
"""Largest NFA of the agreeing matches: the expected number of sets of their size by chance."""
CHANCE_RATE = 4.0 * np.sin(BOUND_RAD)
"""Probability that a wrong match is near its plane: sin(bound) for bearings all over the sphere, more in an image."""


def verified(query: FloatArray, reference: FloatArray) -> BoolArray:
    """Mask (N,) of the matches of unit bearings (N, 3) that agree with the motion that most matches support.

    It is all false if chance may explain as many. Every call draws the same samples.
    """
    count = len(query)
    none = np.zeros(count, dtype=bool)
    if count < MIN_AGREEING:
        return none
    rows = (reference[:, :, None] * query[:, None, :]).reshape(count, 9)
    rng, best, drawn, needed = np.random.default_rng(0), none, 0, MAX_SAMPLES
    while drawn < min(needed, MAX_SAMPLES):
        sample = rng.random((BATCH, count)).argpartition(SAMPLE_SIZE, axis=1)[:, :SAMPLE_SIZE]
        drawn += BATCH
        fits = _fits(np.linalg.svd(rows[sample])[2][:, -1], query, reference)
        most = int(fits.sum(axis=1).argmax())
        if fits[most].sum() > best.sum():
            best = fits[most]
            clean = float(best.mean()) ** SAMPLE_SIZE
            needed = int(np.ceil(np.log1p(-CONFIDENCE) / np.log1p(-clean))) if clean < 1.0 else 0
    for _ in range(REFITS):
        if best.sum() < SAMPLE_SIZE:
            return none
        again = _fits(np.linalg.svd(rows[best])[2][-1:], query, reference)[0]
        best = again if again.sum() > best.sum() else best
    # Eight matches fix a motion, while ``nfa`` counts models that two fix.
    expected = nfa(count, int(best.sum()), CHANCE_RATE) * CHANCE_RATE ** (2 - SAMPLE_SIZE)
    return best if best.sum() >= MIN_AGREEING and expected <= MAX_NFA else none


def _fits(essential: FloatArray, query: FloatArray, reference: FloatArray) -> BoolArray:
    """Mask (S, N) of the matches near their epipolar planes in both images, by each of the matrices (S, 9)."""
    matrices, bound = essential.reshape(-1, 3, 3), np.sin(BOUND_RAD)
    there, here = query @ matrices.transpose(0, 2, 1), reference @ matrices
    error = np.abs(np.einsum("sni,ni->sn", there, reference))
    return (error <= bound * np.linalg.norm(there, axis=2)) & (error <= bound * np.linalg.norm(here, axis=2))
