"""KITTI-360: fisheye images of one drive, localized in another with poses and laser scans (Sec. VI-B.1).

If the dataset's ``fisheye/mask_left_fisheye.npy`` (or right) exists, pixels that show the vehicle itself are not used.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.datasets import scene_file
from spherloc.datasets.map_scene import OPTIONAL, REQUIRED, MapScene, folder, read_settings
from spherloc.errors import InputError, show
from spherloc.files import is_file
from spherloc.formats.kitti360_files import (
    SIDES,
    Drive,
    Rig,
    frames_in,
    read_poses,
    read_rig,
    read_scan,
    read_timestamps,
    scan_motion,
    unwrapped,
    without_car,
)
from spherloc.formats.text_rows import needed_file
from spherloc.frontend.lifting import PointCloudLift
from spherloc.frontend.view import View
from spherloc.geometry import pose, transform
from spherloc.types import FloatArray

EXAMPLE = """\
kind = "kitti360"
name = "KITTI-360, drive 4 in drive 5"
root = "KITTI-360"             # the dataset's folder
reference_sequence = 5
query_sequence = 4
camera = "image_02"            # or "image_03"
# reference_frames = [0, 2000] # first and last; all if absent. Likewise query_frames
# reference_step = 5           # every n-th usable frame; likewise query_step
# scans = 3                    # neighbouring scans whose points a reference gets; only its own scan if absent
"""

THRESHOLDS = ((1.0, 0.5), (2.0, 1.0), (5.0, 2.0))
"""Limits (degrees, metres) of Table II."""
GRAVITY_BOUND_DEG = 2.0
"""Default bound on the difference of a query's roll and pitch from its most similar reference's: on the same street a
car's differ by about a degree, by slopes and springs."""
GRAVITY_MAP = np.array([0.0, 0.0, -1.0])
"""Gravity in the map frame, whose z axis points up."""
MAX_SCANS = 99
_LAST_FRAME = 10**10 - 1
"""Largest frame number: frames are named by ten digits."""


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "kitti360"``; images and scans are read when they are needed.

    Raises ``InputError`` for a wrong key and for a missing or damaged file, which it names. Frames that lack an image,
    a pose or a scan are skipped, and the scene's remarks say how many.
    """
    where = str(path)
    own = {"root", "reference_sequence", "query_sequence", "camera"}
    choices = {"reference_frames", "reference_step", "query_frames", "query_step", "scans"}
    scene_file.check_keys(table, REQUIRED | own, OPTIONAL | choices, where)
    settings = read_settings(table, where, GRAVITY_BOUND_DEG, THRESHOLDS)
    scans = scene_file.integer({"scans": 1} | table, "scans", where, 1, MAX_SCANS)
    if table["camera"] not in tuple(SIDES):
        raise InputError(f"{where}: camera is {show(table['camera'])}; give one of {', '.join(SIDES)}.")
    root = folder(table, "root", path)
    rig = read_rig(root, table["camera"], where)
    mapped = _recorded("reference", table, root, where)
    asked = _recorded("query", table, root, where)
    both = set(mapped.frames) & set(asked.frames) if mapped.drive == asked.drive else set()
    if both:
        raise InputError(f"{where}: frame {min(both)} is both query and reference; give other frames or sequences.")
    references = tuple(mapped.references(rig, scans))
    queries = tuple(asked.view(frame, rig) for frame in asked.frames)
    scene = settings.scene(path, queries, references, GRAVITY_MAP, mapped.remarks + asked.remarks)
    return replace(scene, vehicle_from_camera=rig.imu_from_camera[:3])


@dataclass(frozen=True, eq=False)
class _Recorded:
    """The frames of a sequence that can be used."""

    drive: Drive
    camera: str
    frames: Sequence[int]
    """Frames asked for that have an image, a pose and, for references, a scan; growing."""
    poses: Mapping[int, FloatArray]
    """``world_from_imu`` of all frames that have one."""
    scans: Sequence[int]
    """All frames with a pose and a scan, growing; empty for queries."""
    times_s: Sequence[float]
    """Times of the images by frame; empty if unknown."""
    remarks: tuple[str, ...]

    def view(self, frame: int, rig: Rig, lift: PointCloudLift | None = None) -> View:
        """The image of a frame."""
        file = f"{frame:010d}.png"
        return View(
            name=f"{self.drive.number:04d}/{self.camera}/{file}",
            camera=rig.camera,
            path=self.drive.images(self.camera) / file,
            cam_from_map=self.camera_pose(frame, rig),
            timestamp_s=self.times_s[frame] if frame < len(self.times_s) else None,
            lift=lift,
            mask=partial(without_car, rig.car_mask, rig.camera) if rig.car_mask else None,
        )

    def camera_pose(self, frame: int, rig: Rig) -> FloatArray:
        """``cam_from_map`` (3, 4) of a frame: the inverse of world_from_imu imu_from_camera."""
        map_from_cam = self.poses[frame] @ rig.imu_from_camera
        return pose(map_from_cam[:3, :3].T, -map_from_cam[:3, :3].T @ map_from_cam[:3, 3])

    def references(self, rig: Rig, scans: int) -> Iterator[View]:
        """The images with points: of their frame's scan and of its neighbours, as many as ``scans`` in all."""
        place = {frame: number for number, frame in enumerate(self.scans)}
        for frame in self.frames:
            first = max(0, min(place[frame] - scans // 2, len(self.scans) - scans))
            points = partial(_points, self, rig, self.scans[first : first + scans])
            yield self.view(frame, rig, PointCloudLift(points, rig.camera, self.camera_pose(frame, rig)))


def _points(recorded: _Recorded, rig: Rig, frames: Sequence[int]) -> FloatArray:
    """Laser returns (M, 3) of some scans in the map frame."""
    found = []
    for frame in frames:
        points = read_scan(recorded.drive.scan(frame))
        motion = scan_motion(recorded.poses, frame, rig.imu_from_velodyne)
        if motion is not None:
            points = unwrapped(points, motion)
        found.append(transform((recorded.poses[frame] @ rig.imu_from_velodyne)[:3], points))
    return np.concatenate(found)


def _recorded(role: str, table: dict[str, Any], root: Path, where: str) -> _Recorded:
    """The usable frames of the "reference" or "query" sequence."""
    drive = Drive(root, scene_file.integer(table, f"{role}_sequence", where, 0, 9999))
    camera = table["camera"]
    first, last = _range(table, f"{role}_frames", where)
    step = scene_file.integer({f"{role}_step": 1} | table, f"{role}_step", where, 1, 100_000)
    needed_file(drive.poses.parent, drive.poses.name, where, f"the poses of sequence {drive.number}")
    poses = read_poses(drive.poses)
    images = frames_in(drive.images(camera), ".png", where, f"the images of {camera}")
    images = {frame for frame in images if first <= frame <= last}
    posed = {frame for frame in poses if first <= frame <= last}
    remarks = [
        _remark(images - posed, f"of the {len(images)} images of {drive.name}, {camera}, have no pose"),
        _remark(posed - images, f"of the {len(posed)} poses of {drive.name} have no image of {camera}"),
    ]
    usable, scans = images & posed, []
    if role == "reference":
        scans = sorted(frames_in(drive.scans, ".bin", where, "the laser scans") & set(poses))
        remarks.append(_remark(usable - set(scans), f"images of {drive.name}, {camera}, have no laser scan"))
        usable &= set(scans)
        still = {frame for frame in usable if scan_motion(poses, frame, np.eye(4)) is None}
        if still:
            remarks.append(
                f"{_frames(still)} of {drive.name}: no pose before or after, so the scan is not corrected for motion."
            )
    times = drive.timestamps(camera)
    return _Recorded(
        drive=drive,
        camera=camera,
        frames=sorted(usable)[::step],
        poses=poses,
        scans=scans,
        times_s=read_timestamps(times) if is_file(times) else (),
        remarks=tuple(filter(None, remarks)),
    )


def _range(table: Mapping[str, Any], key: str, where: str) -> tuple[int, int]:
    """First and last frame asked for."""
    value = table.get(key, [0, _LAST_FRAME])
    whole = isinstance(value, list) and all(isinstance(item, int) and not isinstance(item, bool) for item in value)
    if not whole or len(value) != 2 or not 0 <= value[0] <= value[1] <= _LAST_FRAME:
        raise InputError(f"{where}: {key} is {show(value)}; give [first, last], two whole numbers in this order.")
    return value[0], value[1]


def _remark(frames: set[int], what: str) -> str:
    """The remark on some skipped frames; empty if there are none."""
    return f"{_frames(frames)} {what}: skipped." if frames else ""


def _frames(frames: set[int]) -> str:
    """Their number, and the first three: "12 (3, 5, 8, ...)"."""
    some = ", ".join(map(str, sorted(frames)[:3]))
    return f"{len(frames)} ({some}{', ...' if len(frames) > 3 else ''})"
