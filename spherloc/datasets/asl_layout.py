"""Recognizes a recorded sequence in the ASL layout, that of EuRoC and TUM-VI, by the names of its folders.

A folder ``mav0`` has one for each sensor: ``cam0`` with images in ``data`` and their times in ``data.csv``, ``imu0``,
ground truth. Imports nothing large, so that a command says at once what a folder is.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePath

from spherloc.errors import InputError
from spherloc.files import is_file, is_folder, is_image, names_in

MAV, DATA = "mav0", "data"
TABLE, SENSOR = "data.csv", "sensor.yaml"
"""Files of a sensor: its measurements, or the times of its images; and what it is."""
_CAMERA = re.compile(r"cam\d+", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class AslSequence:
    """Where a sequence in the ASL layout is."""

    folder: Path
    """The folder of its sensors' folders, usually called mav0."""
    cameras: Mapping[str, Path]
    """Folders of images by the name of the camera (cam0), in the order of names."""
    empty: tuple[str, ...] = ()
    """Names of cameras without images."""

    def sensor(self, name: str) -> Path:
        """The folder of a sensor, which may not be there."""
        return self.folder / name

    def called(self, file: Path) -> str:
        """What a file is called: its path in the folder that holds ``mav0``, such as mav0/imu0/data.csv."""
        with suppress(ValueError):
            return file.resolve().relative_to(self.folder.resolve().parent).as_posix()
        return str(file)


def asl_sequence(path: Path) -> AslSequence | None:
    """The sequence in a folder: one that holds ``mav0``, ``mav0`` itself, one of its cameras (``mav0/cam0``), or the
    images of that (``mav0/cam0/data``). None for any other folder, and for one that cannot be listed."""
    for folder in (path, path / MAV):
        names = [name for name in _names(folder) if _CAMERA.fullmatch(name) and is_folder(folder / name)]
        cameras = {name: folder / name / DATA for name in names if _has_images(folder / name / DATA)}
        if cameras:
            empty = tuple(name for name in names if name not in cameras)
            return None if folder == path and _has_images(path) else AslSequence(folder, cameras, empty)
    whole = path.resolve()
    if path.name == whole.name and path.parent.resolve() == whole.parent:
        whole = path  # as the user wrote it
    own, images = (whole.parent, path) if whole.name == DATA else (whole, path / DATA)
    known = _CAMERA.fullmatch(own.name) or is_file(own / SENSOR)
    if not known or not _has_images(images) or (images != path and _has_images(path)):
        return None
    return AslSequence(own.parent, {own.name: images})


def of_all_cameras(sequence: AslSequence) -> AslSequence:
    """The sequence with all of its cameras, where ``sequence`` is that of one of them (``mav0/cam0``)."""
    whole = asl_sequence(sequence.folder)
    return whole if whole is not None and whole.cameras.keys() >= sequence.cameras.keys() else sequence


def camera_of_folder(folder: PurePath) -> str:
    """The name of the camera whose images are in a folder: that of the folder, of ``cam0/data`` cam0."""
    return folder.parent.name if folder.name == DATA and _CAMERA.fullmatch(folder.parent.name) else folder.name


def _has_images(folder: Path) -> bool:
    return any(map(is_image, _names(folder)))


def _names(folder: Path) -> list[str]:
    try:
        return names_in(folder) if is_folder(folder) else []
    except InputError:
        return []
