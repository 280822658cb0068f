"""Relative poses of pairs of images with too few clear matches, found with the help of an image between them.

If the relative poses of (i, j) and of (j, k) are known but for the lengths of their baselines, the rotation of (i, k)
is known, and the direction of its baseline lies on the arc between R_kj t_ij and t_jk: one unknown instead of five, so
that a handful of right matches among a hundred is more than chance. Such pairs connect the scales of their neighbours,
without which a map falls into parts.
"""

from collections.abc import Mapping

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import tangent_basis
from spherloc.mapping.two_view.level_pairs import chance_of_fit, fitting, log10_nfa
from spherloc.types import FloatArray

Pair = tuple[int, int]
Relative = tuple[FloatArray, FloatArray]
"""Rotation (3, 3) and unit direction (3,) of the second camera from the first."""

STEPS = 40
"""Number of directions that are tried on the arc."""
MIN_FIT = 5
ELSEWHERE, AWAY_RAD = 4, float(np.radians(25.0))
"""Number of other directions with which a direction is compared, and their angle to it."""
MAX_LOG10_NFA = -1.0


def open_triangles(known: Mapping[Pair, Relative]) -> dict[Pair, list[int]]:
    """Pairs (i, k) of images without a known pose, each with the images j that have one with both."""
    graph = nx.Graph(list(known))
    found: dict[Pair, list[int]] = {}
    for middle in graph:
        for one in graph[middle]:
            for other in graph[middle]:
                if one < other and (one, other) not in known:
                    found.setdefault((one, other), []).append(middle)
    return found


def through(
    known: Mapping[Pair, Relative],
    pair: Pair,
    middles: list[int],
    rays: tuple[FloatArray, FloatArray],
    bound_rad: float,
) -> Relative | None:
    """The relative pose that most matches of bearings (M, 3) fit, among those that the images in between allow.

    None if no more matches fit than chance allows.
    """
    best: tuple[int, Relative] = MIN_FIT - 1, (np.eye(3), np.zeros(3))
    for middle in middles:
        (first_turn, first_way), (second_turn, second_way) = (
            _from(known, pair[0], middle),
            _from(known, middle, pair[1]),
        )
        rotation, start = second_turn @ first_turn, second_turn @ first_way
        for direction in _arc(start, second_way):
            fit = int(np.count_nonzero(fitting(*rays, rotation, direction, bound_rad)))
            if fit > best[0]:
                best = fit, (rotation, direction)
    if best[0] < MIN_FIT:
        return None
    chance = chance_of_fit(*rays, *best[1], bound_rad)
    tests = np.log10(STEPS * len(middles))
    return best[1] if tests + log10_nfa(len(rays[0]), best[0], chance, sample=0) <= MAX_LOG10_NFA else None


def elsewhere(pose: Relative) -> FloatArray:
    """Unit vectors (K, 3) at the angle ``AWAY_RAD`` to the direction of a pose, evenly around it."""
    around = tangent_basis(pose[1][None])[0]
    turns = np.arange(ELSEWHERE)[:, None] * 2.0 * np.pi / ELSEWHERE
    return np.cos(AWAY_RAD) * pose[1] + np.sin(AWAY_RAD) * (np.cos(turns) * around[0] + np.sin(turns) * around[1])


def _arc(start: FloatArray, end: FloatArray) -> NDArray[np.float64]:
    """Unit vectors (S, 3) on the shorter arc between two, without the ends: there one baseline would be zero."""
    angle = float(np.arccos(np.clip(start @ end, -1.0, 1.0)))
    if angle < 1e-3:
        return start[None]
    share = (np.arange(STEPS) + 0.5)[:, None] / STEPS
    ways = np.sin((1.0 - share) * angle) * start + np.sin(share * angle) * end
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    return ways / np.maximum(length, 1e-9)


def _from(known: Mapping[Pair, Relative], start: int, end: int) -> Relative:
    """The relative pose from the camera ``start`` to ``end``."""
    if start < end:
        return known[start, end]
    rotation, direction = known[end, start]
    return rotation.T, -rotation.T @ direction
