"""Random gravity-aligned problems whose bearings are off by a known bound, for the tests of arcs and balls."""

from dataclasses import dataclass, fields

import numpy as np

from spherloc.geometry import yaw_rotation
from spherloc.problem import AlignedProblem


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@dataclass
class Sample:
    """What an estimator gets, and the truth that it does not."""

    aligned: AlignedProblem
    bound_rad: np.ndarray
    yaw: float
    centre: np.ndarray
    true_bearings: np.ndarray
    true_depths: np.ndarray

    @property
    def pairs(self):
        return np.column_stack(np.triu_indices(len(self.bound_rad), 1))

    def bounds_nothing(self, pairs):
        """Pairs whose bearings are closer than their errors, or whose points coincide: nothing can be said."""
        i, j = pairs.T
        sine = np.linalg.norm(np.cross(self.aligned.bearings[i], self.aligned.bearings[j]), axis=1)
        reach = 2 * np.sin(self.bound_rad[i] / 2) + 2 * np.sin(self.bound_rad[j] / 2)
        return (sine <= reach * (1 + 1e-9)) | (self.aligned.points[i] == self.aligned.points[j]).all(axis=1)


def aligned_problem(bearings, points):
    """An ``AlignedProblem`` of exactly these bearings and points; arcs and balls use nothing else of it."""
    count = len(points)
    given = {"index": np.arange(count), "count": count, "camera_turn": np.eye(3), "map_turn": np.eye(3)}
    given |= {"bearings": np.array(bearings, order="C"), "points": np.array(points, order="C")}
    for name in ("bearings", "points"):
        given[name].setflags(write=False)
    unused = {item.name: np.full(count, np.nan) for item in fields(AlignedProblem)}
    return AlignedProblem(**(unused | given))


def sample(rng, bound_rad, count=46, yaw=None):
    """All-round bearings (some level, some clustered, some opposite), depths of 0.1 to 100 m, errors up to the bound.

    Half of the errors lie exactly on the bound: in a random direction, towards or away from another bearing, or across.
    """
    bearings = unit(rng.normal(size=(count, 3)))
    bearings[: count // 6, 1] *= 0.01
    bearings[0, 1] = 0.0
    bearings = unit(bearings)
    third = count // 3
    bearings[-third:] = unit(bearings[:third] * rng.choice([-1, 1], (third, 1)) + 0.1 * rng.normal(size=(third, 3)))
    depths = 10 ** rng.uniform(-1, 2, count)
    yaw = rng.uniform(-np.pi, np.pi) if yaw is None else yaw
    centre = rng.uniform(-5, 5, 3)
    points = centre + (depths[:, None] * bearings) @ yaw_rotation(yaw)
    bounds = bound_rad * rng.uniform(0.2, 1.0, count)

    other = np.roll(bearings, rng.integers(1, count), axis=0)
    across = np.cross(bearings, other)
    along = np.cross(across, bearings)
    kind = rng.integers(0, 4, count)[:, None]
    away = np.where(kind == 0, across, np.where(kind == 1, along, rng.normal(size=(count, 3))))
    away = unit(away - np.sum(away * bearings, axis=1, keepdims=True) * bearings)
    angle = bounds * np.where(rng.random(count) < 0.5, 1.0, rng.uniform(0, 1, count)) * rng.choice([-1, 1], count)
    measured = np.cos(angle)[:, None] * bearings + np.sin(angle)[:, None] * away
    return Sample(aligned_problem(unit(measured), points), bounds, yaw, centre, bearings, depths)
