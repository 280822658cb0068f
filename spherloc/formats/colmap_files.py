"""Reads a COLMAP model from its files: binary (little endian) or text, old or with rigs and frames.

In binary files counts are compared with the size of the file before anything is allocated; see ``colmap_model``.
"""

import io
import os
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, shorten, show
from spherloc.files import is_file, is_folder, open_file, reading
from spherloc.formats.colmap_model import (
    LARGEST,
    MODELS,
    OBSERVATION,
    SPHERE,
    ColmapImage,
    ColmapModel,
    ModelParts,
    check_observations,
    make_points,
    read_pose,
)
from spherloc.types import FloatArray

_FILES = ("cameras", "images", "points3D")


def read_model(folder: Path) -> ColmapModel:
    """Read the model in ``folder``: the binary form if all of its three files are there, else the text form.

    Raises ``InputError`` that names the missing file, or the file and the byte or line of what is wrong.
    """
    folder = Path(folder)
    parts = _read_binary(folder) if _form(folder) == "bin" else _read_text(folder)
    images = {image.name: image for image in sorted(parts.images.values(), key=lambda image: image.name)}
    without = len(parts.counts) - len(images)
    remarks = (f"{folder}: {without} images have no pose and were left out.",) if without else ()
    return ColmapModel(folder, images, parts.points, parts.cameras, remarks)


def _form(folder: Path) -> str:
    """Which form is complete; raises ``InputError`` for none."""
    if not is_folder(folder):
        raise InputError(f"{folder}: no such folder; give the folder of a COLMAP model.")
    missing = {form: [name for name in _FILES if not is_file(folder / f"{name}.{form}")] for form in ("bin", "txt")}
    form = min(missing, key=lambda form: len(missing[form]))
    if len(missing[form]) == len(_FILES):
        models = sorted({path.parent.name for path in folder.glob("*/cameras.*")})
        hint = f"one of its folders {', '.join(map(shorten, models[:5]))}" if models else "the folder that holds one"
        raise InputError(f"{folder}: no COLMAP model (cameras, images and points3D as .bin or .txt); give {hint}.")
    if missing[form]:
        raise InputError(f"{folder / missing[form][0]}.{form} is missing; a COLMAP model needs it, so export it again.")
    has = [name for name in ("rigs", "frames") if is_file(folder / f"{name}.{form}")]
    if len(has) == 1:
        other = "frames" if has == ["rigs"] else "rigs"
        raise InputError(f"{folder / other}.{form} is missing beside {has[0]}.{form}; add it, or remove both.")
    return form


_SPHERE_ID, _SPHERE_PARAMETERS = 11, 3
_CAMERA = 0
"""Number that rigs.bin and frames.bin use for the sensor type camera."""
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


def _read_binary(folder: Path) -> ModelParts:
    """Check ``cameras.bin``, ``images.bin``, ``points3D.bin`` and, where they are, ``rigs.bin`` and ``frames.bin``.

    Raises ``InputError`` with the file and the byte of what is wrong.
    """
    parts = ModelParts()
    steps = {
        "cameras": _binary_cameras,
        "rigs": _binary_rigs,
        "frames": _binary_frames,
        "images": _binary_images,
        "points3D": _binary_points,
    }
    for name, step in steps.items():  # each refers only to what was read before it
        path = folder / f"{name}.bin"
        if name in ("rigs", "frames") and not is_file(path):
            continue
        with reading(path, "check the file"), open_file(path) as file:
            reader = _Reader(path, file)
            step(reader, parts)
            reader.end()
    return parts


def _binary_cameras(reader: _Reader, parts: ModelParts) -> None:
    count = reader.count("<Q", 24, "cameras")
    sphere_bytes = 8 + count * (24 + 8 * _SPHERE_PARAMETERS)
    for _ in range(count):
        number, model, width, height = reader.take("<IiQQ", "a camera")
        if model == _SPHERE_ID and reader.size == sphere_bytes:
            raise InputError(f"{reader.path}: {SPHERE}")
        if not 0 <= model < len(MODELS):
            raise reader.broken(f"camera {number} has the unknown model {model}")
        name, count_params = MODELS[model]
        params = reader.take(f"<{count_params}d", f"the parameters of camera {number}")
        parts.camera(number, (name, width, height, params), reader.broken)


