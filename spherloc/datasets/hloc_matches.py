"""2D-3D correspondences of a query from hloc's features and matches and the COLMAP model of the references."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spherloc.errors import InputError, show
from spherloc.formats.colmap_model import ColmapModel
from spherloc.formats.hloc_files import Hdf5, Keypoints, open_hdf5, read_keypoints, read_matches
from spherloc.frontend.view import Matches, View
from spherloc.types import FloatArray, IntArray

_WORTH_SAYING_PX = 1.0
"""Rounding and uncertainty of keypoints beyond it are said: bounds on the noise are a few pixels."""


@dataclass(frozen=True, eq=False)
class _Pair:
    """What one reference gives."""

    reference: View
    keypoints: IntArray
    """(M,) of the query."""
    point_ids: IntArray
    """(M,) of the model."""
    points: FloatArray
    """(M, 3) map frame."""
    pixels: FloatArray
    """(M, 2) in the reference."""


@dataclass(frozen=True, eq=False)
class HlocMatcher:
    """Looks the matches of a query up in hloc's files."""

    features: Path
    """HDF5 file with the queries' keypoints."""
    matches: Path
    """HDF5 file with the matches of the pairs."""
    model: ColmapModel
    references: Mapping[str, View]
    """By name, all of them images of the model."""
    pairs: Mapping[str, tuple[str, ...]]
    """Names of references by query."""

    def __call__(self, query: View) -> Matches:
        """See ``Matcher``. A keypoint that several references match to one point counts once."""
        with open_hdf5(self.features) as features, open_hdf5(self.matches) as matches:
            keypoints = read_keypoints(features, query.name)
            if keypoints is None:
                raise InputError(f"{self.features}: has no keypoints of {show(query.name)}; extract its features.")
            _check_size(query, keypoints, self.features)
            found = _Found()
            for name in self.pairs.get(query.name, ()):
                try:
                    pair = self._pair(features, matches, query.name, len(keypoints.pixels), self.references[name])
                except InputError as error:
                    found.faults.append(str(error))
                    continue
                found.add(pair)
        return found.matches(query, keypoints, self.matches)

    def _pair(self, features: Hdf5, matches: Hdf5, query: str, count: int, reference: View) -> _Pair | None:
        """None if the pair was not matched."""
        observations = self.model.images[reference.name].load()
        pixels = observations["pixel"]
        own = read_keypoints(features, reference.name)
        if own is not None and len(own.pixels) != len(pixels):
            raise InputError(
                f"{features.path}: has {len(own.pixels)} keypoints of {show(reference.name)}, but the model has "
                f"{len(pixels)}; give the features that the model was made from."
            )
        index = read_matches(matches, query, reference.name, (count, len(pixels)))
        if index is None:
            return None
        ids = observations["point"][index[:, 1]]
        points = self.model.point_xyz(ids)
        known = np.isfinite(points).all(axis=1) & np.isfinite(pixels[index[:, 1]]).all(axis=1)
        return _Pair(reference, index[known, 0], ids[known], points[known], pixels[index[known, 1]])


@dataclass(eq=False)
class _Found:
    """What the pairs of a query gave so far."""

    pairs: list[_Pair] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    unmatched: int = 0

    def add(self, pair: _Pair | None) -> None:
        """Keep a pair, or count one that was not matched."""
        if pair is None:
            self.unmatched += 1
        else:
            self.pairs.append(pair)

    def matches(self, query: View, keypoints: Keypoints, file: Path) -> Matches:
        """All of it as correspondences; the reference with the most of them is taken for the most similar one."""
        pairs = sorted(self.pairs, key=lambda pair: -len(pair.keypoints))
        index = _joined([pair.keypoints for pair in pairs], (0,), np.int64)
        ids = _joined([pair.point_ids for pair in pairs], (0,), np.int64)
        _, first = np.unique(np.column_stack([index, ids]), axis=0, return_index=True)
        first.sort()
        of_pair = np.repeat(np.arange(len(pairs)), [len(pair.keypoints) for pair in pairs])
        return Matches(
            pixels=keypoints.pixels[index[first]],
            points=_joined([pair.points for pair in pairs], (0, 3), np.float64)[first],
            references=tuple(pair.reference for pair in pairs),
            reference_index=of_pair.astype(np.int64)[first],
            reference_pixels=_joined([pair.pixels for pair in pairs], (0, 2), np.float64)[first],
            remarks=tuple(self._remarks(query, keypoints, file)),
        )

    def _remarks(self, query: View, keypoints: Keypoints, file: Path) -> list[str]:
        count = len(self.pairs) + len(self.faults) + self.unmatched
        remarks = []
        if not count:
            remarks.append(f"{query.name} is in no pair, so it has no matches.")
        if self.unmatched:
            remarks.append(f"{self.unmatched} of {count} pairs of {query.name} are not in {file}.")
        if self.faults:
            remarks.append(f"{len(self.faults)} of {count} pairs of {query.name} are skipped: {self.faults[0]}")
        if keypoints.rounding_px >= _WORTH_SAYING_PX:
            remarks.append(
                f"Keypoints of {query.name} are half floats, which are rounded to {keypoints.rounding_px:g} px at the "
                "far edge of the image; extract features with as_half = False."
            )
        if (keypoints.uncertainty_px or 0.0) > _WORTH_SAYING_PX:
            remarks.append(
                f"Keypoints of {query.name} are uncertain by {keypoints.uncertainty_px:.2g} px, as they were found in "
                "a smaller image; bound_px should be larger than that."
            )
        return remarks


def _joined(parts: list, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    return np.concatenate([np.empty(shape, dtype), *parts])


def _check_size(query: View, keypoints: Keypoints, file: Path) -> None:
    size = (query.camera.width, query.camera.height)
    if keypoints.image_size not in (None, size):
        width, height = keypoints.image_size or size
        raise InputError(
            f"{file}: the keypoints of {show(query.name)} are of an image of {width} x {height} pixels, but its camera "
            f"has {size[0]} x {size[1]}; correct the list of queries."
        )
