"""The text files of a kapture dataset (format 1.1): sensors, rigs, trajectories, records_camera.

Values are separated by commas and a value may be empty. A rig holds sensors or other rigs. Poses are
``sensor_from_rig`` in rigs.txt and ``device_from_world`` in trajectories.txt, where a device is a sensor or a rig.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import CalibrationError, InputError, show
from spherloc.files import is_file
from spherloc.formats.text_rows import finite_numbers, needed_file, pose_from_words, rows
from spherloc.geometry import pose
from spherloc.types import FloatArray

_LARGEST_TIMESTAMP = 2**63
_UNKNOWN = "UNKNOWN_CAMERA"


@dataclass(frozen=True)
class Record:
    """One image."""

    timestamp: int
    """Timestamp as in the file: nanoseconds, or a running number."""
    device: str
    """The sensor that took it."""
    image: str
    """Path of the image below sensors/records_data."""


@dataclass(frozen=True, eq=False)
class Kapture:
    """The contents of a dataset's files."""

    cameras: Mapping[str, Camera]
    """Cameras by sensor."""
    rigs: Mapping[str, Mapping[str, FloatArray | None]]
    """``member_from_rig`` (3, 4) by member (a sensor or a rig) and rig; None where the file leaves it open."""
    trajectories: Mapping[tuple[int, str], FloatArray]
    """``device_from_world`` (3, 4) by timestamp and device."""
    records: tuple[Record, ...]
    """Images in the order of the file."""
    remarks: tuple[str, ...]
    """What was skipped and why."""

    def pose(self, timestamp: int, device: str) -> FloatArray | None:
        """``device_from_world`` (3, 4): its own, else by the nearest rig that has one; None if neither has."""
        member_from = {device: np.eye(3, 4)}
        waiting = [device]
        for member in waiting:
            own = self.trajectories.get((timestamp, member))
            if own is not None:
                return _compose(member_from[member], own)
            for rig, member_from_rig in self.rigs.get(member, {}).items():
                if member_from_rig is not None and rig not in member_from:
                    member_from[rig] = _compose(member_from[member], member_from_rig)
                    waiting.append(rig)
        return None

    def carriers(self, device: str) -> set[str]:
        """The device and all rigs that hold it: devices that share one move together."""
        found, waiting = {device}, [device]
        for member in waiting:
            above = set(self.rigs.get(member, {})) - found
            found |= above
            waiting.extend(above)
        return found


def _compose(left: FloatArray, right: FloatArray) -> FloatArray:
    """The pose (3, 4) that applies ``right`` first."""
    return pose(left[:, :3] @ right[:, :3], left[:, :3] @ right[:, 3] + left[:, 3])


def read_kapture(root: Path, where: str) -> Kapture:
    """Read the folder that holds ``sensors/``; ``where`` names the scene file.

    Raises ``InputError``, one sentence with the file and the line, for a missing file and a wrong line. Cameras of
    unknown calibration are skipped, and so is a pose that a file leaves open; ``remarks`` say so.
    """
    folder = root / "sensors"
    sensors_file = needed_file(folder, "sensors.txt", where, "kapture's list of sensors")
    records_file = needed_file(folder, "records_camera.txt", where, "kapture's list of images")
    trajectories_file = needed_file(folder, "trajectories.txt", where, "kapture's poses")
    devices, cameras, remarks = _sensors(sensors_file)
    rigs_file = folder / "rigs.txt"
    rigs = _rigs(rigs_file, devices) if is_file(rigs_file) else {}
    known = devices | {rig for members in rigs.values() for rig in members}
    trajectories, open_poses = _trajectories(trajectories_file, known)
    if open_poses:
        count = len(trajectories) + open_poses
        remarks.append(f"{open_poses} of {count} poses in {trajectories_file} lack a rotation or a position: skipped.")
    return Kapture(cameras, rigs, trajectories, _records(records_file, devices), tuple(remarks))


def _fields(path: Path, what: str, least: int, most: int) -> Iterator[tuple[str, list[str]]]:
    """Place and values of every line, which has ``least`` to ``most`` of them."""
    for place, text in rows(path, what):
        values = [value.strip() for value in text.split(",")]
        if not least <= len(values) <= most:
            count = f"{least}" if least == most else f"{least} or more"
            raise InputError(f"{place}: has {len(values)} values instead of {count}; give {what}.")
        yield place, values


