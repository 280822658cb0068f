"""Image folder: a user's own panoramas or fisheye images, localized in a COLMAP model or among images with poses."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import camera_from_table, load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.colmap import (
    assumed_units,
    gravity_of_map,
    model_views,
    read_map,
    some,
    split_gravity,
    unit_vector,
)
from spherloc.datasets.given_path import OF_MAP
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError, shorten, show
from spherloc.files import IMAGES, is_file, is_image, names_in, size_of
from spherloc.frontend.lifting import DepthLift
from spherloc.frontend.partners import with_triangulation
from spherloc.frontend.pipeline import frontend_options
from spherloc.frontend.view import Gravity, View
from spherloc.images import read_depth_png, read_size
from spherloc.trajectory import Trajectory, pose_at, read_euroc, read_tum
from spherloc.types import FloatArray

MAX_GAP_S = 0.5
"""Largest time between two poses of a trajectory that are interpolated."""

_CAMERA_KEYS = {"camera", "calibration", "calibration_camera"}
_TRAJECTORY_KEYS = {"trajectory", "timestamp_ns", "trajectory_unit", "body_from_camera"}
_DEPTH_KEYS = {"depth", "depth_unit_m", "along"}
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class PosedImages:
    """The usable references, and remarks on the others."""

    views: tuple[View, ...]
    remarks: tuple[str, ...]


def read_camera(table: Mapping[str, Any], path: Path, where: str) -> Camera | None:
    """The camera of the section ``camera`` or of the file ``calibration``; None if the table has neither.

    ``calibration_camera`` picks one of a file's cameras. Raises ``InputError``.
    """
    if "camera" in table and "calibration" in table:
        raise InputError(f"{where}: has both 'camera' and 'calibration'; keep one.")
    if "camera" in table:
        return camera_from_table(scene_file.section(table, "camera", where), where)
    if "calibration" not in table:
        return None
    name = scene_file.text(table, "calibration_camera", where) if "calibration_camera" in table else None
    return load_camera(path.parent / scene_file.text(table, "calibration", where), name)


def read_pose(value: Any, key: str, where: str) -> FloatArray:
    """A rigid pose (3, 4) of three rows, or of four as (4, 4) matrices have; raises ``InputError`` for another."""
    rows = 4 if isinstance(value, list) and len(value) == 4 else 3
    matrix = scene_file.numbers(value, (rows, 4), key, where)
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=_ROTATION_TOLERANCE)
    if not rigid or np.linalg.det(rotation) < 0 or (rows == 4 and matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{where}: {key} is not a rigid pose; give rows of a rotation and a translation.")
    return matrix[:3]


def read_references(entries: Any, shared: Camera | None, path: Path) -> PosedImages:
    """The views of [[references]]; ``shared`` is the camera of those without a camera of their own.

    A reference whose trajectory has no pose at its time is left out and remarked on. Raises ``InputError`` for a wrong
    key or value and for a missing file.
    """
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: 'references' must be a list of sections [[references]].")
    trajectories = cache(_trajectory)
    views, without_pose = [], []
    for number, entry in enumerate(entries, start=1):
        where = f"{path} [[references]] {number}"
        _check(entry, where)
        pose = _pose(entry, path, where, trajectories)
        if pose is None:
            without_pose.append(scene_file.text(entry, "image", where))
            continue
        views.append(_view(entry, pose, shared, path, where))
    remarks = (
        f"{len(without_pose)} of {len(entries)} references were left out, since their trajectory has no pose at their "
        f"time or none within {MAX_GAP_S:g} s around it; the first is {shorten(without_pose[0])}."
        if without_pose
        else ""
    )
    return PosedImages(tuple(views), (remarks,) if remarks else ())


def _check(entry: Mapping[str, Any], where: str) -> None:
    given = {"cam_from_map"} if "trajectory" not in entry else {"trajectory", "timestamp_ns"}
    optional = _CAMERA_KEYS | ({"cam_from_map"} if "trajectory" not in entry else _TRAJECTORY_KEYS)
    needed = _DEPTH_KEYS if _DEPTH_KEYS & entry.keys() else set()
    scene_file.check_keys(entry, {"image"} | needed | given, optional | _DEPTH_KEYS, where)


def _view(entry: Mapping[str, Any], pose: FloatArray, shared: Camera | None, path: Path, where: str) -> View:
    camera = read_camera(entry, path, where) or shared
    if camera is None:
        raise InputError(f"{where}: has no camera; add 'calibration' or 'camera', here or for all.")
    image = scene_file.text(entry, "image", where)
    if not is_file(path.parent / image):
        raise InputError(f"{where}: the image {path.parent / image} does not exist; correct the path.")
    return View(
        image,
        camera,
        path.parent / image,
        pose,
        lift=_lift(entry, camera, pose, path, where) if "depth" in entry else None,
    )


def _pose(entry: Mapping[str, Any], path: Path, where: str, trajectories: Any) -> FloatArray | None:
    """``cam_from_map`` (3, 4); None where the trajectory has a gap."""
    if "trajectory" not in entry:
        return read_pose(entry["cam_from_map"], "cam_from_map", where)
    unit = entry.get("trajectory_unit", "s")
    if unit not in ("s", "ns"):
        raise InputError(f"{where}: trajectory_unit is {show(unit)}; give 's' or 'ns', the unit of its first column.")
    trajectory: Trajectory = trajectories(path.parent / scene_file.text(entry, "trajectory", where), unit)
    time_ns = scene_file.integer(entry, "timestamp_ns", where, -(2**62), 2**62)
    map_from_body = pose_at(trajectory, time_ns, MAX_GAP_S)
    if map_from_body is None:
        return None
    body_from_camera = read_pose(entry.get("body_from_camera", np.eye(3, 4).tolist()), "body_from_camera", where)
    turn = map_from_body[:, :3] @ body_from_camera[:, :3]
    centre = map_from_body[:, :3] @ body_from_camera[:, 3] + map_from_body[:, 3]
    return np.column_stack([turn.T, -turn.T @ centre])


def _trajectory(path: Path, unit: Literal["s", "ns"]) -> Trajectory:
    """A EuRoC ground truth (.csv), else a TUM trajectory whose first column is a time in ``unit``."""
    return read_euroc(path) if path.suffix.lower() == ".csv" else read_tum(path, unit)


def _lift(entry: Mapping[str, Any], camera: Camera, pose: FloatArray, path: Path, where: str) -> DepthLift:
    along = entry["along"]
    if along not in ("ray", "z"):
        raise InputError(
            f"{where}: along is {show(along)}; give 'ray' for distances to the camera, or 'z' for depths along its "
            "optical axis."
        )
    depth = path.parent / scene_file.text(entry, "depth", where)
    if not is_file(depth):
        raise InputError(f"{where}: the depth map {depth} does not exist; correct the path.")
    unit_m = scene_file.number(entry, "depth_unit_m", where, 1e-9, 1e6)
    return DepthLift(partial(read_depth, depth, unit_m), camera, pose, along)


def read_depth(path: Path, unit_m: float) -> NDArray[np.float32]:
    """A depth map (H, W), metres, from a 16-bit PNG or an .npy file whose numbers are in units of ``unit_m`` metres.

    Raises ``InputError`` for a file that cannot be read, and for an .npy file with Python objects, which are a pickle.
    """
    if path.suffix.lower() != ".npy":
        return read_depth_png(path).astype(np.float32) * np.float32(unit_m)
    try:
        # Mapped, so that a header that announces more than the file holds is refused before anything is allocated.
        size_of(path)  # refuses a pipe, which numpy would wait for
        with warnings.catch_warnings(action="ignore"):
            depth = np.lib.format.open_memmap(path, mode="r")
        if depth.ndim == 2 and depth.dtype.kind in "fiu":
            return depth.astype(np.float32) * np.float32(unit_m)
        reason = f"has the shape {depth.shape} of {depth.dtype}"
    except Exception:  # numpy parses the header as Python text, which can raise nearly anything
        reason = "is missing or damaged, or holds Python objects"
    raise InputError(f"{path}: {reason}; give an .npy file with numbers of shape (H, W).")


EXAMPLE = """\
kind = "image-folder"
name = "my walk"
images = "queries"              # a folder of query images, or a list of files
# queries = ["a.jpg", "b.jpg"]  # only these images of the folder; else all
calibration = "camera.yaml"     # of the queries: any file that spherloc reads; or a section [camera]

