"""hloc: its features, matches and pairs, and the COLMAP model that it made.

Without ``features`` and ``matches``, the project detects and matches its own features as [frontend] says: in the pairs,
or with the references that ``global_features = "outputs/global-feats.h5"`` retrieves, or with those that the project
retrieves by itself. hloc's models keep the order of the keypoints: the i-th in features.h5 is the i-th of the model's
image. A query that is an image of the model is no reference, and points that only it and one reference saw are left
out, as for ``kind = "colmap"``.

P.-E. Sarlin, C. Cadena, R. Siegwart, M. Dymczyk: From Coarse to Fine: Robust Hierarchical Localization at Large Scale,
CVPR 2019.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.colmap import (
    assumed_units,
    gravity_of_map,
    model_views,
    read_map,
    some,
    split_gravity,
    without_queries,
)
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError, shorten, show
from spherloc.files import is_file
from spherloc.formats.colmap_model import ColmapModel
from spherloc.formats.hloc_files import (
    Hdf5,
    HlocKeypoints,
    open_hdf5,
    read_global_descriptors,
    read_keypoints,
    read_matches,
    read_pairs,
    read_queries,
    read_results,
)
from spherloc.frontend.pipeline import MAX_REFERENCES, image_matcher
from spherloc.frontend.view import Matcher, Matches, View
from spherloc.types import FloatArray, IntArray

_WORTH_SAYING_PX = 1.0
"""Rounding and uncertainty of keypoints above this are reported in a remark: bounds on the noise are a few pixels."""


@dataclass(frozen=True, eq=False)
class _Pair:
    """The matches of a query with one reference."""

    reference: View
    keypoints: IntArray
    """(M,) indices of the query's keypoints."""
    point_ids: IntArray
    """(M,) ids of the model's points."""
    points: FloatArray
    """(M, 3) the points, map frame, m."""
    pixels: FloatArray
    """(M, 2) their pixels in the reference."""


@dataclass(frozen=True, eq=False)
class HlocMatcher:
    """Looks the matches of a query up in hloc's files."""

    features: Path
    """HDF5 file with the queries' keypoints."""
    matches: Path
    """HDF5 file with the matches of the pairs."""
    model: ColmapModel
    references: Mapping[str, View]
    """References by name, all of them images of the model."""
    pairs: Mapping[str, tuple[str, ...]]
    """Names of references by query."""

    def __call__(self, query: View) -> Matches:
        """See ``Matcher``. A keypoint that several references match to one point counts once."""
        with open_hdf5(self.features) as features, open_hdf5(self.matches) as matches:
            keypoints = read_keypoints(features, query.name)
            if keypoints is None:
                raise InputError(f"{self.features}: has no keypoints of {show(query.name)}; extract its features.")
            _check_size(query, keypoints, self.features)
            found = _QueryMatches()
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
class _QueryMatches:
    """The matches that the pairs of a query gave so far."""

    pairs: list[_Pair] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    unmatched: int = 0

    def add(self, pair: _Pair | None) -> None:
        """Keep a pair, or count one that was not matched."""
        if pair is None:
            self.unmatched += 1
        else:
            self.pairs.append(pair)

    def matches(self, query: View, keypoints: HlocKeypoints, file: Path) -> Matches:
        """All matches as correspondences; the reference with the most of them counts as the most similar one."""
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

    def _remarks(self, query: View, keypoints: HlocKeypoints, file: Path) -> list[str]:
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


def _check_size(query: View, keypoints: HlocKeypoints, file: Path) -> None:
    size = (query.camera.width, query.camera.height)
    if keypoints.image_size not in (None, size):
        width, height = keypoints.image_size or size
        raise InputError(
            f"{file}: the keypoints of {show(query.name)} are of an image of {width} x {height} pixels, but its camera "
            f"has {size[0]} x {size[1]}; correct the list of queries."
        )


