"""Runs that fail for one known cause each: what the diagnosis is measured on, and what lessons show.

Every case is a problem with truth, an estimator with options, and a seed. The cause is in how the case is made, so a
case must differ from a good one by its cause alone: ``tests/datasets/test_failures.py`` checks that taking the cause
away makes the run succeed. Scenes that are staged group by group are in ``staged.py``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.consensus.two_point_search import sample_pair
from spherloc.datasets.point_cloud import HALF_SIZE_M, clearly_apart, sees
from spherloc.datasets.scene_file import bundled_scenes, load_scene
from spherloc.errors import InputError, show
from spherloc.geometry import DOWN, camera_centre, pose, so3_exp, transform, yaw_rotation
from spherloc.problem import Problem
from spherloc.types import BoolArray, FloatArray

Cloud = Callable[[np.random.Generator, int], FloatArray]

SCENES = ("mei_outliers_80", "fisheye_outliers_80", "panorama_outliers_80")
"""Bundled scenes whose cameras the cases use."""
ESTIMATORS = ("mc", "mc-exact", "ransac-2p")
BATCH = 512
MAX_BATCHES = 40


@dataclass(frozen=True, eq=False)
class FailureCase:
    """One run that fails or is doubtful for a known cause, or is ok."""

    cause: str
    """Value of ``spherloc.diagnosis.Cause``."""
    problem: Problem
    """The problem, with truth and labels."""
    estimator: str
    """Registered name of the estimator."""
    options: Mapping[str, Any]
    """The estimator's options that differ from its defaults for this problem."""
    seed: int
    """Seed of the run."""


