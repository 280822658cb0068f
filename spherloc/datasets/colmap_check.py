"""Walks the files of a COLMAP model in binary form before anything else reads them.

COLMAP's own reader takes a truncated file for a shorter one, believes every count, and passes NaN on. So the walk
compares counts with the file's size before anything is allocated, and says at which byte what is wrong. On its way it
collects the columns of observations and points, for which COLMAP has an object each.
Layout: doc/format.rst of COLMAP 4.2; little endian.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import FloatArray
from spherloc.errors import InputError, show

MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5)),
    *(("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5)),
    *(("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6), ("EQUIRECTANGULAR", 2)),
)
"""Name and number of parameters of COLMAP's camera models, by id."""

SPHERE_ID, SPHERE_PARAMETERS = 11, 3
"""The fork SphereSfM gave this id, which is another model's now, to panoramas."""

SPHERE = (
    "has panoramas of the camera model SPHERE, which only the fork SphereSfM knows and whose id is another model's in "
    "COLMAP; make the model anew with COLMAP 4.1 or later and its camera model EQUIRECTANGULAR."
)

OBSERVATION = np.dtype([("pixel", "<f8", (2,)), ("point", "<i8")])
"""A pixel and the id of its point, -1 for none."""

_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("track", "<u8")])
_MAX_NAME_BYTES = 4096
_NORM_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Observed:
    """An image as its file has it."""

    name: str
    camera_id: int
    count: int
    """Number of observations."""
    load: Callable[[], NDArray]
    """The ``OBSERVATION`` records, (count,)."""


@dataclass(frozen=True, eq=False)
class Points:
    """Columns of P points, by rising id."""

    ids: NDArray[np.int64]
    """(P,)"""
    xyz: FloatArray
    """(P, 3), metres if the model has them."""
    errors_px: FloatArray
    """(P,) mean reprojection error; -1 where COLMAP did not compute it."""
    track_lengths: NDArray[np.int64]
    """(P,) number of images that see the point."""


@dataclass(eq=False)
class Walked:
    """What a walk through all files of a model found."""

    images: dict[int, Observed] = field(default_factory=dict)
    """By id."""
    points: Points = field(default_factory=lambda: make_points([], np.empty((0, 3)), [], []))


