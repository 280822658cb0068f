"""The keys that all scenes made of images share."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spherloc.datasets import scene_file
from spherloc.datasets.map_scene import DEFAULT_THRESHOLDS, MapScene, Thresholds
from spherloc.errors import InputError
from spherloc.files import is_folder
from spherloc.frontend.pipeline import image_matcher
from spherloc.frontend.view import View
from spherloc.types import FloatArray

REQUIRED = {"kind", "name"}
OPTIONAL = {"about", "frontend", "gravity", "options", "thresholds"}


@dataclass(frozen=True)
class MapSettings:
    """What the shared keys say."""

    name: str
    frontend: Mapping[str, Any]
    """The section [frontend], for ``image_matcher`` to check."""
    gravity_bound_rad: float
    gravity_sd_rad: float | None
    bound_px: float | None
    thresholds: Thresholds

    def scene(
        self,
        path: Path,
        queries: Iterable[View],
        references: Iterable[View],
        gravity_map: FloatArray,
        remarks: Iterable[str] = (),
        **others: Any,
    ) -> MapScene:
        """The scene of these images; ``path`` is its file, and ``others`` are further fields of ``MapScene``.

        Without a ``matcher`` among them, the front end that [frontend] describes is taken. Raises ``InputError`` for a
        wrong [frontend] and if there is no query or no reference.
        """
        given = tuple(references)
        if "matcher" not in others:
            others["matcher"] = image_matcher(given, self.frontend, str(path), path.parent)
        return MapScene(
            name=self.name,
            where=str(path),
            queries=tuple(queries),
            references=given,
            gravity_map=gravity_map,
            gravity_bound_rad=self.gravity_bound_rad,
            gravity_sd_rad=self.gravity_sd_rad,
            bound_px=self.bound_px,
            thresholds=self.thresholds,
            remarks=tuple(remarks),
            **others,
        )


def read_settings(
    table: Mapping[str, Any], where: str, gravity_bound_deg: float, thresholds: Thresholds = DEFAULT_THRESHOLDS
) -> MapSettings:
    """The shared keys of a scene file; ``gravity_bound_deg`` and ``thresholds`` are the loader's defaults.

    Keys of the loader's own are for it to check, by ``scene_file.check_keys`` with ``REQUIRED`` and ``OPTIONAL``
    among the known ones. Raises ``InputError`` for a wrong value.
    """
    gravity = {"bound_deg": gravity_bound_deg} | scene_file.section(table, "gravity", where)
    scene_file.check_keys(gravity, set(), {"bound_deg", "sd_deg"}, f"{where} [gravity]")
    bound_rad, sd_rad = scene_file.gravity_error_rad(gravity, f"{where} [gravity]")
    return MapSettings(
        name=scene_file.text(table, "name", where),
        frontend=scene_file.section(table, "frontend", where),
        gravity_bound_rad=bound_rad,
        gravity_sd_rad=sd_rad,
        bound_px=scene_file.bound_px(table, where),
        thresholds=_thresholds(table["thresholds"], where) if "thresholds" in table else thresholds,
    )


def _thresholds(value: Any, where: str) -> Thresholds:
    """``thresholds = [[deg, m], ...]``."""
    rows = len(value) if isinstance(value, list) else 0
    if not 1 <= rows <= 10:
        raise InputError(f"{where}: thresholds must be a list of pairs [degrees, metres], strictest first.")
    pairs = scene_file.numbers(value, (rows, 2), "thresholds", where)
    if not (pairs > 0).all():
        raise InputError(f"{where}: thresholds must be pairs of positive numbers [degrees, metres].")
    return tuple((float(degrees), float(metres)) for degrees, metres in pairs)


def folder(table: Mapping[str, Any], key: str, path: Path) -> Path:
    """An existing folder, given relative to the scene file ``path`` or absolutely.

    Raises ``InputError`` if there is none.
    """
    named = path.parent / scene_file.text(table, key, str(path))
    if not is_folder(named):
        raise InputError(f"{path}: {key} names the folder {named}, which does not exist; correct the path.")
    return named