def _sensors(path: Path) -> tuple[set[str], dict[str, Camera], list[str]]:
    devices: set[str] = set()
    cameras: dict[str, Camera] = {}
    remarks = []
    for place, (device, _, kind, *parameters) in _fields(path, "sensor_id, name, sensor_type, parameters", 3, 64):
        if not device or device in devices:
            raise InputError(f"{place}: the sensor {show(device)} is named twice or not at all; give it its own id.")
        devices.add(device)
        if kind != "camera":
            continue
        if parameters and parameters[0] == _UNKNOWN:
            remarks.append(f"The images of camera {show(device)} are skipped: its calibration is {_UNKNOWN}.")
            continue
        try:
            cameras[device] = _camera(parameters, place)
        except CalibrationError as error:
            remarks.append(f"The images of camera {show(device)} are skipped: {error}")
    return devices, cameras, remarks


def _camera(parameters: list[str], place: str) -> Camera:
    if len(parameters) < 3:
        raise InputError(f"{place}: a camera has {len(parameters)} parameters; give MODEL, width, height, parameters.")
    width, height, *numbers = finite_numbers(parameters[1:], place)
    if not (width.is_integer() and height.is_integer()):
        raise InputError(f"{place}: an image of {width:g} x {height:g} pixels; give whole numbers.")
    return camera_from_colmap(parameters[0], int(width), int(height), tuple(numbers), place)


def _rigs(path: Path, sensors: set[str]) -> dict[str, dict[str, FloatArray | None]]:
    """``member_from_rig`` (3, 4) by member and rig; raises ``InputError`` if a rig holds itself."""
    rigs: dict[str, dict[str, FloatArray | None]] = {}
    what = "rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz"
    for place, (rig, member, *words) in _fields(path, what, 9, 9):
        if rig in sensors or not rig or not member:
            raise InputError(f"{place}: the rig {show(rig)} holds {show(member)}; give a rig its own id, and a member.")
        if rig in rigs.setdefault(member, {}):
            raise InputError(f"{place}: the rig {show(rig)} holds {show(member)} twice; remove one line.")
        rigs[member][rig] = pose_from_words(words, place) if any(words) else None
    try:
        TopologicalSorter(rigs).prepare()
    except CycleError as error:
        raise InputError(f"{path}: the rig {show(error.args[1][0])} holds itself; remove one of its lines.") from None
    return rigs


def _trajectories(path: Path, devices: set[str]) -> tuple[dict[tuple[int, str], FloatArray], int]:
    """Poses, and how many the file leaves open."""
    poses: dict[tuple[int, str], FloatArray] = {}
    open_poses = 0
    what = "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz"
    for place, (time, device, *words) in _fields(path, what, 9, 9):
        key = _timestamp(time, place), device
        if device not in devices:
            raise InputError(f"{place}: no sensor or rig is called {show(device)}; add it to sensors.txt or rigs.txt.")
        if key in poses:
            raise InputError(f"{place}: {show(device)} has two poses at {show(time)}; remove one line.")
        if not any(words[:4]) or not any(words[4:]):
            open_poses += 1
            continue
        poses[key] = pose_from_words(words, place)
    return poses, open_poses


def _records(path: Path, devices: set[str]) -> tuple[Record, ...]:
    records: dict[str, Record] = {}
    for place, (time, device, image) in _fields(path, "timestamp, device_id, image_path", 3, 3):
        if device not in devices:
            raise InputError(f"{place}: no sensor is called {show(device)}; add it to sensors.txt.")
        if not image or image in records:
            raise InputError(f"{place}: the image {show(image)} is named twice or not at all; name each image once.")
        records[image] = Record(_timestamp(time, place), device, image)
    return tuple(records.values())


def _timestamp(word: str, place: str) -> int:
    digits = word.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) < 20 and int(digits) < _LARGEST_TIMESTAMP):
        raise InputError(f"{place}: the timestamp {show(word)} is not a whole number of 64 bits; correct it.")
    return int(word)
