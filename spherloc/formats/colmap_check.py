"""Walks the files of a COLMAP model in binary form (little endian) before anything else reads them.

Counts are compared with the size of the file before anything is allocated; see ``colmap_parts``.
"""

import os
import struct
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError
from spherloc.files import is_file, open_file, reading
from spherloc.formats.colmap_parts import (
    LARGEST,
    MODELS,
    OBSERVATION,
    ORDER,
    SPHERE,
    ModelParts,
    Observed,
    check_observations,
    check_pose,
    make_points,
)

_SPHERE_ID, _SPHERE_PARAMETERS = 11, 3
_CAMERA = 0
"""Type of a sensor."""
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("track", "<u8")])
_TRACK = np.dtype([("image", "<u4"), ("place", "<u4")])
_MAX_NAME_BYTES = 4096
_TRACK_BYTES = 8_000_000
"""Tracks are checked in pieces of this size."""


class _Reader:
    """Reads records of a file and knows how much is left of it."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file, self.at, self.size = path, file, 0, os.fstat(file.fileno()).st_size

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        """The numbers of a ``struct`` layout."""
        return struct.unpack(layout, self.bytes(struct.calcsize(layout), what))

    def bytes(self, length: int, what: str) -> bytes:
        content = self.file.read(length)
        if len(content) < length:
            raise self.broken(f"the file ends within {what}")
        self.at += length
        return content

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
        return InputError(f"{self.path}, up to byte {self.at}: {what}; replace the damaged file.")


def check_binary(folder: Path) -> ModelParts:
    """Check ``cameras.bin``, ``images.bin``, ``points3D.bin`` and, where they are, ``rigs.bin`` and ``frames.bin``.

    Raises ``InputError`` with the file and the byte of what is wrong.
    """
    walked = ModelParts()
    for name, step in zip(ORDER, (_cameras, _rigs, _frames, _images, _points), strict=True):
        path = folder / f"{name}.bin"
        if name in ("rigs", "frames") and not is_file(path):
            continue
        with reading(path, "check the file"), open_file(path) as file:
            reader = _Reader(path, file)
            step(reader, walked)
            reader.end()
    return walked


def _cameras(reader: _Reader, walked: ModelParts) -> None:
    count = reader.count("<Q", 24, "cameras")
    sphere_bytes = 8 + count * (24 + 8 * _SPHERE_PARAMETERS)
    for _ in range(count):
        number, model, _, _ = reader.take("<IiQQ", "a camera")
        if model == _SPHERE_ID and reader.size == sphere_bytes:
            raise InputError(f"{reader.path}: {SPHERE}")
        if not 0 <= model < len(MODELS):
            raise reader.broken(f"camera {number} has the unknown model {model}")
        params = reader.take(f"<{MODELS[model][1]}d", f"the parameters of camera {number}")
        walked.camera(number, params, reader.broken)


def _rigs(reader: _Reader, walked: ModelParts) -> None:
    for _ in range(reader.count("<Q", 8, "rigs")):
        number, count = reader.take("<II", "a rig")
        what = f"the sensors of rig {number}"
        sensors = [reader.take("<iI", what)] if count else []
        for _ in range(count - 1):
            *sensor, has_pose = reader.take("<iIB", what)
            sensors.append(tuple(sensor))
            if has_pose:
                check_pose(reader.take("<7d", what), reader.broken, f"a sensor of rig {number}")
        walked.rig(number, [sensor for kind, sensor in sensors if kind == _CAMERA], reader.broken)


def _frames(reader: _Reader, walked: ModelParts) -> None:
    for _ in range(reader.count("<Q", 68, "frames")):
        number, rig, *pose = reader.take("<II7d", "a frame")
        check_pose(pose, reader.broken, f"frame {number}")
        what = f"images of frame {number}"
        data = [reader.take("<iIQ", what) for _ in range(reader.count("<I", 16, what))]
        walked.frame(number, rig, [(sensor, image) for kind, sensor, image in data if kind == _CAMERA], reader.broken)


def _images(reader: _Reader, walked: ModelParts) -> None:
    for _ in range(reader.count("<Q", 73, "images")):
        number, *pose, camera_id = reader.take("<I7dI", "an image")
        check_pose(pose, reader.broken, f"image {number}")
        name = _name(reader, number)
        count = reader.count("<Q", OBSERVATION.itemsize, f"observations of image {number}")
        load = partial(_load, reader.path, reader.at, count)
        observations = np.frombuffer(reader.bytes(count * OBSERVATION.itemsize, "observations"), OBSERVATION)
        check_observations(observations, reader.broken, f"image {number}")
        walked.image(number, Observed(name, camera_id, count, load), reader.broken)


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


def _load(path: Path, offset: int, count: int) -> NDArray[Any]:
    """Observations are read when they are asked for: those of thousands of images would fill the memory."""
    with reading(path, "load the scene again"), open_file(path) as file:
        observations = np.fromfile(file, OBSERVATION, count, offset=offset)
    if len(observations) != count:
        raise InputError(f"{path}: has changed since it was loaded; load the scene again.")
    return observations


def _points(reader: _Reader, walked: ModelParts) -> None:
    records, tracks = bytearray(), bytearray()
    for _ in range(reader.count("<Q", _POINT.itemsize, "points")):
        records += reader.bytes(_POINT.itemsize - 8, "a point")
        length = reader.count("<Q", _TRACK.itemsize, "keypoints of a point")
        records += length.to_bytes(8, "little")
        tracks += reader.bytes(length * _TRACK.itemsize, "the keypoints of a point")
        if len(tracks) > _TRACK_BYTES:
            _check_tracks(reader, walked, tracks)
            tracks = bytearray()
    _check_tracks(reader, walked, tracks)
    table = np.frombuffer(bytes(records), _POINT)
    possible = (np.abs(table["xyz"]) <= LARGEST).all(axis=1) & (table["id"] >= 0)
    if not possible.all():
        raise reader.broken(
            f"record {int(np.flatnonzero(~possible)[0]) + 1} of the points has no possible position or id"
        )
    walked.points = make_points(table["id"], table["xyz"], table["error"], table["track"])


def _check_tracks(reader: _Reader, walked: ModelParts, content: bytearray) -> None:
    track = np.frombuffer(bytes(content), _TRACK)
    walked.tracks(track["image"].astype(np.int64), track["place"].astype(np.int64), reader.broken)
