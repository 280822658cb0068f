"""Matches are the exact nearest neighbours, as OpenCV's brute force finds them."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.errors import InputError
from spherloc.frontend import matching as module
from spherloc.frontend.features import Features
from spherloc.frontend.matching import MatchOptions, match


def features(descriptors, method="sift", pixels=None):
    count = len(descriptors)
    if pixels is None:
        pixels = np.column_stack([np.arange(count) + 0.5, np.full(count, 0.5)])
    ones = np.ones(count)
    return Features(pixels, ones.copy(), ones.copy(), ones.copy(), descriptors, method, (max(count, 1), 1))


def similar(rng, count, other, size=32):
    """Descriptors (N, D) and (M, D): half of the first are noisy copies of some of the second."""
    second = rng.random((other, size)).astype(np.float32)
    first = rng.random((count, size)).astype(np.float32)
    copied = min(count // 2, other)
    first[:copied] = second[rng.permutation(other)[:copied]]
    first[:copied] += rng.normal(0, rng.choice([0.02, 0.2], (copied, 1)), (copied, size)).astype(np.float32)
    return first, second


def bits(rng, count, other, size=32):
    second = rng.integers(0, 256, (other, size), dtype=np.uint8)
    first = rng.integers(0, 256, (count, size), dtype=np.uint8)
    copied = min(count // 2, other)
    flips = rng.random((copied, size * 8)) < rng.choice([0.05, 0.3], (copied, 1))
    first[:copied] = second[rng.permutation(other)[:copied]] ^ np.packbits(flips, axis=1)
    return first, second


def brute_force(first, second, norm, ratio, mutual):
    """{query: (reference, ratio)} by OpenCV."""
    found = {}
    back = [pair.trainIdx for pair in cv2.BFMatcher(norm).match(second, first)]
    for two in cv2.BFMatcher(norm).knnMatch(first, second, 2):
        alike = two[0].distance / two[1].distance if len(two) == 2 else np.nan
        if (ratio is None or not alike >= ratio) and (not mutual or back[two[0].trainIdx] == two[0].queryIdx):
            found[two[0].queryIdx] = (two[0].trainIdx, alike)
    return found


@pytest.mark.parametrize("block_bytes", [module.BLOCK_BYTES, 1, 5000])
@pytest.mark.parametrize("ratio, mutual", [(0.8, True), (0.8, False), (None, True), (None, False)])
@pytest.mark.parametrize("method, norm", [("sift", cv2.NORM_L2), ("orb", cv2.NORM_HAMMING)])
def test_the_same_as_opencv(rng, monkeypatch, method, norm, ratio, mutual, block_bytes):
    monkeypatch.setattr(module, "BLOCK_BYTES", block_bytes)
    first, second = similar(rng, 211, 157) if method == "sift" else bits(rng, 211, 157)
    expected = brute_force(first, second, norm, ratio, mutual)
    found = match(features(first, method), features(second, method), MatchOptions(ratio=ratio, mutual=mutual))
    assert (np.diff(found.query_index) > 0).all()
    ours = dict(zip(found.query_index, zip(found.reference_index, found.ratios, strict=True), strict=True))
    for query in ours.keys() - expected.keys():  # of equally near ones OpenCV may hold another for the mutual one
        best = sorted(cv2.norm(row, second[ours[query][0]], norm) for row in first)
        assert norm == cv2.NORM_HAMMING and mutual and best[0] == best[1]
    assert len(expected) > 20 and expected.keys() <= ours.keys() and len(ours) <= len(expected) + 8
    assert [ours[query][0] for query in expected] == [reference for reference, _ in expected.values()]
    assert np.allclose([ours[query][1] for query in expected], [alike for _, alike in expected.values()], rtol=1e-4)


@settings(max_examples=80)
@given(
    st.integers(1, 30), st.integers(1, 30), st.integers(1, 9), st.integers(0, 2**32), st.sampled_from([1, 300, 10**6])
)
def test_any_sizes(count, other, size, seed, block_bytes):
    """Distances from numpy, with more decimals, for any shape and any scale of descriptors."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.integers(-3, 4)
    first, second = (rng.normal(0, scale, (rows, size)).astype(np.float32) for rows in (count, other))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BLOCK_BYTES", block_bytes)
        nearest, distances, mutual = module.two_nearest(first, second)
    exact = np.linalg.norm(first[:, None].astype(float) - second[None], axis=2)
    best = np.sort(exact, axis=1)
    assert np.allclose(exact[np.arange(count), nearest], best[:, 0], atol=2e-3 * scale)
    assert np.allclose(distances[:, 0], best[:, 0], atol=2e-3 * scale)
    if other == 1:
        assert np.isnan(distances[:, 1]).all()
    else:
        assert np.allclose(distances[:, 1], best[:, 1], atol=2e-3 * scale)
    assert len(np.unique(nearest[mutual])) == mutual.sum() > 0
    assert np.allclose(exact[mutual, nearest[mutual]], exact.min(axis=0)[nearest[mutual]], atol=2e-3 * scale)