def _binary_rigs(reader: _Reader, parts: ModelParts) -> None:
    for _ in range(reader.count("<Q", 8, "rigs")):
        number, count = reader.take("<II", "a rig")
        what = f"the sensors of rig {number}"
        cameras: list[tuple[int, FloatArray | None]] = []
        for place in range(count):
            kind, sensor = reader.take("<iI", what)
            sensor_from_rig = np.eye(3, 4) if place == 0 else None  # the first sensor is the reference
            if place > 0 and reader.take("<B", what)[0]:
                sensor_from_rig = read_pose(reader.take("<7d", what), reader.broken, f"a sensor of rig {number}")
            if kind == _CAMERA:
                cameras.append((sensor, sensor_from_rig))
        parts.rig(number, cameras, reader.broken)


def _binary_frames(reader: _Reader, parts: ModelParts) -> None:
    for _ in range(reader.count("<Q", 68, "frames")):
        number, rig, *numbers = reader.take("<II7d", "a frame")
        rig_from_map = read_pose(numbers, reader.broken, f"frame {number}")
        what = f"images of frame {number}"
        data = [reader.take("<iIQ", what) for _ in range(reader.count("<I", 16, what))]
        images = [(sensor, image) for kind, sensor, image in data if kind == _CAMERA]
        parts.frame(number, rig, rig_from_map, images, reader.broken)


def _binary_images(reader: _Reader, parts: ModelParts) -> None:
    for _ in range(reader.count("<Q", 73, "images")):
        number, *numbers, camera_id = reader.take("<I7dI", "an image")
        cam_from_map = read_pose(numbers, reader.broken, f"image {number}")
        name = _name(reader, number)
        count = reader.count("<Q", OBSERVATION.itemsize, f"observations of image {number}")
        load = partial(_load, reader.path, reader.at, count)
        observations = np.frombuffer(reader.bytes(count * OBSERVATION.itemsize, "observations"), OBSERVATION)
        check_observations(observations, reader.broken, f"image {number}")
        parts.image(number, ColmapImage(name, camera_id, cam_from_map, count, load), reader.broken)


def _name(reader: _Reader, number: int) -> str:
    name = bytearray()
    while (letter := reader.bytes(1, f"the name of image {number}")) != b"\0":
        name += letter
        if len(name) > _MAX_NAME_BYTES:
            raise reader.broken(f"the name of image {number} does not end")
    try:
        return name.decode()
    except UnicodeDecodeError:
        raise reader.broken(f"the name of image {number} is not text in UTF-8") from None


def _load(path: Path, offset: int, count: int) -> NDArray[Any]:
    """Observations of one image, read when they are asked for: those of thousands of images would fill the memory."""
    with reading(path, "load the scene again"), open_file(path) as file:
        observations = np.fromfile(file, OBSERVATION, count, offset=offset)
    if len(observations) != count:
        raise InputError(f"{path}: has changed since it was loaded; load the scene again.")
    return observations


def _binary_points(reader: _Reader, parts: ModelParts) -> None:
    records, tracks = bytearray(), bytearray()
    for _ in range(reader.count("<Q", _POINT.itemsize, "points")):
        records += reader.bytes(_POINT.itemsize - 8, "a point")
        length = reader.count("<Q", _TRACK.itemsize, "keypoints of a point")
        records += length.to_bytes(8, "little")
        tracks += reader.bytes(length * _TRACK.itemsize, "the keypoints of a point")
        if len(tracks) > _TRACK_BYTES:
            _check_tracks(reader, parts, tracks)
            tracks = bytearray()
    _check_tracks(reader, parts, tracks)
    table = np.frombuffer(bytes(records), _POINT)
    possible = (np.abs(table["xyz"]) <= LARGEST).all(axis=1) & (table["id"] >= 0)
    if not possible.all():
        raise reader.broken(
            f"record {int(np.flatnonzero(~possible)[0]) + 1} of the points has no possible position or id"
        )
    parts.points = make_points(table["id"], table["xyz"], table["error"], table["track"])
    twice = np.flatnonzero(parts.points.ids[1:] == parts.points.ids[:-1])
    if len(twice):
        raise reader.broken(f"point {parts.points.ids[twice[0]]} is there twice")


