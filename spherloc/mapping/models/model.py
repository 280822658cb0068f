"""A model that COLMAP made, where it contradicts itself, and the parts into which it is then cut.

Places that look alike (two hotel rooms, a row of houses) give wrong matches that fit a pose. A map that takes such
places for one puts photographs next to each other that have hardly a match, or hardly see each other's points, although
nothing is between them: a contradiction. The map is then cut where fewest matches connect it.
"""

import copy
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from spherloc.geometry import camera_centre
from spherloc.types import FloatArray

NEARBY, NEAR = 2, 3.0
"""Number of nearest images in the map that should match an image, if they are at most that many times as far from each
other as each is from its nearest one: of three photographs of a walk the first and the last need not match."""
MIN_SUPPORT = 0.15
"""Least number of matches of two nearby images, as a share of those of either image's best pair; fewer contradict."""
SIGHT_RAD, SIGHT_POINTS, SIGHT_FACTOR = np.radians(25.0), 8, 1.2
"""An image sees past another camera if it has at least the second number of points within the first angle around the
direction of that camera, and half of them are farther away than the camera by the third factor."""
OPPOSED_RAD = np.radians(120.0)
"""Images of two fisheyes whose optical axes differ by more see hardly the same things and need not match: that of the
front camera of a robot and, a moment later, that of the one at its back, which then stands right before it. Of one
camera they are compared all the same: images in a room that only looks like theirs are found out by that."""
SAME_VIEW_RAD, SAME_VIEW_DEPTH = np.radians(15.0), 1.5
"""Two panoramas should see a point alike if the rays to it differ by less, and its distances by a smaller factor."""
SAME_VIEW_POINTS, SAME_VIEW_NEAR, MIN_SEEN = 100, 1.5, 0.1
"""Two panoramas contradict each other, too, if they should see so many points alike and less than that share of them
are seen in both, where they are at most that many times as far from each other as from their nearest images. A piece of
furniture that stands at two places gives many matches, but what is around it does not match. Of fisheyes that look
aside, right neighbours may see as little of each other's points."""
EXPECTED_SEEN = 8, 20
"""So many of so many points are added to those that two images see, and should see, alike: where a map is cut, few
points say little."""
NEAR_SEEN, MIN_DISTANCE = 2, 0.1
"""A point that so many images see is wrong if one of them is nearer than that share of the distance (median) of what
it sees: nobody holds a camera so close to things."""
COST_OF_CONTRADICTION = 4.0
"""Weight of the share of contradictions when two maps are compared by their share of images."""


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of a model that an image sees."""

    ids: NDArray[np.int64]
    """(K,) their ids in the model."""
    points: FloatArray
    """(K, 3) their positions."""

    @staticmethod
    def of(model: Any, ids: Collection[int]) -> "SeenPoints":
        """The points ``ids`` of a model."""
        found = np.array([model.point3D(int(one)).xyz for one in ids], np.float64).reshape(-1, 3)
        return SeenPoints(np.array(list(ids), np.int64), found)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A model that COLMAP could make."""

    model: Any
    """``pycolmap.Reconstruction``."""
    poses: dict[str, FloatArray]
    """Poses (3, 4) from the model's frame, which has no scale and no up, by name of a registered image."""
    matches: NDArray[np.int64]
    """(V, V) number of matches of each pair of images after the two-view check."""
    contradictions: tuple[tuple[str, str], ...]
    """Names of pairs of images that the model puts next to each other and in sight of each other, but that hardly
    match."""
    all_matches: NDArray[np.int64]
    """(V, V) like ``matches``, but with pairs of images that were taken from one place."""
    database: Path
    """COLMAP's database with features and matches of all images."""
    ids: dict[str, int]
    """Ids of all images in the database, by name."""
    joined: bool = False
    """Whether maps of single cameras were joined by the images that these took together (``rig``)."""
    joints: tuple[tuple[str, str], ...] = ()
    """Names of the pairs of images each of which alone joins two parts of the model (``joining``)."""
    unsure: bool = False
    """Whether it is made of pairs of images that are not sure, as none is (``ImagePairs.sureness``)."""

    def without(self, names: Collection[str]) -> "Reconstruction":
        """The model without the images ``names``, and without points that fewer than two of the other images see."""
        for number in list(self.model.reg_image_ids()):
            image = self.model.image(number)
            if image.name in names:
                self.model.deregister_frame(image.frame_id)
        poses = {name: pose for name, pose in self.poses.items() if name not in names}
        against = tuple(pair for pair in self.contradictions if not set(pair) & set(names))
        return replace(self, poses=poses, contradictions=against)

    def without_near_points(self) -> "Reconstruction":
        """The model without points that only two images see, and that are much nearer to one of them than its others:
        a wrong match of two images that were taken close to each other gives such a point."""
        centres = {number: self.model.image(number).projection_center() for number in self.model.reg_image_ids()}
        far: dict[int, list[float]] = {number: [] for number in centres}
        pairs: dict[int, dict[int, float]] = {}
        for key, point in self.model.points3D.items():
            images = [one.image_id for one in point.track.elements]
            away = {number: float(np.linalg.norm(point.xyz - centres[number])) for number in images}
            for number, distance in away.items():
                far[number].append(distance)
            if len(images) == NEAR_SEEN:
                pairs[key] = away
        usual = {number: float(np.median(found)) for number, found in far.items() if found}
        for key, away in pairs.items():
            if any(distance < MIN_DISTANCE * usual[number] for number, distance in away.items()):
                self.model.delete_point3D(key)
        return self

    def judged(self) -> "Reconstruction":
        """The model with its contradictions computed anew."""
        seen, panoramas = points_of(self.model), panoramas_of(self.model)
        lenses = {one.name: one.camera_id for one in registered(self.model) if one.name not in panoramas}
        against = contradictions(self.poses, list(self.ids), self.all_matches, seen, panoramas, lenses)
        return replace(self, contradictions=against)

    def points(self) -> FloatArray:
        """Positions (N, 3) of the points in the model's present frame."""
        return np.array([point.xyz for point in self.model.points3D.values()]).reshape(-1, 3)

    def depths(self) -> FloatArray:
        """Distance (N,) of each point to an image that sees it, in units of the model's present frame."""
        centres = {number: self.model.image(number).projection_center() for number in self.model.reg_image_ids()}
        points = self.model.points3D.values()
        seen_from = [centres[point.track.elements[0].image_id] for point in points]
        return np.linalg.norm(self.points() - np.reshape(seen_from, (-1, 3)), axis=1)


