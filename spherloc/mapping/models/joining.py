"""Joins the maps that COLMAP left apart, by pairs of images with one in each, unless that makes a contradiction.

COLMAP adds an image to a map by the points that the map has of it. Through a door these are few, although the two
images have a hundred matches that fit. Such a pair and the distance between its images, which a few points of either
map tell, place one map in the other (see ``pair_evidence``).

One wrong pair, of places that look alike, would put a map into another room. There, images that stand side by side
hardly match (``model``), and the pair is refused. Which pairs are refused depends on what is joined before. So the
pairs with most matches come first, then each of those that joined maps is left out in turn, and of all results the one
with the largest maps is taken.
"""

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spherloc.mapping.models.later import with_images
from spherloc.mapping.models.model import Reconstruction, SeenPoints, contradictions, points_of
from spherloc.mapping.models.pair_evidence import PairEvidence, VerifiedPair
from spherloc.mapping.parallel import Tell
from spherloc.mapping.two_view.matched import Matched, Names
from spherloc.mapping.two_view.pairs import SURE
from spherloc.types import FloatArray

MIN_FITTING, LEAST, MOST = 20, 0.3, 0.6
"""Two maps are joined if so many matches between them fit, and the second share of those of the pair that joins them.
From the third share on it does not matter where in the view they lie."""
MIN_RADIUS_DEG, MIN_RADIUS_UNSURE_DEG = 65.0, 80.0
"""Else those of panoramas must not lie within a smaller part of it (``Between.radius_deg``), as those of one thing that
stands at two places do; the second if the pair is not sure."""
SURE_ALONE = 2.0 * SURE
"""Pairs of other images that are less sure join nothing."""
MAX_WORK = 1000
"""Joins are tried until the maps that were made for that have so many images together."""


def joined_by_pairs(
    models: Sequence[Reconstruction], matched: Matched, evidence: PairEvidence, tell: Tell
) -> tuple[Reconstruction, ...]:
    """Models of which some are joined with each other or with images that are in none, the largest first."""
    placed = {name for one in models for name in one.poses}
    if len(models) == 1 and len(placed) == len(matched.ids):
        return tuple(models)
    found = _best(_JoinSearch(models, matched.ids.keys() - placed, evidence, tell))
    before = {frozenset(one.poses): one for one in models}
    made = [before.get(frozenset(one.poses)) or _with_counts(one, models[0].all_matches) for one in found.models]
    return tuple(sorted(made, key=lambda one: -len(one.poses)))


def _with_counts(made: Reconstruction, every: NDArray[np.int64]) -> Reconstruction:
    """A joined model with the matches (V, V) of the other images, too."""
    outside = [name not in made.poses for name in made.ids]
    return replace(made, all_matches=np.where(np.logical_or.outer(outside, outside), every, made.all_matches))


def _best(search: "_JoinSearch") -> "_Result":
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


