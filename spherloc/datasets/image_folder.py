"""Image folder: a user's own panoramas or fisheyes, localized in a COLMAP model or among images with pose and depth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spherloc.cameras.base import Camera
from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.colmap import gravity_of_map, model_views, some, split_gravity, unit_vector
from spherloc.datasets.map_scene import MapScene
from spherloc.datasets.posed_images import read_camera, read_pose, read_references
from spherloc.errors import InputError, show
from spherloc.files import is_file, names_in
from spherloc.formats.colmap_model import read_model
from spherloc.frontend.view import View
from spherloc.images import read_size
from spherloc.types import FloatArray

EXAMPLE = """\
kind = "image-folder"
name = "my walk"
images = "queries"              # a folder of query images, or a list of files
calibration = "camera.yaml"     # of the queries: any file that spherloc reads; or a section [camera]

[map]                           # the references are a COLMAP model (needs pip install 'spherloc[colmap]') ...
model = "sparse/0"
images = "mapping"

# [[references]]                # ... or images with pose and depth
# image = "reference.png"
# calibration = "other.yaml"    # or camera = {...}; that of the queries if absent
# cam_from_map = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
# # or: trajectory = "poses.txt" (TUM; a .csv is EuRoC's), timestamp_ns, body_from_camera (3 or 4 rows),
# # trajectory_unit = "s" or "ns", what TUM's first column counts
# depth = "reference_depth.png" # 16-bit PNG or .npy
# depth_unit_m = 0.001
# along = "z"                   # or "ray"

[gravity]                       # optional
map = [0.0, 0.0, -1.0]          # down; else the mean +y axis of the reference cameras
bound_deg = 3.0
# camera = [0.0, 1.0, 0.0]      # down in all queries; else as in the most similar reference

# [truth]                       # optional: cam_from_map of queries
# "a.jpg" = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
"""

GRAVITY_BOUND_DEG = 3.0
"""Default bound on a query's gravity, taken from its most similar reference; 0 where the scene states it."""

_SUFFIXES = {".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}
_OPTIONAL = {"calibration", "calibration_camera", "camera", "map", "references", "truth"}


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "image-folder"``; paths in it are relative to its file.

    Raises ``InputError`` for a wrong key or value, a missing file, or a map that cannot be read.
    """
    where = str(path)
    scene_file.check_keys(table, map_scene.REQUIRED | {"images"}, map_scene.OPTIONAL | _OPTIONAL, where)
    shared_gravity, gravity = split_gravity(table, where)
    bound_deg = 0.0 if "camera" in gravity else GRAVITY_BOUND_DEG
    settings = map_scene.read_settings(table | {"gravity": shared_gravity}, where, bound_deg)
    camera = read_camera(table, path, where)
    if camera is None:
        raise InputError(f"{where}: the query images have no camera; add 'calibration' or a section [camera].")
    queries, remarks = _queries(table, camera, gravity, path)
    references, more = _references(table, camera, path)
    down, assumed = gravity_of_map(gravity, references, where)
    return settings.scene(path, queries, references, down, (*remarks, *more, *assumed))


def _references(table: dict[str, Any], camera: Camera, path: Path) -> tuple[tuple[View, ...], list[str]]:
    if ("map" in table) == ("references" in table):
        raise InputError(f"{path}: needs either a section [map] with a COLMAP model or sections [[references]].")
    if "references" in table:
        posed = read_references(table["references"], camera, path)
        return posed.views, list(posed.remarks)
    section = scene_file.section(table, "map", str(path))
    scene_file.check_keys(section, {"model", "images"}, set(), f"{path} [map]")
    images = map_scene.folder(section, "images", path)
    views, remarks = model_views(read_model(map_scene.folder(section, "model", path)), images)
    return tuple(views), remarks


def _queries(
    table: dict[str, Any], camera: Camera, gravity: Mapping[str, Any], path: Path
) -> tuple[tuple[View, ...], list[str]]:
    """Views of the query images that can be read, and a remark on the others."""
    where = str(path)
    root, names = _names(table, path)
    truth = _truth(table, names, where)
    down = unit_vector(gravity["camera"], "camera", f"{where} [gravity]") if "camera" in gravity else None
    views, reasons = [], {}
    for name in names:
        reason = _unusable(root / name, camera)
        if reason:
            reasons.setdefault(reason, []).append(name)
        else:
            views.append(View(name, camera, root / name, truth.get(name), gravity_camera=down))
    return tuple(views), [f"{some(bad, 'query image')} left out: {reason}." for reason, bad in reasons.items()]


def _names(table: dict[str, Any], path: Path) -> tuple[Path, list[str]]:
    """The folder of the queries and their names in it."""
    value = table["images"]
    if isinstance(value, list):
        if not value or not all(isinstance(name, str) and name and "\0" not in name for name in value):
            raise InputError(f"{path}: images is {show(value)}; give a folder or a list of files.")
        return path.parent, value
    root = map_scene.folder(table, "images", path)
    names = [name for name in names_in(root) if Path(name).suffix.lower() in _SUFFIXES]
    if not names:
        raise InputError(f"{path}: the folder {root} has no images ({', '.join(sorted(_SUFFIXES))}); correct 'images'.")
    return root, names


def _truth(table: dict[str, Any], names: list[str], where: str) -> dict[str, FloatArray]:
    truth = scene_file.section(table, "truth", where)
    unknown = sorted(set(truth) - set(names))
    if unknown:
        raise InputError(f"{where} [truth]: {show(unknown[0])} is no query image; name it as in 'images'.")
    return {name: read_pose(value, show(name), f"{where} [truth]") for name, value in truth.items()}


def _unusable(path: Path, camera: Camera) -> str:
    """Why an image cannot be a query, judged by its header alone; empty if it can."""
    if not is_file(path):
        return "no such file"
    try:
        width, height = read_size(path)
    except InputError:
        return "not an image that can be read"
    if (width, height) != (camera.width, camera.height):
        return f"not {camera.width} x {camera.height} pixels, as the calibration is for"
    return ""
