"""Cameras that are fixed to each other: which images they took together, and maps that are joined by these.

Cameras that look to different sides hardly see the same things at the same time. What ties their images are matches of
later images, or wrong ones between places that look alike, so that a map of all may put one camera's images far from
those of the others. But all cameras go the same way: where the map of each camera by itself has the images that were
taken together, a similarity transform takes the way of one to that of the other.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.asl_layout import camera_of_folder
from spherloc.datasets.imu import time_in_name
from spherloc.datasets.query_gravity import time_of
from spherloc.frontend.view import View
from spherloc.geometry import align_to_down, camera_centre, inverse_pose, pose, rotation_angle, yaw_rotation
from spherloc.types import BoolArray, FloatArray

MIN_TOGETHER = 5
"""Least number of images that two cameras took together."""
SHARE_TOGETHER = 0.8
"""Least share of such images among those of the camera that has fewer."""
NEAR_IN_TIME = 0.25
"""Two images were taken together if their times differ by no more than this share of the time to the next image."""
MIN_FITTING = 0.6
"""Least share of the images taken together that a transform between two maps must fit."""
OFF, TURNED_RAD = 0.5, float(np.radians(5.0))
"""A pair of images taken together fits if it is no farther apart than this share of a step of the way, and if one
camera is turned against the other as in other pairs."""
ALIKE = 1.0 + 2.0 * float(np.cos(TURNED_RAD))
"""Least trace of a rotation by no more than that angle."""
MAX_TRIED = 150
"""Most times of which all pairs are tried, a second's work."""
MIN_WAY = 3.0
"""Least extent, in steps, of the way on which they fit."""
APART = 1.0
"""In a map that is wrong, images taken together are farther from each other than this many steps (median), and not as
two fixed cameras are."""

Shots = Mapping[str, tuple[str, int]]
"""By an image's name: its camera's name, and a number that all images taken together with it have."""

_NUMBERS = re.compile(r"\d{8}[_-]\d{6}(?:[_-]\d{3})?(?!\d)|\d+(?:\.\d+)?")
"""Numbers in a name; a date and a time of day, perhaps with milliseconds, are one."""
_CAMERA_NUMBER = re.compile(r"(?<![a-z])(?:camera|cam|fisheye|lens)[_-]?\d{1,2}$", re.IGNORECASE)
"""How what precedes the end of a number ends if it tells the camera: ``frame3_cam1``."""


@dataclass(frozen=True)
class Key:
    """What orders the images of a camera, and tells which were taken together."""

    number: float
    """A time in nanoseconds, or the longest number in a name but for that of its camera; -1 without one."""
    is_time: bool


def shots_of(views: Sequence[View]) -> Shots:
    """Camera and time step of the images of cameras that took most of their images together, as names and times in them
    or tables say; none if there are no two such cameras. A panorama sees all around and is left out."""
    return taken_together(_keys_of(views))


def taken_together(keys: Mapping[str, Mapping[str, Key]], least: int = MIN_TOGETHER) -> Shots:
    """Camera and time step of the images of those cameras that took most of their images together, ``least`` or more,
    by the keys of each camera's images by name."""
    numbers = {camera: images for camera, images in _numbers_of(keys).items() if len(images) >= least}
    if len(numbers) < 2:
        return {}
    steps = _steps_of(numbers)
    if len(steps) < least:
        return {}
    found: dict[str, tuple[str, int]] = {}
    for camera, together in _in_steps(numbers, steps, _room(steps)).items():
        count = len({step for _, step in together.values()})
        if count >= max(least, SHARE_TOGETHER * min(len(numbers[camera]), len(steps))):
            found.update(together)
    return found if len({camera for camera, _ in found.values()}) > 1 else {}


def _keys_of(views: Sequence[View]) -> dict[str, dict[str, Key]]:
    """The key of each image by its name, by its camera; panoramas are left out."""
    keys: dict[str, dict[str, Key]] = {}
    for view in views:
        if not isinstance(view.camera, Equirectangular):
            camera, key = camera_and_key(view.name, time_of(view))
            keys.setdefault(camera, {})[view.name] = key
    return keys


def _numbers_of(keys: Mapping[str, Mapping[str, Key]]) -> dict[str, dict[str, float]]:
    """The numbers or times of the images that have one."""
    return {
        camera: {name: key.number for name, key in images.items() if key.number >= 0.0}
        for camera, images in keys.items()
    }


def _steps_of(numbers: Mapping[str, Mapping[str, float]]) -> FloatArray:
    """Numbers or times (T,) of the camera with most images, growing."""
    return np.unique(list(max(numbers.values(), key=len).values()))


