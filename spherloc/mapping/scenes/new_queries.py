"""Other images in a map that is made already: writes a scene whose queries they are, beside that of the map."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from spherloc.datasets.asl_layout import camera_of_folder
from spherloc.datasets.scene_file import read_table, section
from spherloc.errors import InputError, StoppedError, reason
from spherloc.files import is_folder
from spherloc.formats.colmap_files import read_model
from spherloc.formats.colmap_model import ColmapModel
from spherloc.frontend.view import View
from spherloc.mapping.alignment.true_poses import aligned_truth, truth_words
from spherloc.mapping.images.photographs import Photographs, cameras_of, with_cameras
from spherloc.mapping.scenes.new_images import new_images_of
from spherloc.mapping.scenes.scene_files import (
    GRAVITY,
    MODEL,
    UNITS_METRES,
    UNITS_UNKNOWN,
    MapHead,
    toml_value,
    write_new_scene,
)

SECTIONS = ("gravity", "frontend", "masks")
"""Sections of a scene file that are the same for all queries of a map."""


def map_images(scene: Path) -> Path | None:
    """The folder of the images of a map by one of its scene files; None if that is not a scene of a map made here.

    Raises ``InputError`` for a file that is no scene file.
    """
    own = _map_of(read_table(scene))
    return None if own is None or not is_folder(scene.parent / MODEL) else scene.parent / own["images"]


def map_size(scene: Path) -> int:
    """Number of images of the map with that scene file; raises ``InputError`` if its model cannot be read."""
    return len(read_model(scene.parent / MODEL).images)


def _map_of(table: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The keys ``model`` and ``images`` of a map in its scene file; None where they are not those of ``written``."""
    own = table if table.get("kind") == "colmap" else table.get("map")
    if not isinstance(own, Mapping) or own.get("model") != MODEL or not isinstance(own.get("images"), str):
        return None
    return own


def add_new_images(scene: Path, folder: Path) -> tuple[Path, tuple[str, ...]]:
    """Write a scene file whose queries are the images in ``folder``, in the map of the scene file ``scene``.

    Returns its path, and remarks on images that are left out. Raises ``InputError`` if ``scene`` is none of a map, if a
    file of the map cannot be read, or if the camera of no image is known, and ``StoppedError`` if the file cannot be
    written.
    """
    table, images = read_table(scene), map_images(scene)
    own = _map_of(table)
    if images is None or own is None:
        raise InputError(f"{scene.name}: is not the scene of a map; open one that spherloc map made, or the page.")
    model = read_model(scene.parent / MODEL)
    mapped = _mapped(model, images)
    new_images, remarks = new_images_of(folder, mapped)
    truth = None
    if new_images.truth is not None:
        truth = aligned_truth(new_images.truth, {one.name: one.cam_from_map for one in model.images.values()})
        remarks = (*remarks, truth_words(truth))
    gravity_of_map = table.get("gravity")
    if isinstance(gravity_of_map, dict) and gravity_of_map.get("file") == GRAVITY:
        table = table | {"gravity": {key: value for key, value in gravity_of_map.items() if key != "file"}}
    head = MapHead(
        name=_name(table),
        about=str(table.get("about", "")),
        images=own["images"],
        units=UNITS_UNKNOWN if table.get("units") == "unknown" else UNITS_METRES,
        sections=tuple(line for name in SECTIONS for line in _section(table, name, str(scene))),
    )
    try:
        return write_new_scene(head, scene.parent, new_images, mapped.views[0].camera, truth), remarks
    except OSError as error:
        raise StoppedError(
            f"{scene.parent}: cannot be written ({reason(error)}); make room there or allow it."
        ) from None


def _name(table: Mapping[str, Any]) -> str:
    """The name of the map; scenes of other images have that of their folder in front."""
    name, others = str(table.get("name", "")), Path(str(table.get("images", ""))).name
    return name.removeprefix(f"{others} in ") if "map" in table else name


def _mapped(model: ColmapModel, images: Path) -> Photographs:
    """The images of the map with their cameras; where it has several, by the folders of their images, else as the
    calibrations beside these name them, else by COLMAP's numbers."""
    views = tuple(View(one.name, model.camera(one.camera_id), images / one.name) for one in model.images.values())
    if len(cameras_of(views)) == 1:
        return Photographs(views, (), {})
    folders: dict[str, list[View]] = {}
    for view in views:
        inside = PurePosixPath(view.name).parent
        folders.setdefault("." if inside == PurePosixPath() else camera_of_folder(inside), []).append(view)
    if "." not in folders and all(len(cameras_of(some)) == 1 for some in folders.values()):
        return Photographs(views, (), {name: some[0].camera for name, some in folders.items()})
    with suppress(InputError):  # of cameras that were given when the map was made, nothing lies beside the images
        told = with_cameras(images, {})
        if len(cameras_of(told.views)) == len(cameras_of(views)):
            return told
    numbers = sorted({one.camera_id for one in model.images.values()})
    return Photographs(views, (), {f"camera {number}": model.camera(number) for number in numbers})


def _section(table: Mapping[str, Any], name: str, where: str) -> list[str]:
    values = section(table, name, where)
    return ["", f"[{name}]", *(f"{key} = {toml_value(value)}" for key, value in values.items())] if values else []
