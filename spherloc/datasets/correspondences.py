"""Measured problems: a CSV of 2D-3D matches beside a TOML with camera, gravity and, where known, the truth."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import camera_from_table
from spherloc.cameras.principal_point import about_principal_point
from spherloc.datasets import scene_file
from spherloc.errors import InputError, ProblemError, reason, show
from spherloc.files import is_file, read_file, reading
from spherloc.problem import Problem

EXAMPLE = """\
kind = "correspondences"
name = "my query"
correspondences = "matches.csv"   # beside this file; columns u, v (px), X, Y, Z (m), optional inlier (0 or 1)
image = "query.png"               # optional

[camera]
model = "kannala_brandt"
width = 1408
height = 1408
fx = 611.85
fy = 611.85
cx = 715.72
cy = 716.48
distortion = [0.394, -0.549, 0.779, -0.455]

[gravity]                         # unit vectors pointing down
camera = [0.0, 1.0, 0.0]
map = [0.0, 0.0, -1.0]
bound_deg = 1.5                   # optional: how far the camera's may be off; 0 if neither is given
sd_deg = 0.5                      # optional: standard deviation of its roll and of its pitch; a third of the bound

[truth]                           # optional
cam_from_map = [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]]

[options]                         # optional
bound_px = 4
"""

COLUMNS = ("u", "v", "X", "Y", "Z")
MAX_CSV_BYTES = 200_000_000
LARGEST = 1e9
"""Largest absolute value of any number, px or m: larger ones overflow in squares and products."""


@dataclass(frozen=True, eq=False)
class CorrespondencesScene:
    """A measured problem, read and checked."""

    measured: Problem
    """The problem as it stands in the files."""

    @property
    def name(self) -> str:
        """The scene's name."""
        return self.measured.name

    @property
    def camera(self) -> Camera:
        """The query camera."""
        return self.measured.camera

    def problem(self, seed: int | None = None) -> Problem:
        """The problem; measurements have nothing random, so ``seed`` changes nothing."""
        return self.measured


def load(table: dict[str, Any], path: Path) -> CorrespondencesScene:
    """Read a scene of ``kind = "correspondences"``.

    Paths in it are relative to its file. Raises ``InputError`` for a missing file, a wrong key or value, or a bad row.
    """
    where = str(path)
    required = {"kind", "name", "correspondences", "camera", "gravity"}
    scene_file.check_keys(table, required, {"image", "truth", "options", "about"}, where)
    gravity = scene_file.section(table, "gravity", where)
    scene_file.check_keys(gravity, {"camera", "map"}, {"bound_deg", "sd_deg"}, f"{where} [gravity]")
    gravity_bound_rad, gravity_sd_rad = scene_file.gravity_error_rad(gravity, f"{where} [gravity]")
    truth = scene_file.section(table, "truth", where)
    scene_file.check_keys(truth, {"cam_from_map"} if truth else set(), set(), f"{where} [truth]")
    rows, inliers = read_csv(path.parent / scene_file.text(table, "correspondences", where))
    name = scene_file.text(table, "name", where)
    camera = camera_from_table(scene_file.section(table, "camera", where), where)
    doubt = about_principal_point("the camera", camera)
    try:
        problem = Problem(
            name=name,
            camera=camera,
            pixels=rows[:, :2],
            points=rows[:, 2:],
            gravity_camera=scene_file.numbers(gravity["camera"], (3,), "camera", f"{where} [gravity]"),
            gravity_map=scene_file.numbers(gravity["map"], (3,), "map", f"{where} [gravity]"),
            gravity_bound_rad=gravity_bound_rad,
            gravity_sd_rad=gravity_sd_rad,
            bound_px=scene_file.bound_px(table, where),
            truth_cam_from_map=scene_file.numbers(truth["cam_from_map"], (3, 4), "cam_from_map", f"{where} [truth]")
            if truth
            else None,
            truth_inliers=inliers,
            image=_image(table, path),
            scene=where,
            remarks=(doubt,) if doubt else (),
        )
    except ProblemError as error:
        raise InputError(f"{where}: {error}") from None
    return CorrespondencesScene(problem)


def _image(table: dict[str, Any], path: Path) -> Path | None:
    if "image" not in table:
        return None
    image = path.parent / scene_file.text(table, "image", str(path))
    if not is_file(image):
        raise InputError(f"{path}: the image {image} does not exist; correct the path or remove the key 'image'.")
    return image


def read_csv(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Rows u, v, X, Y, Z as (N, 5), and the ``inlier`` column as a mask (N,), or None without that column.

    Other columns are ignored. Raises ``InputError`` with the file and line of what is wrong.
    """
    with reading(path, "correct the key 'correspondences'"):
        content = read_file(path, MAX_CSV_BYTES)
    rows, inliers, _ = _table(content, path, COLUMNS)
    return rows, inliers


def read_csv_of_queries(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Rows and mask, as ``read_csv`` tells them, of each query by its name, the column ``name``."""
    with reading(path, "give a CSV of matches"):
        content = read_file(path, MAX_CSV_BYTES)
    rows, inliers, names = _table(content, path, ("name", *COLUMNS))
    unique, first, index = np.unique(np.array(names, dtype=object), return_index=True, return_inverse=True)
    masks = [index == number for number in np.argsort(first)]
    return {
        str(unique[number]): (rows[mask], None if inliers is None else inliers[mask])
        for number, mask in zip(np.argsort(first), masks, strict=True)
    }


def _table(content: bytes, path: Path, required: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """Rows (N, 5), mask (N,) or None, and names (N,), which are empty if no column ``name`` is required."""
    try:
        return _parse(
            csv.reader(io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig", newline="")), path, required
        )
    except (csv.Error, ValueError) as error:
        raise InputError(f"{path}: not a CSV text file in UTF-8 ({reason(error)}); correct or replace it.") from None


def _parse(reader: Any, path: Path, required: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    header = [name.strip() for name in next(reader, [])]
    for name in (*required, "inlier"):
        if header.count(name) > 1 or (name in required and name not in header):
            what = "missing" if name not in header else "given twice"
            raise InputError(f"{path}: column '{name}' is {what}; the first line must name {', '.join(required)}.")
    wanted = [header.index(name) for name in COLUMNS]
    name_at = header.index("name") if "name" in required else None
    label_at = header.index("inlier") if "inlier" in header else None
    rows, labels, names = [], [], list[str]()
    for line in reader:
        if not line:
            continue
        place = f"{path}, line {reader.line_num}"
        if len(line) != len(header):
            raise InputError(f"{place}: {len(line)} values under {len(header)} columns; correct the line.")
        rows.append([_number(line[at], header[at], place) for at in wanted])
        if label_at is not None:
            labels.append(_label(line[label_at], place))
        if name_at is not None:
            names.append(line[name_at].strip())
    array = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return array, np.array(labels, dtype=bool) if label_at is not None else None, names


def _number(value: str, column: str, place: str) -> float:
    try:
        number = float(value)
    except ValueError:
        raise InputError(f"{place}: {column} is {show(value)}, not a number; correct or remove it.") from None
    if not np.isfinite(number):
        raise InputError(f"{place}: {column} is {number}, not a finite number; correct or remove the line.")
    if abs(number) > LARGEST:
        raise InputError(f"{place}: {column} is {number:g}, beyond {LARGEST:.0e}; correct or remove the line.")
    return number


def _label(value: str, place: str) -> bool:
    if value.strip() not in ("0", "1"):
        raise InputError(f"{place}: inlier is {show(value)}; give 0 or 1.")
    return value.strip() == "1"