def _room(steps: FloatArray) -> float:
    """How far numbers or times of images that were taken together may differ where steps are these (T,)."""
    return NEAR_IN_TIME * float(np.median(np.diff(steps)))


def _in_steps(numbers: Mapping[str, Mapping[str, float]], steps: FloatArray, room: float) -> dict[str, Shots]:
    """Camera and time step of each image that is near enough to one, by the camera."""
    found: dict[str, Shots] = {}
    for camera, images in numbers.items():
        nearest = {name: _nearest(steps, number) for name, number in images.items()}
        found[camera] = {
            name: (camera, step) for name, step in nearest.items() if abs(steps[step] - images[name]) <= room
        }
    return found


def _nearest(steps: FloatArray, number: float) -> int:
    """Index of the nearest of growing ``steps`` (K,), the first of two."""
    after = min(int(np.searchsorted(steps, number)), len(steps) - 1)
    before = max(0, after - 1)
    return before if abs(steps[before] - number) <= abs(steps[after] - number) else after


def camera_and_key(name: str, time_ns: int | None = None) -> tuple[str, Key]:
    """The camera that a name tells, its folder or what is left of it without its longest number, and that number or
    the time that it is, if ``time_ns`` states no other. The number of a camera is not taken if there is another one."""
    path = PurePosixPath(name)
    time_ns = time_in_name(name) if time_ns is None else time_ns
    numbers = list(_NUMBERS.finditer(path.stem))
    others = [number for number in numbers if not _CAMERA_NUMBER.search(path.stem[: number.end()])]
    longest = max(others or numbers, key=lambda number: (len(number[0]), number.start()), default=None)
    folder = "" if path.parent == PurePosixPath(".") else str(path.parent)
    if path.parent.name != (camera := camera_of_folder(path.parent)):
        folder = camera
    rest = path.stem if longest is None else path.stem[: longest.start()] + path.stem[longest.end() :]
    number = -1.0 if longest is None else float(re.sub("[_-]", "", longest[0]))
    return folder or rest.strip("_-. "), Key(number if time_ns is None else float(time_ns), time_ns is not None)


def went_apart(poses: Mapping[str, FloatArray], shots: Shots) -> tuple[str, str] | None:
    """Two cameras that took images together, but went different ways in a map of ``poses`` (3, 4); None if there are
    none."""
    for first, second in combinations(sorted({camera for camera, _ in shots.values()}), 2):
        one, other = _together(poses, poses, shots, (first, second))
        if len(one) >= MIN_TOGETHER:
            here = _centres(one)
            apart = np.linalg.norm(here - _centres(other), axis=1)
            if np.median(apart) > APART * _step(here) and _relative(one, other) is None:
                return first, second
    return None


@dataclass(frozen=True, eq=False)
class Joint:
    """How the map of another camera joins a map."""

    poses: dict[str, FloatArray]
    """Poses (3, 4) of its images in the frame of the map, by name, but for those that do not fit."""
    misfits: frozenset[str]
    """Names of images of the map that were taken together with these; one of the two stands elsewhere, and it is not
    known which."""


def joint_of(
    poses: Mapping[str, FloatArray],
    others: Mapping[str, FloatArray],
    downs: tuple[FloatArray, FloatArray],
    shots: Shots,
) -> Joint | None:
    """How another map joins a map, by the two cameras of which most images fit; None if there are no such cameras.

    ``poses`` and ``others`` (3, 4) are those of both maps by name, ``downs`` (3,) gravity in either.
    """
    cameras = [sorted({shots[name][0] for name in one if name in shots}) for one in (poses, others)]
    most, best = 0, None
    to_level, other_to_level = (align_to_down(down) for down in downs)
    for first, second in product(*cameras):
        one, other = _together(poses, others, shots, (first, second))
        if first == second or len(one) < MIN_TOGETHER:
            continue
        fit = _fit(one @ _turned(to_level), other @ _turned(other_to_level))
        if fit is None or fit[3].sum() <= most:
            continue
        scale, turn, shift, fits = fit
        both = sorted(_steps(poses, shots, first).keys() & _steps(others, shots, second).keys())
        wrong = {both[k] for k in np.flatnonzero(~fits).tolist()}
        misfits = {name for name, (camera, step) in shots.items() if camera in (first, second) and step in wrong}
        moved = {}
        for name, there in others.items():  # in their order, on which COLMAP's map depends
            if name not in misfits:
                rotation = there[:, :3] @ other_to_level.T @ turn.T @ to_level
                centre = to_level.T @ (scale * turn @ other_to_level @ camera_centre(there) + shift)
                moved[name] = pose(rotation, -rotation @ centre)
        most, best = int(fits.sum()), Joint(moved, frozenset(misfits & poses.keys()))
    return best


