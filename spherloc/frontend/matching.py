"""Matching of local features between a query and a reference image."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, show
from spherloc.frontend import learned, trained
from spherloc.frontend.feature_kinds import KINDS, Descriptors
from spherloc.frontend.features import Features
from spherloc.types import BoolArray, FloatArray

METHODS = ("nearest", "lightglue")
LIGHTGLUE_KIND = "aliked"
"""The features that LightGlue matches: OpenCV 5.0 scales the keypoints as the networks for ALIKED need them."""
BLOCK_BYTES = 16_000_000
"""Size of the block of similarities that is computed at once."""


@dataclass(frozen=True)
class MatchOptions:
    """Options of the matching of features."""

    method: str = "nearest"
    """"nearest": nearest neighbours of descriptors; "lightglue": a network that sees all of both images. Where it is
    for one of several joined kinds, the others are matched by nearest neighbours."""
    ratio: float | None = 0.8
    """Upper limit of the ratio of the nearest to the second nearest distance (Lowe 2004, Sec. 7.1); None: no limit. Not
    for what LightGlue matches."""
    mutual: bool = True
    """Whether the two features of a match must each be the nearest of the other, as LightGlue's always are."""
    weights: Path | None = None
    """ONNX file of LightGlue; not needed if the extra ``learned`` is installed."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"The matching {show(self.method)} is unknown; choose one of {', '.join(METHODS)}.")
        number = isinstance(self.ratio, int | float) and not isinstance(self.ratio, bool)
        if self.ratio is not None and not (number and 0.0 < self.ratio <= 1.0):
            raise InputError(f"The ratio of matching is {show(self.ratio)}; give a number above 0, up to 1.")
        if self.method == "lightglue" and self.weights is None:
            trained.check_installed("LightGlue")
        if self.method == "nearest" and self.weights is not None:
            raise InputError("Nearest matching has no weights; leave weights out, or take lightglue.")


@dataclass(frozen=True, eq=False)
class FeatureMatches:
    """Pairs of features, in the order of the query's."""

    query_index: NDArray[np.int64]
    """(K,) into the query's features."""
    reference_index: NDArray[np.int64]
    """(K,) into the reference's features."""
    ratios: FloatArray
    """(K,) distance of the nearest over that of the second nearest descriptor, 0 to 1; NaN where unknown."""

    def __len__(self) -> int:
        return len(self.query_index)


