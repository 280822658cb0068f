"""hloc: its features, matches and pairs, and the COLMAP model that it made.

Without ``features`` and ``matches``, the project's own features are matched as [frontend] says: the pairs, or what
``global_features = "outputs/global-feats.h5"`` retrieves, or what the project retrieves by itself. hloc's models keep
the order of the keypoints: the i-th in features.h5 is the i-th of the model's image.

P.-E. Sarlin, C. Cadena, R. Siegwart, M. Dymczyk: From Coarse to Fine: Robust Hierarchical Localization at Large Scale,
CVPR 2019.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.datasets import map_settings, scene_file
from spherloc.datasets.colmap_views import gravity_of_map, model_views, some, split_gravity
from spherloc.datasets.hloc_matches import HlocMatcher
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError, shorten, show
from spherloc.files import is_file
from spherloc.formats.colmap_model import ColmapModel, read_model
from spherloc.formats.hloc_files import open_hdf5, read_global_descriptors, read_pairs, read_queries, read_results
from spherloc.frontend.frontend_options import MOST_REFERENCES
from spherloc.frontend.pipeline import image_matcher
from spherloc.frontend.view import Matcher, View
from spherloc.types import FloatArray

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

[gravity]                                  # optional
map = [0.0, 0.0, -1.0]                     # down; else the mean +y axis of the reference cameras
bound_deg = 5.0                            # how far a query's roll and pitch may be from its reference's
"""

GRAVITY_BOUND_DEG = 5.0
"""A reference's roll and pitch are not the query's: cameras are held by hand."""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "hloc"``.

    ``features`` and ``matches`` give the correspondences of the ``pairs``; without them, the project's own front end
    matches the pairs, or what ``global_features`` retrieve. Raises ``InputError`` for a missing file or a wrong key.
    """
    where = str(path)
    required = map_settings.REQUIRED | {"model", "images", "queries"}
    optional = {"features", "matches", "pairs", "global_features", "truth"}
    scene_file.check_keys(table, required, map_settings.OPTIONAL | optional, where)
    _check_combination(table, where)
    shared_gravity, gravity = split_gravity(table, where)
    scene_file.check_keys(gravity, set(), {"map"}, f"{where} [gravity]")
    settings = map_settings.read_settings(table | {"gravity": shared_gravity}, where, GRAVITY_BOUND_DEG)
    images = map_settings.folder(table, "images", path)
    model = read_model(map_settings.folder(table, "model", path))
    references, remarks = model_views(model, images)
    down, assumed = gravity_of_map(gravity, references, where)
    cameras, skipped = read_queries(_file(table, "queries", path))
    truth, unknown = _truth(_file(table, "truth", path), cameras) if "truth" in table else ({}, [])
    queries, missing = _queries(cameras, images, truth)
    pairs, unpaired = _pairs(table, path, queries, references)
    said = (*remarks, *assumed, *skipped, *unknown, *missing, *unpaired)
    matcher = _matcher(table, path, model, tuple(references), pairs)
    return settings.scene(path, queries, references, down, said, matcher=matcher)


def _check_combination(table: Mapping[str, Any], where: str) -> None:
    if ("features" in table) != ("matches" in table):
        one, other = ("features", "matches") if "features" in table else ("matches", "features")
        raise InputError(f"{where}: '{one}' is of no use without '{other}'; give both or neither.")
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
    """Poses by query. hloc's results name an image without its folders, or with the last one only."""
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
    remarks = [f"{others} of {len(results)} poses in {path} are of no query."] if others else []
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
            pairs[view.name] = tuple(names[rows[place]] for place in order[:MOST_REFERENCES])
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
        with open_hdf5(file):  # says now what is wrong with it
            pass
    return HlocMatcher(
        features=features,
        matches=matches,
        model=model,
        references={view.name: view for view in references},
        pairs=pairs,
    )