def _turned(to_level: FloatArray) -> FloatArray:
    """What a pose (3, 4) is multiplied by (4, 4) for a map that is turned so."""
    turn = np.eye(4)
    turn[:3, :3] = to_level.T
    return turn


def _steps(poses: Mapping[str, FloatArray], shots: Shots, camera: str) -> dict[int, FloatArray]:
    """Poses (3, 4) of a camera's images by their time step."""
    return {shots[name][1]: one for name, one in poses.items() if name in shots and shots[name][0] == camera}


def _together(
    poses: Mapping[str, FloatArray], others: Mapping[str, FloatArray], shots: Shots, cameras: tuple[str, str]
) -> tuple[FloatArray, FloatArray]:
    """Poses (K, 3, 4) of the images that two cameras took together, those of the first and of the second, in the order
    of time."""
    here, there = _steps(poses, shots, cameras[0]), _steps(others, shots, cameras[1])
    both = sorted(here.keys() & there.keys())
    one, other = (np.array([poses[step] for step in both]).reshape(-1, 3, 4) for poses in (here, there))
    return one, other


def _centres(poses: FloatArray) -> FloatArray:
    """Camera centres (K, 3) of poses (K, 3, 4)."""
    return -np.einsum("kij,ki->kj", poses[:, :, :3], poses[:, :, 3])


def _step(centres: FloatArray) -> float:
    """Median distance between centres (K, 3) that follow each other."""
    return float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))


def _fit(one: FloatArray, other: FloatArray) -> tuple[float, FloatArray, FloatArray, BoolArray] | None:
    """Scale, rotation (3, 3) about the vertical and translation (3,) of a level map to another, from poses (K, 3, 4) in
    both of images that were taken together, and which of these fit (K,); None if too few do.

    All pairs of ``MAX_TRIED`` times are tried, each of which fixes a transform; then it is fitted to all that fit the
    best one.
    """
    here, there = _centres(one), _centres(other)
    step = _step(here)
    if step == 0.0:
        return None

    def fitting(transform: tuple[float, FloatArray, FloatArray], index: int) -> tuple[int, float, BoolArray]:
        """How many pairs fit, how well, and which (K,), with cameras turned against each other as at ``index``."""
        scale, turn, shift = transform
        off = np.linalg.norm(scale * there @ turn.T + shift - here, axis=1) / step
        fits = (off <= OFF) & _turned_alike(one, other @ _turned(turn), index)
        return int(fits.sum()), -float(off[fits].sum()), fits

    best, fits = (0, 0.0), np.zeros(len(here), np.bool_)
    tried = np.unique(np.linspace(0, len(here) - 1, min(len(here), MAX_TRIED)).round().astype(int)).tolist()
    for i, j in combinations(tried, 2):
        transform = _laid_over(here[[i, j]], there[[i, j]])
        if transform is not None and (found := fitting(transform, i))[:2] > best:
            best, fits = found[:2], found[2]
    if best[0] < 2 or (transform := _laid_over(here[fits], there[fits])) is None:
        return None
    count, _, fits = fitting(transform, int(np.argmax(fits)))
    enough = count >= max(MIN_TOGETHER, MIN_FITTING * len(here))
    return (*transform, fits) if enough and np.linalg.norm(np.ptp(here[fits], axis=0)) >= MIN_WAY * step else None


def _laid_over(here: FloatArray, there: FloatArray) -> tuple[float, FloatArray, FloatArray] | None:
    """Scale, rotation (3, 3) about the vertical and translation (3,) that take positions ``there`` (K, 3) closest to
    those ``here`` (K, 3); None if they do not fix them."""
    middle, other_middle = here.mean(axis=0), there.mean(axis=0)
    aimed, moved = here - middle, there - other_middle
    moment = np.sum((aimed[:, 2] + 1j * aimed[:, 0]) * (moved[:, 2] - 1j * moved[:, 0]))
    spread = float(np.sum(moved**2))
    if min(abs(moment), spread) < 1e-12:
        return None
    scale = float(abs(moment) + np.sum(aimed[:, 1] * moved[:, 1])) / spread
    turn = yaw_rotation(float(np.angle(moment)))
    return (scale, turn, middle - scale * turn @ other_middle) if scale > 0.0 else None


