"""Estimated and true camera poses of a sequence as trajectories."""

from decimal import Decimal

import numpy as np

from spherloc.experiments.results import SequenceResults
from spherloc.experiments.rows import QueryResult
from spherloc.geometry import camera_centre, pose
from spherloc.trajectory import NS_PER_S, Trajectory

LATEST_S = 4e9
"""Beyond the year 2090; a number larger than that is no time in seconds."""


def estimated_trajectory(results: SequenceResults) -> Trajectory:
    """Estimated poses ``map_from_camera`` of the localized queries."""
    return _trajectory(results, "cam_from_map")


def true_trajectory(results: SequenceResults) -> Trajectory:
    """True poses ``map_from_camera`` of the queries whose truth is known."""
    return _trajectory(results, "truth_cam_from_map")


def timed(results: SequenceResults) -> bool:
    """Whether every query has a time and the times grow; else a query's time is its place in the sequence."""
    times = [row.timestamp_s for row in results.rows]
    if any(time is None or not abs(time) < LATEST_S for time in times):
        return False
    return bool((np.diff([_nanoseconds(row, True) for row in results.rows]) > 0).all())


def _trajectory(results: SequenceResults, field: str) -> Trajectory:
    by_time = timed(results)
    rows = [row for row in results.rows if getattr(row, field) is not None]
    times = np.array([_nanoseconds(row, by_time) for row in rows], dtype=np.int64)
    poses = [getattr(row, field) for row in rows]
    inverse = [pose(matrix[:, :3].T, camera_centre(matrix)) for matrix in poses]
    return Trajectory(times, np.array(inverse).reshape(-1, 3, 4))


def _nanoseconds(row: QueryResult, by_time: bool) -> int:
    seconds = row.timestamp_s if by_time and row.timestamp_s is not None else row.index
    return round(Decimal(repr(seconds)) * NS_PER_S)  # the decimals that were written, not their nearest double
