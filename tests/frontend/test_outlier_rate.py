"""The guess of the outlier rate, against matches whose truth is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spherloc.frontend.features import Features
from spherloc.frontend.matching import MatchOptions, match
from spherloc.frontend.outlier_rate import BINARY_SHARES, RATIOS, SHARES, wrong_matches


def features(descriptors: np.ndarray, random: np.random.Generator) -> Features:
    count = len(descriptors)
    pixels = random.uniform(0, 1000, (count, 2))
    sizes = (np.ones(count), np.zeros(count), np.ones(count))
    return Features(pixels, *sizes, descriptors.astype(np.float32), "sift", (1000, 1000))


@given(st.integers(0, 10**6), st.integers(0, 10**6), st.floats(0.01, 1.0) | st.none(), st.booleans())
def test_never_more_than_there_are(count, matches, ratio, binary):
    wrong = wrong_matches(count, matches, ratio, binary)
    assert 0.0 <= wrong <= matches
    assert wrong <= wrong_matches(count + 100, matches, ratio, binary)


@given(st.floats(0.5, 0.99), st.floats(0.0, 0.01))
def test_a_stricter_ratio_leaves_fewer_wrong_ones(ratio, more):
    assert wrong_matches(3000, 2000, ratio, False) <= wrong_matches(3000, 2000, ratio + more, False) + 1e-9
    assert wrong_matches(3000, 2000, None, False) == wrong_matches(3000, 2000, 1.0, False)


def test_all_features_matched_leaves_none_for_wrong_matches():
    assert wrong_matches(1000, 1000, 0.8, False) == 0.0


@pytest.mark.parametrize("binary", [False, True])
def test_unrelated_images_have_wrong_matches_only(binary):
    """As many matches as the share says, in images of which none can be right: all of them are wrong."""
    for ratio, share in zip(RATIOS, BINARY_SHARES if binary else SHARES, strict=True):
        matches = round(40_000 * share)
        assert wrong_matches(40_000, matches, ratio, binary) == pytest.approx(matches, rel=0.01)


def test_more_overlap_means_a_lower_rate(rng):
    """Half, a quarter, ... of the query's features have partners; the guess falls as the truth does."""
    guesses, truths = [], []
    for partners in (60, 200, 600):
        # 14 dimensions: as many neighbours pass the ratio test by chance as among SIFT's descriptors of pictures.
        query = rng.normal(size=(1500, 14))
        reference = rng.normal(size=(1500, 14))
        reference[:partners] = query[:partners] + 0.1 * rng.normal(size=(partners, 14))
        found = match(features(query, rng), features(reference, rng), MatchOptions(ratio=0.8))
        truths.append(np.mean(found.query_index != found.reference_index))
        guesses.append(wrong_matches(1500, len(found), 0.8, False) / len(found))
    assert np.all(np.diff(truths) < 0) and np.all(np.diff(guesses) < 0)
    assert np.abs(np.subtract(guesses, truths)).max() < 0.25
