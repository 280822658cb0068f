"""The entries [[references]] of a scene: images with a camera, a pose and a depth map each."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import camera_from_table, load_camera
from spherloc.datasets import scene_file
from spherloc.errors import InputError, shorten, show
from spherloc.files import is_file, size_of
from spherloc.frontend.lifting import DepthLift
from spherloc.frontend.view import View
from spherloc.images import read_depth_png
from spherloc.trajectory import Trajectory, pose_at, read_euroc, read_tum
from spherloc.types import FloatArray

MAX_GAP_S = 0.5
"""Poses of a trajectory farther apart than this are not interpolated."""

_CAMERA_KEYS = {"camera", "calibration", "calibration_camera"}
_TRAJECTORY_KEYS = {"trajectory", "timestamp_ns", "trajectory_unit", "body_from_camera"}
_KEYS = {"image", "depth", "depth_unit_m", "along"}
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class PosedImages:
    """References that could be used, and what is said of the others."""

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
        raise InputError(f"{where}: {key} is no rigid pose; give rows of a rotation and a translation.")
    return matrix[:3]


def read_references(entries: Any, shared: Camera | None, path: Path) -> PosedImages:
    """The views of [[references]]; ``shared`` is the camera of those that name none.

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
    scene_file.check_keys(entry, _KEYS | given, optional, where)


def _view(entry: Mapping[str, Any], pose: FloatArray, shared: Camera | None, path: Path, where: str) -> View:
    camera = read_camera(entry, path, where) or shared
    if camera is None:
        raise InputError(f"{where}: has no camera; add 'calibration' or 'camera', here or for all.")
    image = scene_file.text(entry, "image", where)
    if not is_file(path.parent / image):
        raise InputError(f"{where}: the image {path.parent / image} does not exist; correct the path.")
    return View(image, camera, path.parent / image, pose, lift=_lift(entry, camera, pose, path, where))


def _pose(entry: Mapping[str, Any], path: Path, where: str, trajectories: Any) -> FloatArray | None:
    """``cam_from_map`` (3, 4); None where the trajectory has a gap."""
    if "trajectory" not in entry:
        return read_pose(entry["cam_from_map"], "cam_from_map", where)
    unit = entry.get("trajectory_unit", "s")
    if unit not in ("s", "ns"):
        raise InputError(f"{where}: trajectory_unit is {show(unit)}; give 's' or 'ns', what its first column counts.")
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
    """A EuRoC ground truth (.csv), else rows of TUM whose first column counts ``unit``."""
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
    """A depth map (H, W), metres, of a 16-bit PNG or an .npy file whose numbers count units of ``unit_m`` metres.

    Raises ``InputError`` for what cannot be read. An .npy file with Python objects is refused: they are a pickle.
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
    except Exception:  # numpy reads the header as Python text, and lets through whatever that makes of a damaged one
        reason = "is missing or damaged, or holds Python objects"
    raise InputError(f"{path}: {reason}; give an .npy file with numbers of shape (H, W).")