# [[cameras]]                   # queries of several cameras
# images = "left*"              # a pattern of names, or a list of names
# calibration = "left.yaml"     # or camera = {...}

# truth_source = "mocap.csv, aligned with the map"  # where true poses in [truth] are from, told beside errors
# units = "unknown"             # of a model without a scale in [map]; "metres" if it is to scale

[map]                           # the references are a COLMAP model ...
model = "sparse/0"
images = "mapping"

# [[references]]                # ... or images with pose, and depth if there is one
# image = "reference.png"
# calibration = "other.yaml"    # or camera = {...}; that of the queries if absent
# cam_from_map = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
# # or: trajectory = "poses.txt" (TUM; a .csv is EuRoC's), timestamp_ns, body_from_camera (3 or 4 rows),
# # trajectory_unit = "s" or "ns", the unit of TUM's first column
# # Without the next three keys, its points are triangulated with other references.
# depth = "reference_depth.png" # 16-bit PNG or .npy
# depth_unit_m = 0.001
# along = "z"                   # or "ray"

[gravity]                       # optional
map = [0.0, 0.0, -1.0]          # down; else the mean +y axis of the reference cameras
bound_deg = 3.0
# camera = [0.0, 1.0, 0.0]      # down in all queries; else as in the most similar reference
# query = "lines"               # or in each query from the vertical lines of its image
# file = "gravity.txt"          # or from rows: image gx gy gz [sd_deg]