@dataclass
class CaseMaker:
    """Draws the parts of one case: a camera, the true pose, and groups of correspondences."""

    rng: np.random.Generator
    camera: Camera = field(init=False)
    truth: FloatArray = field(init=False)
    estimator: str = field(init=False)
    noise_px: float = field(init=False)
    parts: list[tuple[FloatArray, FloatArray, bool]] = field(default_factory=list)
    """Pixels (K, 2), points (K, 3), and whether they are right."""

    def __post_init__(self) -> None:
        self.camera = cameras()[self.rng.integers(len(SCENES))]
        self.truth = self.random_pose()
        self.estimator = str(self.rng.choice(ESTIMATORS))
        self.noise_px = self.rng.uniform(0.5, 1.1)

    def random_pose(self) -> FloatArray:
        """A level pose (3, 4): any yaw, position within half the cube."""
        centre = self.rng.uniform(-0.5 * HALF_SIZE_M, 0.5 * HALF_SIZE_M, 3)
        rotation = yaw_rotation(self.rng.uniform(-np.pi, np.pi))
        return pose(rotation, -rotation @ centre)

    def between(self, low: float, high: float) -> float:
        """A random number from ``low`` to ``high``, uniformly distributed."""
        return float(self.rng.uniform(low, high))

    def whole(self, low: int, high: int) -> int:
        """A random whole number from ``low`` to ``high``, both included."""
        return int(self.rng.integers(low, high + 1))

    def cube(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Points (count, 3) of the cube, uniformly, metres."""
        return rng.uniform(-HALF_SIZE_M, HALF_SIZE_M, (count, 3))

    def seen(self, points: FloatArray, cam_from_map: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Noisy pixels (K, 2) of points (K, 3), and which of them the camera sees."""
        pixels, valid = self.camera.project(transform(cam_from_map, points))
        pixels = np.where(valid[:, None], pixels, -1.0) + self.noise_px * self.rng.standard_normal(pixels.shape)
        return pixels, valid & sees(self.camera, pixels)

    def visible(self, count: int, cloud: Cloud, *poses: FloatArray) -> tuple[FloatArray, list[FloatArray]] | None:
        """``count`` points (count, 3) of the cloud that are seen from every pose, and their noisy pixels from each."""
        found = []
        for _ in range(MAX_BATCHES):
            points = cloud(self.rng, BATCH)
            views = [self.seen(points, cam_from_map) for cam_from_map in poses]
            kept = np.logical_and.reduce([valid for _, valid in views])
            found.append(np.hstack([points[kept], *(pixels[kept] for pixels, _ in views)]))
            if sum(map(len, found)) >= count:
                rows = np.concatenate(found)[:count]
                return rows[:, :3], [rows[:, 3 + 2 * k : 5 + 2 * k] for k in range(len(poses))]
        return None

    def right(self, count: int, cloud: Cloud | None = None) -> None:
        """Add right correspondences; the true pose is drawn anew until it sees enough of the cloud."""
        while (found := self.visible(count, cloud or self.cube, self.truth)) is None:
            self.truth = self.random_pose()
        self.parts.append((found[1][0], found[0], True))

    def random(self, count: int, cloud: Cloud | None = None) -> None:
        """Add wrong correspondences: random pixels that the camera sees."""
        size = np.array([self.camera.width, self.camera.height])
        pixels = np.empty((0, 2))
        while len(pixels) < count:
            more = self.rng.uniform(0.0, 1.0, (BATCH, 2)) * size
            pixels = np.concatenate([pixels, more[self.camera.unproject(more)[1]]])
        self.parts.append((pixels[:count], (cloud or self.cube)(self.rng, count), False))

    def coherent(self, count: int, doubled: int = 0) -> None:
        """Add wrong correspondences that agree with one wrong pose, as repeated structure makes them.

        The first ``doubled`` of them take the pixels' points twice: each point was matched in both of its places.
        """
        found = None
        while found is None:
            wrong = self.random_pose()
            if clearly_apart(wrong, self.truth):
                found = self.visible(count, self.cube, self.truth, wrong)
        points, (right, off) = found
        self.parts.append((off, points, False))
        if doubled:
            self.parts.append((right[:doubled], points[:doubled], True))

    def agreeing(self, count: int, wrong: FloatArray) -> None:
        """Add wrong correspondences that agree with that pose (3, 4), and are seen from the true one too."""
        while (found := self.visible(count, self.cube, self.truth, wrong)) is None:
            continue
        self.parts.append((found[1][1], found[0], False))

    def case(self, cause: str, **changes: Any) -> FailureCase:
        """The parts in random order as a case; ``options`` and fields of the problem can be given."""
        options = changes.pop("options", {})
        pixels, points = (np.concatenate([part[k] for part in self.parts]) for k in range(2))
        labels = np.concatenate([np.full(len(part[0]), part[2]) for part in self.parts])
        order = self.rng.permutation(len(pixels))
        known = {"gravity_camera": DOWN, "gravity_map": DOWN, "truth_cam_from_map": self.truth} | changes
        problem = Problem(
            name=cause,
            camera=self.camera,
            pixels=pixels[order],
            points=points[order],
            truth_inliers=labels[order],
            scene=f"made to show: {cause}",
            **known,
        )
        return FailureCase(cause, problem, self.estimator, options, int(self.rng.integers(2**31)))

    def tilted(self, angle_rad: float) -> FloatArray:
        """Gravity (3,) that is off by that angle, to any side."""
        side = self.between(-np.pi, np.pi)
        return so3_exp(angle_rad * np.array([np.cos(side), 0.0, np.sin(side)])) @ DOWN


@cache
def cameras() -> tuple[Camera, ...]:
    """The cameras of the scenes ``SCENES``."""
    scenes = bundled_scenes()
    return tuple(load_scene(scenes[name]).problem().camera for name in SCENES)


GUESSES = 100
"""Number of pairs that mc-exact samples with the least effort."""


def _ok(make: CaseMaker) -> FailureCase:
    """Up to 80 % outliers; some with weaker repeated structure, some with a gravity error within its bound."""
    count = make.whole(60, 300)
    inliers = round(count * make.between(0.2, 1.0))
    make.right(inliers)
    if make.rng.random() < 0.25:
        make.coherent(min(count - inliers, round(make.between(0.05, 0.25) * inliers)))
    make.random(count - sum(len(part[0]) for part in make.parts))
    if make.rng.random() < 0.25:
        bound = np.radians(make.between(0.3, 1.5))
        tilt = bound * np.sqrt(make.between(0.0, 0.5))
        return make.case("ok", gravity_camera=make.tilted(tilt), gravity_bound_rad=bound)
    return make.case("ok")


def _too_few_inliers(make: CaseMaker) -> FailureCase:
    """Two or three right matches among 40 to 105: as many agree with some wrong pose by chance."""
    count, inliers = make.whole(40, 105), make.whole(2, 3)
    make.right(inliers)
    make.random(count - inliers)
    return make.case("too few inliers")


def _wrong_reference(make: CaseMaker) -> FailureCase:
    """95 to 300 matches to points of another place, none right."""
    corner = make.rng.uniform(-HALF_SIZE_M, HALF_SIZE_M, 3)
    size = make.rng.uniform(1.0, 5.0, 3)
    make.random(make.whole(95, 300), lambda rng, count: corner + size * rng.uniform(0.0, 1.0, (count, 3)))
    return make.case("wrong reference image")


def _map_too_sparse(make: CaseMaker) -> FailureCase:
    """Too few right matches, as above, and 30 to 120 more that agree between the images but have no map point."""
    make.right(make.whole(2, 3))
    make.random(make.whole(40, 105))
    return make.case("map too sparse", verified_without_point=make.whole(30, 120))


def _false_consensus(make: CaseMaker) -> FailureCase:
    """Repeated structure: 1.3 to 2 times as many matches agree with one wrong pose as with the true one."""
    count = make.whole(80, 300)
    right = round(count * make.between(0.15, 0.32))
    wrong = min(count - right, round(right * make.between(1.3, 2.0)))
    make.right(right)
    make.coherent(wrong)
    make.random(count - right - wrong)
    return make.case("larger false consensus")


def _ambiguous(make: CaseMaker) -> FailureCase:
    """A wrong pose with as many matches as the true one: parts of the map look alike, or each point is there twice."""
    count = make.whole(80, 300)
    half = round(count * make.between(0.2, 0.45))
    if make.rng.random() < 0.5:
        make.coherent(half, doubled=half)
    else:
        make.right(half)
        make.coherent(half)
    make.random(count - 2 * half)
    return make.case("ambiguous")


def _gravity_off(make: CaseMaker) -> FailureCase:
    """Gravity is off by 3 to 10 degrees more than is said."""
    count = make.whole(60, 300)
    inliers = round(count * make.between(0.4, 0.9))
    make.right(inliers)
    make.random(count - inliers)
    bound = float(np.radians(make.rng.choice([0.0, 0.5, 1.0])))
    gravity = make.tilted(bound + np.radians(make.between(3.0, 10.0)))
    return make.case("gravity prior off", gravity_camera=gravity, gravity_bound_rad=bound)


def _bound_too_small(make: CaseMaker) -> FailureCase:
    """The noise's standard deviation is 1 to 2.5 times the bound: 8 to 39 % of the right matches are within it."""
    count = make.whole(80, 300)
    bound = make.between(1.0, 2.0)
    make.noise_px = bound * make.between(1.0, 2.5)
    inliers = round(count * make.between(0.5, 1.0))
    make.right(inliers)
    make.random(count - inliers)
    return make.case("noise bound too small", bound_px=bound)


def _bound_too_large(make: CaseMaker) -> FailureCase:
    """Few matches are right, and the bound is 80 to 150 px: as many wrong ones agree with any pose."""
    count, inliers = make.whole(150, 300), make.whole(7, 10)
    make.right(inliers)
    make.random(count - inliers)
    return make.case("noise bound too large", bound_px=make.between(80.0, 150.0))


def _degenerate(make: CaseMaker) -> FailureCase:
    """Right matches on one pole, at one spot, or too far away to fix the position."""
    count = make.whole(40, 200)
    inliers = round(count * make.between(0.5, 1.0))
    make.right(inliers, make.rng.choice(np.array([_pole, _spot, _far], dtype=object))(make))
    make.random(count - inliers)
    return make.case("degenerate geometry")


def _place(make: CaseMaker, near: float, far: float) -> FloatArray:
    """A point (3,) at a distance from the camera, not above or below it."""
    side, distance = make.between(-np.pi, np.pi), make.between(near, far)
    return camera_centre(make.truth) + distance * np.array([np.cos(side), make.between(-0.3, 0.3), np.sin(side)])


def _pole(make: CaseMaker) -> Cloud:
    """A vertical line 3 cm thick and some metres high."""

    def cloud(rng: np.random.Generator, count: int) -> FloatArray:
        thick = rng.uniform(-0.015, 0.015, (count, 3))
        return foot + thick + np.array([0.0, 1.0, 0.0]) * rng.uniform(-height, height, (count, 1))

    foot, height = _place(make, 3.0, 7.0), make.between(1.0, 3.0)
    make.truth = _facing(make.truth, foot)
    return cloud


def _spot(make: CaseMaker) -> Cloud:
    """A ball of a few centimetres."""
    middle, radius = _place(make, 3.0, 8.0), make.between(0.01, 0.04)
    make.truth = _facing(make.truth, middle)
    return lambda rng, count: middle + rng.uniform(-radius, radius, (count, 3))


def _far(make: CaseMaker) -> Cloud:
    """Mountains 2 to 20 km away on all sides."""

    def cloud(rng: np.random.Generator, count: int) -> FloatArray:
        side, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(2e3, 2e4, count)
        return distance[:, None] * np.column_stack([np.cos(side), -rng.uniform(0.0, 0.4, count), np.sin(side)])

    return cloud


def _below(make: CaseMaker) -> Cloud:
    """A piece of floor straight below the camera, 6 cm wide: a panorama's lower pole."""

    def cloud(rng: np.random.Generator, count: int) -> FloatArray:
        return foot + rng.uniform(-0.03, 0.03, (count, 3)) * np.array([1.0, 0.1, 1.0])

    foot = camera_centre(make.truth) + np.array([0.0, 1.5, 0.0])
    return cloud


def _behind(make: CaseMaker) -> Cloud:
    """A wall behind the camera, left and right of the seam of a panorama."""

    def cloud(rng: np.random.Generator, count: int) -> FloatArray:
        seen = rng.uniform(-1.0, 1.0, (count, 3)) * np.array([3.0, 2.0, 1.0]) - np.array([0.0, 0.0, 4.0])
        return camera_centre(make.truth) + seen @ make.truth[:, :3]

    return cloud


def _facing(cam_from_map: FloatArray, point: FloatArray) -> FloatArray:
    """The level pose at the same place with ``point`` in the middle of the image."""
    centre = camera_centre(cam_from_map)
    away = point - centre
    rotation = yaw_rotation(-np.arctan2(away[0], away[2]))
    return pose(rotation, -rotation @ centre)


def _iterations_ran_out(make: CaseMaker) -> FailureCase:
    """RANSAC is given too few iterations: see ``_unlucky``."""
    make.estimator = "ransac-2p"
    return _unlucky(make, make.between(0.03, 0.12))


def _search_missed(make: CaseMaker) -> FailureCase:
    """mc-exact is given no effort, so that only its first guess is left: see ``_unlucky``."""
    make.estimator = "mc-exact"
    return _unlucky(make, make.between(0.03, 0.05))


def _unlucky(make: CaseMaker, rate: float) -> FailureCase:
    """3 to 12 % right matches, at least nine, and no two of them are sampled together before the search has to end."""
    count = max(make.whole(80, 300), int(np.ceil(9 / rate)))
    inliers = round(rate * count)
    make.right(inliers)
    make.random(count - inliers)
    if make.estimator == "ransac-2p":
        samples = int(np.ceil(make.between(0.02, 1.0) / rate**2))
        case = make.case("iterations ran out", options={"iterations": samples})
    else:
        samples = GUESSES
        case = make.case("search missed the best pose", options={"effort": 1e-9})
    return replace(case, seed=_unlucky_seed(make.rng, case.problem.truth_inliers, samples))


def _unlucky_seed(rng: np.random.Generator, labels: NDArray[np.bool_] | None, samples: int) -> int:
    """A seed of which no sample is a pair of right matches."""
    assert labels is not None
    while True:
        seed = int(rng.integers(2**31))
        pairs = np.array([sample_pair(np.uint64(seed), k, len(labels)) for k in range(samples)])
        if not labels[pairs].all(axis=1).any():
            return seed


MAKERS: Mapping[str, Callable[[CaseMaker], FailureCase]] = {
    "ok": _ok,
    "too few inliers": _too_few_inliers,
    "larger false consensus": _false_consensus,
    "wrong reference image": _wrong_reference,
    "gravity prior off": _gravity_off,
    "noise bound too small": _bound_too_small,
    "degenerate geometry": _degenerate,
    "iterations ran out": _iterations_ran_out,
    "ambiguous": _ambiguous,
    "search missed the best pose": _search_missed,
    "map too sparse": _map_too_sparse,
    "noise bound too large": _bound_too_large,
}


PLACES: Mapping[str, Callable[[CaseMaker], Cloud]] = {
    "line": _pole,
    "spot": _spot,
    "far": _far,
    "below": _below,
    "behind": _behind,
}
"""Places of the points of right matches, other than all over the cube. Some turn the camera towards them."""


def failure_case(cause: str, seed: int) -> FailureCase:
    """The case of that cause (a value of ``spherloc.diagnosis.Cause``) and seed.

    Raises ``InputError`` for an unknown cause or a negative seed.
    """
    if cause not in MAKERS:
        raise InputError(f"unknown cause {show(cause)}: choose one of {', '.join(MAKERS)}.")
    if seed < 0:
        raise InputError(f"seed is {seed}; give 0 or more.")
    return MAKERS[cause](CaseMaker(np.random.default_rng([seed, list(MAKERS).index(cause)])))