def _turned_alike(one: FloatArray, other: FloatArray, index: int) -> BoolArray:
    """Whether (K,) cameras of poses (K, 3, 4) are turned against each other as those of one pair are."""
    between = other[:, :, :3] @ one[:, :, :3].transpose(0, 2, 1)
    return np.einsum("kij,ij->k", between, between[index]) >= ALIKE


def one_camera(names: Sequence[str], shots: Shots) -> BoolArray:
    """Whether (V, V) two images are of one camera, as far as it is known which is whose."""
    cameras = [shots[name][0] if name in shots else "" for name in names]
    return np.array([[one == other for other in cameras] for one in cameras])


def with_ties(counts: NDArray[np.int64], names: Sequence[str], shots: Shots) -> NDArray[np.int64]:
    """Numbers of matches (V, V), in which images that were taken together have as many as either has with any other, so
    that they are never told apart for having none."""
    tied, best = counts.copy(), counts.max(axis=1)
    for one, other in combinations(range(len(names)), 2):
        first, second = shots.get(names[one]), shots.get(names[other])
        if first and second and first[1] == second[1]:
            tied[one, other] = tied[other, one] = max(best[one], best[other], tied[one, other])
    return tied


def words(poses: Mapping[str, FloatArray], shots: Shots) -> str:
    """The cameras of a map of ``poses`` (3, 4), and how often they took images together, in words."""
    inside = {name: shot for name, shot in shots.items() if name in poses}
    images = Counter(step for _, step in inside.values())
    cameras = sorted({camera for camera, _ in inside.values()})
    count = sum(images_then > 1 for images_then in images.values())
    return f"{', '.join(cameras[:-1])} and {cameras[-1]}, by {count} times at which they took images together"


def expected_poses(poses: Mapping[str, FloatArray], shots: Shots) -> dict[str, FloatArray]:
    """Poses (3, 4) that images which are not in a map should have, since another camera's that was taken together with
    each is. How two cameras stand to each other is told by the images of both in the map."""
    found: dict[str, FloatArray] = {}
    name_of = {shot: name for name, shot in shots.items()}
    cameras = sorted({camera for camera, _ in shots.values()})
    for first in cameras:
        for second in cameras:
            one, other = _together(poses, poses, shots, (first, second))
            if first == second or (relative := _relative(one, other)) is None:
                continue
            for step, here in _steps(poses, shots, first).items():
                name = name_of.get((second, step))
                if name is not None and name not in poses:
                    found.setdefault(name, _after(relative, here))
    return found


def misfits(poses: Mapping[str, FloatArray], shots: Shots) -> set[str]:
    """Names of images of a map of ``poses`` (3, 4) that stand to those which were taken together with them otherwise
    than their cameras do at most times: where more of these speak against an image than for it."""
    balance: Counter[str] = Counter()
    name_of = {shot: name for name, shot in shots.items()}
    for first, second in combinations(sorted({camera for camera, _ in shots.values()}), 2):
        one, other = _together(poses, poses, shots, (first, second))
        relative = _relative(one, other)
        if relative is None:
            continue
        step_m = _step(_centres(one))
        both = sorted(_steps(poses, shots, first).keys() & _steps(poses, shots, second).keys())
        for step, here, there in zip(both, one, other, strict=True):
            off = np.linalg.norm(camera_centre(_after(relative, here)) - camera_centre(there))
            turned = rotation_angle(there[:, :3] @ _after(relative, here)[:, :3].T)
            fits = off <= OFF * step_m and turned <= TURNED_RAD
            for camera in (first, second):
                balance[name_of[camera, step]] += 1 if fits else -1
    return {name for name, count in balance.items() if count < 0}


def _relative(one: FloatArray, other: FloatArray, step: float | None = None) -> FloatArray | None:
    """The pose (3, 4) of the second camera from the first that most of their poses (K, 3, 4) agree on; None if too few
    do. A step of the way is that between these poses if it is not given."""
    if len(one) < MIN_TOGETHER:
        return None
    step = _step(_centres(one)) if step is None else step
    if step == 0.0:
        return None
    turns = other[:, :, :3] @ one[:, :, :3].transpose(0, 2, 1)
    shifts = other[:, :, 3] - np.einsum("kij,kj->ki", turns, one[:, :, 3])
    near = np.linalg.norm(shifts[:, None] - shifts, axis=2) <= OFF * step
    alike = np.einsum("kij,lij->kl", turns, turns) >= ALIKE
    best = int(np.argmax((near & alike).sum(axis=1)))
    fits = near[best] & alike[best]
    if fits.sum() < max(MIN_TOGETHER, MIN_FITTING * len(one)):
        return None
    left, _, right = np.linalg.svd(turns[fits].sum(axis=0))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return pose(turn, np.median(shifts[fits], axis=0))


