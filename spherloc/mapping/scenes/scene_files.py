"""The scene files of a map: of its own images, and of others that are to be localized in it."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.datasets.asl_layout import camera_of_folder
from spherloc.datasets.query_gravity import BOUND_SD
from spherloc.datasets.scene_file import read_table
from spherloc.errors import InputError, SpherlocError
from spherloc.files import is_file, is_folder, read_file
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.true_poses import AlignedTruth
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.images.photographs import cameras_of
from spherloc.mapping.rig import camera_and_key
from spherloc.mapping.scenes.new_images import NewImages

MODEL = "model"
"""Folder of COLMAP's model in that of the map."""
SCENE = "scene.toml"
"""Scene file of the map's own images."""
MAP_FOLDER = "{}_map"
"""What the folder of a map is called, by that of its photographs."""
GRAVITY = "gravity.txt"
"""Gravity of the map's images by the IMU of a sequence that they are of, or by their tags."""
LENS = "lens.toml"
"""Calibration file of a lens that the map's images told."""
GIVEN = "Given as the calibration when the map was made."
"""What such a file says of a lens that they did not tell."""
_MAX_LENS = 1 << 16
"""Bytes of such a file."""
COMMENT_WIDTH = 110
UNITS_UNKNOWN = 'units = "unknown"             # lengths are told in units of the map'
UNITS_METRES = 'units = "metres"'
EVERY = 4
"""Every fourth image of the map is a query of the scene file, localized against the others."""


@dataclass(frozen=True)
class MapHead:
    """What the scene files of a map have in common, as lines of TOML."""

    name: str
    """Name of the map that users see."""
    about: str
    images: str
    """Folder of the map's images, relative to the scene files."""
    units: str
    """The line that says whether lengths are metres."""
    sections: tuple[str, ...]
    """The sections [gravity], [frontend] and [masks]."""

    def with_gravity(self, file: str) -> "MapHead":
        """With that gravity file, beside the scene file, and no other."""
        lines = [line for line in self.sections if not line.startswith("file = ")]
        lines.insert(lines.index("[gravity]") + 1, f"file = {toml_text(file)}")
        return replace(self, sections=tuple(lines))


def scene_text(head: MapHead, queries: Sequence[str]) -> str:
    """The scene whose queries are some of the map's own images."""
    lines = [
        'kind = "colmap"',
        f"name = {toml_text(head.name)}",
        f"about = {toml_text(head.about)}",
        f"model = {toml_text(MODEL)}",
        f"images = {toml_text(head.images)}",
        head.units,
        "# Localized against the other images; those of the map that you name here are left out of it.",
        f"queries = {_names(queries)}",
        *head.sections,
    ]
    return "\n".join(lines) + "\n"


def own_queries(names: Sequence[str]) -> list[str]:
    """Every fourth image of a map of these ``names``, or the last one. Those of one camera are counted one after
    another: of four cameras, every fourth image may be the same one's, which then would have no reference."""
    by_camera = sorted(names, key=lambda name: camera_and_key(name)[0])
    chosen = set(by_camera[EVERY - 1 :: EVERY] or by_camera[-1:])
    return [name for name in names if name in chosen]


def new_scene_text(
    head: MapHead, folder: Path, new_images: NewImages, camera: Camera, truth: AlignedTruth | None = None
) -> str:
    """The scene of images that are to be localized in the map in ``folder``; ``camera`` is theirs where ``new_images``
    do not say, and ``truth`` has their true poses."""
    lines = [
        'kind = "image-folder"',
        f"name = {toml_text(f'{new_images.folder.resolve().name} in {head.name}')}",
        f"about = {toml_text(head.about)}",
        f"images = {toml_text(relative(new_images.folder, folder))}",
        head.units,
        *([] if truth is None else [_about_truth(truth)]),
        *_queries(new_images.views or (), camera),
        "",
        "[map]",
        f"model = {toml_text(MODEL)}",
        f"images = {toml_text(head.images)}",
        *head.sections,
        *([] if truth is None else _true_poses(truth)),
    ]
    return "\n".join(lines) + "\n"


def _about_truth(truth: AlignedTruth) -> str:
    """The line on what true poses are from, or on why there are none."""
    return f"truth_source = {toml_text(truth.said)}" if truth.poses else f"# No true poses: {truth.said}."


def _true_poses(truth: AlignedTruth) -> list[str]:
    rows = (f"{toml_text(name)} = {json.dumps(pose.tolist())}" for name, pose in truth.poses.items())
    return ["", "[truth]", *rows] if truth.poses else []