EXTRAS = ("colmap", "hloc")
EXAMPLE = """\
kind = "hloc"
name = "my city"
model = "outputs/sfm"                      # COLMAP model of the references, binary or text
images = "images"                          # folder of the images
queries = "queries_with_intrinsics.txt"    # rows: name MODEL width height parameters
pairs = "outputs/pairs-netvlad.txt"        # rows: query reference, the most similar one first
features = "outputs/feats.h5"              # of the queries
matches = "outputs/matches.h5"             # of the pairs
truth = "outputs/results.txt"              # optional, rows: name qw qx qy qz tx ty tz
units = "unknown"                          # COLMAP knows no scale; "metres" if the model is to scale

[gravity]                                  # optional
map = [0.0, 0.0, -1.0]                     # down; else the mean +y axis of the reference cameras
bound_deg = 5.0                            # how far a query's roll and pitch may be from its reference's
# query = "lines"                          # down in a query from the vertical lines of its image instead
# file = "gravity.txt"                     # or from rows: image gx gy gz [sd_deg]
"""

GRAVITY_BOUND_DEG = 5.0
"""Default bound on the difference of a query's roll and pitch from its most similar reference's: cameras are
handheld."""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "hloc"``.

    ``features`` and ``matches`` give the correspondences of the ``pairs``; without them, the project's own front end
    matches the pairs, or what ``global_features`` retrieve. Raises ``InputError`` for a missing file or a wrong key.
    """
    where = str(path)
    required = map_scene.REQUIRED | {"model", "images", "queries"}
    optional = {"features", "matches", "pairs", "global_features", "truth"}
    scene_file.check_keys(table, required, map_scene.OPTIONAL | optional, where)
    _check_combination(table, where)
    shared_gravity, gravity = split_gravity(table, where)
    scene_file.check_keys(gravity, set(), {"map"}, f"{where} [gravity]")
    settings = map_scene.read_settings(table | {"gravity": shared_gravity}, where, GRAVITY_BOUND_DEG)
    images = map_scene.folder(table, "images", path)
    model = read_map(map_scene.folder(table, "model", path))
    cameras, skipped = read_queries(_file(table, "queries", path))
    model, references, remarks = _map(model, images, cameras, where)
    down, assumed = gravity_of_map(gravity, references, where)
    truth, unknown = _truth(_file(table, "truth", path), cameras) if "truth" in table else ({}, [])
    queries, missing = _queries(cameras, images, truth)
    pairs, unpaired = _pairs(table, path, queries, references)
    said = (*remarks, *assumed, *assumed_units(table), *skipped, *unknown, *missing, *unpaired)
    matcher = _matcher(table, path, model, tuple(references), pairs)
    others = {"matcher": matcher, "assumed_down": bool(assumed), "cloud": model.points.xyz}
    named = [key for key in ("features", "matches", "pairs", "global_features") if key in table]
    others["matched_files"] = tuple(_file(table, key, path) for key in named)
    return settings.scene(path, queries, references, down, said, **others)


def _map(
    model: ColmapModel, images: Path, queries: Mapping[str, Camera], where: str
) -> tuple[ColmapModel, list[View], list[str]]:
    """The model and its views, without the queries that are images of it, and remarks.

    Raises ``InputError`` if no image or no point stays.
    """
    both = [name for name in model.images if name in queries]
    if not both:
        return model, *model_views(model, images)
    if len(both) == len(model.images):
        raise InputError(
            f"{where}: all images of the model are queries; list fewer queries, or add images to the model."
        )
    model, left_out = without_queries(model, both, where)
    views, remarks = model_views(model, images)
    said = f"Queries that are in the model, too: {some(both, 'image')}, not used as references."
    return model, [view for view in views if view.name not in queries], [*remarks, said, *left_out]


def _check_combination(table: Mapping[str, Any], where: str) -> None:
    if ("features" in table) != ("matches" in table):
        one, other = ("features", "matches") if "features" in table else ("matches", "features")
        raise InputError(f"{where}: '{one}' needs '{other}' as well; give both or neither.")
    if "matches" in table and "pairs" not in table:
        raise InputError(f"{where}: key 'pairs' is missing; give the list of pairs that were matched.")
    for one, other in (("matches", "frontend"), ("pairs", "global_features")):
        if one in table and other in table:
            raise InputError(f"{where}: '{one}' and '{other}' say the same in two ways; remove one of them.")


def _file(table: Mapping[str, Any], key: str, path: Path) -> Path:
    return path.parent / scene_file.text(table, key, str(path))


def _queries(
    cameras: Mapping[str, Camera], images: Path, truth: Mapping[str, FloatArray]
) -> tuple[tuple[View, ...], list[str]]:
    """A view of every query whose image exists, and a remark on the others."""
    views, missing = [], []
    for name, camera in cameras.items():
        if is_file(images / name):
            views.append(View(name, camera, images / name, truth.get(name)))
        else:
            missing.append(name)
    return tuple(views), [f"{some(missing, 'query')} not found in {images}: left out."] if missing else []


def _truth(path: Path, cameras: Mapping[str, Camera]) -> tuple[dict[str, FloatArray], list[str]]:
    """True poses by query. hloc's results name an image without its folders, or with the last one only."""
    by_tail: dict[str, list[str]] = {}
    for name in cameras:
        parts = name.split("/")
        for start in range(len(parts)):
            by_tail.setdefault("/".join(parts[start:]), []).append(name)
    poses, others = {}, 0
    results = read_results(path)
    for named, cam_from_map in results.items():
        meant = [named] if named in cameras else by_tail.get(named, [])
        if len(meant) > 1:
            raise InputError(
                f"{path}: {show(named)} may be {show(meant[0])} or {show(meant[1])}; name the images with their "
                "folders."
            )
        if meant:
            poses[meant[0]] = cam_from_map
        others += not meant
    remarks = [f"{others} of {len(results)} poses in {path} belong to none of the queries."] if others else []
    if len(poses) < len(cameras):
        remarks.append(f"{len(cameras) - len(poses)} of {len(cameras)} queries have no pose in {path}.")
    return poses, remarks


