"""The front end: features of a query, its most similar references, matches with each, and their points in the map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, ProblemError, show
from spherloc.files import is_file
from spherloc.frontend import retrieval
from spherloc.frontend.feature_kinds import KINDS
from spherloc.frontend.features import FeatureOptions, Features, extract
from spherloc.frontend.matching import MatchOptions, match, right_shares, wrong_matches
from spherloc.frontend.triangulation import TriangulationLift
from spherloc.frontend.two_view import verified
from spherloc.frontend.view import Matcher, Matches, Report, View
from spherloc.geometry import camera_centre
from spherloc.types import BoolArray, FloatArray

MAX_REFERENCES = 100

_FEATURE_KEYS = {"features": "method", "max_features": "max_features", "feature_weights": "weights"}
_MATCH_KEYS = {"matching": "method", "ratio": "ratio", "matching_weights": "weights"}
NO_POINT = "matches have no point in the map"
"""What a remark says of nearly every query."""


@dataclass(frozen=True)
class FrontendOptions:
    """Options of the front end."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    """The keys ``features``, ``max_features`` and ``feature_weights``."""
    matching: MatchOptions = field(default_factory=MatchOptions)
    """The keys ``matching``, ``ratio`` and ``matching_weights``."""
    references: int = 4
    """Number of references, the most similar ones, whose matches a query gets."""


def frontend_options(table: Mapping[str, Any], where: str, folder: Path) -> FrontendOptions:
    """The options in a section [frontend]; files of weights are relative to ``folder``.

    Raises ``InputError`` for an unknown key, a wrong value or a missing file.
    """
    place = f"{where} [frontend]"
    known = [*_FEATURE_KEYS, *_MATCH_KEYS, "references"]
    for key in table:
        if key not in known:
            raise InputError(f"{place}: unknown key {show(key)}; the known ones are {', '.join(sorted(known))}.")
    values = dict(table)
    for key in ("feature_weights", "matching_weights"):
        if key in values:
            values[key] = _weights(folder, key, values[key], place)
    if values.get("matching") == "lightglue" and "ratio" in values:
        raise InputError(f"{place}: LightGlue has no ratio; remove that key.")
    try:
        features = FeatureOptions(**{own: values[key] for key, own in _FEATURE_KEYS.items() if key in values})
        matching = MatchOptions(**{own: values[key] for key, own in _MATCH_KEYS.items() if key in values})
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    count = values.get("references", FrontendOptions.references)
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MAX_REFERENCES:
        raise InputError(f"{place}: references is {show(count)}; give a whole number from 1 to {MAX_REFERENCES}.")
    return FrontendOptions(features, matching, count)


def _weights(folder: Path, key: str, value: Any, place: str) -> Path:
    if not isinstance(value, str) or not value or "\0" in value:
        raise InputError(f"{place}: {key} is {show(value)}; give the path of an ONNX file.")
    path = folder / value
    if not is_file(path):
        raise InputError(f"{place}: {key} names {path}, which is not a file; correct the path.")
    return path


SAME_POINT = 0.02
"""Points of two references count as one if they are closer than this share of their distance to the first reference."""
SHORTLIST = 2
"""Ratio of the references that are matched to those that are kept: matches show better than retrieval which references
see the same place."""
FEW_LIFTED = 100
"""If there are fewer correspondences, right matches without a map point are counted too."""
VOCABULARY_IMAGES = 64
"""Number of references, spread over all, from which the visual words are learnt."""


def image_matcher(
    references: tuple[View, ...],
    table: Mapping[str, Any],
    where: str,
    folder: Path,
    pairs: Mapping[str, tuple[str, ...]] | None = None,
) -> Matcher:
    """The matcher that a scene's section [frontend], ``table``, describes.

    ``where`` names the scene file in messages, paths of weights are relative to ``folder``, and ``pairs``, instead of
    retrieval, gives the names of references, the most similar first, by the name of a query. Raises ``InputError``
    for an unknown key or a wrong value. No image is read yet.
    """
    return ImageMatcher(references, frontend_options(table, where, folder), pairs)


@dataclass(frozen=True, eq=False)
class ImageMatcher:
    """Finds the correspondences of a query with the references most similar to it.

    If there are at most ``options.references`` references, all are matched; of more, retrieval picks ``SHORTLIST``
    times that many, and those with the most correspondences are kept. An image is never matched with itself, so that a
    map's own images can be localized in it. References with more correspondences count as more similar. Where several
    references give a query keypoint the same point (``SAME_POINT``), it counts once, from the most similar of them;
    different points are alternatives and are all kept.
    """

    references: tuple[View, ...]
    options: FrontendOptions
    pairs: Mapping[str, tuple[str, ...]] | None = None
    """Names of references by the name of a query, the most similar first."""

    def __call__(self, query: View) -> Matches:
        """See ``Matcher``; if no reference can be used, there are no correspondences, and remarks say why.

        Raises ``InputError`` if the query cannot be read, and ``ProblemError`` if it has no features.
        """
        features = extract(query, self.options.features)
        if not len(features.pixels):
            raise ProblemError(
                f"{query.name} has no features, and so no matches; it is black, white, blurred or covered by a mask."
            )
        tried, remarks = self._candidates(query, features)
        found: list[_ReferenceMatches] = []
        for reference in tried:
            try:
                found.append(_correspondences(features, reference, self.options))
            except InputError as error:
                remarks.append(f"Reference {reference.name} was skipped: {error}")
                continue
            if isinstance(reference.lift, TriangulationLift):
                remarks += reference.lift.remarks
        return _joined(query, found, tried, self.options.references, remarks)

    def prepare(self, report: Report) -> None:
        """Compute global descriptors of all references, if there are so many that retrieval has to choose."""
        if self.pairs is None and len(self.references) > self.options.references and "_index" not in vars(self):
            # Stored where cached_property keeps its value, since a property cannot take ``report``.
            vars(self)["_index"] = _index(self.references, self.options, report)

    def _candidates(self, query: View, features: Features) -> tuple[list[View], list[str]]:
        """References to match with, at most as many as the options say, and remarks."""
        remarks: list[str] = []
        if self.pairs is not None:
            if query.name in self.pairs:
                return self._paired(query, self.pairs[query.name])
            remarks.append(f"{query.name} is not in the list of pairs, so that its references were retrieved.")
        others = [index for index, view in enumerate(self.references) if not _same_file(view, query)]
        if len(others) > self.options.references:
            index = self._index
            remarks += index.remarks
            allowed = set(others)
            order = index.views[retrieval.rank(index.describe(features), index.vectors)].tolist()
            others = [place for place in order if place in allowed][: SHORTLIST * self.options.references]
        return [self.references[place] for place in others], remarks

    def _paired(self, query: View, names: Sequence[str]) -> tuple[list[View], list[str]]:
        known = [self._by_name[name] for name in names if name in self._by_name]
        unknown = [name for name in names if name not in self._by_name]
        remarks = []
        if unknown:
            remarks.append(
                f"{len(unknown)} of the {len(names)} references paired with {query.name} are not in the map, "
                f"the first is {show(unknown[0])}."
            )
        return [view for view in known if not _same_file(view, query)][: self.options.references], remarks

    @cached_property
    def _by_name(self) -> dict[str, View]:
        return {view.name: view for view in self.references}

    @cached_property
    def _index(self) -> "_Index":
        return _index(self.references, self.options, lambda done, count: None)


@dataclass(frozen=True, eq=False)
class _Index:
    """Global descriptors of all references that can be read."""

    words: retrieval.Floats
    vectors: retrieval.Floats
    """(R, K * D) global descriptors."""
    views: NDArray[np.int64]
    """(R,) indices of the references that they describe."""
    remarks: list[str]

    def describe(self, features: Features) -> retrieval.Floats:
        if not self.vectors.any():  # no reference has a feature
            return np.zeros(self.words.size, np.float32)
        return retrieval.vlad(retrieval.real_descriptors(features), self.words)


def _index(references: Sequence[View], options: FrontendOptions, report: Report) -> _Index:
    """The index of the references. Features are not kept in memory, where thousands would not fit, but read again from
    the cache on disk."""
    failures: dict[int, str] = {}
    seen: set[int] = set()

    def described(index: int) -> retrieval.Floats | None:
        try:
            return retrieval.real_descriptors(extract(references[index], options.features))
        except InputError as error:
            failures[index] = str(error)
            return None
        finally:
            if index not in seen:
                seen.add(index)
                report(len(seen), len(references))

    spread = np.unique(np.linspace(0, len(references) - 1, VOCABULARY_IMAGES).round().astype(np.int64))
    samples = [image for index in spread.tolist() if (image := described(index)) is not None and len(image)]
    words = retrieval.vocabulary(samples) if samples else np.zeros((1, 1), np.float32)
    vectors = {
        index: retrieval.vlad(image, words)
        for index in range(len(references))
        if (image := described(index)) is not None
    }
    remarks = []
    if failures:
        first = min(failures)
        remarks.append(
            f"{len(failures)} of {len(references)} references were skipped, the first is {references[first].name}: "
            f"{failures[first]}"
        )
    stacked = np.stack(list(vectors.values())) if vectors else np.empty((0, words.size), np.float32)
    return _Index(words, stacked, np.array(list(vectors), dtype=np.int64), remarks)


@dataclass(frozen=True, eq=False)
class _ReferenceMatches:
    """Correspondences through one reference."""

    reference: View
    pixels: FloatArray
    points: FloatArray
    reference_pixels: FloatArray
    wrong: float | None
    """Estimated number of wrong ones among them; None if unknown."""
    unlifted: tuple[FloatArray, FloatArray]
    """(K, 2) pixels in the query and in the reference of the matches without a map point."""

    @property
    def matches(self) -> int:
        """Number of matches before lifting."""
        return len(self.pixels) + len(self.unlifted[0])


def _correspondences(query: Features, reference: View, options: FrontendOptions) -> _ReferenceMatches:
    if reference.lift is None:
        raise InputError("nothing gives its pixels points in the map; give depth, lidar or a model.")
    features = extract(reference, options.features)
    matches = match(query, features, options.matching)
    reference_pixels = features.pixels[matches.reference_index]
    points, lifted = reference.lift(reference_pixels)
    wrong = None
    if options.matching.method == "nearest" and len(matches) and not query.parts:
        binary = KINDS[query.method].binary
        wrong = wrong_matches(len(query), len(matches), options.matching.ratio, binary) * float(lifted.mean())
    return _ReferenceMatches(
        reference=reference,
        pixels=query.pixels[matches.query_index[lifted]],
        points=points[lifted],
        reference_pixels=reference_pixels[lifted],
        wrong=wrong,
        unlifted=(query.pixels[matches.query_index[~lifted]], reference_pixels[~lifted]),
    )


def _verified_unlifted(query: View, part: _ReferenceMatches) -> int:
    """Number of matches without a map point that agree with the motion between the query and the reference."""
    lifted, lacking = (part.pixels, part.reference_pixels), part.unlifted
    bearings, seen = query.camera.unproject(np.concatenate([lifted[0], lacking[0]]))
    others, seen_there = part.reference.camera.unproject(np.concatenate([lifted[1], lacking[1]]))
    both = seen & seen_there
    lacks = np.arange(len(both)) >= len(lifted[0])
    return int(np.count_nonzero(verified(bearings[both], others[both]) & lacks[both]))


def _joined(
    query: View, found: Sequence[_ReferenceMatches], tried: Sequence[View], most: int, remarks: list[str]
) -> Matches:
    """The matches of at most ``most`` references, those with the most correspondences."""
    found = sorted(found, key=lambda part: -len(part.pixels))[:most]
    ranked = [part for part in found if len(part.pixels)]
    total, lifted = sum(part.matches for part in found), sum(len(part.pixels) for part in found)
    lacking = sum(_verified_unlifted(query, part) for part in found) if lifted < min(total, FEW_LIFTED) else 0
    if lifted < total:
        but = f", though {lacking:,} of these agree with the motion between two images" if lacking else ""
        remarks.append(f"{total - lifted:,} of {total:,} {NO_POINT}{but}.")
    if not ranked:
        none, no_index = np.empty((0, 2)), np.empty(0, np.int64)
        return Matches(none, np.empty((0, 3)), tuple(tried[:most]), no_index, none, None, tuple(remarks), lacking)
    pixels = np.concatenate([part.pixels for part in ranked])
    points = np.concatenate([part.points for part in ranked])
    index = np.repeat(np.arange(len(ranked)), [len(part.pixels) for part in ranked])
    centres = np.stack([_centre(part.reference) for part in ranked])
    keep = ~_repeated(pixels, points, np.linalg.norm(points - centres[index], axis=1))
    return Matches(
        pixels=pixels[keep],
        points=points[keep],
        references=tuple(part.reference for part in ranked),
        reference_index=index[keep],
        reference_pixels=np.concatenate([part.reference_pixels for part in ranked])[keep],
        estimated_outlier_rate=_outlier_rate(ranked, int(keep.sum())),
        remarks=tuple(remarks),
        verified_without_point=lacking,
    )


def _outlier_rate(ranked: Sequence[_ReferenceMatches], kept: int) -> float | None:
    """Estimated outlier rate of the ``kept`` matches; repetitions, which were left out, count as right ones."""
    if all(part.wrong is None for part in ranked):
        return None
    ranges = [np.linalg.norm(part.points - _centre(part.reference), axis=1) for part in ranked]
    right = right_shares([part.pixels for part in ranked], [part.points for part in ranked], ranges)
    by_agreement = [(1.0 - share) * len(part.pixels) for share, part in zip(right, ranked, strict=True)]
    by_chance = [part.wrong or 0.0 for part in ranked]
    return min(1.0, float(np.fmax(by_agreement, by_chance).sum()) / kept)


def _repeated(pixels: FloatArray, points: FloatArray, ranges: FloatArray) -> BoolArray:
    """Mask (N,) of rows for which an earlier row has the same pixel and, within ``SAME_POINT`` of its range (N,), the
    same point."""
    _, label = np.unique(pixels, axis=0, return_inverse=True)
    order = np.argsort(label.ravel(), kind="stable")
    label, points, ranges = label.ravel()[order], points[order], ranges[order]
    repeated = np.zeros(len(pixels), dtype=bool)
    for step in range(1, len(pixels)):
        same = label[step:] == label[:-step]
        if not same.any():
            break
        apart = np.linalg.norm(points[step:] - points[:-step], axis=1)
        repeated[order[step:]] |= same & (apart <= SAME_POINT * ranges[:-step])
    return repeated


def _centre(reference: View) -> FloatArray:
    return np.full(3, np.nan) if reference.cam_from_map is None else camera_centre(reference.cam_from_map)


def _same_file(reference: View, query: View) -> bool:
    return reference.path == query.path