def _check_tracks(reader: _Reader, parts: ModelParts, content: bytearray) -> None:
    track = np.frombuffer(bytes(content), _TRACK)
    parts.tracks(track["image"].astype(np.int64), track["place"].astype(np.int64), reader.broken)


_MAX_LINE = 64_000_000
"""Largest number of characters of a line: the observations of a million keypoints."""
_PARAMETERS = dict(MODELS)


class _Line:
    """A line and its place."""

    def __init__(self, path: Path, number: int, text: str) -> None:
        self.path, self.number, self.text = path, number, text

    def broken(self, what: str) -> InputError:
        return InputError(f"{self.path}, line {self.number}: {what}; correct it, or export the model again.")

    def words(self, least: int, form: str) -> list[str]:
        """The words of the line, at least ``least``; ``form`` says what the line should hold."""
        words = self.text.split()
        if len(words) < least:
            raise self.broken(f"{len(words)} values instead of {form}")
        return words

    def numbers(self, words: list[str]) -> list[float]:
        """The words as finite numbers."""
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = [np.nan]
        if not np.isfinite(values).all() or any("_" in word for word in words):
            wrong = next((word for word in words if not _is_number(word)), "")
            raise self._no_number(wrong, "a finite number")
        return values

    def whole(self, word: str) -> int:
        """A word as a whole number that is not negative."""
        if not (word.isascii() and word.isdecimal() and len(word) < 20 and int(word) < 2**63):
            raise self._no_number(word, "a whole number from 0")
        return int(word)

    def _no_number(self, word: str, wanted: str) -> InputError:
        if "," in word:
            return InputError(
                f"{self.path}, line {self.number}: has commas between its values, where COLMAP has spaces only; "
                "replace ', ' by ' ', or load a kapture folder by kind = \"kapture\"."
            )
        return self.broken(f"{show(word)} is not {wanted}")


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word))) and "_" not in word
    except ValueError:
        return False


def _read_text(folder: Path) -> ModelParts:
    """Check ``cameras.txt``, ``images.txt``, ``points3D.txt`` and, where they are, ``rigs.txt`` and ``frames.txt``.

    Raises ``InputError`` with the file and the line of what is wrong.
    """
    parts = ModelParts()
    steps = {
        "cameras": _text_cameras,
        "rigs": _text_rigs,
        "frames": _text_frames,
        "images": _text_images,
        "points3D": _text_points,
    }
    for name, step in steps.items():
        path = folder / f"{name}.txt"
        if name in ("rigs", "frames") and not is_file(path):
            continue
        try:
            with reading(path, "check the file"):
                step(_lines(path), parts)
        except UnicodeDecodeError:
            raise InputError(f"{path}: is not text in UTF-8; export the model again.") from None
    return parts


def _lines(path: Path) -> Iterator[_Line]:
    with io.TextIOWrapper(open_file(path), encoding="utf-8-sig", newline="\n") as file:
        for number, text in enumerate(iter(lambda: file.readline(_MAX_LINE), ""), start=1):
            line = _Line(path, number, text.strip())
            if len(text) == _MAX_LINE:
                raise line.broken(f"is longer than {_MAX_LINE:,} characters")
            yield line


def _records(lines: Iterator[_Line]) -> Iterator[_Line]:
    return (line for line in lines if line.text and not line.text.startswith("#"))


def _text_cameras(lines: Iterator[_Line], parts: ModelParts) -> None:
    for line in _records(lines):
        number, model, width, height, *params = line.words(4, "CAMERA_ID, MODEL, WIDTH, HEIGHT and parameters")
        if model in ("SPHERE", "SPHERICAL"):
            raise InputError(f"{line.path}, line {line.number}: {SPHERE}")
        if model not in _PARAMETERS:
            raise line.broken(f"the camera model {show(model)} is unknown")
        numbers = line.numbers(params)
        if len(numbers) != _PARAMETERS[model]:
            raise line.broken(f"{len(numbers)} parameters instead of the {_PARAMETERS[model]} of {model}")
        camera = model, line.whole(width), line.whole(height), tuple(numbers)
        parts.camera(line.whole(number), camera, line.broken)


