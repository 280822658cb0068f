"""Joins the maps that COLMAP left apart, by pairs of images with one in each, unless that makes a contradiction.

COLMAP adds an image to a map by the points that the map has of it. Through a door these are few, although the two
images have a hundred matches that fit. Such a pair tells the rotation between the two cameras and the direction from
one to the other, so that only their distance and the ratio of the two maps' scales are unknown. Each match with a point
in one of the maps tells the distance in that map's units; a few that agree are enough.

One wrong pair, of places that look alike, would put a map into another room. There, images that stand side by side
hardly match (``model``), and the pair is refused. Which pairs are refused depends on what is joined before. So the
pairs with most matches come first, then each of those that joined maps is left out in turn, and of all results the one
with the largest maps is taken.
"""

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.spread import joined, spread_of
from spherloc.geometry import transform
from spherloc.mapping.later import with_images
from spherloc.mapping.level_pairs import chance_of_fit, fitting
from spherloc.mapping.matched import Matched, Names
from spherloc.mapping.model import Reconstruction
from spherloc.mapping.pairs import relative
from spherloc.mapping.parallel import Tell
from spherloc.types import BoolArray, FloatArray

NOISE_RAD, MAX_SPREAD = float(np.radians(0.3)), 0.15
"""A match tells the distance if an error of the first size in a bearing changes it by no more than the second share."""
WINDOW = 0.1
"""Two distances agree if their logarithms differ by no more than that."""
MIN_AGREEING, MIN_SHARE, CLEARLY = 6, 1.0 / 3.0, 2.0
"""A distance is taken if so many matches agree on it, that share of all, and so many times as many as on any other."""
MIN_MATCHES, SIGMAS = 8, 3.0
"""So many matches of two images are counted, if more of them fit than chance explains, by so many of its deviations."""
MIN_RADIUS_DEG, MOST = 62.0, 0.6
"""Two maps are not joined if what fits between them is within a smaller part of the view, as of one thing that stands
at two places, unless that is the second share of the matches of the pair that joins them."""
MAX_WORK = 1000
"""Joins are tried until the maps that were made for that have so many images together."""


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

    def turned_round(self) -> "VerifiedPair":
        """The same with the second image as the first."""
        rotation = self.rotation.T
        return VerifiedPair(self.names[::-1], rotation, -rotation @ self.direction, self.matches[:, ::-1])


