"""hloc's logs (``results.txt_logs.pkl``): the matches of every query and the pose that came of them.

A log is a pickle, which is read without running anything in it, see ``pickle_data``. Its pixels have the centre of the
top-left one at (0.5, 0.5), as here. Logs of hloc up to 1.3 have the points' coordinates, and quaternions that begin
with w; later ones have ids of points of the COLMAP model, and objects of pycolmap, whose quaternions end with w.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import CalibrationError, InputError, show
from spherloc.files import read_file, reading
from spherloc.formats.colmap_model import MODELS, ColmapModel
from spherloc.formats.pickle_data import Noted, PickleDataError, read_pickle_data, value_of
from spherloc.formats.text_rows import pose_from_words
from spherloc.types import FloatArray

MAX_BYTES = 1 << 30
MAX_MATCHES = 1_000_000
"""Largest number of matches of a query."""
NAMES = (".pkl", ".pickle")
"""File name endings of pickles."""


@dataclass(frozen=True, eq=False)
class LoggedQuery:
    """Pose and matches of a query that was localized."""

    cam_from_map: FloatArray
    """Its pose (3, 4)."""
    pixels: FloatArray
    """(N, 2) px, the matched pixels."""
    points: FloatArray
    """(N, 3) m, their points in the map frame."""
    camera: Camera


def is_log(path: Path) -> bool:
    """Whether the name of a file is that of a pickle."""
    return path.suffix.lower() in NAMES


def read_log_poses(path: Path) -> dict[str, FloatArray]:
    """Poses ``cam_from_map`` (3, 4) of the queries that were localized. Raises ``InputError`` for another file."""
    poses = {}
    for name, entry, place in _entries(path):
        if entry is not None:
            with _placed(place):
                poses[name] = _pose(entry, place)
    return poses


def read_log(
    path: Path, model: ColmapModel | None, camera: Camera | None = None
) -> dict[str, LoggedQuery | InputError | None]:
    """Pose and matches of each query, or why they cannot be used; None for one that was not localized.

    ``model`` is the COLMAP model of the map, which newer logs need, since they have only the ids of points. A query of
    which the log states no camera has that of the model's image of its name; if there is none, ``camera``. Raises
    ``InputError`` for another file.
    """
    found: dict[str, LoggedQuery | InputError | None] = {}
    for name, entry, place in _entries(path):
        try:
            with _placed(place):
                found[name] = None if entry is None else _query(name, entry, model, camera, place)
        except InputError as error:
            found[name] = error
    return found


@contextmanager
def _placed(place: str) -> Iterator[None]:
    """Adds the place in the log to an error."""
    try:
        yield
    except PickleDataError as error:
        raise InputError(f"{place}: {error}; give the log as hloc wrote it.") from error


def _entries(path: Path) -> Iterator[tuple[str, Mapping[str, Any] | None, str]]:
    """Name, entry and place of each query; of several clusters of references, the best one's entry.

    The entry is None where the query has no pose.
    """
    with reading(path, "give hloc's log"):
        content = read_file(path, MAX_BYTES)
    try:
        logs = read_pickle_data(content)
    except PickleDataError as error:
        raise InputError(f"{path}: {error}, so it is not a log of hloc; give results.txt_logs.pkl.") from error
    queries = _table(_table(logs).get("loc"))
    if not queries:
        raise InputError(f"{path}: has no query under 'loc', so it is not a log of hloc; give results.txt_logs.pkl.")
    for name, told in queries.items():
        place = f"{path}: {show(name)}"
        entry = _table(told)
        clusters = entry.get("log_clusters")
        if isinstance(clusters, list):
            with _placed(place):
                best = value_of(entry.get("best_cluster"))
            entry = _table(clusters[best]) if isinstance(best, int) and 0 <= best < len(clusters) else {}
        result = _table(entry.get("PnP_ret"))
        if isinstance(name, str):
            posed = "cam_from_world" in result or (result.get("success") and "qvec" in result)
            yield name, entry if posed else None, place


def _table(found: Any) -> Mapping[str, Any]:
    """A dict, or the fields of an object by name; empty for anything else."""
    if isinstance(found, Noted):
        found = found.state if isinstance(found.state, dict) else found.items
    return found if isinstance(found, dict) else {}


def _query(
    name: str, entry: Mapping[str, Any], model: ColmapModel | None, camera: Camera | None, place: str
) -> LoggedQuery:
    pixels = _floats(entry.get("keypoints_query"), 2, f"{place}: keypoints_query")
    points = _points(entry, model, place)
    if len(points) != len(pixels):
        raise InputError(f"{place}: has {len(pixels):,} keypoints but {len(points):,} points.")
    known = np.isfinite(points).all(axis=1)
    pose, stated = _pose(entry, place), _camera(entry, place)
    if stated is None and model is not None and name in model.images:
        stated = model.camera(model.images[name].camera_id)
    stated = stated or camera
    if stated is None:
        raise InputError(
            f"{place}: has no camera, and is no image of a model that is given; give its calibration by --camera, or a "
            "scene file of kind hloc instead, which names the cameras."
        )
    return LoggedQuery(pose, pixels[known], points[known], stated)


def _pose(entry: Mapping[str, Any], place: str) -> FloatArray:
    result = _table(entry.get("PnP_ret"))
    rigid = _table(result.get("cam_from_world"))
    if rigid:
        x, y, z, w = _numbers(_table(rigid.get("rotation")).get("quat"), 4, f"{place}: rotation")
        numbers = [w, x, y, z, *_numbers(rigid.get("translation"), 3, f"{place}: translation")]
    else:
        numbers = [
            *_numbers(result.get("qvec"), 4, f"{place}: qvec"),
            *_numbers(result.get("tvec"), 3, f"{place}: tvec"),
        ]
    return pose_from_words([repr(number) for number in numbers], place)


def _points(entry: Mapping[str, Any], model: ColmapModel | None, place: str) -> FloatArray:
    """Positions (N, 3) of the points, m; NaN for points that the model does not have."""
    stated = entry.get("points3D_xyz")
    if stated is not None:
        return _floats(stated, 3, f"{place}: points3D_xyz")
    ids = entry.get("points3D_ids")
    numbers = [value_of(number) for number in ids] if isinstance(ids, list) else np.ravel(value_of(ids)).tolist()
    if not all(type(number) is int and 0 <= number < 1 << 63 for number in numbers):
        raise InputError(f"{place}: points3D_ids are not ids of points; give the log as hloc wrote it.")
    if model is None:
        raise InputError(f"{place}: has only the ids of its points; give the COLMAP model of the map by --model.")
    return model.point_xyz(np.array(numbers, dtype=np.int64))


def _camera(entry: Mapping[str, Any], place: str) -> Camera | None:
    """The camera that the log states; None if it states none."""
    result = _table(entry.get("PnP_ret"))
    told = _table(result.get("camera")) or _table(result.get("cfg"))
    model = told.get("model")
    if isinstance(model, Noted):  # an enumeration of pycolmap
        number = model.state if model.args == () else (model.args or (None,))[0]
        model = MODELS[number][0] if isinstance(number, int) and 0 <= number < len(MODELS) else None
    width, height = value_of(told.get("width")), value_of(told.get("height"))
    if not isinstance(model, str) or not isinstance(width, int) or not isinstance(height, int):
        return None
    params = _numbers(told.get("params"), None, f"{place}: params")
    try:
        return camera_from_colmap(model, width, height, tuple(params), place)
    except CalibrationError as error:
        raise InputError(str(error)) from error


def _numbers(found: Any, count: int | None, what: str) -> list[float]:
    values = value_of(found)
    try:
        numbers = [
            float(value_of(value)) for value in (values.ravel().tolist() if isinstance(values, np.ndarray) else values)
        ]
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or (count is not None and len(numbers) != count):
        raise InputError(f"{what} is not {count or 'a list of'} numbers; give the log as hloc wrote it.")
    return numbers


def _floats(found: Any, width: int, what: str) -> FloatArray:
    """An array (N, width), from an array or a list of rows."""
    values = value_of(found)
    if isinstance(values, list):
        values = np.array([_numbers(row, width, what) for row in values[: MAX_MATCHES + 1]]).reshape(-1, width)
    if (
        not isinstance(values, np.ndarray)
        or values.dtype.kind not in "fiu"
        or values.ndim != 2
        or values.shape[1] != width
    ):
        raise InputError(f"{what} is not an array of {width} columns; give the log as hloc wrote it.")
    if len(values) > MAX_MATCHES:
        raise InputError(f"{what} has more than {MAX_MATCHES:,} rows.")
    return np.array(values, dtype=np.float64)
