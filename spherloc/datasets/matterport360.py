"""Matterport360: panoramas of buildings with dense depth, from Matterport3D's scans.

Layout (researchdata.bath.ac.uk/1126): a folder a building, and in it ``<id>_rgb.png``, ``<id>_depth.dpt`` and
``<id>_pose.txt`` of every panorama. Depth is taken along the ray unless ``depth`` says "z"; the dataset does not tell.
"""

import fnmatch
import os
import struct
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.registration import DepthRegistration
from spherloc.errors import InputError, shorten, show
from spherloc.files import is_file, names_in, open_file, read_file, reading
from spherloc.frontend.lifting import DepthLift
from spherloc.frontend.view import Lift, View
from spherloc.geometry import pose
from spherloc.images import MAX_PIXELS, read_size
from spherloc.trajectory import rotation_from_wxyz
from spherloc.types import FloatArray

TAG = 202021.25
HEADER = struct.Struct("<fii")


def read_dpt(path: Path) -> NDArray[np.float32]:
    """Depth (H, W), metres, as it is stored: a value that is not positive and finite means that there is no depth.

    Layout: float32 tag 202021.25, int32 width, int32 height, then float32 row by row, all little endian. Raises
    ``InputError`` for a missing file, another tag, or a size that does not fit the file's.
    """
    with reading(path, "the panorama beside it needs this depth map"), open_file(path) as file:
        header = file.read(HEADER.size)
        if len(header) < HEADER.size:
            raise InputError(f"{path}: is only {len(header)} bytes long; replace this depth map.")
        tag, width, height = HEADER.unpack(header)
        if tag != TAG:
            hint = "; its byte order is reversed" if struct.unpack(">f", header[:4])[0] == TAG else ""
            raise InputError(f"{path}: does not begin with the tag {TAG}{hint}; give a .dpt depth map.")
        count = width * height
        if width < 1 or height < 1 or count > MAX_PIXELS:
            raise InputError(f"{path}: claims {width} x {height} pixels; replace this depth map.")
        length = os.fstat(file.fileno()).st_size - HEADER.size
        if length != 4 * count:
            raise InputError(
                f"{path}: {length:,} bytes follow its header, but {width} x {height} pixels take {4 * count:,}; "
                "replace this depth map."
            )
        content = file.read(4 * count)
    return np.frombuffer(content, "<f4").reshape(height, width)


GRAVITY_MAP = (0.0, 0.0, -1.0)
GRAVITY_BOUND_DEG = 2.0
"""Default bound on the error of gravity: the scanner stands on a levelled tripod."""
REGISTRATION_M = (0.4, 0.6, 0.8)
"""Limits of Table III on the registration error, m."""
CAMERA_FROM_BLENDER = np.diag([1.0, -1.0, -1.0])
"""Rotation from Blender's camera axes (x right, y up, z backward), which the poses have, to OpenCV's."""
AT_CAMERA = np.eye(3, 4)
MAX_POSE_BYTES = 4096

EXAMPLE = """\
kind = "matterport360"
name = "Matterport360, one building"
root = "Matterport360/17DRP5sb8fy"     # folder of a building
queries = ["*5_rgb.png"]               # names or patterns; the others are references
depth = "ray"                          # or "z"
trust_poses = true                     # false: poses are judged by registration alone (Sec. VI-B.2)
"""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "matterport360"``.

    Raises ``InputError`` for a wrong key, a missing folder, or a folder without panoramas.
    """
    where = str(path)
    own = {"root", "queries"}
    scene_file.check_keys(table, map_scene.REQUIRED | own, map_scene.OPTIONAL | {"depth", "trust_poses"}, where)
    settings = map_scene.read_settings(table, where, GRAVITY_BOUND_DEG)
    root = map_scene.folder(table, "root", path)
    along = table.get("depth", "ray")
    if along not in ("ray", "z"):
        raise InputError(f'{where}: depth is {show(along)}; give "ray" or "z".')
    trusted = table.get("trust_poses", True)
    if not isinstance(trusted, bool):
        raise InputError(f"{where}: trust_poses is {show(trusted)}; give true or false.")
    views, remarks = _views(root, along, where)
    wanted = _patterns(table["queries"], where)
    chosen = [view for view in views if any(fnmatch.fnmatchcase(view.name, pattern) for pattern in wanted)]
    names = {view.name for view in chosen}
    references = tuple(view for view in views if view.name not in names)
    queries = tuple(_as_query(view, trusted) for view in chosen)
    if not trusted:
        # The map is then one reference image, whatever its pose: only the motion between two is judged.
        settings = replace(settings, frontend={**settings.frontend, "references": 1})
    registration = DepthRegistration(REGISTRATION_M, GRAVITY_MAP, lambda view: _own_depth(view, along))
    return settings.scene(path, queries, references, np.array(GRAVITY_MAP), remarks, registration=registration)


def _patterns(value: Any, where: str) -> list[str]:
    if not isinstance(value, list) or not value or not all(isinstance(item, str) and item for item in value):
        raise InputError(f'{where}: queries must be a list of names or patterns, such as ["*5_rgb.png"].')
    return value


def _views(root: Path, along: Any, where: str) -> tuple[list[View], tuple[str, ...]]:
    """All panoramas with depth and pose, by name, and what was left out."""
    images = [root / name for name in names_in(root) if name.endswith("_rgb.png")]
    if not images:
        raise InputError(f"{where}: {root} has no file *_rgb.png; give the folder of one building as root.")
    views, remarks = [], []
    for image in images:
        stem = image.name.removesuffix("_rgb.png")
        missing = [name for end in ("_depth.dpt", "_pose.txt") if not is_file(root / (name := f"{stem}{end}"))]
        if missing:
            remarks.append(
                f"{shorten(image.name)} was skipped, since {' and '.join(map(shorten, missing))} is missing."
            )
            continue
        try:
            camera = Equirectangular(*read_size(image))
            cam_from_map = read_pose(root / f"{stem}_pose.txt")
        except InputError as error:
            remarks.append(f"{shorten(image.name)} was skipped: {error}")
            continue
        lift = DepthLift(partial(read_dpt, _depth_file(image)), camera, cam_from_map, along)
        views.append(View(image.name, camera, image, cam_from_map, lift=lift))
    return views, tuple(remarks)


def _as_query(view: View, trusted: bool) -> View:
    return View(view.name, view.camera, view.path, view.cam_from_map if trusted else None)


def _depth_file(image: Path) -> Path:
    return image.with_name(image.name.removesuffix("_rgb.png") + "_depth.dpt")


def _own_depth(view: View, along: Any) -> Lift:
    return DepthLift(partial(read_dpt, _depth_file(view.path)), view.camera, AT_CAMERA, along)


def read_pose(path: Path) -> FloatArray:
    """``cam_from_map`` (3, 4) of a pose file: camera centre, then the quaternion x y z w of camera to world.

    Raises ``InputError`` unless the file holds exactly seven finite numbers, of which four are a rotation.
    """
    with reading(path, "correct or remove it"):
        content = read_file(path, MAX_POSE_BYTES)
    try:
        words = content.decode("ascii").split()
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise InputError(f"{path}: holds something other than numbers; replace it.") from None
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        raise InputError(f"{path}: holds {len(numbers)} numbers; a pose has 7 finite ones, x y z qx qy qz qw.")
    x, y, z, w = numbers[3:]
    try:
        world_from_blender = rotation_from_wxyz(np.array([w, x, y, z]))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    rotation = CAMERA_FROM_BLENDER @ world_from_blender.T
    return pose(rotation, -rotation @ numbers[:3])
