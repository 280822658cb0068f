"""COLMAP: some images of a model are localized against the others.

Queries are no references, and their poses in the model are the truth. Lengths are those of the model.
"""

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from spherloc.datasets import map_settings, scene_file
from spherloc.datasets.colmap_views import gravity_of_map, model_views, some, split_gravity
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError, show
from spherloc.formats.colmap_model import read_model

EXTRAS = ("colmap",)
EXAMPLE = """\
kind = "colmap"
name = "my model"
model = "sparse/0"        # folder with cameras, images and points3D, binary or text
images = "images"         # folder of the images
queries = "night/*"       # a pattern of names, a list of names, or a number n for every n-th image

[gravity]                 # optional
map = [0.0, 0.0, -1.0]    # down; else the mean +y axis of the reference cameras
bound_deg = 3.0           # how far a query's roll and pitch may be from its reference's
"""

GRAVITY_BOUND_DEG = 3.0
"""Default bound on how far a query's roll and pitch are from those of its most similar reference."""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "colmap"``; paths in it are relative to its file.

    Raises ``InputError`` for a wrong key or value, a missing file, or a model that cannot be read.
    """
    where = str(path)
    scene_file.check_keys(table, map_settings.REQUIRED | {"model", "images", "queries"}, map_settings.OPTIONAL, where)
    shared_gravity, gravity = split_gravity(table, where)
    scene_file.check_keys(gravity, set(), {"map"}, f"{where} [gravity]")
    settings = map_settings.read_settings(table | {"gravity": shared_gravity}, where, GRAVITY_BOUND_DEG)
    images = map_settings.folder(table, "images", path)
    model = read_model(map_settings.folder(table, "model", path))
    chosen = set(_chosen(table["queries"], list(model.images), where))
    views, remarks = model_views(model, images)
    references = tuple(view for view in views if view.name not in chosen)
    down, assumed = gravity_of_map(gravity, references, where)
    queries = (view for view in views if view.name in chosen)
    return settings.scene(path, queries, references, down, (*remarks, *assumed))


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
