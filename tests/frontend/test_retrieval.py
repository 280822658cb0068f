"""Retrieval on descriptors whose similarities are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.frontend.features import Features
from spherloc.frontend.retrieval import STRONGEST, WORDS, rank, real_descriptors, vlad, vocabulary


def features(descriptors: np.ndarray, method: str) -> Features:
    count = len(descriptors)
    return Features(np.zeros((count, 2)), *(np.ones(count) for _ in range(3)), descriptors, method, (100, 100))


def unit(array):
    return (array / np.linalg.norm(array, axis=1, keepdims=True)).astype(np.float32)


def images(random, count=6, each=400, kinds=40):
    """Every image shows its own mixture of the same kinds of features, by which it can be told from the others."""
    centres = unit(random.normal(size=(kinds, 32)))
    mixtures = [random.dirichlet(np.full(kinds, 0.3)) for _ in range(count)]
    offsets = random.normal(size=(count, kinds, 32)) * 0.08

    def picture(image):
        kind = random.choice(kinds, each, p=mixtures[image])
        return unit(centres[kind] + offsets[image, kind] + 0.05 * random.normal(size=(each, 32)))

    return picture


def test_another_picture_of_the_same_place_comes_first(rng):
    picture = images(rng)
    references = [picture(image) for image in range(6)]
    words = vocabulary(references)
    vectors = np.stack([vlad(reference, words) for reference in references])
    assert words.shape == (WORDS, 32)
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    for image in range(6):
        assert rank(vlad(picture(image), words), vectors)[0] == image


def test_words_are_where_the_descriptors_are(rng):
    """k-means on clusters that are far apart: every word is the mean of the descriptors nearest to it."""
    descriptors = images(rng)(0)
    words = vocabulary([descriptors])
    nearest = np.linalg.norm(descriptors[:, None] - words[None], axis=2).argmin(axis=1)
    spread = np.linalg.norm(descriptors - words[nearest], axis=1).mean()
    start = descriptors[np.sort(rng.choice(len(descriptors), len(words), replace=False))]
    random_spread = np.linalg.norm(descriptors[:, None] - start[None], axis=2).min(axis=1).mean()
    assert spread < random_spread


@settings(max_examples=25)
@given(st.integers(0, 200), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_few_features_never_fail_and_the_order_of_features_says_nothing(count, size, seed):
    random = np.random.default_rng(seed)
    pictures = [unit(random.normal(size=(random.integers(0, count + 1), 8))) for _ in range(size)]
    words = vocabulary(pictures, seed)
    assert 1 <= len(words) <= WORDS or not any(len(picture) for picture in pictures)
    assert np.array_equal(words, vocabulary(pictures, seed))
    if len(words):
        for picture in pictures:
            one, other = vlad(picture, words), vlad(picture[random.permutation(len(picture))], words)
            assert np.isfinite(one).all() and (one @ other > 0.99 or not one.any())
            assert len(picture) or not one.any()


def test_a_repeated_texture_does_not_drown_the_rest(rng):
    """A thousand equal features more change the vector by one word's share, not by a thousand features' one."""
    draw = images(rng)
    picture = draw(0)
    words = vocabulary([draw(image) for image in range(6)])
    hedge = np.repeat(unit(rng.normal(size=(1, 32))), 1000, axis=0)
    assert vlad(picture, words) @ vlad(np.vstack([picture, hedge]), words) > 0.9


def test_distances_of_bits_are_kept(rng):
    """The squared distance of the real descriptors grows with the Hamming distance alone."""
    bits = rng.integers(0, 256, (20, 32), np.uint8)
    real = real_descriptors(features(bits, "orb"))
    hamming = np.unpackbits(bits[:, None] ^ bits[None], axis=2).sum(axis=2)
    squared = np.square(real[:, None] - real[None]).sum(axis=2)
    assert real.shape == (20, 256) and np.allclose(squared, 4.0 * hamming / 256, atol=1e-5)


@pytest.mark.parametrize("count", [0, 3, STRONGEST + 5])
def test_only_the_strongest_are_described(rng, count):
    floats = rng.normal(size=(count, 16)).astype(np.float32)
    real = real_descriptors(features(floats, "sift"))
    assert np.allclose(real, unit(floats[:STRONGEST]) if count else real, atol=1e-6) and len(real) == min(
        count, STRONGEST
    )
