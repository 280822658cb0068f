"""The guess of the outlier rate, against matches whose truth is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spherloc.frontend.features import Features
from spherloc.frontend.matching import (
    BINARY_SHARES,
    MIN_SHARED,
    RATIOS,
    SHARES,
    MatchOptions,
    match,
    right_shares,
    wrong_matches,
)


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


def drawn_matches(rng, truths, features=3000, matched=2000):
    """Matches of as many references as there are shares of right ones: pixels, points and ranges of each."""
    pixels, points = rng.uniform(0, 1000, (features, 2)), rng.uniform(-5, 5, (features, 3)) + np.array([0.0, 0.0, 20.0])
    parts = []
    for share in truths:
        chosen = rng.permutation(features)[:matched]
        right = rng.random(matched) < share
        wrong = rng.uniform(-5, 5, (matched, 3)) + np.array([0.0, 0.0, 20.0])
        found = np.where(right[:, None], points[chosen] + 0.02 * rng.normal(size=(matched, 3)), wrong)
        parts.append((pixels[chosen], found, np.linalg.norm(found, axis=1)))
    return [list(column) for column in zip(*parts, strict=True)]


def test_agreement_tells_how_many_are_right_in_each_reference(rng):
    truths = [0.9, 0.6, 0.3, 0.1]
    found = right_shares(*drawn_matches(rng, truths))
    assert np.abs(found - truths).max() < 0.12 and np.all(np.diff(found) < 0)


def test_agreement_says_nothing_of_references_that_share_too_little(rng):
    pixels, points, ranges = drawn_matches(rng, [0.9, 0.8])
    alone = pixels[0] + 5000.0  # other features of the query
    found = right_shares([*pixels, alone], [*points, points[0]], [*ranges, ranges[0]])
    assert np.isfinite(found[:2]).all() and np.isnan(found[2])
    assert np.isnan(right_shares(pixels[:1], points[:1], ranges[:1])).all()
    few = MIN_SHARED - 1
    short = right_shares([pixels[0][:few], pixels[0]], [points[0][:few], points[0]], [ranges[0][:few], ranges[0]])
    assert np.isnan(short).all()
