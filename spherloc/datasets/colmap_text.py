"""Walks the files of a COLMAP model in text form before anything else reads them; see ``colmap_check``."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spherloc.datasets.colmap_check import (
    MODELS,
    OBSERVATION,
    SPHERE,
    Observed,
    Walked,
    add_image,
    check_observations,
    check_pose,
    make_points,
)
from spherloc.errors import InputError, show

_MAX_LINE = 64_000_000
"""Characters of a line: the observations of a million keypoints."""
_MAX_WORD = 64
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
            raise self.broken(f"{show(wrong)} is not a finite number{self._hint(wrong)}")
        return values

    def whole(self, word: str) -> int:
        """A whole number that is not negative."""
        if not (word.isascii() and word.isdecimal() and len(word) < 20 and int(word) < 2**63):
            raise self.broken(f"{show(word)} is not a whole number from 0{self._hint(word)}")
        return int(word)

    @staticmethod
    def _hint(word: str) -> str:
        return " (COLMAP puts spaces between values, but no commas: replace ', ' by ' ')" if "," in word else ""


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word))) and "_" not in word
    except ValueError:
        return False


def walk_text(folder: Path) -> Walked:
    """Check ``cameras.txt``, ``images.txt``, ``points3D.txt`` and, where they are, ``rigs.txt`` and ``frames.txt``.

    Raises ``InputError`` with the file and the line of what is wrong.
    """
    walked = Walked()
    steps = {"cameras": _cameras, "rigs": _rigs, "frames": _frames, "images": _images, "points3D": _points}
    for name, step in steps.items():
        path = folder / f"{name}.txt"
        if name in ("rigs", "frames") and not path.is_file():
            continue
        try:
            step(_lines(path), walked)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check the file.") from None
        except UnicodeDecodeError:
            raise InputError(f"{path}: is no text in UTF-8; export the model again.") from None
    return walked


def _lines(path: Path) -> Iterator[_Line]:
    with path.open(encoding="utf-8", newline="\n") as file:
        for number, text in enumerate(iter(lambda: file.readline(_MAX_LINE), ""), start=1):
            line = _Line(path, number, text.strip())
            if len(text) == _MAX_LINE:
                raise line.broken(f"is longer than {_MAX_LINE:,} characters")
            yield line


def _records(lines: Iterator[_Line]) -> Iterator[_Line]:
    return (line for line in lines if line.text and not line.text.startswith("#"))


def _cameras(lines: Iterator[_Line], walked: Walked) -> None:
    for line in _records(lines):
        number, model, width, height, *params = line.words(4, "CAMERA_ID, MODEL, WIDTH, HEIGHT and parameters")
        for word in (number, width, height):
            line.whole(word)
        if model in ("SPHERE", "SPHERICAL"):
            raise InputError(f"{line.path}, line {line.number}: {SPHERE}")
        if model not in _PARAMETERS:
            raise line.broken(f"the camera model {show(model)} is unknown")
        if len(line.numbers(params)) != _PARAMETERS[model]:
            raise line.broken(f"{len(params)} parameters instead of the {_PARAMETERS[model]} of {model}")


def _rigs(lines: Iterator[_Line], walked: Walked) -> None:
    for line in _records(lines):
        number, sensors, *words = line.words(2, "RIG_ID, NUM_SENSORS and the sensors")
        line.whole(number)
        words = words[2:]
        for _ in range(line.whole(sensors) - 1):
            size = 10 if len(words) > 2 and words[2] == "1" else 3
            if len(words) < size:
                raise line.broken("the sensors are incomplete")
            line.whole(words[1])
            if size == 10:
                check_pose(line.numbers(words[3:10]), line.broken, f"rig {number}")
            words = words[size:]
        if words:
            raise line.broken(f"{len(words)} values follow the {sensors} sensors")


def _frames(lines: Iterator[_Line], walked: Walked) -> None:
    for line in _records(lines):
        number, rig, *rest = line.words(10, "FRAME_ID, RIG_ID, a pose, NUM_DATA_IDS and the images")
        for word in (number, rig):
            line.whole(word)
        check_pose(line.numbers(rest[:7]), line.broken, f"frame {number}")
        if len(rest) - 8 != 3 * line.whole(rest[7]):
            raise line.broken(f"{len(rest) - 8} values instead of three for each of {rest[7]} images")


def _images(lines: Iterator[_Line], walked: Walked) -> None:
    for line in _records(lines):
        *head, name = [*line.text.split(maxsplit=9), ""][:10]
        if not name:
            raise line.broken("too few values instead of IMAGE_ID, a pose, CAMERA_ID and NAME")
        number, camera_id = line.whole(head[0]), line.whole(head[8])
        check_pose(line.numbers(head[1:8]), line.broken, f"image {number}")
        second = next(lines, None)
        if second is None:
            raise line.broken("the line with the observations after it is missing")
        observations = _observations(second)
        check_observations(observations, second.broken, f"image {number}")
        image = Observed(name, camera_id, len(observations), partial(_same, observations))
        add_image(walked, number, image, line.broken)


def _same(observations: NDArray) -> NDArray:
    return observations


def _observations(line: _Line) -> NDArray:
    words = line.text.split()
    if len(words) % 3:
        raise line.broken(f"{len(words)} values instead of X, Y, POINT3D_ID for every observation")
    table = np.empty(len(words) // 3, OBSERVATION)
    table["pixel"] = np.array(line.numbers([*words[0::3], *words[1::3]])).reshape(2, -1).T
    table["point"] = [-1 if word == "-1" else line.whole(word) for word in words[2::3]]
    return table


def _points(lines: Iterator[_Line], walked: Walked) -> None:
    ids, columns = [], []
    for line in _records(lines):
        number, *rest = line.words(8, "POINT3D_ID, X, Y, Z, R, G, B, ERROR and the track")
        if len(rest) % 2 == 0:
            raise line.broken("the track is no list of pairs IMAGE_ID, POINT2D_IDX")
        ids.append(line.whole(number))
        for word in (*rest[3:6], *rest[7:]):
            line.whole(word)
        columns.append((*line.numbers(rest[:3]), float(line.numbers(rest[6:7])[0]), (len(rest) - 7) // 2))
    table = np.array(columns, dtype=np.float64).reshape(-1, 5)
    walked.points = make_points(ids, table[:, :3], table[:, 3], table[:, 4])