def _text_rigs(lines: Iterator[_Line], parts: ModelParts) -> None:
    for line in _records(lines):
        number, count, *words = line.words(2, "RIG_ID, NUM_SENSORS and the sensors")
        words[2:2] = ["0"] if len(words) >= 2 else []  # the reference has no pose in the file
        cameras: list[tuple[int, FloatArray | None]] = []
        for place in range(line.whole(count)):
            sensor_from_rig = np.eye(3, 4) if place == 0 else None
            size = 10 if words[2:3] == ["1"] else 3
            if len(words) < size:
                raise line.broken("its sensors are incomplete")
            if size == 10:
                sensor_from_rig = read_pose(line.numbers(words[3:10]), line.broken, f"a sensor of rig {number}")
            if words[0] == "CAMERA":
                cameras.append((line.whole(words[1]), sensor_from_rig))
            words = words[size:]
        if words:
            raise line.broken(f"{len(words)} values follow its {count} sensors")
        parts.rig(line.whole(number), cameras, line.broken)


def _text_frames(lines: Iterator[_Line], parts: ModelParts) -> None:
    for line in _records(lines):
        number, rig, *rest = line.words(10, "FRAME_ID, RIG_ID, a pose, NUM_DATA_IDS and the images")
        rig_from_map = read_pose(line.numbers(rest[:7]), line.broken, f"frame {number}")
        data = rest[8:]
        if len(data) != 3 * line.whole(rest[7]):
            raise line.broken(f"{len(data)} values instead of three for each of {rest[7]} images")
        triples = zip(data[0::3], data[1::3], data[2::3], strict=True)
        images = [(line.whole(sensor), line.whole(image)) for kind, sensor, image in triples if kind == "CAMERA"]
        parts.frame(line.whole(number), line.whole(rig), rig_from_map, images, line.broken)


def _text_images(lines: Iterator[_Line], parts: ModelParts) -> None:
    for line in _records(lines):
        words = line.words(10, "IMAGE_ID, a pose, CAMERA_ID and NAME")
        number, *numbers, camera_id, name = words[:10]
        cam_from_map = read_pose(line.numbers(numbers), line.broken, f"image {number}")
        if len(words) > 10:
            raise line.broken("the image's name has a space, which only COLMAP's binary form can hold")
        second = next(lines, None)
        if second is None:
            raise line.broken("the line with the observations after it is missing")
        observations = _observations(second)
        check_observations(observations, second.broken, f"image {number}")
        image = ColmapImage(name, line.whole(camera_id), cam_from_map, len(observations), partial(_same, observations))
        parts.image(line.whole(number), image, line.broken)


def _same(observations: NDArray[Any]) -> NDArray[Any]:
    return observations


def _observations(line: _Line) -> NDArray[Any]:
    words = line.text.split()
    if len(words) % 3:
        raise line.broken(f"{len(words)} values instead of X, Y, POINT3D_ID for every observation")
    table = np.empty(len(words) // 3, OBSERVATION)
    table["pixel"] = np.array(line.numbers([*words[0::3], *words[1::3]])).reshape(2, -1).T
    table["point"] = [-1 if word == "-1" else line.whole(word) for word in words[2::3]]
    return table


def _text_points(lines: Iterator[_Line], parts: ModelParts) -> None:
    ids: dict[int, None] = {}  # in their order
    columns = []
    for line in _records(lines):
        number, *rest = line.words(8, "POINT3D_ID, X, Y, Z, R, G, B, ERROR and the track")
        if len(rest) % 2 == 0:
            raise line.broken("the track is not a list of pairs IMAGE_ID, POINT2D_IDX")
        if line.whole(number) in ids:
            raise line.broken(f"point {number} is there twice")
        ids[line.whole(number)] = None
        track = np.array([line.whole(word) for word in rest[7:]], dtype=np.int64).reshape(-1, 2)
        parts.tracks(track[:, 0], track[:, 1], line.broken)
        for word in rest[3:6]:
            line.whole(word)
        *xyz, error_px = line.numbers([*rest[:3], rest[6]])
        if max(map(abs, xyz)) > LARGEST:
            raise line.broken(f"the position {show(xyz)} is impossible")
        columns.append((*xyz, error_px, len(track)))
    table = np.array(columns, dtype=np.float64).reshape(-1, 5)
    parts.points = make_points(list(ids), table[:, :3], table[:, 3], table[:, 4])