def _after(relative: FloatArray, here: FloatArray) -> FloatArray:
    """The pose (3, 4) of a camera that stands so to another with the pose ``here`` (3, 4)."""
    return pose(relative[:, :3] @ here[:, :3], relative[:, :3] @ here[:, 3] + relative[:, 3])


def disagree(
    poses: Mapping[str, FloatArray],
    others: Mapping[str, FloatArray],
    downs: tuple[FloatArray, FloatArray],
    shots: Shots,
) -> tuple[str, str] | None:
    """Two cameras that took images together, but went different ways in two maps; None if there are none.

    The parameters are those of ``joint_of``: ``poses`` and ``others`` (3, 4) by name, ``downs`` (3,).
    """
    if joint_of(poses, others, downs, shots) is not None:
        return None
    for pair in combinations(sorted({camera for camera, _ in shots.values()}), 2):
        for first, second in (pair, pair[::-1]):
            if len(_together(poses, others, shots, (first, second))[0]) >= MIN_TOGETHER:
                return pair
    return None


@dataclass(frozen=True, eq=False)
class FixedCameras:
    """How cameras that are fixed to each other stand to each other in a map."""

    relative: Mapping[tuple[str, str], FloatArray]
    """Pose (3, 4) of the second camera from the first, in units of the map, by the names of both."""
    off: float
    """How far apart, in units of the map, the position of an image and that which another one taken together with it
    expects may be."""
    room: float
    """How far numbers or times in the names of images taken together may differ."""

    def times_of(self, views: Sequence[View]) -> Shots:
        """Camera and time step of other images of these cameras."""
        cameras = {camera for pair in self.relative for camera in pair}
        found = _numbers_of(_keys_of(views))
        numbers = {camera: images for camera, images in found.items() if camera in cameras and images}
        if len(numbers) < 2:
            return {}
        own = [np.unique(list(images.values())) for images in numbers.values()]
        room = min([self.room, *(_room(steps) for steps in own if len(steps) > 1)])
        steps = np.unique(np.concatenate(own))
        steps = steps[np.diff(steps, prepend=-np.inf) > room]
        return {name: shot for shots in _in_steps(numbers, steps, room).values() for name, shot in shots.items()}

    def expected(self, first: tuple[str, FloatArray], second: str) -> FloatArray | None:
        """The pose (3, 4) of the second camera where that of the first one is known, by its name and its pose (3, 4);
        None if it is not known how they stand to each other."""
        relative = self.relative.get((first[0], second))
        return None if relative is None else _after(relative, first[1])

    def agrees(self, expected: FloatArray, found: FloatArray) -> bool:
        """Whether a pose (3, 4) is about the expected one (3, 4)."""
        apart = np.linalg.norm(camera_centre(expected) - camera_centre(found))
        return bool(apart <= self.off and rotation_angle(found[:, :3] @ expected[:, :3].T) <= TURNED_RAD)


def rig_of(views: Sequence[View]) -> FixedCameras | None:
    """How the cameras of images in a map stand to each other; None if there are no two that took ``MIN_TOGETHER``
    images together, and stand to each other alike at most times."""
    poses = {view.name: view.cam_from_map for view in views if view.cam_from_map is not None}
    known = [view for view in views if view.name in poses]
    shots = shots_of(known)
    by_camera: dict[str, dict[int, FloatArray]] = {}
    for name, (camera, step) in shots.items():
        by_camera.setdefault(camera, {})[step] = poses[name]
    relative: dict[tuple[str, str], FloatArray] = {}
    lengths: list[float] = []
    for first, second in combinations(sorted(by_camera), 2):
        here, there = by_camera[first], by_camera[second]
        both = sorted(here.keys() & there.keys())
        if len(both) < MIN_TOGETHER:
            continue
        length = _step(_centres(np.array([here[step] for step in both])))
        some = [
            both[k] for k in np.unique(np.linspace(0, len(both) - 1, min(len(both), MAX_TRIED)).round().astype(int))
        ]
        one, other = (np.array([poses[step] for step in some]) for poses in (here, there))
        if (found := _relative(one, other, length)) is not None:
            relative[first, second], relative[second, first] = found, inverse_pose(found)
            lengths.append(length)
    if not relative:
        return None
    numbers = _numbers_of(_keys_of(known))
    fixed = {camera: numbers[camera] for pair in relative for camera in pair}
    return FixedCameras(relative, OFF * float(np.median(lengths)), _room(_steps_of(fixed)))