def _pairs(
    table: Mapping[str, Any], path: Path, queries: Sequence[View], references: Sequence[View]
) -> tuple[dict[str, tuple[str, ...]] | None, list[str]]:
    """Names of references by query, None where nothing gives them, and what was left out."""
    if "global_features" in table:
        return _retrieved(_file(table, "global_features", path), queries, references)
    if "pairs" not in table:
        return None, []
    file = _file(table, "pairs", path)
    listed = read_pairs(file)
    known = {view.name for view in references}
    in_map = {view.name: tuple(name for name in listed.get(view.name, ()) if name in known) for view in queries}
    pairs = {name: names for name, names in in_map.items() if names}
    remarks = []
    asked = [name for view in queries for name in listed.get(view.name, ())]
    absent = [name for name in asked if name not in known]
    if absent:
        remarks.append(
            f"{len(absent)} of {len(asked)} pairs in {file} are skipped: their reference is not in the map, the first "
            f"is {shorten(absent[0])}."
        )
    alone = [name for name in in_map if name not in pairs]
    if alone:
        remarks.append(
            f"{len(alone)} of {len(queries)} queries have no pair in {file}, the first is {shorten(alone[0])}."
        )
    return pairs, remarks


def _retrieved(
    file: Path, queries: Sequence[View], references: Sequence[View]
) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """References of every query by their global descriptors, the most similar first."""
    names = [view.name for view in (*queries, *references)]
    descriptors = read_global_descriptors(file, names)
    known = np.isfinite(descriptors[:, 0])
    rows = len(queries) + np.flatnonzero(known[len(queries) :])
    pairs = {}
    for row, view in enumerate(queries):
        order = np.argsort(-(descriptors[rows] @ descriptors[row]), kind="stable") if known[row] else []
        if len(order):
            pairs[view.name] = tuple(names[rows[place]] for place in order[:MAX_REFERENCES])
    missing = int(np.count_nonzero(~known))
    return pairs, [f"{missing} of {len(names)} images have no descriptor in {file}."] if missing else []


def _matcher(
    table: Mapping[str, Any],
    path: Path,
    model: ColmapModel,
    references: tuple[View, ...],
    pairs: Mapping[str, tuple[str, ...]] | None,
) -> Matcher:
    if "matches" not in table or pairs is None:
        frontend = scene_file.section(table, "frontend", str(path))
        return image_matcher(references, frontend, str(path), path.parent, pairs)
    features, matches = _file(table, "features", path), _file(table, "matches", path)
    for file in (features, matches):
        with open_hdf5(file):  # a damaged file is refused now, not at the first query
            pass
    return HlocMatcher(
        features=features,
        matches=matches,
        model=model,
        references={view.name: view for view in references},
        pairs=pairs,
    )
