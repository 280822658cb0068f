"""Walks the files of a COLMAP model in text form before anything else reads them; see ``colmap_parts``."""

import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.errors import InputError, show
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

_MAX_LINE = 64_000_000
"""Characters of a line: the observations of a million keypoints."""
_PARAMETERS = dict(MODELS)


class _Line:
    """A line and its place."""

    def __init__(self, path: Path, number: int, text: str) -> None:
        self.path, self.number, self.text = path, number, text

    def broken(self, what: str) -> InputError:
        return InputError(f"{self.path}, line {self.number}: {what}; correct it, or export the model again.")

    def words(self, least: int, form: str) -> list[str]:
        """At least so many words; ``form`` says what belongs there."""
        words = self.text.split()
        if len(words) < least:
            raise self.broken(f"{len(words)} values instead of {form}")
        return words

    def numbers(self, words: list[str]) -> list[float]:
        """Finite numbers."""
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = [np.nan]
        if not np.isfinite(values).all() or any("_" in word for word in words):
            wrong = next((word for word in words if not _is_number(word)), "")
            raise self._no_number(wrong, "a finite number")
        return values

    def whole(self, word: str) -> int:
        """A whole number that is not negative."""
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


def check_text(folder: Path) -> ModelParts:
    """Check ``cameras.txt``, ``images.txt``, ``points3D.txt`` and, where they are, ``rigs.txt`` and ``frames.txt``.

    Raises ``InputError`` with the file and the line of what is wrong.
    """
    walked = ModelParts()
    for name, step in zip(ORDER, (_cameras, _rigs, _frames, _images, _points), strict=True):
        path = folder / f"{name}.txt"
        if name in ("rigs", "frames") and not is_file(path):
            continue
        try:
            with reading(path, "check the file"):
                step(_lines(path), walked)
        except UnicodeDecodeError:
            raise InputError(f"{path}: is no text in UTF-8; export the model again.") from None
    return walked


def _lines(path: Path) -> Iterator[_Line]:
    with io.TextIOWrapper(open_file(path), encoding="utf-8", newline="\n") as file:
        for number, text in enumerate(iter(lambda: file.readline(_MAX_LINE), ""), start=1):
            line = _Line(path, number, text.strip())
            if len(text) == _MAX_LINE:
                raise line.broken(f"is longer than {_MAX_LINE:,} characters")
            yield line


def _records(lines: Iterator[_Line]) -> Iterator[_Line]:
    return (line for line in lines if line.text and not line.text.startswith("#"))


def _cameras(lines: Iterator[_Line], walked: ModelParts) -> None:
    for line in _records(lines):
        number, model, width, height, *params = line.words(4, "CAMERA_ID, MODEL, WIDTH, HEIGHT and parameters")
        for word in (width, height):
            line.whole(word)
        if model in ("SPHERE", "SPHERICAL"):
            raise InputError(f"{line.path}, line {line.number}: {SPHERE}")
        if model not in _PARAMETERS:
            raise line.broken(f"the camera model {show(model)} is unknown")
        numbers = line.numbers(params)
        if len(numbers) != _PARAMETERS[model]:
            raise line.broken(f"{len(numbers)} parameters instead of the {_PARAMETERS[model]} of {model}")
        walked.camera(line.whole(number), numbers, line.broken)


def _rigs(lines: Iterator[_Line], walked: ModelParts) -> None:
    for line in _records(lines):
        number, count, *words = line.words(2, "RIG_ID, NUM_SENSORS and the sensors")
        words[2:2] = ["0"] if len(words) >= 2 else []  # the reference has no pose, as others may have none
        cameras = []
        for _ in range(line.whole(count)):
            size = 10 if words[2:3] == ["1"] else 3
            if len(words) < size:
                raise line.broken("its sensors are incomplete")
            if words[0] == "CAMERA":
                cameras.append(line.whole(words[1]))
            if size == 10:
                check_pose(line.numbers(words[3:10]), line.broken, f"a sensor of rig {number}")
            words = words[size:]
        if words:
            raise line.broken(f"{len(words)} values follow its {count} sensors")
        walked.rig(line.whole(number), cameras, line.broken)


def _frames(lines: Iterator[_Line], walked: ModelParts) -> None:
    for line in _records(lines):
        number, rig, *rest = line.words(10, "FRAME_ID, RIG_ID, a pose, NUM_DATA_IDS and the images")
        check_pose(line.numbers(rest[:7]), line.broken, f"frame {number}")
        data = rest[8:]
        if len(data) != 3 * line.whole(rest[7]):
            raise line.broken(f"{len(data)} values instead of three for each of {rest[7]} images")
        triples = zip(data[0::3], data[1::3], data[2::3], strict=True)
        images = [(line.whole(sensor), line.whole(image)) for kind, sensor, image in triples if kind == "CAMERA"]
        walked.frame(line.whole(number), line.whole(rig), images, line.broken)


def _images(lines: Iterator[_Line], walked: ModelParts) -> None:
    for line in _records(lines):
        words = line.words(10, "IMAGE_ID, a pose, CAMERA_ID and NAME")
        number, *pose, camera_id, name = words[:10]
        check_pose(line.numbers(pose), line.broken, f"image {number}")
        if len(words) > 10:
            raise line.broken("the image's name has a space, which only COLMAP's binary form can hold")
        second = next(lines, None)
        if second is None:
            raise line.broken("the line with the observations after it is missing")
        observations = _observations(second)
        check_observations(observations, second.broken, f"image {number}")
        image = Observed(name, line.whole(camera_id), len(observations), partial(_same, observations))
        walked.image(line.whole(number), image, line.broken)


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


def _points(lines: Iterator[_Line], walked: ModelParts) -> None:
    ids, columns = [], []
    for line in _records(lines):
        number, *rest = line.words(8, "POINT3D_ID, X, Y, Z, R, G, B, ERROR and the track")
        if len(rest) % 2 == 0:
            raise line.broken("the track is no list of pairs IMAGE_ID, POINT2D_IDX")
        ids.append(line.whole(number))
        track = np.array([line.whole(word) for word in rest[7:]], dtype=np.int64).reshape(-1, 2)
        walked.tracks(track[:, 0], track[:, 1], line.broken)
        for word in rest[3:6]:
            line.whole(word)
        *xyz, error_px = line.numbers([*rest[:3], rest[6]])
        if max(map(abs, xyz)) > LARGEST:
            raise line.broken(f"the position {show(xyz)} is impossible")
        columns.append((*xyz, error_px, len(track)))
    table = np.array(columns, dtype=np.float64).reshape(-1, 5)
    walked.points = make_points(ids, table[:, :3], table[:, 3], table[:, 4])
