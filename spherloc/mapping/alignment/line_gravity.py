"""Gravity of a map's photographs by their vertical lines, also where a headset or a car stores them sideways.

One image cannot tell whether it is upright: in rooms, horizontal edges meet as well as vertical ones. Several can: held
by one camera, vertical edges meet about where they did in the image before, and horizontal ones wherever it turned. In
the map, vertical edges of all images meet in one direction, and horizontal ones in two.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.frontend.gravity_from_lines import gravity_of_lines, image_lines, why_not_found
from spherloc.frontend.view import Gravity, View
from spherloc.geometry import DOWN, camera_centre
from spherloc.images import grey
from spherloc.mapping.parallel import Tell, as_completed
from spherloc.types import FloatArray

RIGHT = np.array([1.0, 0.0, 0.0])
MIN_IMAGES = 5
"""Least number of images that tell whether they are stored sideways."""
STEADY_DEG = 16.0
"""Gravity of an image is steady if it is this near to the middle of those of its camera: heads tilt."""
CLEAR = 0.25
"""If the shares of images that are steady upright and sideways differ by less, or those of the images that show edges
say the opposite, only the map tells which they are."""
AGREE_DEG = 3.0
"""Gravity of two images agrees in the map if it differs by less from the middle of all."""
CLEARLY_MORE = 1.25
"""Images are stored sideways if this many times more of them agree so than upright."""
FEW = 2
"""So many more are counted for a share, as a few images agree by chance."""
SAME_WAY, APART_WAYS = 0.8, 0.6
"""Lengths of the mean of directions that are about the same, and of such as are not."""
LEANING_DEG = 20.0
"""If images lean more than that in the median and would agree as well sideways, they may be stored sideways."""


@dataclass(frozen=True)
class GravityByLines:
    """What the vertical lines of images tell of gravity, by the name of the image: each is in one of both."""

    found: Mapping[str, Gravity]
    why_not: Mapping[str, str]
    """Why lines gave no gravity, in a part of a sentence such as "it has 3 straight edges, fewer than 5."."""
    sideways: bool = False
    """Whether the images are stored sideways: down is at their right or left."""
    unsure: bool = False
    """Whether the images alone do not tell that."""
    other: "GravityByLines | None" = None
    """What lines tell if it is the other way round; None if that is impossible."""

    @property
    def leans(self) -> bool:
        """Whether most images would lean much, more than people hold cameras."""
        angles = [np.degrees(np.arccos(np.clip(one.down @ DOWN, -1.0, 1.0))) for one in self.found.values()]
        return bool(angles) and float(np.median(angles)) > LEANING_DEG

    def in_maps(self, maps: Sequence[Mapping[str, FloatArray]], points: FloatArray) -> "GravityByLines":
        """This or the other way round, whichever agrees better in maps of images: poses (3, 4) by name, of each.

        Where images are stored sideways, down is their right or left, whichever has more ``points`` (N, 3) of the first
        map below the camera next to them: rooms and streets have more to see below. Images that lean are ``unsure`` if
        both ways agree.
        """
        if self.other is None:
            return replace(self, unsure=False)
        upright, sideways = sorted((replace(self, unsure=False, other=None), self.other), key=lambda one: one.sideways)
        (here, upright_share), (there, sideways_share) = upright._agreeing(maps), sideways._agreeing(maps)
        if there >= MIN_IMAGES and there > CLEARLY_MORE * here and sideways_share > upright_share:
            return sideways._turned_down(maps[0], points)
        return replace(upright, unsure=there > here / CLEARLY_MORE and upright.leans)

    def _agreeing(self, maps: Sequence[Mapping[str, FloatArray]]) -> tuple[int, float]:
        """Number of images whose gravity is about the middle of all in their map, and their share: a low one, however
        many they are, is that of horizontal edges, such as those of paving stones."""
        agreeing = count = 0
        for poses in maps:
            downs = self._downs(poses)
            if downs:
                near = np.stack(downs) @ middle(np.stack(downs)) > np.cos(np.radians(AGREE_DEG))
                agreeing, count = agreeing + int(np.count_nonzero(near)), count + len(downs)
        return agreeing, agreeing / (count + FEW)

    def _downs(self, poses: Mapping[str, FloatArray]) -> list[FloatArray]:
        return [poses[name][:, :3].T @ one.down for name, one in self.found.items() if name in poses]

    def _turned_down(self, poses: Mapping[str, FloatArray], points: FloatArray) -> "GravityByLines":
        if share_below(poses, points, middle(np.stack(self._downs(poses)))) >= 0.5:
            return self
        return replace(self, found={name: replace(one, down=-one.down) for name, one in self.found.items()})


def share_below(poses: Mapping[str, FloatArray], points: FloatArray, down: FloatArray) -> float:
    """Share of points (N, 3) that are below the camera next to them, of poses (3, 4); ``down`` is a vector (3,)."""
    centres = np.stack([camera_centre(pose) for pose in poses.values()])
    return float(np.mean((points - centres[KDTree(centres).query(points)[1]]) @ down > 0.0))


def gravity_by_lines(
    views: Sequence[View],
    tell: Tell,
    stated: Mapping[str, Gravity] | None = None,
    body_from_camera: Mapping[str, FloatArray] | None = None,
) -> GravityByLines:
    """Gravity of those images whose vertical lines show it, and the reasons of the others.

    It is searched below, but where images of the same camera have ``stated`` gravity, around that. If none has, and
    none is a panorama, images may be stored sideways, unless how their cameras are fixed to each other
    (``body_from_camera`` (4, 4), by the name of the image) says that they are not. ``tell`` is called after each image.
    """
    todo = [view for view in views if view.name not in (stated or {})]
    near = _stated_directions(views, stated or {})
    ways: dict[str, tuple[Gravity | str, Gravity | str]] = {}

    def measure(view: View) -> tuple[Gravity | str, Gravity | str]:
        down = near.get(repr(view.camera), DOWN)
        try:
            lines = image_lines(grey(view.read()), view.camera, view.usable_pixels())
        except InputError as error:
            return str(error), str(error)

        def found(direction: FloatArray) -> Gravity | str:
            try:
                return gravity_of_lines(lines, direction, view.name)
            except InputError as error:
                return why_not_found(str(error)) or str(error)

        return found(down), found(RIGHT)

    for done, (view, both) in enumerate(as_completed(measure, todo), start=1):
        ways[view.name] = both
        tell("images searched for vertical lines", done, len(todo))
    upright, sideways = ({view.name: ways[view.name][way] for view in todo} for way in (0, 1))
    free = [v for v in todo if repr(v.camera) not in near and not isinstance(v.camera, Equirectangular)]
    if not free or len(free) < len(todo) or upright_in_body(list((body_from_camera or {}).values())):
        return _told(upright, sideways=False)
    more, better = _steady_shares(free, sideways) - _steady_shares(free, upright)
    one, other = _told(upright, sideways=False), _told(sideways, sideways=True)
    if len(free) < MIN_IMAGES:
        return replace(one, unsure=one.leans, other=other)
    if more <= -CLEAR and better < 0.0:
        return replace(one, other=other)
    told = more >= CLEAR and better > 0.0
    return replace(other, other=one) if told else replace(one, unsure=True, other=other)


def upright_in_body(body_from_camera: Sequence[FloatArray]) -> bool:
    """Whether cameras that are fixed to each other, (4, 4) each, are upright or all upside down: what is below in their
    images is about the same direction then, and what is at their right is not."""
    if not body_from_camera:
        return False
    rotations = np.unique(np.round([one[:3, :3] for one in body_from_camera], 3), axis=0)
    below, right = (float(np.linalg.norm(np.mean(rotations @ axis, axis=0))) for axis in (DOWN, RIGHT))
    return below >= SAME_WAY and right <= APART_WAYS


def _told(found: Mapping[str, Gravity | str], *, sideways: bool) -> GravityByLines:
    """Gravity and reasons, by the name of the image."""
    return GravityByLines(
        {name: one for name, one in found.items() if isinstance(one, Gravity)},
        {name: one for name, one in found.items() if isinstance(one, str)},
        sideways,
    )


def _stated_directions(views: Sequence[View], stated: Mapping[str, Gravity]) -> dict[str, FloatArray]:
    """Unit vectors (3,) of the mean stated gravity by camera."""
    sums: dict[str, FloatArray] = {}
    for view in views:
        if view.name in stated:
            key = repr(view.camera)
            sums[key] = sums.get(key, np.zeros(3)) + stated[view.name].down
    return {key: total / np.linalg.norm(total) for key, total in sums.items() if np.linalg.norm(total) > 0.0}


def _of(views: Collection[View], found: Mapping[str, Gravity | str]) -> dict[str, Gravity]:
    """What was found of these views."""
    return {view.name: one for view in views if isinstance(one := found[view.name], Gravity)}


def _steady_shares(views: Collection[View], found: Mapping[str, Gravity | str]) -> FloatArray:
    """Shares (2,) of images whose gravity is about that of the others of their camera: of the views, and of those in
    which gravity was found."""
    by_camera: dict[str, list[View]] = defaultdict(list)
    for view in views:
        by_camera[repr(view.camera)].append(view)
    steady = count = 0
    for own in by_camera.values():
        downs = [one.down for one in _of(own, found).values()]
        if downs:
            steady += np.count_nonzero(np.stack(downs) @ middle(np.stack(downs)) > np.cos(np.radians(STEADY_DEG)))
        count += len(downs)
    return np.array([steady / max(1, len(views)), steady / (count + FEW)])


def middle(directions: FloatArray) -> FloatArray:
    """The unit vector with the least sum of distances to unit vectors (N, 3): Weiszfeld's iteration."""
    found = directions.mean(axis=0)
    for _ in range(50):
        weights = 1.0 / np.maximum(np.linalg.norm(directions - found, axis=1), 1e-9)
        found = weights @ directions / weights.sum()
    return found / max(float(np.linalg.norm(found)), 1e-12)
