"""Matches of many queries of another pipeline: one CSV with one camera, hloc's log, or COLMAP's database."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import load_camera
from spherloc.cameras.principal_point import about_principal_point, about_principal_points
from spherloc.datasets.colmap import some
from spherloc.datasets.correspondences import read_csv_of_queries
from spherloc.datasets.query_gravity import read_gravity_file
from spherloc.errors import InputError, ProblemError
from spherloc.formats.colmap_database import DatabaseQuery, read_queries_of_database
from spherloc.formats.colmap_files import read_model
from spherloc.formats.hloc_log import LoggedQuery, read_log
from spherloc.frontend.view import Gravity
from spherloc.problem import Problem
from spherloc.types import BoolArray, FloatArray

POSE_BOUND_RAD = float(np.radians(5.0))
"""Bound on a gravity that follows from a pose which may be wrong."""
STATED_BOUND_RAD = float(np.radians(3.0))
"""Bound on a stated gravity without a standard deviation."""


@dataclass(frozen=True, eq=False)
class MatchTable:
    """Matches, cameras and gravity of many queries, from a CSV with a calibration file, an hloc log, or COLMAP's
    database."""

    path: Path
    """The CSV, the log or the database."""
    matches: Mapping[str, tuple[FloatArray, BoolArray | None]]
    """Rows u, v (px), X, Y, Z (N, 5) and the mask of right ones (N,), if it is known, by the name of the query."""
    cameras: Mapping[str, Camera]
    """Camera by the name of the query."""
    gravity: Mapping[str, Gravity] | None
    """Gravity by the name of the query; None takes it from the poses."""
    gravity_map: FloatArray
    """Unit vector (3,) pointing down in the map."""
    lost: tuple[str, ...] = ()
    """Names of the queries that an hloc log lists without a pose."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on queries that are not diagnosed, and on what seems to be wrong with the cameras."""
        doubts = tuple(about_principal_points(self.cameras.items()))
        if not self.lost:
            return doubts
        missed = (
            f"{self.path}: hloc found no pose of {some(self.lost, 'query')}, of which nothing is told here; a scene of "
            "kind hloc localizes them: see spherloc scenes hloc"
        )
        return missed, *doubts

    def problem(self, name: str, pose: FloatArray | None) -> Problem | InputError:
        """The problem of a query, or what is wrong with it; ``pose`` is its ``cam_from_map`` (3, 4), if it has one."""
        try:
            return self._problem(name, *self.matches[name], pose)
        except (InputError, ProblemError) as error:
            return InputError(f"{self.path}: {error}")

    def _problem(self, name: str, rows: FloatArray, inliers: BoolArray | None, pose: FloatArray | None) -> Problem:
        if self.gravity is None:
            if pose is None:
                raise InputError(f"{name}: has no pose and no gravity; give --gravity, a file that says where down is.")
            down = pose[:, :3] @ self.gravity_map
            gravity = Gravity(down / np.linalg.norm(down), "the given pose", POSE_BOUND_RAD)
        elif name in self.gravity:
            gravity = self.gravity[name]
        else:
            raise InputError(f"{name}: has no row in the gravity file; add one.")
        doubt = about_principal_point("the camera", self.cameras[name])
        return Problem(
            name=name,
            camera=self.cameras[name],
            pixels=rows[:, :2],
            points=rows[:, 2:],
            gravity_camera=gravity.down,
            gravity_map=self.gravity_map,
            gravity_bound_rad=STATED_BOUND_RAD if gravity.bound_rad is None else gravity.bound_rad,
            gravity_sd_rad=gravity.sd_rad,
            gravity_source=gravity.source,
            truth_inliers=inliers,
            scene=str(self.path),
            remarks=(doubt,) if doubt else (),
        )


def read_match_table(path: Path, camera: Path, gravity: Path | None, gravity_map: tuple[float, ...]) -> MatchTable:
    """Read a CSV of matches with the columns name, u, v (px), X, Y, Z, a calibration and, if given, a gravity file.

    ``gravity_map`` (3,) points down in the map and may have any length. Raises ``InputError`` or ``CalibrationError``
    for a file that cannot be read.
    """
    matches, one = read_csv_of_queries(path), load_camera(camera)
    return _table(path, matches, dict.fromkeys(matches, one), gravity, gravity_map)


def read_logged_matches(
    path: Path, model: Path | None, camera: Path | None, gravity: Path | None, gravity_map: tuple[float, ...]
) -> tuple[MatchTable, tuple[InputError, ...]]:
    """The matches in hloc's log of queries that were localized, and what is wrong with those that cannot be used.

    ``model`` is the folder of the map's COLMAP model, which newer logs need, and ``camera`` the calibration of queries
    that have no camera in the log and are no images of the model. Raises ``InputError`` as ``read_match_table`` does.
    """
    one = None if camera is None else load_camera(camera)
    told = read_log(path, None if model is None else read_model(model), one)
    queries = {name: query for name, query in told.items() if isinstance(query, LoggedQuery)}
    matches = {name: (np.hstack([query.pixels, query.points]), None) for name, query in queries.items()}
    cameras = {name: query.camera for name, query in queries.items()}
    wrong = tuple(query for query in told.values() if isinstance(query, InputError))
    lost = tuple(name for name, query in told.items() if query is None)
    return replace(_table(path, matches, cameras, gravity, gravity_map), lost=lost), wrong


def read_database_matches(
    path: Path, model: Path, gravity: Path | None, gravity_map: tuple[float, ...]
) -> tuple[MatchTable, tuple[InputError, ...]]:
    """Verified matches in COLMAP's database of images that the map lacks, and what is wrong with the others of them.

    ``model`` is the folder of the map's COLMAP model. Raises ``InputError`` as ``read_match_table`` does.
    """
    told = read_queries_of_database(path, read_model(model))
    queries = {name: query for name, query in told.items() if isinstance(query, DatabaseQuery)}
    matches = {name: (np.hstack([query.pixels, query.points]), None) for name, query in queries.items()}
    cameras = {name: query.camera for name, query in queries.items()}
    wrong = tuple(query for query in told.values() if isinstance(query, InputError))
    return _table(path, matches, cameras, gravity, gravity_map), wrong


def _table(
    path: Path,
    matches: Mapping[str, tuple[FloatArray, BoolArray | None]],
    cameras: Mapping[str, Camera],
    gravity: Path | None,
    gravity_map: tuple[float, ...],
) -> MatchTable:
    down = np.array(gravity_map, dtype=np.float64)
    length = float(np.linalg.norm(down))
    if not 1e-3 < length < 1e6:
        raise InputError(f"the map's gravity has the length {length:.3g}; give a vector that points down.")
    stated = None if gravity is None else read_gravity_file(gravity)
    return MatchTable(path, matches, cameras, stated, down / length)
