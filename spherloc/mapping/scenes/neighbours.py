"""Finds queries of a sequence that lie far from those before and after them, which lie near each other.

A frame of a walk that was put into an alike room stands out: the camera went there and back between two frames. That
speaks against a pose only where the camera is known to move steadily, so most frames must be within a few typical
steps of the next one; photographs in no order, or taken in clusters, are not judged.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spherloc.experiments.results import LOCALIZED, QueryResult
from spherloc.mapping.rig import camera_and_key
from spherloc.types import FloatArray

MIN_FRAMES = 8
"""Least number of localized queries of one camera that show how it moves."""
STEADY = 0.75
"""Share of the ways between frames that follow each other by which a usual one is told: at most so many are slower."""
AWAY, BACK = 5.0, 2.0
"""A query stands out if the camera went to it and on from it this many times as fast as usual, while the queries before
and after it are no farther from each other than this many usual ways in the time between them."""
LEAPS = 0.03
"""Most ways, as a share of all, that are that fast without such a return: there are more where photographs were taken
in several at each place."""


@dataclass(frozen=True)
class Jump:
    """A query far from its neighbours in a sequence."""

    before: str
    """Name of the query before it."""
    after: str
    """Name of the query after it."""
    away: float
    """Distance to the nearer one of them, in units of the map."""
    apart: float
    """Distance between these two."""


def jumps(rows: Sequence[QueryResult], limit: float) -> Mapping[str, Jump]:
    """The localized queries that stand out in the sequence of their camera, by name; ``limit`` is the error of a
    position, in units of the map, beyond which it is wrong.

    The order is that of the times or numbers in the names; where one camera has two images of the same time or number,
    its images are not judged.
    """
    sequences: dict[str, list[tuple[float, QueryResult]]] = {}
    for row in rows:
        camera, key = camera_and_key(row.query)
        if key.number >= 0.0:
            sequences.setdefault(camera, []).append((key.number, row))
    found: dict[str, Jump] = {}
    for known in sequences.values():
        sure = sorted(((key, row) for key, row in known if row.status == LOCALIZED), key=lambda item: item[0])
        keys = np.array([key for key, _ in sure])
        if len(sure) >= MIN_FRAMES and len({key for key, _ in known}) == len(known):
            places = np.array([row.position_m for _, row in sure])
            names = [row.query for _, row in sure]
            for k in _standing_out(keys, places, limit):
                away = min(np.linalg.norm(places[k] - places[k - 1]), np.linalg.norm(places[k + 1] - places[k]))
                apart = np.linalg.norm(places[k + 1] - places[k - 1])
                found[names[k]] = Jump(names[k - 1], names[k + 1], float(away), float(apart))
    return found


def _standing_out(keys: FloatArray, places: FloatArray, least: float) -> list[int]:
    """Which of positions (K, 3) at growing times or numbers (K,) stand out, farther than ``least`` from both others."""
    ways, gaps = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(keys)
    speeds = ways / gaps
    found = []
    for k in range(1, len(keys) - 1):
        usual = float(np.quantile(np.delete(speeds, [k - 1, k]), STEADY))
        back = float(np.linalg.norm(places[k + 1] - places[k - 1]))
        fast = min(speeds[k - 1], speeds[k]) > AWAY * usual and min(ways[k - 1], ways[k]) > least
        if fast and back <= BACK * usual * (gaps[k - 1] + gaps[k]):
            found.append(k)
    leaps = set(np.flatnonzero(speeds > AWAY * float(np.quantile(speeds, STEADY))).tolist())
    returning = {way for k in found for way in (k - 1, k)}
    return found if len(leaps - returning) <= LEAPS * len(ways) else []