class _JoinSearch:
    def __init__(
        self, models: Sequence[Reconstruction], alone: Collection[str], evidence: PairEvidence, tell: Tell
    ) -> None:
        self._evidence, self._tell, self._work = evidence, tell, 0
        self._models, self._alone = [self._judged(one) for one in models], frozenset(alone)
        pairs = [pair for pair in evidence.pairs if evidence.panoramas or pair.sureness >= SURE_ALONE]
        self._pairs = sorted(pairs, key=lambda pair: (-evidence.strength(pair), pair.names))
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
            if _size(model_of.get(pair.names[0])) < _size(model_of.get(pair.names[1])):
                pair = pair.turned_round()
            whole, other = (model_of.get(name) for name in pair.names)
            if whole is None or whole is other or (other is None and pair.names[1] not in alone):
                continue
            joint = self._joint(whole, other, pair)
            if joint is not None:
                result.models[:] = [joint if one is whole else one for one in result.models if one is not other]
                result.joins.append(pair.names)
                alone.discard(pair.names[1])
                return True
        return False

    def _joint(self, whole: Reconstruction, other: Reconstruction | None, pair: VerifiedPair) -> Reconstruction | None:
        """A model joined with another one, or with the second image; None if it cannot be or contradicts itself."""
        state = pair.names, frozenset(whole.poses), frozenset(() if other is None else other.poses)
        if state in self._known:
            return self._known[state]
        self._known[state] = None
        moved = self._moved(whole, other, pair)
        if moved is None or self._work >= MAX_WORK or not self._allowed(whole, other, pair, moved):
            return None
        self._work += len(whole.poses) + len(moved.poses)
        self._tell("joins of maps tried", len(self._known), len(self._known))
        joint = with_images(replace(whole, model=copy.deepcopy(whole.model)), moved.poses)
        between = self._evidence.between(joint.poses, moved.poses, whole.poses)
        joint = replace(joint, all_matches=between.added_to(_counts(whole, other), whole.ids)).judged()
        against = {*joint.contradictions, *self._evidence.misplaced(joint.poses)}
        if not against - _contradictions(whole, other):
            joints = (*whole.joints, pair.names, *other.joints) if other is not None else whole.joints
            self._known[state] = replace(joint, joints=joints)
        return self._known[state]

    def _moved(self, whole: Reconstruction, other: Reconstruction | None, pair: VerifiedPair) -> "_Moved | None":
        """What a pair adds to a model that has its first image: a model with the second, or that image; None if the
        distance between the two is not known."""
        first, second = pair.names
        distance = self._evidence.distance(whole, pair)
        if distance is None:
            return None
        rotation = pair.rotation @ whole.poses[first][:, :3]
        shift = pair.rotation @ whole.poses[first][:, 3] + distance * pair.direction
        if other is None:
            return _Moved({second: np.column_stack([rotation, shift])}, {second: SeenPoints.of(whole.model, ())})
        other_distance = self._evidence.distance(other, pair.turned_round())
        if other_distance is None:
            return None
        scale = distance / other_distance
        turn = other.poses[second][:, :3].T @ rotation
        move = other.poses[second][:, :3].T @ (shift - scale * other.poses[second][:, 3])
        poses = {
            name: np.column_stack([one[:, :3] @ turn, one[:, :3] @ move + scale * one[:, 3]])
            for name, one in other.poses.items()
        }
        points = {
            name: replace(seen, points=(scale * seen.points - move) @ turn)
            for name, seen in points_of(other.model).items()
        }
        return _Moved(poses, points)

    def _allowed(
        self, whole: Reconstruction, other: Reconstruction | None, pair: VerifiedPair, moved: "_Moved"
    ) -> bool:
        """Whether two models may be joined, as far as can be told before poses and points are adjusted."""
        poses = {**whole.poses, **moved.poses}
        between = self._evidence.between(poses, moved.poses, whole.poses)
        share = self._evidence.share(pair)
        if sum(between.counts.values()) < MIN_FITTING or share < LEAST:
            return False
        radius_deg = MIN_RADIUS_UNSURE_DEG if pair.sureness < SURE else MIN_RADIUS_DEG
        if self._evidence.panoramas and share < MOST and between.radius_deg < radius_deg:
            return False
        counts = between.added_to(_counts(whole, other), whole.ids)
        points = {**points_of(whole.model), **moved.points}
        return not set(contradictions(poses, list(whole.ids), counts, points)) - _contradictions(whole, other)

    def _judged(self, made: Reconstruction) -> Reconstruction:
        """A model with matches and contradictions by all matches that fit it."""
        between = self._evidence.between(made.poses, made.poses, made.poses)
        return replace(made, all_matches=between.added_to(np.zeros_like(made.all_matches), made.ids)).judged()


@dataclass(frozen=True, eq=False)
class _Moved:
    """Images that are added to a model, in its frame."""

    poses: Mapping[str, FloatArray]
    """(3, 4) by name."""
    points: Mapping[str, SeenPoints]
    """What each of them sees."""


def _size(made: Reconstruction | None) -> int:
    return 0 if made is None else len(made.poses)


def _counts(whole: Reconstruction, other: Reconstruction | None) -> NDArray[np.int64]:
    """Numbers of matches (V, V) within two models."""
    return whole.all_matches if other is None else whole.all_matches + other.all_matches


def _contradictions(whole: Reconstruction, other: Reconstruction | None) -> set[Names]:
    """Those that two models have before they are joined."""
    return {*whole.contradictions, *(() if other is None else other.contradictions)}
