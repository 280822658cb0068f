"""What a sequence in the ASL layout (EuRoC, TUM-VI) tells of its cameras: calibrations, places on the body, and times.

A sensor's ``T_BS`` takes points from its own frame to that of the body, p_B = T_BS p_S; ``T_cam_imu`` of a Kalibr chain
takes them from the IMU's frame to the camera's. Without a ``T_BS`` of the IMU its frame is that of the body.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import camera_names, load_camera
from spherloc.cameras.rig_files import read_rig
from spherloc.cameras.tool_files import read_body_from_sensor
from spherloc.datasets.asl_layout import MAV, SENSOR, TABLE, AslSequence
from spherloc.datasets.imu import time_in_name
from spherloc.errors import CalibrationError, InputError, shorten
from spherloc.files import is_file, is_folder, is_image, names_in
from spherloc.formats.text_rows import rows
from spherloc.types import FloatArray

IMU = "imu0"
CHAINS = (".json", ".txt", ".yaml", ".yml")
"""Endings of calibration files that may have several cameras."""
MAX_FILES, MAX_FOLDERS = 20, 20
"""Largest numbers of files in a folder that are tried as a calibration, and of folders that are searched for these."""
_COLUMNS = "timestamp [ns], filename"


@dataclass(frozen=True, eq=False)
class AslCamera:
    """The calibration of a camera of a sequence."""

    camera: Camera
    file: Path
    body_from_camera: FloatArray | None = None
    """(4, 4), metres; None if no file says it."""
    shift_s: float = 0.0
    """What is added to a time of the camera to get the same moment by the IMU's clock."""


@dataclass(frozen=True, eq=False)
class AslCameras:
    """The calibrations of a sequence, as far as there are any."""

    by_name: Mapping[str, AslCamera]
    remarks: tuple[str, ...] = ()
    """Why files are not used, in sentences."""


@dataclass(frozen=True)
class ImageTimes:
    """When the images of a camera were taken."""

    times_ns: Mapping[str, int]
    """By file name, of those of which it is known."""
    remarks: tuple[str, ...] = ()
    """What is wrong with the table, in sentences."""


def image_times(folder: Path) -> ImageTimes:
    """When the images in a folder ``cam0/data`` were taken: by the table ``data.csv`` beside it, else by their names,
    nanoseconds with zeros in front or without. A table that cannot be read is not used, as a remark says."""
    table = folder.parent / TABLE
    names = {name for name in names_in(folder) if is_image(name)}
    found = {name: time for name in names if (time := _time_in(name)) is not None}
    if not is_file(table):
        return ImageTimes(found)
    try:
        stated = _stated_times(table)
    except InputError as error:
        return ImageTimes(found, (f"{error} Times are those in the names of the images.",))
    told = {name: time for name, time in stated.items() if name in names}
    absent = [name for name in stated if name not in names]
    remarks = []
    if absent:
        what = f"{table}: {len(absent):,} of its {len(stated):,} rows name no image there"
        instead = "" if told else "; times are those in the names of the images"
        remarks.append(f"{what}, the first is {shorten(absent[0])}{instead}.")
    return ImageTimes(found | told, tuple(remarks))


def _stated_times(table: Path) -> dict[str, int]:
    """Times, ns, by file name; raises ``InputError`` for a row of another form."""
    found = {}
    for place, text in rows(table, f"rows of {_COLUMNS}"):
        words = [word.strip() for word in text.split(",")]
        if len(words) != 2 or not (words[0].isascii() and words[0].isdigit() and len(words[0]) < 20):
            raise InputError(f"{place}: is not a row of {_COLUMNS}.")
        found[words[1]] = int(words[0])
    return found


def _time_in(name: str) -> int | None:
    return time_in_name(Path(name).stem.lstrip("0") + Path(name).suffix)


def asl_cameras(sequence: AslSequence) -> AslCameras:
    """The calibrations of a sequence's cameras: of ``sensor.yaml`` in the folder of each, else of a file with all of
    them, such as a Kalibr chain, in ``mav0``, beside it, or in a folder there. What cannot be read is not used."""
    own: dict[str, AslCamera] = {}
    remarks: list[str] = []
    for name in sequence.cameras:
        file = sequence.sensor(name) / SENSOR
        if is_file(file):
            try:
                own[name] = AslCamera(load_camera(file), file, read_body_from_sensor(file))
            except CalibrationError as error:
                remarks.append(f"A file beside them is not used: {error}")
    if len(own) == len(sequence.cameras):
        return AslCameras(own)
    best: dict[str, AslCamera] = {}
    for file in _files(sequence):
        with suppress(CalibrationError):  # most are no calibration
            of_file = _of_chain(file, sequence)
            if len(of_file) > len(best) or (_fixed(of_file) and not _fixed(best)):
                best = of_file
    found = {name: own.get(name) or best[name] for name in sequence.cameras if name in own or name in best}
    return AslCameras(found, () if len(found) == len(sequence.cameras) else tuple(remarks))


def body_from(sensor: Path) -> FloatArray:
    """``T_BS`` (4, 4) of the sensor in a folder; the identity if it states none. Raises ``CalibrationError`` for a
    damaged file."""
    file = sensor / SENSOR
    stated = read_body_from_sensor(file) if is_file(file) else None
    return np.eye(4) if stated is None else stated


def _fixed(cameras: Mapping[str, AslCamera]) -> bool:
    """Whether it is known how they are fixed to the IMU."""
    return any(one.body_from_camera is not None for one in cameras.values())


def _files(sequence: AslSequence) -> Iterator[Path]:
    """Files that may have the calibrations of all cameras of a sequence, the nearest first."""
    here = sequence.folder
    places = [here]
    if here.resolve().name == MAV:
        places.append(here.parent if here.name == MAV else here.resolve().parent)
    names = {place: _names(place) for place in places}
    inside = [place / name for place in places for name in names[place] if not name.startswith(".")]
    for folder in (*places, *[path for path in inside if is_folder(path) and path != here][:MAX_FOLDERS]):
        files = [name for name in names.get(folder, _names(folder)) if Path(name).suffix.lower() in CHAINS]
        yield from [folder / name for name in files if name != SENSOR][:MAX_FILES]


def _names(folder: Path) -> list[str]:
    """Names in a folder; none if it cannot be listed."""
    try:
        return names_in(folder)
    except InputError:
        return []


def _of_chain(file: Path, sequence: AslSequence) -> dict[str, AslCamera]:
    """The cameras of the sequence that a file has by name; raises ``CalibrationError`` if it is none."""
    names = [name for name in camera_names(file) if name in sequence.cameras]
    found = {name: AslCamera(load_camera(file, name), file) for name in names}
    with suppress(CalibrationError):  # what it says of the IMU cannot be used
        body, rig = body_from(sequence.sensor(IMU)), read_rig(file)
        for name, imu_from_camera in rig.body_from_camera.items() if rig.of_imu else ():
            if name in found:
                shift_s = rig.shifts_s.get(name, 0.0)
                found[name] = replace(found[name], body_from_camera=body @ imu_from_camera, shift_s=shift_s)
    return found
