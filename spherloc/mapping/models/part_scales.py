"""Parts of a map that have the right shape, but not the same scale.

COLMAP adds an image by fifteen matches with points of the map. Through a door these may be few and wrong: the pair of
images tells the direction of the new one, but wrong points put it at ten times the distance, and all images that are
added after it have ten times the scale. In such a map all pairs of images fit.

Two parts share a scale through points that two images of one part and an image of the other see. Where few such points
are in the model, all matches of the pairs between the parts are asked for the distance. If they agree on another one,
one part is scaled to the other.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import camera_centre, transform
from spherloc.mapping.models.later import with_images
from spherloc.mapping.models.misplaced import fits
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.models.pair_evidence import (
    MIN_AGREEING,
    MIN_SHARE,
    WINDOW,
    PairEvidence,
    VerifiedPair,
    agreed_distance,
    distances_of,
)
from spherloc.mapping.two_view.matched import Names
from spherloc.mapping.two_view.pairs import SURE
from spherloc.types import BoolArray, FloatArray

ENOUGH = 30
"""An image has the scale of a part if it sees so many points that two images of the part see."""
ALIGNED_RAD = np.radians(10.0)
"""A pair tells a distance if its direction differs by no more from that in the map."""


def with_one_scale(made: Reconstruction, evidence: PairEvidence) -> Reconstruction:
    """The model with its parts scaled to each other where matches agree that they are not."""
    for _ in range(len(made.poses)):
        found = _other_scale(made, evidence)
        if found is None:
            break
        fixed, poses = camera_centre(made.poses[found.pair[0]]), dict[str, FloatArray]()
        for name in found.names:
            rotation, centre = made.poses[name][:, :3], camera_centre(made.poses[name])
            poses[name] = np.column_stack([rotation, -rotation @ (fixed + found.factor * (centre - fixed))])
        made = with_images(made.without(found.names), poses)
        made = replace(made, joints=(*made.joints, found.pair))
    return made


@dataclass(frozen=True)
class _OtherScale:
    """Images that must be scaled."""

    pair: Names
    """An image of the rest, from which they are scaled, and that of them which is tied to it."""
    names: set[str]
    factor: float


def _other_scale(made: Reconstruction, evidence: PairEvidence) -> _OtherScale | None:
    """The part of a model that has another scale; None if it has one scale as far as matches tell."""
    if len(made.poses) < 3:
        return None
    seen = _Seen(made, evidence)
    part = seen.grown(seen.first_pair(), made.poses)
    while len(part) < len(made.poses):
        name = seen.next_of(part)
        logs = seen.logs(part, {name})
        if _confirmed(logs):
            part = seen.grown({*part, name}, made.poses)
            continue
        pivot = seen.partner(name, part)
        if pivot is not None:
            other = seen.grown({pivot, name}, {*(made.poses.keys() - part), pivot}) - {pivot}
            logs = np.concatenate([seen.logs(part, other), -seen.logs({*other, pivot}, part - {pivot})])
            factor = agreed_distance(logs)
            if factor is not None and abs(np.log(factor)) > 3.0 * WINDOW and not _confirmed(logs):
                return _OtherScale((pivot, name), other, factor)
        part = seen.grown({*part, name}, made.poses)
    return None


def _confirmed(logs: FloatArray) -> bool:
    """Whether enough of the distances, as logarithms (T,) of their ratio to that in the map, are that of the map."""
    same = np.count_nonzero(np.abs(logs) <= WINDOW)
    return bool(same >= max(MIN_AGREEING, MIN_SHARE * len(logs)))


class _Seen:
    """Which images of a model see which of its points."""

    def __init__(self, made: Reconstruction, evidence: PairEvidence) -> None:
        self._poses, self._names = made.poses, sorted(made.poses)
        self._place = {name: place for place, name in enumerate(self._names)}
        name_of = {made.ids[name]: name for name in self._names}
        rows = [
            (number, self._place[name_of[one.image_id]], one.point2D_idx)
            for number, point in enumerate(made.model.points3D.values())
            for one in point.track.elements
        ]
        self._point, self._image, self._feature = np.array(rows, np.int64).reshape(-1, 3).T
        self._count = len(made.model.points3D)
        self._point_of = {name: np.full(len(evidence.bearings[name]), -1) for name in self._names}
        self._rays = np.empty((len(rows), 3))
        for place, name in enumerate(self._names):
            own = self._image == place
            self._point_of[name][self._feature[own]] = self._point[own]
            self._rays[own] = evidence.bearings[name][self._feature[own]] @ made.poses[name][:, :3]
        self._bearings = evidence.bearings
        self._pairs = [pair for pair in evidence.pairs if self._fits(pair)]

    def _fits(self, pair: VerifiedPair) -> bool:
        """Whether a pair is sure and has the rotation and direction of the map."""
        if pair.sureness < SURE or not set(pair.names) <= self._poses.keys():
            return False
        one, other = (self._poses[name] for name in pair.names)
        way = other[:, 3] - other[:, :3] @ one[:, :3].T @ one[:, 3]
        aligned = way @ pair.direction >= np.cos(ALIGNED_RAD) * np.linalg.norm(way)
        return bool(aligned) and fits(one, other, pair.rotation)

    def _held(self, part: Collection[str]) -> BoolArray:
        """Which points (P,) two images of a part see, or more."""
        inside = np.isin(self._names, list(part))[self._image]
        return np.bincount(self._point[inside], minlength=self._count) >= 2

    def _bonds(self, part: Collection[str]) -> NDArray[np.int64]:
        """How many points that two images of a part see each image (V,) sees."""
        return np.bincount(self._image[self._held(part)[self._point]], minlength=len(self._names))

    def first_pair(self) -> set[str]:
        """The two images that see most points together."""
        seen = np.zeros((len(self._names), self._count), np.float32)
        seen[self._image, self._point] = 1.0
        common = np.triu(seen @ seen.T, 1)
        return {self._names[place] for place in np.unravel_index(int(np.argmax(common)), common.shape)}

    def grown(self, part: set[str], allowed: Collection[str]) -> set[str]:
        """A part with those of the images ``allowed`` that surely have its scale."""
        while True:
            bonds = self._bonds(part)
            more = {name for name in allowed if name not in part and bonds[self._place[name]] >= ENOUGH}
            if not more:
                return part
            part = part | more

    def next_of(self, part: Collection[str]) -> str:
        """The image outside a part that sees most of its points."""
        bonds = self._bonds(part)
        return max((name for name in self._names if name not in part), key=lambda name: int(bonds[self._place[name]]))

    def partner(self, name: str, part: Collection[str]) -> str | None:
        """The image of a part that has most matches with another image; None without any."""
        matches = {one: len(pair.matches) for pair in self._pairs for one in _others(pair.names, name) if one in part}
        return max(matches, key=lambda one: (matches[one], one), default=None)

    def logs(self, part: Collection[str], others: Collection[str]) -> FloatArray:
        """Logarithms (T,) of the distances of other images from those of a part by the points of that part, each
        relative to the distance in the map."""
        held, inside = self._held(part), np.isin(self._names, list(part))[self._image]
        points = self._triangulated(held[self._point] & inside)
        found = [np.empty(0)]
        for pair in self._pairs:
            for one in (pair, pair.turned_round()):
                if one.names[0] in part and one.names[1] in others:
                    number = self._point_of[one.names[0]][one.matches[:, 0]]
                    used = (number >= 0) & held[number]
                    pose, other = (self._poses[name] for name in one.names)
                    own = transform(pose, points[number[used]])
                    rays = self._bearings[one.names[1]][one.matches[used, 1]]
                    apart = np.linalg.norm(camera_centre(pose) - camera_centre(other))
                    found.append(np.log(distances_of(own, rays, one.rotation, one.direction) / apart))
        return np.concatenate(found)

    def _triangulated(self, used: BoolArray) -> FloatArray:
        """Points (P, 3) nearest to the rays of some observations (M,); at the origin without any."""
        centres = np.array([camera_centre(self._poses[name]) for name in self._names])[self._image[used]]
        rays = self._rays[used]
        across = np.eye(3) - rays[:, :, None] * rays[:, None]
        matrices, sums = np.tile(1e-9 * np.eye(3), (self._count, 1, 1)), np.zeros((self._count, 3))
        np.add.at(matrices, self._point[used], across)
        np.add.at(sums, self._point[used], np.einsum("kij,kj->ki", across, centres))
        return np.asarray(np.linalg.solve(matrices, sums[:, :, None]), np.float64)[:, :, 0]


def _others(names: Names, name: str) -> list[str]:
    """The other image of a pair, if an image is in it."""
    return [one for one in names if one != name] if name in names else []
