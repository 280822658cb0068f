"""What the matches between images say of two maps that a pair of images may join.

A pair tells the rotation between its cameras and the direction from one to the other, so that only their distance is
unknown: each match with a point in a map tells it in the units of that map. How well two maps fit to each other is
counted by all matches between them, right or wrong: the two-view check leaves out too many where all that fits is seen
through a door.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.consensus.spread import spread_of
from spherloc.geometry import transform
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.two_view.level_pairs import chance_of_fit, fitting
from spherloc.mapping.two_view.matched import Matched, Names
from spherloc.mapping.two_view.pairs import SURE, relative
from spherloc.types import BoolArray, FloatArray

NOISE_RAD, MAX_SPREAD = float(np.radians(0.3)), 0.15
"""A match tells the distance if an error of the first size in a bearing changes it by no more than the second share."""
WINDOW = 0.1
"""Two distances agree if their logarithms differ by no more than that."""
MIN_AGREEING, MIN_SHARE, CLEARLY = 6, 1.0 / 3.0, 2.0
"""A distance is taken if so many matches agree on it, that share of all, and so many times as many as on any other."""
OWN, LESS, MIN_TELLING = 0.6, 0.6, 60
"""Two images are misplaced in a map if the first share of their matches, and so many, fit their own pose, and less than
the second share of these that in the map. A wrong pair seldom has so large a share. In maps of rendered flats 96 to 100
% of these fit where both images stand right, and 33 and 45 % where a room stood two metres beside its place."""
MIN_MATCHES, SIGMAS = 8, 3.0
"""So many matches of two images are counted, if more of them fit than chance explains, by so many of its deviations."""


@dataclass(frozen=True, eq=False)
class VerifiedPair:
    """Two images whose matches fit a relative pose."""

    names: Names
    rotation: FloatArray
    """(3, 3), of the second camera from the first."""
    direction: FloatArray
    """Unit vector (3,) in the second camera's frame: the translation without its length."""
    matches: NDArray[np.int64]
    """(M, 2) indices of the features of both images that fit."""
    sureness: float
    """``ImagePairs.sureness``."""

    def turned_round(self) -> "VerifiedPair":
        """The same with the second image as the first."""
        rotation = self.rotation.T
        return VerifiedPair(
            (self.names[1], self.names[0]), rotation, -rotation @ self.direction, self.matches[:, ::-1], self.sureness
        )


class PairEvidence:
    """What speaks for or against that two maps are joined: the matches between their images, right or wrong."""

    def __init__(self, matched: Matched) -> None:
        """Read the matches of all pairs from the database."""
        names = matched.names
        self.pairs = [
            VerifiedPair(
                (names[one], names[other]),
                *relative(found),
                np.asarray(found.inlier_matches, np.int64),
                matched.sureness.get((one, other), SURE),
            )
            for (one, other), found in {**matched.unsure, **matched.verified}.items()
        ]
        self.bearings, self._cameras = matched.bearings, matched.cameras
        self.panoramas = all(isinstance(camera, Equirectangular) for camera in matched.cameras.values())
        """Whether all images see all around."""
        self._matches, self._bound_rad = matched.matches(), matched.bound_rad
        self._telling = [
            pair
            for pair in self.pairs
            if pair.sureness >= SURE
            and self.share(pair) >= OWN
            and self.share(pair) * len(self._rays(*pair.names)[0]) >= MIN_TELLING
        ]

    def strength(self, pair: VerifiedPair) -> float:
        """Number of matches of a pair that fit its own pose, times their share of all."""
        return self.share(pair) ** 2 * len(self._rays(*pair.names)[0])

    def share(self, pair: VerifiedPair) -> float:
        """Share of the matches of a pair that fit its own pose."""
        first, second = pair.names
        rays, others = self._rays(first, second)
        return float(np.mean(fitting(rays, others, pair.rotation, pair.direction, self._bound_rad)))

    def misplaced(self, poses: Mapping[str, FloatArray]) -> set[Names]:
        """Pairs of which most matches fit their own pose, and clearly fewer the poses (3, 4) in a map: one of the two
        images stands elsewhere."""
        inside = [pair for pair in self._telling if set(pair.names) <= poses.keys()]
        return {pair.names for pair in inside if np.mean(self._fit(poses, pair.names)[1]) < LESS * self.share(pair)}

    def distance(self, made: Reconstruction, pair: VerifiedPair) -> float | None:
        """The distance between the images of a pair, in the units of a model that has the first; None if its points do
        not tell it."""
        first, second = pair.names
        image = made.model.image(made.ids[first])
        seen = [
            (image.points2D[one], other) for one, other in pair.matches.tolist() if image.points2D[one].has_point3D()
        ]
        points = np.array([made.model.point3D(point.point3D_id).xyz for point, _ in seen]).reshape(-1, 3)
        rays = self.bearings[second][[other for _, other in seen]]
        return distance_of(transform(made.poses[first], points), rays, pair.rotation, pair.direction)

    def least_holding(self, poses: Mapping[str, FloatArray]) -> int:
        """How many matches that fit the poses (3, 4) of a map hold its two parts together that fewest hold."""
        graph = nx.Graph()
        graph.add_nodes_from(poses)
        for pair, count in self.between(poses, poses, poses).counts.items():
            if count:
                graph.add_edge(*pair, weight=count)
        return int(nx.stoer_wagner(graph)[0]) if len(poses) > 1 and nx.is_connected(graph) else 0

    def between(self, poses: Mapping[str, FloatArray], some: Collection[str], others: Collection[str]) -> "Between":
        """How the matches between two sets of images fit their poses (3, 4)."""
        counts, fit = dict[Names, int](), dict[str, list[FloatArray]]()
        for pair in product(some, others):
            rays = self._rays(*pair)
            if len(rays[0]) >= MIN_MATCHES and pair[0] != pair[1]:
                counts[pair], fits = self._fit(poses, pair)
                for name, seen in zip(pair, rays, strict=True):
                    fit.setdefault(name, []).append(seen[fits if counts[pair] else []])
        return Between(counts, max(self._radius_deg(fit, some), self._radius_deg(fit, others)))

    def _radius_deg(self, fit: Mapping[str, Sequence[FloatArray]], names: Collection[str]) -> float:
        """Mean radius of the part of the view in which what fits lies, over those of the images; 0 if nothing fits."""
        found = []
        for name in names:
            rays = np.concatenate(fit.get(name, [np.empty((0, 3))]))
            spread = spread_of(self._cameras[name], rays, np.ones(len(rays), np.bool_))
            if spread is not None:
                found.append(spread.radius_deg)
        return float(np.mean(found)) if found else 0.0

    def _rays(self, first: str, second: str) -> tuple[FloatArray, FloatArray]:
        """Bearings (M, 3) of the matches of two images in both."""
        if (second, first) in self._matches:
            found = self._matches[second, first][:, ::-1]
        else:
            found = self._matches.get((first, second), np.empty((0, 2), np.int64))
        return self.bearings[first][found[:, 0]], self.bearings[second][found[:, 1]]

    def _fit(self, poses: Mapping[str, FloatArray], pair: Names) -> tuple[int, BoolArray]:
        """How many more matches of two images fit their poses than do by chance, 0 if no more, and which (M,) fit."""
        one, other = (poses[name] for name in pair)
        rotation = other[:, :3] @ one[:, :3].T
        way = other[:, 3] - rotation @ one[:, 3]
        direction = way / max(float(np.linalg.norm(way)), 1e-12)
        rays = self._rays(*pair)
        fits = fitting(*rays, rotation, direction, self._bound_rad)
        expected = len(fits) * chance_of_fit(*rays, rotation, direction, self._bound_rad)
        count = int(np.count_nonzero(fits))
        return round(count - expected) if count > expected + SIGMAS * np.sqrt(max(expected, 1.0)) else 0, fits


