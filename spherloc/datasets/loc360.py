"""360Loc: panoramas, fisheye and pinhole images of four halls, localized among posed panoramas (Huang et al. 2024).

Points of the map are triangulated between its panoramas, which come without depth. Fisheye and pinhole images are
cut from panoramas by the dataset's own process.py. A sequence is a folder with ``camera_pose.json``, matrices [R | T]
from the camera to the world by the name of the image, and a folder ``image``.

https://github.com/HuajianUP/360Loc
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import map_scene, scene_file
from spherloc.datasets.colmap import gravity_of_map, some, split_gravity
from spherloc.datasets.image_folder import read_pose
from spherloc.datasets.loc360_layout import IMAGES, MAPPING, POSES
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError, show
from spherloc.files import is_file, is_folder, names_in, read_file, reading
from spherloc.frontend.partners import with_triangulation
from spherloc.frontend.pipeline import frontend_options
from spherloc.frontend.view import View
from spherloc.images import read_size
from spherloc.types import FloatArray

EXAMPLE = """\
kind = "360loc"
name = "360Loc, atrium by day"
root = "360Loc/atrium"                            # one of the four halls
queries = ["query_fisheye1/daytime_fisheye1_0"]   # folders below root, or those that hold them: "query_360"
# mapping = ["mapping"]                           # likewise, of the map's panoramas
# query_step = 5                                  # every n-th image; likewise reference_step

[gravity]                                         # optional
map = [0.0, 0.0, -1.0]                            # down; else the mean +y axis of the panoramas of the map
# query = "lines"                                 # down in a query from the vertical lines of its image
bound_deg = 5.0                                   # how far a query's roll and pitch may be from its reference's
"""

THRESHOLDS = ((2.0, 0.25), (5.0, 0.5), (10.0, 5.0))
"""The dataset's own limits (degrees, metres)."""
GRAVITY_BOUND_DEG = 5.0
_MAX_BYTES = 1 << 26
_MAX_STEPS = 100_000


def load(table: dict[str, Any], path: Path) -> MapScene:
    """Read a scene of ``kind = "360loc"``; paths in it are relative to its file.

    Raises ``InputError`` for a wrong key, a missing or damaged file, and a matrix that is not a pose. Missing images
    are skipped, and the scene's remarks say how many.
    """
    where = str(path)
    choices = {"mapping", "query_step", "reference_step"}
    scene_file.check_keys(table, map_scene.REQUIRED | {"root", "queries"}, map_scene.OPTIONAL | choices, where)
    shared_gravity, gravity = split_gravity(table, where)
    scene_file.check_keys(gravity, set(), {"map"}, f"{where} [gravity]")
    settings = map_scene.read_settings(table | {"gravity": shared_gravity}, where, GRAVITY_BOUND_DEG, THRESHOLDS)
    root = map_scene.folder(table, "root", path)
    queries, skipped = _views(root, {"mapping": [MAPPING]} | table, "queries", "query_step", where)
    mapped, missing = _views(root, {"mapping": [MAPPING]} | table, "mapping", "reference_step", where)
    references = with_triangulation(mapped, frontend_options(settings.frontend, where, path.parent))
    down, assumed = gravity_of_map(gravity, references, where)
    return settings.scene(path, queries, references, down, (*skipped, *missing, *assumed), assumed_down=bool(assumed))


@dataclass(frozen=True)
class _Sequence:
    """A folder with poses and images."""

    folder: Path
    name: str
    """Its path below the root, with forward slashes."""


def _views(root: Path, table: Mapping[str, Any], key: str, step_key: str, where: str) -> tuple[list[View], list[str]]:
    """Views of the sequences that a key names, and a remark on images that are not there."""
    named = [table[key]] if isinstance(table[key], str) else table[key]
    if not isinstance(named, list) or not named or not all(isinstance(one, str) and one for one in named):
        raise InputError(f"{where}: {key} is {show(table[key])}; give folders below root.")
    step = scene_file.integer({step_key: 1} | dict(table), step_key, where, 1, _MAX_STEPS)
    sequences = list(dict.fromkeys(one for name in named for one in _sequences(root, name, key, where)))
    views, missing = [], []
    for sequence in sequences:
        poses = sorted(_poses(sequence.folder / POSES).items())[::step]
        there = [(name, pose) for name, pose in poses if is_file(sequence.folder / IMAGES / name)]
        missing += [f"{sequence.name}/{name}" for name, _ in poses if not is_file(sequence.folder / IMAGES / name)]
        if there:
            camera = _camera(root, sequence, sequence.folder / IMAGES / there[0][0])
            views += [
                View(f"{sequence.name}/{name}", camera, sequence.folder / IMAGES / name, pose) for name, pose in there
            ]
    advice = "; run the dataset's process.py, which cuts them from panoramas" if key == "queries" else ""
    return views, [f"{some(missing, 'image')} of {key} not found in {root}: left out{advice}."] if missing else []


def _sequences(root: Path, name: str, key: str, where: str) -> Iterator[_Sequence]:
    """The folders with poses that a name means: its own one, or those in it."""
    folder = root / name
    if not is_folder(folder):
        raise InputError(f"{where}: {key} names the folder {folder}, which does not exist; correct the path.")
    inside = [name, *(f"{name}/{one}" for one in names_in(folder))]
    found = [one for one in inside if is_file(root / one / POSES)]
    if not found:
        raise InputError(f"{where}: neither {folder} nor a folder in it has {POSES}; name a folder of 360Loc that has.")
    yield from (_Sequence(root / one, one) for one in found)


def _poses(path: Path) -> dict[str, FloatArray]:
    """``cam_from_map`` (3, 4) by the names of the images."""
    with reading(path, "correct the path of the dataset"):
        content = read_file(path, _MAX_BYTES)
    try:
        table = json.loads(content)
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is not valid JSON; download it again.") from None
    if not isinstance(table, dict) or not table:
        raise InputError(f"{path}: holds no table of poses by image; download it again.")
    poses = {}
    for name, rows in table.items():
        if "/" in name or "\\" in name or "\0" in name or name in ("", ".", ".."):
            raise InputError(f"{path}: {show(name)} is not the name of an image; correct it.")
        map_from_cam = read_pose(rows, show(name), str(path))
        turn = map_from_cam[:, :3].T
        poses[name] = np.column_stack([turn, -turn @ map_from_cam[:, 3]])
    return poses


def _camera(root: Path, sequence: _Sequence, image: Path) -> Camera:
    """A panorama of the image's size, or what the dataset's file says of the camera in the sequence's name."""
    model = sequence.name.split("/")[0].rpartition("_")[2]
    file = root / "camera_config" / f"{model}.yaml"
    if model not in ("360", "mapping") and is_file(file):
        return load_camera(file)
    width, height = read_size(image)
    if width != 2 * height:
        raise InputError(
            f"{image}: is {width} x {height} pixels, so it is not a full panorama, and there is no {file}; check that "
            "'root' is a hall of 360Loc."
        )
    return Equirectangular(width, height)