# [truth]                       # optional: cam_from_map of queries
# "a.jpg" = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
"""

GRAVITY_BOUND_DEG = 3.0
"""Default bound on a query's gravity, taken from its most similar reference; 0 where the scene states it."""

_OPTIONAL = _CAMERA_KEYS | {"cameras", "map", "queries", "references", "truth", "truth_source"}


@dataclass(frozen=True)
class _Cameras:
    """The cameras of the queries."""

    shared: Camera | None
    """That of the queries without one of their own."""
    own: tuple[tuple[str | frozenset[str], Camera], ...]
    """A pattern of names or a set of names, and the camera of these queries; the first that fits counts."""

    def of(self, name: str) -> Camera | None:
        """The camera of the query of that name."""
        for names, camera in self.own:
            if fnmatchcase(name, names) if isinstance(names, str) else name in names:
                return camera
        return self.shared


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "image-folder"``; paths in it are relative to its file.

    Raises ``InputError`` for a wrong key or value, a missing file, a map that cannot be read, or one that has got other
    units since.
    """
    where = str(path)
    scene_file.check_keys(table, map_scene.REQUIRED | {"images"}, map_scene.OPTIONAL | _OPTIONAL, where)
    shared_gravity, gravity = split_gravity(table, where)
    other = next((key for key in ("query", "imu") if "camera" in gravity and key in shared_gravity), None)
    if other is not None:
        raise InputError(f"{where} [gravity]: has both 'camera' and '{other}'; keep one.")
    bound_deg = 0.0 if "camera" in gravity else GRAVITY_BOUND_DEG
    settings = map_scene.read_settings(table | {"gravity": shared_gravity}, where, bound_deg)
    _check_units(table, path)
    cameras = _cameras(table, path)
    queries, remarks = _queries(table, cameras, gravity, path)
    references, more, cloud = _references(table, cameras.shared, settings.frontend, path)
    down, assumed = gravity_of_map(gravity, references, where)
    remarks = [*remarks, *more, *_in_the_map(queries, references), *assumed]
    remarks += assumed_units(table) if "map" in table else []
    truth_source = scene_file.text(table, "truth_source", where) if "truth_source" in table else ""
    return settings.scene(
        path,
        queries,
        references,
        down,
        remarks,
        assumed_down=bool(assumed),
        cloud=cloud,
        truth_source=truth_source,
    )


def _check_units(table: Mapping[str, Any], path: Path) -> None:
    """Raise ``InputError`` if the scene of a map of photographs, which is written with every map, says of the same
    model that its lengths have other units: then this scene was written for an earlier map."""
    of_map = path.with_name(OF_MAP)
    if path.name == OF_MAP or "map" not in table or not is_file(of_map):
        return
    try:
        other = scene_file.read_table(of_map)
    except InputError:  # its own loader says why
        return
    # That scene is of kind "colmap", or of this one where the map has few images.
    model = other["map"].get("model") if isinstance(other.get("map"), dict) else other.get("model")
    same = model is not None and isinstance(table["map"], dict) and model == table["map"].get("model")
    units, now = (one.get("units", "metres") for one in (table, other))
    if same and units != now:
        raise InputError(
            f"{path}: units is {show(units)}, but {OF_MAP} beside it has {show(now)} for the same model, which was "
            "made again since; localize these images again with spherloc map."
        )


def _cameras(table: dict[str, Any], path: Path) -> _Cameras:
    """The cameras that the scene gives its queries; raises ``InputError`` if it gives none."""
    where = str(path)
    shared, entries = read_camera(table, path, where), table.get("cameras", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{where}: 'cameras' must be a list of sections [[cameras]].")
    if shared is None and not entries:
        raise InputError(f"{where}: the query images have no camera; add 'calibration' or a section [camera].")
    own = []
    for number, entry in enumerate(entries, start=1):
        place = f"{where} [[cameras]] {number}"
        scene_file.check_keys(entry, {"images"}, _CAMERA_KEYS, place)
        camera = read_camera(entry, path, place)
        if camera is None:
            raise InputError(f"{place}: has no camera; add 'calibration' or 'camera'.")
        value = entry["images"]
        own.append((value if isinstance(value, str) else frozenset(_list_of_names(value, "images", place)), camera))
    return _Cameras(shared, tuple(own))


def _list_of_names(value: Any, key: str, where: str) -> list[str]:
    names = value if isinstance(value, list) else []
    if not names or not all(isinstance(name, str) and name and "\0" not in name for name in names):
        raise InputError(f"{where}: {key} is {show(value)}; give a list of file names.")
    return names


def _in_the_map(queries: Sequence[View], references: Sequence[View]) -> list[str]:
    """A remark on queries that are references, too."""
    known = {reference.path.resolve() for reference in references}
    both = [query.name for query in queries if query.path.resolve() in known]
    if not both:
        return []
    return [
        f"In the map already, and matched with themselves: {some(both, 'query image')}; use other images to see how "
        "well new ones are localized."
    ]


def _references(
    table: dict[str, Any], camera: Camera | None, frontend: Mapping[str, Any], path: Path
) -> tuple[tuple[View, ...], list[str], FloatArray | None]:
    """The references, remarks, and the points of the map's model if it has one."""
    if ("map" in table) == ("references" in table):
        raise InputError(f"{path}: needs either a section [map] with a COLMAP model or sections [[references]].")
    if "references" in table:
        posed = read_references(table["references"], camera, path)
        without = sum(view.lift is None for view in posed.views)
        if without and len(posed.views) == 1:
            raise InputError(
                f"{path}: the only reference has no depth, and points are triangulated between two or more; add its "
                "depth, or other references."
            )
        options = frontend_options(frontend, str(path), path.parent)
        views = with_triangulation(posed.views, options) if without else posed.views
        return views, list(posed.remarks), None
    section = scene_file.section(table, "map", str(path))
    scene_file.check_keys(section, {"model", "images"}, set(), f"{path} [map]")
    images = map_scene.folder(section, "images", path)
    model = read_map(map_scene.folder(section, "model", path))
    views, remarks = model_views(model, images)
    return tuple(views), remarks, model.points.xyz


