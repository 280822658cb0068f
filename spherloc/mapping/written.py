"""Writes a map to the disk: COLMAP's model, and scene files that open it."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.errors import StoppedError, reason
from spherloc.frontend.masks import Masks
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import View
from spherloc.mapping.advice import advice
from spherloc.mapping.photographs import NewImages, cameras_of
from spherloc.mapping.reconstruction import Reconstruction
from spherloc.mapping.upright import Level, MapScale, upright_frame
from spherloc.registry import require
from spherloc.types import FloatArray

MODEL = "model"
SCENE = "scene.toml"
MIN_BOUND_DEG = 3.0
EVERY = 4
"""Every fourth image of the map is a query of the scene file, localized against the others."""
MIN_WITHOUT = 4
"""Least number of a map's images for which queries are left out of the map; in a smaller one all points are used."""


@dataclass(frozen=True, eq=False)
class Written:
    """The files of a map that was written, and the map in its final frame."""

    scene: Path
    """Scene file whose queries are images of the map."""
    new_scene: Path | None
    """Scene file of other images; None if there are none."""
    poses: dict[str, FloatArray]
    """Poses ``cam_from_map`` (3, 4) by the name of the image; the map's z axis points up."""
    points: FloatArray
    """(N, 3), map frame, in the map's unit."""
    error_px: float
    """Mean reprojection error, px."""


@dataclass(frozen=True)
class Kept:
    """Settings of a map that its scene files use too."""

    masks: Masks | None
    how: FrontendOptions
    """Features and matching."""


def write_map(
    made: Reconstruction,
    level: Level,
    scale: MapScale,
    views: Sequence[View],
    images: Path,
    folder: Path,
    new_images: NewImages | None,
    kept: Kept,
) -> Written:
    """Level and scale a model and write it with its scenes into ``folder``.

    ``images`` is the folder of the views, and ``kept`` the settings for the scene files. Raises ``StoppedError`` if
    a file cannot be written.
    """
    pycolmap = require("pycolmap", "colmap", "making a map")
    turn = pycolmap.Rotation3d(upright_frame(level))
    made.model.transform(pycolmap.Sim3d(scale.metres_per_unit, turn, np.zeros(3)))
    poses = {
        image.name: np.asarray(image.cam_from_world().matrix())
        for image in (made.model.image(number) for number in made.model.reg_image_ids())
    }
    names = [view.name for view in views if view.name in poses]
    about = _about(made, level, scale, len(views))
    try:
        (folder / MODEL).mkdir(parents=True, exist_ok=True)
        made.model.write(str(folder / MODEL))
        scene = folder / SCENE
        if len(names) >= MIN_WITHOUT:
            content = _scene(folder, images, names, about, level, scale)
        else:
            own = NewImages(images, tuple(view for view in views if view.name in poses))
            content = _new_scene(folder, images, own, views[0].camera, about, level, scale)
        scene.write_text(content + _kept(kept, folder), encoding="utf-8")
        new_scene = None
        if new_images is not None:
            new_scene = folder / f"{_file_name(new_images.folder)}.toml"
            content = _new_scene(folder, images, new_images, views[0].camera, about, level, scale)
            new_scene.write_text(content + _kept(kept, folder), encoding="utf-8")
    except (OSError, RuntimeError) as error:
        raise StoppedError(f"{folder}: cannot be written ({reason(error)}); {advice('go on')}.") from None
    return Written(scene, new_scene, poses, made.points(), float(made.model.compute_mean_reprojection_error()))


def _file_name(new_images: Path) -> str:
    """What the scene file of new images is called: as their folder, so that several folders have one each."""
    name = new_images.resolve().name
    return f"new_{name}" if f"{name}.toml" == SCENE else name


def _about(made: Reconstruction, level: Level, scale: MapScale, count: int) -> str:
    units = f"metres: {scale.source}" if scale.source else "unknown, ten are the usual distance of a point to an image"
    return (
        f"Map of {len(made.poses)} of {count} images, {len(made.model.points3D):,} points. "
        f"Units are {units}. Down is from {level.source}."
    )


def _scene(folder: Path, images: Path, names: Sequence[str], about: str, level: Level, scale: MapScale) -> str:
    queries = names[EVERY - 1 :: EVERY] or names[-1:]
    lines = [
        'kind = "colmap"',
        f"name = {_text(_name(images, scale))}",
        f"about = {_text(about)}",
        f"model = {_text(MODEL)}",
        f"images = {_text(_relative(images, folder))}",
        *_units(scale),
        "# Localized against the other images; those of the map that you name here are left out of it.",
        f"queries = {_names(queries)}",
        *_gravity(level),
    ]
    return "\n".join(lines) + "\n"


def _new_scene(
    folder: Path, images: Path, new_images: NewImages, camera: Camera, about: str, level: Level, scale: MapScale
) -> str:
    lines = [
        'kind = "image-folder"',
        f"name = {_text(f'{new_images.folder.resolve().name} in {_name(images, scale)}')}",
        f"about = {_text(about)}",
        f"images = {_text(_relative(new_images.folder, folder))}",
        *_units(scale),
        *_queries(new_images.views or (), camera),
        "",
        "[map]",
        f"model = {_text(MODEL)}",
        f"images = {_text(_relative(images, folder))}",
        *_gravity(level),
    ]
    return "\n".join(lines) + "\n"


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
    return [f"{key} = {_value(value)}" for key, value in camera.to_dict().items()]


def _name(images: Path, scale: MapScale) -> str:
    return images.resolve().name + ("" if scale.source else " (units unknown)")


def _units(scale: MapScale) -> list[str]:
    return [] if scale.source else ['units = "unknown"             # lengths are told in units of the map']


def _gravity(level: Level) -> list[str]:
    bound = max(MIN_BOUND_DEG, round(2.0 * level.spread_deg, 1))
    lines = ["", "[gravity]", "map = [0.0, 0.0, -1.0]", f"bound_deg = {bound}"]
    if level.by_lines:
        lines.append('query = "lines"                # where an image shows too few, gravity is that of its reference')
    return lines


def _kept(kept: Kept, folder: Path) -> str:
    """The sections [masks] and [frontend]; empty where nothing differs from what scenes do anyway."""
    lines = []
    if kept.how.features != FrontendOptions().features:
        lines += ["", "[frontend]", f"features = {_text(kept.how.features.method)}"]
        lines.append(f"matching = {_text(kept.how.matching.method)}")
    if kept.masks is not None:
        lines += ["", "[masks]"]
        if kept.masks.images is not None:
            lines.append(f"images = {_text(_relative(kept.masks.images, folder))}")
        lines += [f"{key} = {value}" for key in ("nadir_deg", "seam_deg") if (value := getattr(kept.masks, key))]
    return "".join(f"{line}\n" for line in lines)


def _relative(path: Path, folder: Path) -> str:
    """A path relative to the folder, so that both can be moved together; absolute on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return path.resolve().as_posix()


def _text(value: str) -> str:
    """A TOML basic string: JSON's strings are those."""
    return json.dumps(value, ensure_ascii=False)


def _value(value: Any) -> str:
    return _text(value) if isinstance(value, str) else json.dumps(value)