class Evidence:
    """What speaks for or against that two maps are joined: the matches between their images, right or wrong."""

    def __init__(self, matched: Matched) -> None:
        """Read the matches of all pairs from the database."""
        names = matched.names
        self.pairs = [
            VerifiedPair((names[one], names[other]), *relative(found), np.asarray(found.inlier_matches, np.int64))
            for (one, other), found in {**matched.one_thing, **matched.verified}.items()
        ]
        self.bearings = matched.bearings
        self._cameras, self._matches, self._bound_rad = matched.cameras, matched.matches(), matched.bound_rad

    def share(self, pair: VerifiedPair) -> float:
        """Share of the matches of a pair that fit its own pose."""
        first, second = pair.names
        rays, others = self._rays(first, second)
        return float(np.mean(fitting(rays, others, pair.rotation, pair.direction, self._bound_rad)))

    def between(self, made: Reconstruction, some: Collection[str], others: Collection[str]) -> "Between":
        """How the matches between two sets of a model's images fit their poses."""
        counts = dict[Names, int]()
        seen, fit = dict[str, list[FloatArray]](), dict[str, list[BoolArray]]()
        for pair in product(some, others):
            if len(self._rays(*pair)[0]) >= MIN_MATCHES and pair[0] != pair[1]:
                count, fits = self._fit(made, pair)
                counts[pair] = count
                for name, rays in zip(pair, self._rays(*pair), strict=True):
                    seen.setdefault(name, []).append(rays)
                    fit.setdefault(name, []).append(fits)
        radii = [0.0]
        for side in (some, others):
            spreads = [
                spread_of(self._cameras[name], np.concatenate(seen[name]), np.concatenate(fit[name]))
                for name in side
                if name in seen
            ]
            if known := [spread for spread in spreads if spread is not None]:
                radii.append(joined(known).radius_deg)
        return Between(counts, max(radii))

    def _rays(self, first: str, second: str) -> tuple[FloatArray, FloatArray]:
        """Bearings (M, 3) of the matches of two images in both."""
        if (second, first) in self._matches:
            found = self._matches[second, first][:, ::-1]
        else:
            found = self._matches.get((first, second), np.empty((0, 2), np.int64))
        return self.bearings[first][found[:, 0]], self.bearings[second][found[:, 1]]

    def _fit(self, made: Reconstruction, pair: Names) -> tuple[int, BoolArray]:
        """How many more matches of two images fit their poses than do by chance, 0 if no more, and which (M,) fit."""
        one, other = (made.poses[name] for name in pair)
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
    that set where it is larger."""

    def added_to(self, counts: NDArray[np.int64], names: Sequence[str]) -> NDArray[np.int64]:
        """Numbers of matches (V, V) of all images with those of these pairs."""
        place, more = {name: index for index, name in enumerate(names)}, counts.copy()
        for (one, other), count in self.counts.items():
            more[place[one], place[other]] = more[place[other], place[one]] = count
        return more


def joined_by_pairs(models: Sequence[Reconstruction], matched: Matched, tell: Tell) -> tuple[Reconstruction, ...]:
    """Models of which some are joined with each other or with images that are in none, the largest first."""
    placed = {name for one in models for name in one.poses}
    if len(models) == 1 and len(placed) == len(matched.ids):
        return tuple(models)
    found = _best(_Search(models, matched.ids.keys() - placed, Evidence(matched), tell))
    counts = models[0].all_matches
    made = [replace(one, all_matches=np.maximum(one.all_matches, counts)) for one in found.models]
    return tuple(sorted(made, key=lambda one: -len(one.poses)))


def _best(search: "_Search") -> "_Result":
    """The best result with all pairs, or without some of those that join models."""
    best, tried = search.run(frozenset()), set[frozenset[Names]]()
    while True:
        todo = [left_out for pair in best.joins if (left_out := best.left_out | {pair}) not in tried]
        for left_out in todo:
            tried.add(left_out)
            other = search.run(left_out)
            if other.worth() > best.worth():
                best = other
                break
        else:
            return best


@dataclass(frozen=True, eq=False)
class _Result:
    models: list[Reconstruction]
    joins: list[Names]
    """The pairs that joined them."""
    left_out: frozenset[Names]
    """The pairs that were not tried."""

    def worth(self) -> tuple[int, int]:
        """Larger models, then more matches that fit them."""
        return sum(len(one.poses) ** 2 for one in self.models), sum(int(one.all_matches.sum()) for one in self.models)


class _Search:
    def __init__(
        self, models: Sequence[Reconstruction], alone: Collection[str], evidence: Evidence, tell: Tell
    ) -> None:
        self.work = 0
        self._evidence = evidence
        self._models = [self._judged(one, np.zeros_like(one.all_matches)) for one in models]
        self._alone, self._tell = frozenset(alone), tell
        self._pairs = sorted(evidence.pairs, key=lambda pair: (-len(pair.matches), pair.names))
        self._known: dict[tuple[Names, frozenset[str], frozenset[str]], Reconstruction | None] = {}

    def run(self, left_out: frozenset[Names]) -> _Result:
        """The models, joined by the pairs, those with most matches first, without those ``left_out``."""
        result = _Result(list(self._models), [], left_out)
        alone = set(self._alone)
        while self._join(result, alone):
            pass
        return result

    def _join(self, result: _Result, alone: set[str]) -> bool:
        """Join two models, or one with an image, in place; false if no pair does."""
        model_of = {name: one for one in result.models for name in one.poses}
        for pair in self._pairs:
            if pair.names in result.left_out or pair.names in result.joins:
                continue
            sides = [(model_of.get(name), name) for name in pair.names]
            if len(sides[0][0].poses if sides[0][0] else ()) < len(sides[1][0].poses if sides[1][0] else ()):
                sides.reverse()
            (whole, _), (other, name) = sides
            if whole is None or whole is other or (other is None and name not in alone):
                continue
            joint = self._joint(whole, other, pair if pair.names[1] == name else pair.turned_round())
            if joint is not None:
                result.models[:] = [joint if one is whole else one for one in result.models if one is not other]
                result.joins.append(pair.names)
                alone.discard(name)
                return True
        return False

    def _joint(self, whole: Reconstruction, other: Reconstruction | None, pair: VerifiedPair) -> Reconstruction | None:
        """A model joined with another one, or with the second image; None if it cannot be or contradicts itself."""
        more = frozenset[str]() if other is None else frozenset(other.poses)
        state = pair.names, frozenset(whole.poses), more
        if state not in self._known:
            self._known[state] = None
            poses = _moved(whole, other, pair, self._evidence.bearings)
            if poses is not None and self.work < MAX_WORK:
                self.work += len(whole.poses) + len(poses)
                joint = with_images(replace(whole, model=copy.deepcopy(whole.model)), poses)
                counts = whole.all_matches if other is None else whole.all_matches + other.all_matches
                between = self._evidence.between(joint, poses, whole.poses)
                joint = replace(joint, all_matches=between.added_to(counts, list(joint.ids))).judged()
                before = {*whole.contradictions, *(() if other is None else other.contradictions)}
                told = between.radius_deg >= MIN_RADIUS_DEG or self._evidence.share(pair) >= MOST
                self._known[state] = joint if told and not set(joint.contradictions) - before else None
                self._tell("joins of maps tried", len(self._known), len(self._known))
        return self._known[state]

    def _judged(self, made: Reconstruction, none: NDArray[np.int64]) -> Reconstruction:
        """A model whose matches and contradictions are those by all matches that fit it: the two-view check leaves out
        too many where all that fits is seen through a door."""
        between = self._evidence.between(made, made.poses, made.poses)
        return replace(made, all_matches=between.added_to(none, list(made.ids))).judged()


def _moved(
    whole: Reconstruction, other: Reconstruction | None, pair: VerifiedPair, bearings: Mapping[str, FloatArray]
) -> dict[str, FloatArray] | None:
    """Poses (3, 4), in the frame of a model with the first image, of those of a model with the second, or of the second
    image alone; None if the distance between the two is not known in both models."""
    first, second = pair.names
    distance = _distance(whole, pair, bearings)
    if distance is None:
        return None
    rotation = pair.rotation @ whole.poses[first][:, :3]
    shift = pair.rotation @ whole.poses[first][:, 3] + distance * pair.direction
    if other is None:
        return {second: np.column_stack([rotation, shift])}
    other_distance = _distance(other, pair.turned_round(), bearings)
    if other_distance is None:
        return None
    scale = distance / other_distance
    turn = other.poses[second][:, :3].T @ rotation
    move = other.poses[second][:, :3].T @ (shift - scale * other.poses[second][:, 3])
    return {
        name: np.column_stack([one[:, :3] @ turn, one[:, :3] @ move + scale * one[:, 3]])
        for name, one in other.poses.items()
    }


def _distance(made: Reconstruction, pair: VerifiedPair, bearings: Mapping[str, FloatArray]) -> float | None:
    """The distance between the images of a pair, in the units of a model that has the first; None if its points do not
    tell it."""
    first, second = pair.names
    image = made.model.image(made.ids[first])
    seen = [(image.points2D[one], other) for one, other in pair.matches.tolist() if image.points2D[one].has_point3D()]
    points = np.array([made.model.point3D(point.point3D_id).xyz for point, _ in seen]).reshape(-1, 3)
    rays = bearings[second][[other for _, other in seen]]
    return distance_of(transform(made.poses[first], points), rays, pair.rotation, pair.direction)


def distance_of(points: FloatArray, rays: FloatArray, rotation: FloatArray, direction: FloatArray) -> float | None:
    """How far a second camera is from a first one, if enough points agree on that.

    ``points`` (K, 3) are in the frame of the first camera, ``rays`` (K, 3) the second's bearings of them. ``rotation``
    (3, 3) and the unit ``direction`` (3,) are those of the second camera from the first: each point X gives the
    distance d for which its bearing is parallel to R X + d t.
    """
    turned = points @ rotation.T
    along = np.cross(rays, direction)
    strength = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    distances = -np.sum(np.cross(rays, turned) * along, axis=1) / strength**2
    moved = turned + distances[:, None] * direction
    spread = NOISE_RAD * np.linalg.norm(moved, axis=1) / strength
    telling = (distances > 0.0) & (spread < MAX_SPREAD * distances) & (np.sum(moved * rays, axis=1) > 0.0)
    logs = np.log(distances[telling])
    if len(logs) < MIN_AGREEING:
        return None
    agree = np.abs(logs[:, None] - logs) <= WINDOW
    votes = agree.sum(axis=1)
    best = int(np.argmax(votes))
    rival = votes[np.abs(logs - logs[best]) > 3.0 * WINDOW].max(initial=0)
    if votes[best] < max(MIN_AGREEING, MIN_SHARE * len(logs), CLEARLY * rival):
        return None
    return float(np.exp(np.median(logs[agree[best]])))
