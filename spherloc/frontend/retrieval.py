"""Image retrieval: which references look like the query. VLAD over local features is used in place of NetVLAD.

H. Jegou, M. Douze, C. Schmid, P. Perez: Aggregating local descriptors into a compact image representation, CVPR 2010;
normalised within each word as by R. Arandjelovic and A. Zisserman: All about VLAD, CVPR 2013.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spherloc.frontend.features import Features

WORDS = 64
STRONGEST = 4000
"""Number of an image's features that are used. For 47 of 48 rendered queries, the nearest reference was among the four
most similar ones; with 1,000 features, for 41."""
MAX_SAMPLES = 20_000
"""Number of descriptors from which the vocabulary is learnt: 300 per word."""
MIN_SAMPLES_A_WORD = 30
"""Least number of descriptors per word; with fewer, a word would describe single features."""

_ROUNDS = 12
"""Number of iterations of Lloyd's algorithm: from random starts, words hardly move after ten."""
_CHUNK = 4096
_ROUNDING = 1e-5

Floats = NDArray[np.float32]


def real_descriptors(features: Features) -> Floats:
    """Descriptors (N, D) of the strongest features as unit vectors; bits of binary ones count as +1 and -1.

    Weak features, which are those of plain walls and of noise, tell no place. Of joined kinds, the first is taken: VLAD
    compares features of one kind.
    """
    first = features.parts[0] if features.parts else features
    descriptors = first.descriptors[: min(STRONGEST, first.strong)]
    if descriptors.dtype == np.uint8:
        descriptors = 2.0 * np.unpackbits(descriptors.astype(np.uint8), axis=1) - 1.0
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return (descriptors / np.where(lengths > 0, lengths, 1.0)).astype(np.float32)


def vocabulary(images: Sequence[Floats], seed: int = 0) -> Floats:
    """Words (K, D) by k-means over the descriptors of some images; K is at most ``WORDS``, fewer for few features.

    Every image gives about as many samples. The same descriptors and seed give the same words.
    """
    random = np.random.default_rng(seed)
    share = -(-MAX_SAMPLES // max(1, len(images)))
    samples = np.concatenate([image[_some(random, len(image), share)] for image in images])
    samples = samples[_some(random, len(samples), MAX_SAMPLES)]
    count = max(1, min(WORDS, len(samples) // MIN_SAMPLES_A_WORD))
    words = samples[_some(random, len(samples), count)]
    for _ in range(_ROUNDS):
        sums, sizes = _sums(samples, words)
        words = np.where(sizes > 0, sums / np.maximum(sizes, 1), words)
    return words


def vlad(descriptors: Floats, words: Floats) -> Floats:
    """Unit vector (K * D,) of an image with descriptors (N, D); zero for an image without features."""
    sums, sizes = _sums(descriptors, words)
    residuals = sums - sizes * words
    # Where the mean of a word's features is the word itself, normalisation would turn rounding errors into a direction.
    residuals[np.abs(residuals) < _ROUNDING * sizes] = 0.0
    residuals = np.sign(residuals) * np.sqrt(np.abs(residuals))
    # Normalised within each word first: one repeated texture (a hedge, a row of windows) must not outweigh the others.
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-12)
    length = np.linalg.norm(residuals)
    return (residuals / max(float(length), 1e-12)).ravel()


def rank(query: Floats, references: Floats) -> NDArray[np.int64]:
    """Indices of the references (R, K * D), the one most similar to the query (K * D,) first."""
    return np.argsort(-(references @ query), kind="stable")


def _some(random: np.random.Generator, count: int, most: int) -> NDArray[np.int64]:
    return np.sort(random.choice(count, most, replace=False)) if count > most else np.arange(count)


def _sums(descriptors: Floats, words: Floats) -> tuple[Floats, Floats]:
    """Sum (K, D) and number (K, 1) of the descriptors that are nearest to each word."""
    half = 0.5 * (words**2).sum(axis=1)
    sums, sizes = np.zeros_like(words), np.zeros((len(words), 1), np.float32)
    for start in range(0, len(descriptors), _CHUNK):
        part = descriptors[start : start + _CHUNK]
        nearest = (part @ words.T - half).argmax(axis=1)
        chosen = (np.arange(len(words))[:, None] == nearest).astype(np.float32)
        sums += chosen @ part
        sizes += chosen.sum(axis=1, keepdims=True)
    return sums, sizes