def parted(made: Reconstruction, misplaced: Collection[tuple[str, str]] = ()) -> list[Reconstruction]:
    """The model cut until no two images contradict each other: parts of two images or more, the largest first.

    Pairs whose matches do not fit the poses at all, the ``misplaced``, contradict, too, and hold no parts together.

    A contradiction says that two images do not belong next to each other, so somewhere between them the model takes two
    similar places for one. The cut that separates the two images with the fewest matches is made there; matches count
    less where the two images see little of what both should see.
    """
    against = {*map(_sorted, made.contradictions), *map(_sorted, misplaced)}
    if not against:
        return [made]
    place = {name: index for index, name in enumerate(made.ids)}
    points, panoramas = points_of(made.model), panoramas_of(made.model)
    graph = nx.Graph()
    graph.add_nodes_from(made.poses)
    for pair in combinations(made.poses, 2):
        matches = int(made.all_matches[place[pair[0]], place[pair[1]]])
        if matches and pair not in misplaced and pair[::-1] not in misplaced:
            share = 1.0
            if panoramas.issuperset(pair):
                alike, both = _seen_alike(made.poses, points, pair)
                share = (both + EXPECTED_SEEN[0]) / (alike + EXPECTED_SEEN[1])
            graph.add_edge(*pair, capacity=round(100 * matches * share))
    if (alone := _contradicted_end(graph, made.contradictions)) is not None:
        return parted(made.without({alone}).judged())
    cuts = [nx.minimum_cut(graph, *pair) for pair in sorted(against)]
    _, (first, second) = min(cuts, key=lambda cut: cut[0])
    parts = []
    for side in (first, second):
        if len(made.poses.keys() - side) > 1:
            part = replace(made, model=copy.deepcopy(made.model)).without(side)
            parts += parted(part.judged())
    return sorted(parts, key=lambda part: -len(part.poses))


