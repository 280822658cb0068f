"""Finds pairs of images whose relative rotations agree; pairs of different places that look alike seldom do.

Along a closed loop of right pairs, the product of the relative rotations is the identity. The rotations of all images
are found by weighted averaging (chordal, Geman and McClure's weights), which starts from the tree of the pairs that
most loops of three agree with (Hartley, Trumpf, Dai, Li 2013; Zach, Klopschitz, Pollefeys 2010). A pair whose rotation
is far from these joins two different places.
"""

from collections.abc import Mapping
from itertools import combinations

import networkx as nx
import numpy as np

from spherloc.geometry import rotation_angle
from spherloc.types import FloatArray

Pair = tuple[int, int]

LOOP_RAD = float(np.radians(4.0))
"""Largest angle of the product of the rotations along a loop of three right pairs."""
OFF_RAD = float(np.radians(4.0))
"""Largest angle between a right pair's rotation and the one that the rotations of its images give."""
SCALE_RAD = float(np.radians(2.0))
"""Angle at which the weight of a pair has fallen to a quarter."""
SWEEPS = 30


def agreeing(rotations: Mapping[Pair, FloatArray], matches: Mapping[Pair, int]) -> set[Pair]:
    """The pairs (i, j) whose rotation (3, 3), j from i, agrees with those of the others, weighted by their matches.

    A pair that is in no loop cannot be checked and is kept.
    """
    graph = nx.Graph()
    for pair in rotations:
        graph.add_edge(*pair)
    for pair, (good, bad) in _loops(graph, rotations).items():
        graph.edges[pair]["trust"] = matches[pair] * (1.0 + good) / (1.0 + bad)
    absolute: dict[int, FloatArray] = {}
    tree = nx.maximum_spanning_tree(graph, weight="trust")
    for part in nx.connected_components(tree):
        root = min(part)
        absolute[root] = np.eye(3)
        for near, far in nx.bfs_edges(tree, root):
            absolute[far] = _from(rotations, near, far) @ absolute[near]
    for _ in range(SWEEPS):
        for one in graph:
            total = np.zeros((3, 3))
            for other in graph[one]:
                pair = min(one, other), max(one, other)
                off = _off(rotations[pair], absolute, pair)
                weight = graph.edges[pair]["trust"] / (1.0 + (off / SCALE_RAD) ** 2) ** 2
                total += weight * _from(rotations, other, one) @ absolute[other]
            left, _, right = np.linalg.svd(total)
            absolute[one] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return {pair for pair, rotation in rotations.items() if _off(rotation, absolute, pair) <= OFF_RAD}


def _loops(graph: nx.Graph, rotations: Mapping[Pair, FloatArray]) -> dict[Pair, tuple[int, int]]:
    """For each pair, how many loops of three agree with it and how many do not."""
    found = {pair: (0, 0) for pair in rotations}
    for one, other in rotations:
        for third in set(graph[one]) & set(graph[other]):
            if third < other or third < one:
                continue  # each loop once
            loop = _from(rotations, third, one) @ _from(rotations, other, third) @ _from(rotations, one, other)
            good = rotation_angle(loop) <= LOOP_RAD
            for pair in combinations(sorted((one, other, third)), 2):
                before = found[pair]
                found[pair] = (before[0] + good, before[1] + (not good))
    return found


def _from(rotations: Mapping[Pair, FloatArray], start: int, end: int) -> FloatArray:
    """The rotation (3, 3) from the camera frame of ``start`` to that of ``end``."""
    return rotations[start, end] if start < end else rotations[end, start].T


def _off(rotation: FloatArray, absolute: Mapping[int, FloatArray], pair: Pair) -> float:
    return rotation_angle(rotation @ absolute[pair[0]] @ absolute[pair[1]].T)