class _Reader:
    """Reads records of a file and knows how much is left of it."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file, self.at, self.size = path, file, 0, path.stat().st_size

    def take(self, layout: str, what: str) -> tuple:
        """The numbers of a ``struct`` layout."""
        return struct.unpack(layout, self.bytes(struct.calcsize(layout), what))

    def bytes(self, length: int, what: str) -> bytes:
        content = self.file.read(length)
        if len(content) < length:
            raise self.broken(f"the file ends within {what}")
        self.at += length
        return content

    def skip(self, length: int) -> None:
        self.file.seek(length, 1)
        self.at += length

    def count(self, layout: str, least_bytes: int, what: str) -> int:
        """A number of records that follow, each of ``least_bytes`` at least."""
        (number,) = self.take(layout, f"the number of {what}")
        if number * least_bytes > self.size - self.at:
            raise self.broken(f"{number} {what} are announced, more than the file can hold")
        return number

    def end(self) -> None:
        if self.at != self.size:
            raise self.broken(f"{self.size - self.at} bytes follow the last record")

    def broken(self, what: str) -> InputError:
        return InputError(f"{self.path}, byte {self.at}: {what}; the file is damaged, so export the model again.")


def walk_binary(folder: Path) -> Walked:
    """Check ``cameras.bin``, ``images.bin``, ``points3D.bin`` and, where they are, ``rigs.bin`` and ``frames.bin``.

    Raises ``InputError`` with the file and the byte of what is wrong.
    """
    walked = Walked()
    steps = {"cameras": _cameras, "rigs": _rigs, "frames": _frames, "images": _images, "points3D": _points}
    for name, step in steps.items():
        path = folder / f"{name}.bin"
        if name in ("rigs", "frames") and not path.is_file():
            continue
        try:
            with path.open("rb") as file:
                reader = _Reader(path, file)
                step(reader, walked)
                reader.end()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check the file.") from None
    return walked


def _cameras(reader: _Reader, walked: Walked) -> None:
    count = reader.count("<Q", 24, "cameras")
    sphere_bytes = 8 + count * (24 + 8 * SPHERE_PARAMETERS)
    for _ in range(count):
        number, model, _, _ = reader.take("<IiQQ", "a camera")
        if model == SPHERE_ID and reader.size == sphere_bytes:
            raise InputError(f"{reader.path}: {SPHERE}")
        if not 0 <= model < len(MODELS):
            raise reader.broken(f"camera {number} has the unknown model {model}")
        params = reader.take(f"<{MODELS[model][1]}d", f"the parameters of camera {number}")
        if not np.isfinite(params).all():
            raise reader.broken(f"a parameter of camera {number} is not a finite number")


def _rigs(reader: _Reader, walked: Walked) -> None:
    for _ in range(reader.count("<Q", 8, "rigs")):
        number, sensors = reader.take("<II", "a rig")
        if sensors:
            reader.take("<iI", f"the sensors of rig {number}")
        for _ in range(sensors - 1):
            *_, has_pose = reader.take("<iIB", f"the sensors of rig {number}")
            if has_pose:
                pose = reader.take("<7d", f"the sensors of rig {number}")
                check_pose(pose, reader.broken, f"rig {number}")


def _frames(reader: _Reader, walked: Walked) -> None:
    for _ in range(reader.count("<Q", 68, "frames")):
        number, _, *pose = reader.take("<II7d", "a frame")
        check_pose(pose, reader.broken, f"frame {number}")
        reader.skip(16 * reader.count("<I", 16, f"images of frame {number}"))


def _images(reader: _Reader, walked: Walked) -> None:
    for _ in range(reader.count("<Q", 73, "images")):
        number, *pose, camera_id = reader.take("<I7dI", "an image")
        check_pose(pose, reader.broken, f"image {number}")
        name = _name(reader, number)
        count = reader.count("<Q", OBSERVATION.itemsize, f"observations of image {number}")
        load = partial(_load, reader.path, reader.at, count)
        observations = np.frombuffer(reader.bytes(count * OBSERVATION.itemsize, "observations"), OBSERVATION)
        check_observations(observations, reader.broken, f"image {number}")
        add_image(walked, number, Observed(name, camera_id, count, load), reader.broken)


def _name(reader: _Reader, number: int) -> str:
    name = bytearray()
    while (letter := reader.bytes(1, f"the name of image {number}")) != b"\0":
        name += letter
        if len(name) > _MAX_NAME_BYTES:
            raise reader.broken(f"the name of image {number} does not end")
    try:
        return name.decode()
    except UnicodeDecodeError:
        raise reader.broken(f"the name of image {number} is no text in UTF-8") from None


def _load(path: Path, offset: int, count: int) -> NDArray:
    """Observations are read when they are asked for: those of thousands of images would fill the memory."""
    try:
        observations = np.fromfile(path, OBSERVATION, count, offset=offset)
    except OSError as error:
        raise InputError(f"{path}: cannot be read any more ({error.strerror}); load the scene again.") from None
    if len(observations) != count:
        raise InputError(f"{path}: has changed since it was loaded; load the scene again.")
    return observations


def _points(reader: _Reader, walked: Walked) -> None:
    records = bytearray()
    for _ in range(reader.count("<Q", _POINT.itemsize, "points")):
        records += reader.bytes(_POINT.itemsize - 8, "a point")
        elements = reader.count("<Q", 8, "images of a point")
        records += elements.to_bytes(8, "little")
        reader.skip(8 * elements)
    table = np.frombuffer(bytes(records), _POINT)
    wrong = np.flatnonzero(~np.isfinite(table["xyz"]).all(axis=1) | (table["id"] < 0))
    if len(wrong):
        raise reader.broken(f"record {wrong[0] + 1} of the points has no finite position or an impossible id")
    walked.points = make_points(table["id"], table["xyz"], table["error"], table["track"])


def make_points(ids, xyz, errors_px, track_lengths) -> Points:
    """Columns in the order of ids."""
    numbers = np.asarray(ids, dtype=np.int64)
    order = np.argsort(numbers, kind="stable")
    return Points(
        ids=numbers[order],
        xyz=np.asarray(xyz, dtype=np.float64)[order],
        errors_px=np.asarray(errors_px, dtype=np.float64)[order],
        track_lengths=np.asarray(track_lengths, dtype=np.int64)[order],
    )


def add_image(walked: Walked, number: int, image: Observed, broken: Callable[[str], InputError]) -> None:
    """Keep an image whose id and name are new; ``broken`` makes the error otherwise."""
    if number in walked.images:
        raise broken(f"image {number} is there twice")
    if not image.name:
        raise broken(f"image {number} has no name")
    walked.images[number] = image


def check_pose(numbers, broken: Callable[[str], InputError], what: str) -> None:
    """Raise what ``broken`` makes unless ``numbers`` are a unit quaternion and a finite translation."""
    values = np.asarray(numbers, dtype=np.float64)
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all() or abs(length - 1.0) > _NORM_TOLERANCE:
        raise broken(f"the pose of {what} is {show(list(numbers))}, not a unit quaternion and a finite translation")


def check_observations(observations: NDArray, broken: Callable[[str], InputError], what: str) -> None:
    """Raise what ``broken`` makes unless all ``OBSERVATION`` records have a finite pixel and a possible point."""
    wrong = np.flatnonzero(~np.isfinite(observations["pixel"]).all(axis=1) | (observations["point"] < -1))
    if len(wrong):
        raise broken(f"observation {wrong[0] + 1} of {what} has no finite pixel or an impossible point")
