"""A COLMAP model: cameras, posed images and points, from its binary or its text form, old or with rigs and frames."""

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import MOST_REASON, CalibrationError, InputError, reason, shorten, show
from spherloc.files import is_file, is_folder
from spherloc.formats.colmap_check import check_binary
from spherloc.formats.colmap_parts import ModelParts, Points
from spherloc.formats.colmap_text import check_text
from spherloc.registry import require
from spherloc.types import FloatArray

_FILES = ("cameras", "images", "points3D")
_PATIENCE_S = 120.0
_BYTES_PER_S = 1_000_000
"""Far slower than any disk: what takes longer is stuck."""


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A posed image. Its observations are read when they are asked for."""

    name: str
    camera_id: int
    cam_from_map: FloatArray
    """Pose (3, 4), absolute, also for an image of a rig."""
    load: Callable[[], NDArray[Any]]
    """Its observations, records of ``colmap_parts.OBSERVATION``."""

    @property
    def pixels(self) -> FloatArray:
        """(K, 2) all keypoints, with or without a point, in COLMAP's order. Raises ``InputError`` if unreadable."""
        return np.ascontiguousarray(self.load()["pixel"])

    @property
    def point_ids(self) -> NDArray[np.int64]:
        """(K,) the id of each keypoint's point, -1 for none. Raises ``InputError`` if unreadable."""
        return np.ascontiguousarray(self.load()["point"])

    def observed(self, model: "ColmapModel") -> tuple[FloatArray, FloatArray]:
        """Keypoints with a point: pixels (M, 2) and their points (M, 3). Raises ``InputError`` if unreadable."""
        observations = self.load()
        points = model.point_xyz(observations["point"])
        known = np.isfinite(points[:, 0])
        return observations["pixel"][known], points[known]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model, in columns."""

    folder: Path
    images: Mapping[str, ColmapImage]
    """Images with a pose, by name, in the order of names."""
    points: Points
    """All points, by rising id."""
    raw_cameras: Mapping[int, tuple[str, int, int, tuple[float, ...]]]
    """COLMAP's model, width, height and parameters, by camera id."""
    remarks: tuple[str, ...] = ()
    """What was left out and why, in sentences."""

    @cached_property
    def _cameras(self) -> dict[int, Camera | str]:
        return {}

    def camera(self, camera_id: int) -> Camera:
        """The camera of an id, converted when it is first asked for: one that is not supported harms no other.

        Raises ``CalibrationError``.
        """
        if camera_id not in self._cameras:
            name, width, height, params = self.raw_cameras[camera_id]
            where = f"{self.folder}, camera {camera_id}"
            self._cameras[camera_id] = _converted(name, width, height, params, where)
        camera = self._cameras[camera_id]
        if isinstance(camera, str):
            raise CalibrationError(camera)
        return camera

    def point_xyz(self, ids: NDArray[np.integer]) -> FloatArray:
        """(K, 3) positions of points, metres; NaN for -1 and for ids that the model does not have."""
        if not len(self.points.ids):
            return np.full((len(ids), 3), np.nan)
        place = np.minimum(np.searchsorted(self.points.ids, ids), len(self.points.ids) - 1)
        known = self.points.ids[place] == ids
        return np.where(known[:, None], self.points.xyz[place], np.nan)


def _converted(name: str, width: int, height: int, params: tuple[float, ...], where: str) -> Camera | str:
    try:
        return camera_from_colmap(name, width, height, params, where)
    except CalibrationError as error:
        return str(error)


def read_model(folder: Path) -> ColmapModel:
    """Read the model in ``folder``: the binary form if all of its three files are there, else the text form.

    Every file is walked and checked first; then pycolmap reads cameras and poses, in a process of its own. Raises
    ``InputError`` that names the missing file, or the file and the byte or line of what is wrong, and where pycolmap
    is not installed.
    """
    folder = Path(folder)
    form = _form(folder)
    require("pycolmap", "colmap", "reading COLMAP models")
    walked = check_binary(folder) if form == "bin" else check_text(folder)
    answer = _read_by_pycolmap(folder, form)
    cameras = {row[0]: (str(row[1]), int(row[2]), int(row[3]), tuple(row[4])) for row in answer["cameras"]}
    images, remarks = _images(folder, walked, answer["images"])
    return ColmapModel(folder, images, walked.points, cameras, remarks)


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


def _read_by_pycolmap(folder: Path, form: str) -> dict[str, Any]:
    """pycolmap's answer; raises ``InputError`` if it refuses the model or does not survive it."""
    child = Path(__file__).with_name("colmap_child.py")
    size = sum(path.stat().st_size for path in folder.glob(f"*.{form}"))
    try:
        done = subprocess.run(
            [sys.executable, "-P", str(child), str(folder), form],
            capture_output=True,
            timeout=_PATIENCE_S + size / _BYTES_PER_S,
        )
        answer = json.loads(done.stdout) if done.returncode == 0 else {"error": f"it ended with {done.returncode}"}
    except subprocess.TimeoutExpired:
        answer = {"error": "it does not come to an end"}
    except (OSError, ValueError) as error:
        answer = {"error": reason(error)}
    if "error" in answer:
        said = shorten(" ".join(str(answer["error"]).split("Check failed:")[-1].split()), MOST_REASON)
        raise InputError(f"{folder}: COLMAP's own reader refuses the model ({said}); export the model again.")
    return answer


def _images(folder: Path, walked: ModelParts, rows: list[list[Any]]) -> tuple[dict[str, ColmapImage], tuple[str, ...]]:
    if {(row[0], row[1]) for row in rows} != {(number, image.name) for number, image in walked.images.items()}:
        raise InputError(f"{folder}: COLMAP's own reader finds other images in it; export the model again.")
    names = Counter(row[1] for row in rows)
    twice = next((name for name, count in names.items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{folder}: two images have the name {show(twice)}; give every image a name of its own.")
    images = {
        name: ColmapImage(name, camera_id, _rigid(numbers), walked.images[number].load)
        for number, name, camera_id, numbers in sorted(rows, key=lambda row: row[1])
        if numbers is not None
    }
    without = len(rows) - len(images)
    return images, (f"{folder}: {without} images have no pose and were left out.",) if without else ()


def _rigid(numbers: list[float]) -> FloatArray:
    """Pose (3, 4) with the nearest rotation: quaternions in the files are rounded."""
    matrix = np.array(numbers).reshape(3, 4)
    left, _, right = np.linalg.svd(matrix[:, :3])
    return np.column_stack([left @ right, matrix[:, 3]])
