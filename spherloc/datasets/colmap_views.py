"""What the images of a COLMAP model give the front end: views whose observed keypoints have points."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.datasets import scene_file
from spherloc.errors import CalibrationError, InputError, shorten
from spherloc.files import is_file
from spherloc.formats.colmap_model import ColmapImage, ColmapModel
from spherloc.frontend.lifting import SfmLift
from spherloc.frontend.view import View
from spherloc.types import BoolArray, FloatArray

_KEPT = 64
"""Images whose observations stay in memory, those used last."""
_LEAST_AGREEMENT = 0.9
"""Length of the mean of the cameras' +y axes: 0.9 where all tilt by 25 degrees."""


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


def some(names: Sequence[str], what: str) -> str:
    """How many, and the first three by name: "5 images (a, b, c, ...)"."""
    plural = what if len(names) == 1 else f"{what}s"
    return f"{len(names)} {plural} ({', '.join(map(shorten, names[:3]))}{', ...' if len(names) > 3 else ''})"


def split_gravity(table: Mapping[str, Any], where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The section [gravity] without and with only its keys ``map`` and ``camera``, which not all scenes have."""
    gravity = scene_file.section(table, "gravity", where)
    own = {key: value for key, value in gravity.items() if key in ("map", "camera")}
    return {key: value for key, value in gravity.items() if key not in own}, own


def unit_vector(value: Any, key: str, where: str) -> FloatArray:
    """A vector (3,) of a scene file, scaled to length 1; raises ``InputError`` if it has none."""
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
    if axes and length < _LEAST_AGREEMENT:
        raise InputError(
            f"{where}: the reference cameras were not held upright, so they do not show where down is; add a section "
            "[gravity] with map = [x, y, z] pointing down."
        )
    down = mean / length if axes else np.array([0.0, 1.0, 0.0])
    return down, [
        "Down in the map is the mean +y axis of the reference cameras, as if they were held upright; [gravity] map "
        "would say it for sure."
    ]
