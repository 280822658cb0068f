"""Writes a map to the disk: COLMAP's model, and scene files that open it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.errors import StoppedError, reason
from spherloc.frontend.masks import Masks
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import View
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.stated_gravity import StatedGravity
from spherloc.mapping.alignment.true_poses import AlignedTruth, aligned_truth
from spherloc.mapping.alignment.upright import Level, MapScale, upright_frame
from spherloc.mapping.models.model import Reconstruction, poses_of, registered
from spherloc.mapping.scenes.new_images import NewImages
from spherloc.mapping.scenes.scene_files import (
    GRAVITY,
    MODEL,
    SCENE,
    UNITS_METRES,
    UNITS_UNKNOWN,
    MapHead,
    new_scene_text,
    own_queries,
    relative,
    scene_text,
    toml_text,
    write_gravity,
    write_new_scene,
)
from spherloc.mapping.two_view.pairs import MIN_MATCHES
from spherloc.registry import require
from spherloc.types import FloatArray

MIN_BOUND_DEG = 3.0
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
    truth: AlignedTruth | None = None
    """True poses of the other images; None if nothing tells of them."""


@dataclass(frozen=True)
class Kept:
    """Settings of a map that its scene files use too."""

    masks: Masks | None
    how: FrontendOptions
    """Features and matching."""
    gravity: StatedGravity | None = None
    """Gravity of photographs that a file states."""


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
    poses = poses_of(made.model)
    names = [view.name for view in views if view.name in poses]
    head = MapHead(
        _name(images, scale),
        _about(made, level, scale, len(views)),
        relative(images, folder),
        UNITS_METRES if scale.source else UNITS_UNKNOWN,
        (*_gravity(level, kept.gravity, folder), *_kept(kept, folder)),
    )
    try:
        (folder / MODEL).mkdir(parents=True, exist_ok=True)
        made.model.write(str(folder / MODEL))
        scene, own_head = folder / SCENE, head
        if kept.gravity is not None and kept.gravity.in_map_folder:
            write_gravity(
                folder / GRAVITY, {name: kept.gravity.found[name] for name in names if name in kept.gravity.found}
            )
            own_head = head.with_gravity(GRAVITY)
        queries = _leavable(made.model, own_queries(names)) if len(names) >= MIN_WITHOUT else []
        if queries:
            content = scene_text(own_head, queries)
        else:
            own = NewImages(images, tuple(view for view in views if view.name in poses))
            content = new_scene_text(own_head, folder, own, views[0].camera)
        scene.write_text(content, encoding="utf-8")
        new_scene = truth = None
        if new_images is not None:
            truth = None if new_images.truth is None else aligned_truth(new_images.truth, poses)
            new_scene = write_new_scene(head, folder, new_images, views[0].camera, truth)
    except (OSError, RuntimeError) as error:
        raise StoppedError(f"{folder}: cannot be written ({reason(error)}); {advice('go on')}.") from None
    return Written(scene, new_scene, poses, made.points(), float(made.model.compute_mean_reprojection_error()), truth)


def _leavable(model: Any, queries: Sequence[str]) -> list[str]:
    """Those of the images ``queries`` of a model that see enough of the points that it has without them: of cameras
    that look to all sides at a single moment, hardly a point is seen by three."""
    ids = {image.name: image.image_id for image in registered(model)}
    without = set(ids.values()) - {ids[name] for name in queries}
    tracks = [{one.image_id for one in point.track.elements} for point in model.points3D.values()]
    left = [track for track in tracks if len(track & without) > 1]
    return [name for name in queries if sum(ids[name] in track for track in left) >= MIN_MATCHES]


def _about(made: Reconstruction, level: Level, scale: MapScale, count: int) -> str:
    units = f"metres: {scale.source}" if scale.source else "unknown, ten are the usual distance of a point to an image"
    return (
        f"Map of {len(made.poses)} of {count} images, {len(made.model.points3D):,} points. "
        f"Units are {units}. Down is from {level.source}."
    )


def _name(images: Path, scale: MapScale) -> str:
    return images.resolve().name + ("" if scale.source else " (units unknown)")


def _gravity(level: Level, stated: StatedGravity | None, folder: Path) -> list[str]:
    bound = max(MIN_BOUND_DEG, round(2.0 * level.spread_deg, 1))
    lines = ["", "[gravity]", "map = [0.0, 0.0, -1.0]", f"bound_deg = {bound}"]
    if level.by_lines or (stated is not None and stated.lines_agree):
        lines.append('query = "lines"                # where an image shows too few, gravity is that of its reference')
    if stated is not None and not stated.in_map_folder:
        file = toml_text(relative(stated.file, folder))
        lines.append(f"file = {file}" if stated.camera_from_imu is None else f"imu = {file}")
        if stated.camera_from_imu is not None:
            lines.append(f"camera_from_imu = {stated.camera_from_imu.tolist()}")
    return lines


def _kept(kept: Kept, folder: Path) -> list[str]:
    """The sections [masks] and [frontend]; empty where nothing differs from what scenes do anyway."""
    lines: list[str] = []
    if kept.how.features != FrontendOptions().features:
        lines += ["", "[frontend]", f"features = {toml_text(kept.how.features.method)}"]
        lines.append(f"matching = {toml_text(kept.how.matching.method)}")
    if kept.masks is not None:
        lines += ["", "[masks]"]
        if kept.masks.images is not None:
            lines.append(f"images = {toml_text(relative(kept.masks.images, folder))}")
        lines += [f"{key} = {value}" for key in ("nadir_deg", "seam_deg") if (value := getattr(kept.masks, key))]
    return lines