def _queries(
    table: dict[str, Any], cameras: _Cameras, gravity: Mapping[str, Any], path: Path
) -> tuple[tuple[View, ...], list[str]]:
    """Views of the query images that can be read, and a remark on the others."""
    where = str(path)
    root, names = _names(table, path)
    truth = _truth(table, names, where)
    down = None
    if "camera" in gravity:
        down = Gravity(unit_vector(gravity["camera"], "camera", f"{where} [gravity]"), "the scene file")
    views, reasons = [], {}
    for name in names:
        reason, its_camera = _camera_of(root / name, cameras.of(name))
        if its_camera is None:
            reasons.setdefault(reason, []).append(name)
        else:
            views.append(View(name, its_camera, root / name, truth.get(name), gravity=down))
    return tuple(views), [f"{some(bad, 'query image')} left out: {reason}." for reason, bad in reasons.items()]


def _names(table: dict[str, Any], path: Path) -> tuple[Path, list[str]]:
    """The folder of the queries and their names in it."""
    value = table["images"]
    if isinstance(value, list):
        if "queries" in table:
            raise InputError(f"{path}: 'images' lists files, so 'queries' must be left out.")
        return path.parent, _list_of_names(value, "images", str(path))
    root = map_scene.folder(table, "images", path)
    if "queries" in table:
        return root, _list_of_names(table["queries"], "queries", str(path))
    names = [name for name in names_in(root) if is_image(name)]
    if not names:
        raise InputError(f"{path}: the folder {root} has no images ({', '.join(sorted(IMAGES))}); correct 'images'.")
    return root, names


def _truth(table: dict[str, Any], names: list[str], where: str) -> dict[str, FloatArray]:
    truth = scene_file.section(table, "truth", where)
    unknown = sorted(set(truth) - set(names))
    if unknown:
        raise InputError(f"{where} [truth]: {show(unknown[0])} is not a query image; name it as in 'images'.")
    return {name: read_pose(value, show(name), f"{where} [truth]") for name, value in truth.items()}


def _camera_of(path: Path, camera: Camera | None) -> tuple[str, Camera | None]:
    """The camera of a query image, judged by its header alone; or why it cannot be a query, and None. Panoramas are
    of any size."""
    if not is_file(path):
        return "no such file", None
    if camera is None:
        return "no section [[cameras]] has its name", None
    try:
        width, height = read_size(path)
    except InputError:
        return "not an image that can be read", None
    if (width, height) == (camera.width, camera.height):
        return "", camera
    if isinstance(camera, Equirectangular) and width == 2 * height:
        return "", Equirectangular(width, height)
    shape = ", and not twice as wide as high" if isinstance(camera, Equirectangular) else ""
    return f"not {camera.width} x {camera.height} pixels, as the calibration is for{shape}", None