def _queries(views: Sequence[View], camera: Camera) -> list[str]:
    """The queries and their cameras; without views, all images of the folder are queries of the one camera."""
    if not views:
        return ["", "[camera]", *_camera(camera)]
    lines = [f"queries = {_names([view.name for view in views])}"]
    names: dict[str, list[str]] = {}
    for view in views:
        names.setdefault(repr(view.camera), []).append(view.name)
    cameras = cameras_of(views)
    if len(cameras) == 1:
        return [*lines, "", "[camera]", *_camera(views[0].camera)]
    for key, own in names.items():
        lines += ["", "[[cameras]]", f"images = {_names(own)}", "[cameras.camera]", *_camera(cameras[key])]
    return lines


def _names(names: Sequence[str]) -> str:
    return json.dumps(names, ensure_ascii=False)


def _camera(camera: Camera) -> list[str]:
    return [f"{key} = {toml_value(value)}" for key, value in camera.to_dict().items()]


def lens_path(folder: Path, name: str) -> Path:
    """The calibration file of a lens in the folder of a map: ``lens.toml`` of that without a name."""
    return folder / (f"lens_{name}.toml" if name else LENS)


def kept_lens(path: Path) -> Camera | None:
    """The lens that ``write_lenses`` wrote; None if the file is missing or damaged."""
    try:
        return load_camera(path)
    except SpherlocError:
        return None


def was_given(path: Path) -> bool:
    """Whether the file of a lens says that it was given."""
    try:
        return read_file(path, _MAX_LENS).decode("utf-8", "replace").startswith(f"# {GIVEN}")
    except OSError:
        return False


def check_images_of(folder: Path, images: Path) -> None:
    """Raise ``InputError`` if ``folder``, for a map, is that of its photographs, ``images``, or has a map of others."""
    if folder.resolve() == images.resolve():
        raise InputError(
            f"{folder}: is the folder of the photographs, and a map needs its own; {advice('own folder')}."
        )
    scene = folder / SCENE
    if not is_file(scene):
        return
    known = read_table(scene).get("images")
    if not isinstance(known, str):
        return
    there = (folder / known).resolve()
    if there != images.resolve() and is_folder(there):
        raise InputError(f"{folder}: holds the map of other photographs, those in {there}; {advice('another map')}.")


def lenses_given(views: Sequence[View]) -> dict[str, CalibratedLens]:
    """The calibrations of images for which a file was given, by their folder in that of the map, where all images of
    that have one."""
    by_folder: dict[str, dict[str, Camera]] = {}
    for view in views:
        name = "" if Path(view.name).parent == Path() else camera_of_folder(view.path.parent)
        by_folder.setdefault(name, {})[repr(view.camera)] = view.camera
    return {
        name: CalibratedLens(next(iter(found.values())), GIVEN) for name, found in by_folder.items() if len(found) == 1
    }


def write_lenses(folder: Path, lenses: Mapping[str, CalibratedLens]) -> None:
    """Write the ``lens_path`` of lenses by name where another is there or none; raises ``OSError``."""
    for name, lens in lenses.items():
        path = lens_path(folder, name)
        if kept_lens(path) == lens.camera:
            continue
        about = [f"# {line}" for line in wrap(lens.how, COMMENT_WIDTH)]
        path.write_text("\n".join([*about, "[camera]", *_camera(lens.camera)]) + "\n", encoding="utf-8")


def write_new_scene(
    head: MapHead, folder: Path, new_images: NewImages, camera: Camera, truth: AlignedTruth | None = None
) -> Path:
    """Write the file of ``new_scene_text``; returns its path. Raises ``OSError``."""
    path = folder / f"{_file_name(new_images.folder)}.toml"
    if new_images.gravity:
        file = path.with_suffix("").with_name(f"{path.stem}_{GRAVITY}")
        write_gravity(file, new_images.gravity)
        head = head.with_gravity(file.name)
    path.write_text(new_scene_text(head, folder, new_images, camera, truth), encoding="utf-8")
    return path


def write_gravity(path: Path, found: Mapping[str, Gravity]) -> None:
    """Write a gravity file, of vectors by the name of the image; raises ``OSError``."""
    rows = ["# image gx gy gz sd_deg: down in the camera's frame"]
    for name, one in found.items():
        sd_deg = "" if one.bound_rad is None else f" {np.degrees(one.bound_rad) / BOUND_SD:.4g}"
        rows.append(f'"{name}" {" ".join(f"{value:.7f}" for value in one.down)}{sd_deg}')
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def _file_name(new_images: Path) -> str:
    """What the scene file of new images is called: as their folder, so that several folders have one each, but not as
    the map's own scene or a lens."""
    name = new_images.resolve().name
    return f"new_{name}" if f"{name}.toml" in (SCENE, LENS) or name.startswith("lens_") else name


def relative(path: Path, folder: Path) -> str:
    """A path relative to the folder, so that both can be moved together; absolute on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return path.resolve().as_posix()


def toml_text(value: str) -> str:
    """A TOML basic string: JSON's strings are those."""
    return json.dumps(value, ensure_ascii=False)


def toml_value(value: Any) -> str:
    """A text, number, list or switch in TOML."""
    return toml_text(value) if isinstance(value, str) else json.dumps(value)