def _contradicted_end(matched: nx.Graph, contradictions: Sequence[tuple[str, str]]) -> str | None:
    """An image that only one other image matches, and which several others contradict, but nothing else."""
    graph = nx.Graph(contradictions)
    ends = [name for name in sorted(graph) if matched.degree[name] == 1 and graph.degree[name] > 1]
    return next((name for name in ends if all(graph.degree[other] == 1 for other in graph[name])), None)


def _sorted(pair: tuple[str, str]) -> tuple[str, str]:
    return (min(pair), max(pair))


def untangled(made: Sequence[Reconstruction]) -> tuple[Reconstruction, ...]:
    """The models without images that have more matches with those of another one, the largest first.

    Models that share images and yet could not be joined take two places for one somewhere. A shared image belongs to
    the model with which it has most matches, of those alike to the first.
    """
    if len(made) < 2:
        return tuple(made)
    place = {name: index for index, name in enumerate(made[0].ids)}
    members = [set(one.poses) for one in made]
    changed = True
    while changed:
        changed = False
        for name in place:
            ties = [
                int(made[0].all_matches[place[name], [place[one] for one in group - {name}]].sum()) for group in members
            ]
            held = [group for group, tie in zip(members, ties, strict=True) if tie == max(ties) and name in group]
            for group in members:
                if name in group and group is not next(iter(held), None):
                    group.remove(name)
                    changed = True
    left = [one.without(one.poses.keys() - group) for one, group in zip(made, members, strict=True) if len(group) > 1]
    return tuple(sorted(left, key=lambda one: -len(one.poses)))


def worth(made: Reconstruction) -> float:
    """Number of images, less the more of them contradict each other."""
    share = len(made.contradictions) / (NEARBY * len(made.poses))
    return len(made.poses) * (1.0 - COST_OF_CONTRADICTION * share)


def contradictions(
    poses: Mapping[str, FloatArray],
    names: Sequence[str],
    counts: NDArray[np.int64],
    points: Mapping[str, SeenPoints],
    panoramas: Collection[str] = (),
    lenses: Mapping[str, Hashable] = MappingProxyType({}),
) -> tuple[tuple[str, str], ...]:
    """Pairs of neighbouring images of ``poses``, in sight of each other, that hardly match or, of ``panoramas``, hardly
    see each other's points.

    ``counts`` (V, V) are the numbers of matches of all ``names``, ``points`` what each image sees, ``lenses`` which
    camera took it, of those that look to one side: images of two cameras that look opposite ways need not match.
    """
    inside = [index for index, name in enumerate(names) if name in poses]
    centres = np.stack([camera_centre(poses[names[index]]) for index in inside])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.min(axis=1)
    best = counts.max(axis=1)
    around = np.array([names[index] in panoramas for index in inside])
    beside = around & around[:, None] & (apart <= SAME_VIEW_NEAR * np.maximum(nearest[:, None], nearest))
    found = []
    for row, index in enumerate(inside):
        nearby = np.argsort(apart[row])[: min(NEARBY, len(inside) - 1)].tolist()
        for place in dict.fromkeys((*nearby, *(row + np.flatnonzero(beside[row, row:])).tolist())):
            other = inside[place]
            pair = names[index], names[other]
            hardly_match = (
                place in nearby
                and apart[row, place] <= NEAR * min(nearest[row], nearest[place])
                and counts[index, other] < MIN_SUPPORT * min(best[index], best[other])
                and not _opposed(poses, lenses, pair)
            )
            side_by_side = row < place and beside[row, place]
            if not hardly_match and not side_by_side:
                continue
            here, there = centres[row], centres[place]
            past = _sees_past(points[pair[0]].points, here, there), _sees_past(points[pair[1]].points, there, here)
            unseen = side_by_side and True in past and False not in past and _see_others(poses, points, pair)
            if unseen or (hardly_match and all(past)):
                found.append(pair)
    return tuple(found)


