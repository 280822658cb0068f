"""COLMAP's database: keypoints and verified matches of all images, also of those that COLMAP could not localize.

It is a SQLite file, which is opened for reading only and whose triggers and views are not run. Keypoints have the
centre of the top-left pixel at (0.5, 0.5), as here. Layout: doc/database.rst of COLMAP 4.2.
"""

import sqlite3
from collections.abc import Collection, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.errors import CalibrationError, InputError, show
from spherloc.files import reading, size_of
from spherloc.formats.colmap_model import MODELS, ColmapModel
from spherloc.types import FloatArray, IntArray

_PAIR = 2_147_483_647
"""A pair's id is this times the smaller image id, plus the larger one."""
MAX_ROWS = 10_000_000
"""Largest number of keypoints of an image, and of matches of a pair."""


@dataclass(frozen=True, eq=False)
class DatabaseQuery:
    """An image of the database that is not in the map."""

    pixels: FloatArray
    """(N, 2) px, its keypoints that are matched with points of the map."""
    points: FloatArray
    """(N, 3) m, these points in the map frame."""
    camera: Camera


def read_queries_of_database(path: Path, model: ColmapModel) -> dict[str, DatabaseQuery | InputError]:
    """Verified matches with points of the map ``model``, by image, of each image that is not in the map.

    Where a query's keypoint is matched with a keypoint of a map image, it is matched with the map point of that
    keypoint; the same match from several images counts once. Raises ``InputError`` for a file of another kind.
    """
    with reading(path, "give COLMAP's database"):
        size_of(path)
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            database.text_factory = lambda text: text.decode("utf-8", errors="replace")
            return _DatabaseReader(path, database).queries(model)
    except (sqlite3.Error, UnicodeDecodeError) as error:  # the latter from SQLite's messages, which quote the file
        raise InputError(f"{path}: is not a COLMAP database ({show(str(error))}); give its database.db.") from error


class _DatabaseReader:
    """Reads one database."""

    def __init__(self, path: Path, database: sqlite3.Connection) -> None:
        self._path = path
        self._database = database

    def queries(self, model: ColmapModel) -> dict[str, DatabaseQuery | InputError]:
        rows = self._database.execute("SELECT image_id, name, camera_id FROM images ORDER BY name").fetchall()
        if not all(type(number) is int and 0 < number < _PAIR and type(name) is str for number, name, _ in rows):
            raise InputError(f"{self._path}: its table of images is damaged; give the database as COLMAP wrote it.")
        ids = {name: number for number, name, _ in rows}
        absent = [name for name in model.images if name not in ids]
        if absent:
            raise InputError(
                f"{self._path}: has no image {show(absent[0])} of the map {model.folder}; give the map's database."
            )
        references = {ids[name]: name for name in model.images}
        found: dict[str, DatabaseQuery | InputError] = {}
        for number, name, camera in rows:
            if name in model.images:
                continue
            try:
                found[name] = self._query(number, camera, references, model)
            except (InputError, CalibrationError) as error:
                found[name] = InputError(f"{self._path}: {show(name)}: {error}")
        return found

    def _query(self, number: int, camera: int, references: Mapping[int, str], model: ColmapModel) -> DatabaseQuery:
        keypoints = self._keypoints(number)
        matched = [np.empty((0, 2), dtype=np.int64)]
        for other, pairs in self._matches(number, references):
            ids = model.images[references[other]].point_ids
            if len(pairs) and not (pairs.max(axis=0) < (len(keypoints), len(ids))).all():
                raise InputError(f"its matches with {show(references[other])} name keypoints that do not exist.")
            points = ids[pairs[:, 1]]
            matched.append(np.column_stack([pairs[:, 0], points])[points >= 0])
        both = np.unique(np.concatenate(matched), axis=0)
        xyz = model.point_xyz(both[:, 1])
        known = np.isfinite(xyz[:, 0])
        return DatabaseQuery(keypoints[both[known, 0]], xyz[known], self._camera(camera))

    def _matches(self, number: int, references: Collection[int]) -> list[tuple[int, IntArray]]:
        """For each pair with a map image: that image, and the matches (M, 2), indices of this and of its keypoints."""
        found = []
        for other in references:
            pair = _PAIR * min(number, other) + max(number, other)
            sql = "SELECT rows, cols, data FROM two_view_geometries WHERE pair_id = ?"
            for count, columns, content in self._database.execute(sql, (pair,)):
                pairs = self._array(count, columns, content, np.dtype("<u4"), 2)
                found.append((other, pairs.astype(np.int64)[:, :: 1 if number < other else -1]))
        return found

    def _keypoints(self, number: int) -> FloatArray:
        """Keypoints (K, 2) of an image, px."""
        sql = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
        row = self._database.execute(sql, (number,)).fetchone()
        if row is None:
            raise InputError("has no keypoints in the database.")
        count, columns, content = row
        pixels = self._array(count, columns, content, np.dtype("<f4"), None)[:, :2].astype(np.float64)
        if not np.isfinite(pixels).all():
            raise InputError("has a keypoint that is not finite.")
        return pixels

    @staticmethod
    def _array(count: Any, columns: Any, content: Any, kind: np.dtype, wanted: int | None) -> np.ndarray:
        """The rows of a blob, an array (count, columns)."""
        if count == 0:
            return np.empty((0, 2), dtype=kind)
        whole = type(count) is int and type(columns) is int and type(content) is bytes
        if not whole or not 0 < count <= MAX_ROWS or not 2 <= columns <= 16 or columns != (wanted or columns):
            raise InputError("has a table of an impossible size in the database.")
        if len(content) != count * columns * kind.itemsize:
            raise InputError("has a table in the database that is not as long as it says.")
        return np.frombuffer(content, dtype=kind).reshape(count, columns)

    def _camera(self, number: int) -> Camera:
        sql = "SELECT model, width, height, params FROM cameras WHERE camera_id = ?"
        row = self._database.execute(sql, (number,)).fetchone()
        where = f"camera {number}"
        if row is None or type(row[0]) is not int or not 0 <= row[0] < len(MODELS):
            raise InputError(f"{where} is not in the database, or its model is unknown.")
        model, width, height, content = row
        name, count = MODELS[model]
        if type(content) is not bytes or len(content) != 8 * count or type(width) is not int or type(height) is not int:
            raise InputError(f"{where} does not have the {count} parameters of {name}.")
        return camera_from_colmap(name, width, height, np.frombuffer(content, dtype="<f8"), where)