def match(query: Features, reference: Features, options: MatchOptions | None = None) -> FeatureMatches:
    """Matches of two images; none if one has no features.

    A pixel with several features (SIFT gives one for each orientation) is matched with another pixel only once:
    repeated pairs would count as independent evidence. Raises ``InputError`` if the features are of different
    kinds, or if LightGlue cannot be used for them.
    """
    options = options or MatchOptions()
    if query.method != reference.method:
        raise InputError(
            f"Features {query.method} cannot be matched with {reference.method}; extract the same ones from all images."
        )
    if query.parts:
        return _by_parts(query, reference, options)
    if len(query) == 0 or len(reference) == 0:
        return FeatureMatches(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
    if query.descriptors.shape[1] != reference.descriptors.shape[1]:
        raise InputError(
            f"Features {query.method} of {query.descriptors.shape[1]} and of {reference.descriptors.shape[1]} numbers "
            "cannot be matched; extract all with the same weights."
        )
    found = (
        _by_lightglue(query, reference, options)
        if options.method == "lightglue"
        else _nearest(query, reference, options)
    )
    return _once_a_place(found, query, reference)


def _by_parts(query: Features, reference: Features, options: MatchOptions) -> FeatureMatches:
    """Matches of joined kinds, each with its own."""
    nearest = replace(options, method="nearest", weights=None)
    index, other, ratios = [], [], []
    start = start_there = 0
    for part, there in zip(query.parts, reference.parts, strict=True):
        found = match(part, there, options if part.method == LIGHTGLUE_KIND else nearest)
        index.append(found.query_index + start)
        other.append(found.reference_index + start_there)
        ratios.append(found.ratios)
        start, start_there = start + len(part), start_there + len(there)
    return FeatureMatches(*(np.concatenate(parts) for parts in (index, other, ratios)))


def _by_lightglue(query: Features, reference: Features, options: MatchOptions) -> FeatureMatches:
    if query.method != LIGHTGLUE_KIND:
        raise InputError(
            f"LightGlue is for aliked features, not {query.method}; take those, or the matching 'nearest'."
        )
    left, right = ((one.pixels, one.descriptors.astype(np.float32), one.image_size) for one in (query, reference))
    if options.weights is None:
        pairs = trained.lightglue(left, right)
    else:
        pairs = learned.lightglue(options.weights, left, right)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return FeatureMatches(pairs[:, 0], pairs[:, 1], np.full(len(pairs), np.nan))


def _nearest(query: Features, reference: Features, options: MatchOptions) -> FeatureMatches:
    binary = KINDS[query.method].binary
    nearest, distances, mutual = two_nearest(*(_comparable(one.descriptors, binary) for one in (query, reference)))
    if binary:
        distances = np.round(distances**2)  # of bits: their Hamming distance
    with np.errstate(invalid="ignore", divide="ignore"):
        # If both distances are zero, the ratio is 1: the two descriptors cannot be told apart.
        ratios = np.where(distances[:, 1] == 0.0, 1.0, distances[:, 0] / distances[:, 1])
    kept = mutual if options.mutual else np.ones(len(nearest), bool)
    if options.ratio is not None:
        kept &= ~(ratios >= options.ratio)  # a lone reference feature has no second: NaN passes
    index = np.flatnonzero(kept)
    return FeatureMatches(index, nearest[index], ratios[index])


def _comparable(descriptors: Descriptors, binary: bool) -> NDArray[np.float32]:
    numbers = np.unpackbits(descriptors.astype(np.uint8), axis=1) if binary else descriptors
    return numbers.astype(np.float32)


def two_nearest(
    query: NDArray[np.float32], reference: NDArray[np.float32]
) -> tuple[NDArray[np.int64], FloatArray, BoolArray]:
    """Exact nearest neighbours of N descriptors (N, D) among M others (M, D), by Euclidean distance.

    Returns the nearest (N,), the distances (N, 2) to the two nearest (NaN for the second one if M = 1), and a mask (N,)
    of mutual nearest neighbours; among equals the first counts. Only a block of the (N, M) distances is in memory at a
    time.
    """
    count, other = len(query), len(reference)
    # With two more columns the product itself is -d^2 / 2 = q r - |q|^2 / 2 - |r|^2 / 2.
    ones = np.ones
    left = np.column_stack([query, -0.5 * np.square(query).sum(axis=1), ones(count)]).astype(np.float32)
    right = np.column_stack([reference, ones(other), -0.5 * np.square(reference).sum(axis=1)]).astype(np.float32)
    two = np.empty((count, min(2, other)), np.int64)
    best, best_of_reference = np.empty(count, np.float32), np.full(other, -np.inf, np.float32)
    rows = max(1, BLOCK_BYTES // (4 * other))
    for start in range(0, count, rows):
        near = left[start : start + rows] @ right.T
        np.maximum(best_of_reference, near.max(axis=0), out=best_of_reference)
        every, part = np.arange(len(near)), slice(start, start + rows)
        for place in range(two.shape[1]):
            two[part, place] = near.argmax(axis=1)
            if place == 0:
                best[part] = near[every, two[part, 0]]
                near[every, two[part, 0]] = -np.inf
    distances = np.full((count, 2), np.nan)
    # Computed again, since the product loses the digits of small distances.
    for place in range(two.shape[1]):
        distances[:, place] = np.linalg.norm(query - reference[two[:, place]], axis=1)
    return two[:, 0], distances, _first_of(two[:, 0], best == best_of_reference[two[:, 0]])


def _first_of(labels: NDArray[np.int64], wanted: BoolArray) -> BoolArray:
    """Mask (N,) of the first wanted element for each label (N,)."""
    index = np.flatnonzero(wanted)
    _, first = np.unique(labels[index], return_index=True)
    mask = np.zeros(len(wanted), bool)
    mask[index[first]] = True
    return mask


def _once_a_place(found: FeatureMatches, query: Features, reference: Features) -> FeatureMatches:
    """The matches; of several between the same two pixels only the one with the best ratio, or the first."""
    places = np.column_stack([query.pixels[found.query_index], reference.pixels[found.reference_index]])
    best_first = np.argsort(found.ratios, kind="stable")  # NaN comes last
    _, first = np.unique(places[best_first], axis=0, return_index=True)
    kept = np.sort(best_first[first])
    return FeatureMatches(found.query_index[kept], found.reference_index[kept], found.ratios[kept])


RATIOS = (0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
"""Bounds on the ratio of the distances to the nearest and the second nearest descriptor."""
SHARES = (0.0039, 0.0095, 0.026, 0.079, 0.136, 0.25)
"""Share of the query's SIFT features that have a wrong match below each of ``RATIOS``: means over the data above."""
BINARY_SHARES = (0.0018, 0.0052, 0.018, 0.075, 0.137, 0.25)
"""The same for ORB."""


def wrong_matches(features: int, matches: int, ratio: float | None, binary: bool) -> float:
    """Expected number of wrong ones among ``matches`` mutual nearest neighbours, 0 to ``matches``.

    ``features`` counts those of the query image, ``ratio`` is the bound that the matches passed, None for no bound,
    and ``binary`` says that descriptors are bits.
    """
    shares = np.log(BINARY_SHARES if binary else SHARES)
    share = float(np.exp(np.interp(1.0 if ratio is None else ratio, RATIOS, shares)))
    # W = share (features - right), right = matches - W.
    return min(float(matches), share * max(0, features - matches) / (1.0 - share))


SAME_PLACE = 0.05
"""Points of two references agree if they are closer than this share of their distance to the first of them."""
MIN_SHARED = 10
"""Least number of query features that a reference must share with the others for an estimate."""
ROUNDS = 100


def right_shares(
    pixels: Sequence[FloatArray], points: Sequence[FloatArray], ranges: Sequence[FloatArray]
) -> FloatArray:
    """Share (R,) of right matches of each of R references, by their agreement; NaN where too few are shared.

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
        for i in range(count):  # one after another: updated all at once they would oscillate
            weight = shared[i] @ right**2
            if weight > 0:
                right[i] = min(1.0, agreeing[i] @ right / weight)
    return np.where(shared.sum(axis=1) >= MIN_SHARED, right, np.nan)