def _opposed(poses: Mapping[str, FloatArray], lenses: Mapping[str, Hashable], pair: tuple[str, str]) -> bool:
    """Whether two images are of two cameras, and their optical axes go opposite ways."""
    if not lenses.keys() >= set(pair) or lenses[pair[0]] == lenses[pair[1]]:
        return False
    one, other = (poses[name][2, :3] for name in pair)
    return float(one @ other) < np.cos(OPPOSED_RAD)


def _see_others(poses: Mapping[str, FloatArray], points: Mapping[str, SeenPoints], pair: tuple[str, str]) -> bool:
    """Whether two panoramas see hardly any of the points of each other that they should see alike."""
    alike, both = _seen_alike(poses, points, pair)
    return alike >= SAME_VIEW_POINTS and both < MIN_SEEN * alike


def _seen_alike(
    poses: Mapping[str, FloatArray], points: Mapping[str, SeenPoints], pair: tuple[str, str]
) -> tuple[int, int]:
    """How many of the points of either of two panoramas both should see alike, and how many of these both see."""
    alike = both = 0
    for one, other in (pair, pair[::-1]):
        rays = points[one].points - camera_centre(poses[one])
        other_rays = points[one].points - camera_centre(poses[other])
        ranges, other_ranges = np.linalg.norm(rays, axis=1), np.linalg.norm(other_rays, axis=1)
        same = np.sum(rays * other_rays, axis=1) >= np.cos(SAME_VIEW_RAD) * ranges * other_ranges
        same &= np.maximum(ranges, other_ranges) <= SAME_VIEW_DEPTH * np.minimum(ranges, other_ranges)
        alike += int(np.count_nonzero(same))
        both += int(np.count_nonzero(same & np.isin(points[one].ids, points[other].ids)))
    return alike, both


def _sees_past(points: FloatArray, centre: FloatArray, other: FloatArray) -> bool | None:
    """Whether the points (K, 3) that a camera at ``centre`` sees in the direction of another camera lie behind it; None
    if it sees too few there.

    With a wall between the two cameras they would lie in front of it; such cameras need not match.
    """
    rays, way = points - centre, other - centre
    depth, distance = np.linalg.norm(rays, axis=1), float(np.linalg.norm(way))
    near = rays @ way > np.cos(SIGHT_RAD) * depth * distance
    if np.count_nonzero(near) < SIGHT_POINTS:
        return None
    return bool(np.median(depth[near]) > SIGHT_FACTOR * distance)


def points_of(model: Any) -> dict[str, SeenPoints]:
    """The points that each image of a model sees, by its name."""
    found = {}
    for image in registered(model):
        ids = [point.point3D_id for point in image.points2D if point.has_point3D()]
        found[image.name] = SeenPoints.of(model, ids)
    return found


def panoramas_of(model: Any) -> set[str]:
    """Names of the images of a model that see all around."""
    return {image.name for image in registered(model) if image.camera.model.name == "EQUIRECTANGULAR"}


def poses_of(model: Any) -> dict[str, FloatArray]:
    """Poses (3, 4) from a model's frame of the images that have one, by name."""
    return {image.name: np.asarray(image.cam_from_world().matrix()) for image in registered(model)}


def registered(model: Any) -> list[Any]:
    """The images of a model that have a pose."""
    return [model.image(number) for number in model.reg_image_ids()]
