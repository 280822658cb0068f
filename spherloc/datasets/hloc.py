"""Scenes of ``kind = "hloc"``: what hloc wrote (features, matches, pairs), and the COLMAP model that it made.

P.-E. Sarlin, C. Cadena, R. Siegwart, M. Dymczyk: From Coarse to Fine: Robust Hierarchical Localization at Large Scale,
CVPR 2019. hloc's models keep the order of the keypoints: the i-th of features.h5 is the i-th of the model's image.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import BoolArray, Camera, FloatArray
from spherloc.datasets import map_settings, scene_file
from spherloc.datasets.colmap_model import ColmapImage, ColmapModel, read_model
from spherloc.datasets.hloc_files import read_global_descriptors, read_pairs, read_queries, read_results
from spherloc.datasets.hloc_matches import HlocMatcher
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import CalibrationError, InputError
from spherloc.frontend.lifting import SfmLift
from spherloc.frontend.pipeline import image_matcher
from spherloc.frontend.view import Matcher, View

GRAVITY_BOUND_DEG = 5.0
"""A reference's roll and pitch are not the query's: cameras are held by hand."""
RETRIEVED = 20
"""References of a query by global descriptors; hloc's recipes take 10 to 50."""
_LEAST_AGREEMENT = 0.5
"""Length of the references' mean direction down, below which they do not agree on one."""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "hloc"``.

    ``features`` and ``matches`` give the correspondences of the ``pairs``; without them, the project's own front end
    matches the pairs, or what ``global_features`` retrieve. Raises ``InputError`` for a missing file or a wrong key.
    """
    where = str(path)
    optional = {"features", "matches", "pairs", "global_features", "truth", "gravity_map"}
    required = map_settings.REQUIRED | {"model", "images", "queries"}
    scene_file.check_keys(table, required, map_settings.OPTIONAL | optional, where)
    _check_combination(table, where)
    settings = map_settings.read_settings(table, where, GRAVITY_BOUND_DEG)
    model = read_model(map_settings.folder(table, "model", path))
    images = map_settings.folder(table, "images", path)
    references, remarks = _references(model, images)
    cameras, skipped = read_queries(_file(table, "queries", path))
    truth, unknown = _truth(_file(table, "truth", path), cameras) if "truth" in table else ({}, [])
    queries = tuple(View(name, camera, images / name, truth.get(name)) for name, camera in cameras.items())
    pairs, unpaired = _pairs(table, path, queries, references)
    return MapScene(
        name=settings.name,
        where=where,
        queries=queries,
        references=references,
        matcher=_matcher(table, path, model, references, pairs),
        gravity_map=_gravity_map(table, where, references),
        gravity_bound_rad=settings.gravity_bound_rad,
        gravity_sd_rad=settings.gravity_sd_rad,
        bound_px=settings.bound_px,
        thresholds=settings.thresholds,
        remarks=(*model.remarks, *remarks, *skipped, *unknown, *unpaired),
    )


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


@dataclass(frozen=True, eq=False)
class _ModelLift:
    """An image's points in the model, read when they are first asked for."""

    model: ColmapModel
    image: ColmapImage

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """See ``Lift``."""
        return SfmLift(*self.image.observed(self.model))(pixels)


def _references(model: ColmapModel, images: Path) -> tuple[tuple[View, ...], list[str]]:
    """A view of every image of the model whose camera can be used, and a remark on the others."""
    views, faults = [], []
    for image in model.images.values():
        try:
            camera = model.camera(image.camera_id)
        except CalibrationError as error:
            faults.append(str(error))
            continue
        lift = _ModelLift(model, image)
        views.append(View(image.name, camera, images / image.name, image.cam_from_map, lift=lift))
    remark = f"{len(faults)} of the model's images are skipped for their cameras: {faults[0]}" if faults else ""
    return tuple(views), [remark] if remark else []


def _truth(path: Path, cameras: Mapping[str, Camera]) -> tuple[dict[str, FloatArray], list[str]]:
    """Poses by query. hloc's results name an image without its folders, or with the last one only."""
    by_tail: dict[str, list[str]] = {}
    for name in cameras:
        parts = name.split("/")
        for start in range(len(parts)):
            by_tail.setdefault("/".join(parts[start:]), []).append(name)
    poses, others = {}, 0
    for named, cam_from_map in read_results(path).items():
        meant = [named] if named in cameras else by_tail.get(named, [])
        if len(meant) > 1:
            raise InputError(f"{path}: {named} may be {meant[0]} or {meant[1]}; name the images with their folders.")
        if meant:
            poses[meant[0]] = cam_from_map
        others += not meant
    remarks = [f"{others} poses of {path} are of no query."] if others else []
    if len(poses) < len(cameras):
        remarks.append(f"{len(cameras) - len(poses)} of {len(cameras)} queries have no pose in {path}.")
    return poses, remarks


def _pairs(
    table: Mapping[str, Any], path: Path, queries: tuple[View, ...], references: tuple[View, ...]
) -> tuple[dict[str, tuple[str, ...]] | None, list[str]]:
    """Names of references by query, None where nothing gives them, and what was left out."""
    if "global_features" in table:
        return _retrieved(_file(table, "global_features", path), queries, references)
    if "pairs" not in table:
        return None, []
    file = _file(table, "pairs", path)
    listed = read_pairs(file)
    known = {view.name for view in references}
    pairs = {view.name: tuple(name for name in listed.get(view.name, ()) if name in known) for view in queries}
    remarks = []
    absent = sum(name not in known for view in queries for name in listed.get(view.name, ()))
    if absent:
        remarks.append(f"{absent} pairs of {file} are skipped: their reference is not in the model.")
    alone = [name for name, names in pairs.items() if not names]
    if alone:
        remarks.append(f"{len(alone)} of {len(queries)} queries have no pair in {file}, the first is {alone[0]}.")
    return pairs, remarks


def _retrieved(
    file: Path, queries: tuple[View, ...], references: tuple[View, ...]
) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """The ``RETRIEVED`` references of every query whose global descriptors are the most similar."""
    names = [view.name for view in (*queries, *references)]
    descriptors = read_global_descriptors(file, names)
    known = np.isfinite(descriptors).all(axis=1) if descriptors.size else np.zeros(len(names), dtype=bool)
    rows = len(queries) + np.flatnonzero(known[len(queries) :])
    pairs = {}
    for row, view in enumerate(queries):
        order = np.argsort(-(descriptors[rows] @ descriptors[row]), kind="stable") if known[row] else []
        pairs[view.name] = tuple(names[rows[place]] for place in order[:RETRIEVED])
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
    return HlocMatcher(
        features=_file(table, "features", path),
        matches=_file(table, "matches", path),
        model=model,
        references={view.name: view for view in references},
        pairs=pairs,
    )


def _gravity_map(table: Mapping[str, Any], where: str, references: tuple[View, ...]) -> FloatArray:
    """The key ``gravity_map``, else the mean direction of the references' image columns, downwards."""
    if "gravity_map" in table:
        return scene_file.numbers(table["gravity_map"], (3,), "gravity_map", where)
    down = np.mean([np.asarray(view.cam_from_map)[1, :3] for view in references], axis=0) if references else np.ones(3)
    length = float(np.linalg.norm(down))
    if length < _LEAST_AGREEMENT:
        raise InputError(
            f"{where}: the references are rolled too differently to say where down is; add gravity_map = [x, y, z]."
        )
    return down / length
