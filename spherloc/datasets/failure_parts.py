"""Draws the parts of a failure case: camera, true pose, and groups of right and wrong correspondences."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.datasets.outliers import clearly_apart
from spherloc.datasets.point_cloud import HALF_SIZE_M, sees
from spherloc.datasets.scene_file import bundled_scenes, load_scene
from spherloc.geometry import DOWN, pose, so3_exp, transform, yaw_rotation
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
    """With truth and labels."""
    estimator: str
    """Registered name."""
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
        return float(self.rng.uniform(low, high))

    def whole(self, low: int, high: int) -> int:
        """From ``low`` to ``high``, both included."""
        return int(self.rng.integers(low, high + 1))

    def cube(self, rng: np.random.Generator, count: int) -> FloatArray:
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
    scenes = bundled_scenes()
    return tuple(load_scene(scenes[name]).camera for name in SCENES)  # type: ignore[attr-defined]