@dataclass(frozen=True, eq=False)
class Between:
    """How the matches between two sets of images fit their poses."""

    counts: dict[Names, int]
    """How many more matches of two images fit than do by chance."""
    radius_deg: float
    """Mean over the images of the part of the view with nine tenths of the matches that fit (``Spread.radius_deg``), of
    that set where it is larger; 0 without panoramas."""

    def added_to(self, counts: NDArray[np.int64], ids: Mapping[str, int]) -> NDArray[np.int64]:
        """Numbers of matches (V, V) of all images ``ids`` with those of these pairs."""
        place, more = {name: index for index, name in enumerate(ids)}, counts.copy()
        for (one, other), count in self.counts.items():
            more[place[one], place[other]] = more[place[other], place[one]] = count
        return more


def distance_of(points: FloatArray, rays: FloatArray, rotation: FloatArray, direction: FloatArray) -> float | None:
    """How far a second camera is from a first one, if enough points agree on that.

    ``points`` (K, 3) are in the frame of the first camera, ``rays`` (K, 3) the second's bearings of them. ``rotation``
    (3, 3) and the unit ``direction`` (3,) are those of the second camera from the first: each point X gives the
    distance d for which its bearing is parallel to R X + d t.
    """
    return agreed_distance(np.log(distances_of(points, rays, rotation, direction)))


def distances_of(points: FloatArray, rays: FloatArray, rotation: FloatArray, direction: FloatArray) -> FloatArray:
    """How far (T,) a second camera is from a first one by each of the points (K, 3) that tell it, with the arguments of
    ``distance_of``."""
    turned = points @ rotation.T
    along = np.cross(rays, direction)
    strength = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    distances = -np.sum(np.cross(rays, turned) * along, axis=1) / strength**2
    moved = turned + distances[:, None] * direction
    spread = NOISE_RAD * np.linalg.norm(moved, axis=1) / strength
    telling = (distances > 0.0) & (spread < MAX_SPREAD * distances) & (np.sum(moved * rays, axis=1) > 0.0)
    return distances[telling]


def agreed_distance(logs: FloatArray) -> float | None:
    """The distance on which enough of those with these logarithms (T,) agree; None if there is none."""
    if len(logs) < MIN_AGREEING:
        return None
    agree = np.abs(logs[:, None] - logs) <= WINDOW
    votes = agree.sum(axis=1)
    best = int(np.argmax(votes))
    rival = votes[np.abs(logs - logs[best]) > 3.0 * WINDOW].max(initial=0)
    if votes[best] < max(MIN_AGREEING, MIN_SHARE * len(logs), CLEARLY * rival):
        return None
    return float(np.exp(np.median(logs[agree[best]])))