@pytest.mark.parametrize("method, kind", [("sift", np.float32), ("orb", np.uint8)])
def test_nothing_to_match(method, kind):
    none, some = features(np.empty((0, 1), kind), method), features(np.ones((3, 4), kind), method)
    for query, reference in ((none, some), (some, none), (none, none)):
        found = match(query, reference)
        assert len(found) == 0 and found.ratios.shape == (0,)
        assert found.query_index.dtype == found.reference_index.dtype == np.int64


def test_a_lone_reference_feature(rng):
    """There is no second nearest: the ratio is unknown and refuses nothing."""
    first, second = rng.random((5, 8)).astype(np.float32), rng.random((1, 8)).astype(np.float32)
    found = match(features(first), features(second))
    assert found.query_index.tolist() == [np.linalg.norm(first - second, axis=1).argmin()]
    assert found.reference_index.tolist() == [0] and np.isnan(found.ratios).all()


def test_equal_descriptors_are_ambiguous(rng):
    """Twins in the reference have the ratio 1; without a ratio the first of them is taken, once."""
    one = rng.random((1, 8)).astype(np.float32)
    query, reference = features(np.repeat(one, 3, axis=0)), features(np.repeat(one, 2, axis=0))
    assert len(match(query, reference)) == 0
    found = match(query, reference, MatchOptions(ratio=None))
    assert (found.query_index.tolist(), found.reference_index.tolist(), found.ratios.tolist()) == ([0], [0], [1.0])


def test_a_place_is_matched_once(rng):
    """SIFT describes a place once for each of its orientations: two pairs of places are one correspondence."""
    turned = np.eye(8, dtype=np.float32)[:3]
    noise = rng.normal(0, 0.01, (3, 8)).astype(np.float32)
    noise[1] *= 0.1  # the best of them
    places = np.array([(10.5, 20.5), (10.5, 20.5), (30.5, 20.5)])
    found = match(features(turned + noise, pixels=places), features(turned, pixels=places + 1.0))
    assert found.query_index.tolist() == [1, 2] and found.reference_index.tolist() == [1, 2]


def test_what_cannot_be_compared(rng):
    numbers = features(rng.random((3, 8)).astype(np.float32))
    with pytest.raises(InputError, match="Features sift cannot be matched with orb"):
        match(numbers, features(np.ones((3, 32), np.uint8), "orb"))
    with pytest.raises(InputError, match="of 8 and of 9 numbers"):
        match(numbers, features(rng.random((3, 9)).astype(np.float32)))


@pytest.mark.parametrize(
    "options, reason",
    [
        ({"method": "flann"}, "matching 'flann' is unknown.*nearest, lightglue"),
        ({"method": ["nearest"]}, "is unknown"),
        ({"ratio": 0.0}, "ratio of matching is 0.0"),
        ({"ratio": 1.1}, "ratio"),
        ({"ratio": float("nan")}, "ratio"),
        ({"ratio": True}, "ratio"),
        ({"ratio": "0.8"}, "ratio"),
        ({"method": "lightglue"}, "LightGlue needs the extra 'learned'"),
        ({"weights": "a.onnx"}, "Nearest matching has no weights"),
    ],
)
def test_wrong_options(options, reason):
    with pytest.raises(InputError, match=reason):
        MatchOptions(**options)
