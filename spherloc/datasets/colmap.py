"""COLMAP: some images of a model are localized against the others.

A query is never a reference, and its pose in the model is the truth. Points that only the queries made possible are
left out; the other points, and all poses, stay as the adjustment of the whole model left them. Lengths are in the
model's unit.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import CalibrationError, InputError, shorten, show
from spherloc.files import is_file
from spherloc.formats.colmap_files import read_model
from spherloc.formats.colmap_model import ColmapImage, ColmapModel, ModelPoints
from spherloc.frontend.lifting import SfmLift
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre
from spherloc.types import BoolArray, FloatArray, IntArray

_KEPT = 64
"""Number of images whose observations stay in memory: those used last."""
_MIN_AGREEMENT = 0.9
"""Least length of the mean of the cameras' unit +y axes: it is 0.9 where all tilt by 25 degrees."""
_MIN_ANGLE_DEG = 1.5
"""Least angle between the rays to a point: COLMAP's mapper removes points below it (``filter_min_tri_angle``)."""


@dataclass(frozen=True, eq=False)
class ObservedLift:
    """Points of an image's keypoints in a model; its observations are read when they are first needed."""

    model: ColmapModel
    image: ColmapImage

    def __call__(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """See ``Lift``."""
        return _sfm_lift(self)(pixels)


@lru_cache(maxsize=_KEPT)
def _sfm_lift(lift: ObservedLift) -> SfmLift:
    return SfmLift(*lift.image.observed(lift.model))


def read_map(folder: Path) -> ColmapModel:
    """The model in ``folder`` as a map; raises ``InputError`` as ``read_model`` does, and if it has no points."""
    model = read_model(folder)
    if len(model.points.ids) == 0:
        raise InputError(
            f"{folder}: the COLMAP model has no points, by whose matches a query is localized; make them with colmap "
            "point_triangulator, or give another model."
        )
    return model


def assumed_units(table: Mapping[str, Any]) -> list[str]:
    """A remark where a scene file does not say whether the lengths of its model are metres: COLMAP knows no scale."""
    if "units" in table:
        return []
    return [
        'Lengths are told in metres, as if the model were to scale; units = "unknown" in the scene file tells them in '
        'units of the map, and units = "metres" says that it is to scale.'
    ]


def model_views(model: ColmapModel, images: Path) -> tuple[list[View], list[str]]:
    """Views of a model's images, by name, and remarks on those left out.

    Left out are images that are not in the folder ``images`` and those of a camera that is not supported.
    """
    views, missing, unsupported = [], [], {}
    for image in model.images.values():
        try:
            camera = model.camera(image.camera_id)
        except CalibrationError as error:
            unsupported.setdefault(str(error), []).append(image.name)
            continue
        path = images / image.name
        if not is_file(path):
            missing.append(image.name)
            continue
        views.append(View(image.name, camera, path, image.cam_from_map, lift=ObservedLift(model, image)))
    remarks = [*model.remarks]
    if missing:
        remarks.append(f"{some(missing, 'image')} of the model not found in {images}: left out.")
    remarks += [f"{some(names, 'image')} left out: {reason}" for reason, names in unsupported.items()]
    return views, remarks


def without_queries(model: ColmapModel, queries: Collection[str], where: str) -> tuple[ColmapModel, list[str]]:
    """The model without the points that it has only because of the images named ``queries``, and a remark on them.

    A point that a query observes stays if the rays to it from other images are ``_MIN_ANGLE_DEG`` apart. One that
    only the query and one reference (or several at one place) see was intersected with the query's own ray: by its
    construction it fits the query's true pose, so that a match with it would test nothing. For more than two rays their
    angle is that across the box around their unit vectors, at most sqrt(3) times the largest between two.

    Raises ``InputError`` if no point stays or the observations cannot be read.
    """
    points = model.points
    observed = np.zeros(len(points.ids), dtype=bool)
    for name in queries:
        observed[_observed(model, name)] = True
    low, high = np.full_like(points.xyz, np.inf), np.full_like(points.xyz, -np.inf)
    others = [name for name in model.images if name not in queries]
    for name in others:
        places = _observed(model, name)
        places = places[observed[places]]
        rays = points.xyz[places] - camera_centre(model.images[name].cam_from_map)
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
        low[places] = np.minimum(low[places], rays)
        high[places] = np.maximum(high[places], rays)
    apart = np.linalg.norm(high - low, axis=1) >= 2.0 * np.sin(np.radians(_MIN_ANGLE_DEG) / 2.0)
    stay = ~observed | (np.isfinite(low[:, 0]) & apart)
    if stay.all():
        return model, []
    reason = f"without the queries, no two images see them from directions {_MIN_ANGLE_DEG} degrees apart"
    if others and not stay.any():
        raise InputError(
            f"{where}: no point of the model can be used: {reason}; name fewer queries, or add images to the model."
        )
    kept = ModelPoints(points.ids[stay], points.xyz[stay], points.errors_px[stay], points.track_lengths[stay])
    gone = np.count_nonzero(~stay)
    return replace(model, points=kept), [f"{gone:,} of {len(stay):,} points of the model left out: {reason}."]


def _observed(model: ColmapModel, name: str) -> IntArray:
    """Which of the model's points an image observes, as indices (K,)."""
    places = model.point_places(model.images[name].point_ids)
    return places[places >= 0]


def some(names: Sequence[str], what: str) -> str:
    """Their number, and the names of the first three: "5 images (a, b, c, ...)"."""
    plural = what if len(names) == 1 else f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"{len(names):,} {plural} ({', '.join(map(shorten, names[:3]))}{', ...' if len(names) > 3 else ''})"


def split_gravity(table: Mapping[str, Any], where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The section [gravity] without and with only its keys ``map`` and ``camera``, which not all scenes have."""
    gravity = scene_file.section(table, "gravity", where)
    own = {key: value for key, value in gravity.items() if key in ("map", "camera")}
    return {key: value for key, value in gravity.items() if key not in own}, own


def unit_vector(value: Any, key: str, where: str) -> FloatArray:
    """A vector (3,) of a scene file, scaled to length 1; raises ``InputError`` if its length is zero or not finite."""
    vector = scene_file.numbers(value, (3,), key, where)
    length = float(np.linalg.norm(vector))
    if not 1e-3 < length < 1e3:
        raise InputError(f"{where}: {key} has the length {length:.3g}; give a vector that points down.")
    return vector / length


def gravity_of_map(own: Mapping[str, Any], references: Iterable[View], where: str) -> tuple[FloatArray, list[str]]:
    """Down in the map frame, and a remark where it is an assumption.

    It is ``[gravity] map``, or, without that, the mean +y axis of the references' cameras: right where they were held
    upright on average, since a model made of images alone knows no gravity. Raises ``InputError`` if they disagree.
    """
    if "map" in own:
        return unit_vector(own["map"], "map", f"{where} [gravity]"), []
    axes = [reference.cam_from_map[1, :3] for reference in references if reference.cam_from_map is not None]
    mean = np.mean(axes, axis=0) if axes else np.zeros(3)
    length = float(np.linalg.norm(mean))
    if axes and length < _MIN_AGREEMENT:
        raise InputError(
            f"{where}: the reference cameras were not held upright, so they do not show where down is; add a section "
            "[gravity] with map = [x, y, z] pointing down."
        )
    down = mean / length if axes else np.array([0.0, 1.0, 0.0])
    return down, [
        "Down in the map is the mean +y axis of the reference cameras, as if they were held upright; [gravity] map "
        "would say it for sure."
    ]


EXTRAS = ("colmap",)
EXAMPLE = """\
kind = "colmap"
name = "my model"
model = "sparse/0"        # folder with cameras, images and points3D, binary or text
images = "images"         # folder of the images
queries = "night/*"       # a pattern of names, a list of names, or a number n for every n-th image
units = "unknown"         # COLMAP knows no scale; "metres" if the model is to scale

[gravity]                 # optional
map = [0.0, 0.0, -1.0]    # down; else the mean +y axis of the reference cameras
bound_deg = 3.0           # how far a query's roll and pitch may be from its reference's
# query = "lines"         # down in a query from the vertical lines of its image instead
# file = "gravity.txt"    # or from rows: image gx gy gz [sd_deg]
"""

GRAVITY_BOUND_DEG = 3.0
"""Default bound on how far a query's roll and pitch are from those of its most similar reference."""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "colmap"``; paths in it are relative to its file.

    Raises ``InputError`` for a wrong key or value, a missing file, or a model that cannot be read.
    """
    where = str(path)
    scene_file.check_keys(table, map_scene.REQUIRED | {"model", "images", "queries"}, map_scene.OPTIONAL, where)
    shared_gravity, gravity = split_gravity(table, where)
    scene_file.check_keys(gravity, set(), {"map"}, f"{where} [gravity]")
    settings = map_scene.read_settings(table | {"gravity": shared_gravity}, where, GRAVITY_BOUND_DEG)
    images = map_scene.folder(table, "images", path)
    model = read_map(map_scene.folder(table, "model", path))
    chosen = set(_chosen(table["queries"], list(model.images), where))
    model, left_out = without_queries(model, chosen, where)
    views, remarks = model_views(model, images)
    references = tuple(view for view in views if view.name not in chosen)
    down, assumed = gravity_of_map(gravity, references, where)
    queries = (view for view in views if view.name in chosen)
    remarks = [*remarks, *left_out, *assumed, *assumed_units(table)]
    return settings.scene(
        path,
        queries,
        references,
        down,
        remarks,
        assumed_down=bool(assumed),
        cloud=model.points.xyz,
        truth_source="the model, which the queries' own images helped to make",
    )


def _chosen(value: Any, names: list[str], where: str) -> list[str]:
    """The names that the key ``queries`` means, among those of the model in their order."""
    if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
        unknown = sorted(set(value) - set(names))
        if unknown:
            raise InputError(f"{where}: {some(unknown, 'query image')} not in the model; name images of the model.")
        return value
    if isinstance(value, str) and value:
        chosen = [name for name in names if fnmatchcase(name, value)]
    elif isinstance(value, int) and not isinstance(value, bool) and value >= 2:
        chosen = names[value - 1 :: value]
    else:
        raise InputError(
            f"{where}: queries is {show(value)}; give a pattern of names, a list of names, or a whole number n from 2 "
            "to take every n-th image."
        )
    if not chosen:
        raise InputError(f"{where}: queries = {show(value)} fits none of the {len(names)} images of the model.")
    return chosen
