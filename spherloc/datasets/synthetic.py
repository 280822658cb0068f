"""The paper's simulation (Sec. VI-A): map points in the cube [-5, 5]^3 seen by a level camera.

Where the paper is silent or breaks: points and positions are uniform in the cube; points are drawn until N are
visible, that is valid for the camera model and inside the image after noise; an outlier is the projection of its map
point by a random wrong pose of its own. The paper's gravity is exact; here it may be off.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera, in_image
from spherloc.cameras.calibration import camera_from_table
from spherloc.datasets import scene_file
from spherloc.errors import InputError
from spherloc.geometry import DOWN, pose, so3_exp, transform, yaw_rotation
from spherloc.problem import Problem

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

EXAMPLE = """\
kind = "synthetic"
name = "panorama, 80 % outliers"

[camera]
model = "equirectangular"
width = 2048
height = 1024

[simulation]
correspondences = 100
outlier_rate = 0.8
noise_px = 1.0
seed = 0
gravity_error_deg = 0.0           # optional: standard deviation of the error of the known roll and pitch
"""

HALF_SIZE_M = 5.0
BATCH = 512
MAX_BATCHES = 400
MOST_CORRESPONDENCES = 10_000
MOST_GRAVITY_ERROR_DEG = 10.0
GRAVITY_BOUND_SD = 3.0
"""The bound on gravity, in standard deviations. Errors beyond it (1.1 %) are drawn again, so that the bound is true."""


@dataclass(frozen=True)
class SyntheticScene:
    """A random problem with known truth. The same seed keeps points and pose while noise or outliers change."""

    name: str
    """Shown to people."""
    camera: Camera
    """The query camera."""
    correspondences: int
    """How many, N."""
    outlier_rate: float
    """Share of wrong correspondences, 0 to 1; rounded to whole correspondences."""
    noise_px: float
    """Standard deviation of the pixel noise, px."""
    seed: int
    """Seed of every random draw."""
    bound_px: float | None = None
    """Pixel bound asked of estimators; None leaves it to them."""
    gravity_error_deg: float = 0.0
    """Standard deviation of the error of the known roll and of the known pitch, degrees. The problem states it, and
    three times as much as the bound on the angle between the known and the true gravity, which is kept."""

    def __post_init__(self) -> None:
        for name, lowest, highest in (
            ("correspondences", 2, MOST_CORRESPONDENCES),
            ("outlier_rate", 0.0, 1.0),
            ("noise_px", 0.0, 100.0),
            ("seed", 0, 2**63 - 1),
            ("gravity_error_deg", 0.0, MOST_GRAVITY_ERROR_DEG),
        ):
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise InputError(f"{self.name}: {name} is {value}; give a number from {lowest:g} to {highest:g}.")

    def problem(self, seed: int | None = None) -> Problem:
        """Draw the problem; ``seed`` replaces the scene's own.

        Raises ``InputError`` for a negative seed or if the camera sees too little of the cube.
        """
        if seed is not None and seed != self.seed:
            return replace(self, seed=seed).problem()
        geometry, noise, choice, wrong, tilt = (np.random.default_rng([self.seed, stream]) for stream in range(5))
        truth = _random_poses(geometry, 1)[0]
        points, pixels = self._visible_points(geometry, noise, truth)
        outliers = np.zeros(self.correspondences, dtype=bool)
        outliers[choice.permutation(self.correspondences)[: round(self.outlier_rate * self.correspondences)]] = True
        pixels[outliers] = self._wrong_pixels(wrong, points)[outliers]
        gravity_sd_rad = float(np.radians(self.gravity_error_deg))
        return Problem(
            name=self.name,
            camera=self.camera,
            pixels=pixels,
            points=points,
            gravity_camera=_tilted_down(tilt, gravity_sd_rad),
            gravity_map=DOWN,
            gravity_bound_rad=GRAVITY_BOUND_SD * gravity_sd_rad,
            gravity_sd_rad=gravity_sd_rad or None,
            bound_px=self.bound_px,
            truth_cam_from_map=truth,
            truth_inliers=~outliers,
            scene=f"synthetic: N {self.correspondences}, outliers {self.outlier_rate:g}, noise {self.noise_px:g} px, "
            + (f"gravity error {self.gravity_error_deg:g} deg, " if self.gravity_error_deg else "")
            + f"seed {self.seed}",
        )

    def _seen(self, pixels: FloatArray) -> BoolArray:
        return in_image(self.camera, pixels) & self.camera.unproject(pixels)[1]

    def _visible_points(
        self, geometry: np.random.Generator, noise: np.random.Generator, truth: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The first N random points (N, 3) that are visible, and their noisy pixels (N, 2)."""
        found: list[tuple[FloatArray, FloatArray]] = []
        count = 0
        for _ in range(MAX_BATCHES):
            points = geometry.uniform(-HALF_SIZE_M, HALF_SIZE_M, (BATCH, 3))
            pixels, valid = self.camera.project(transform(truth, points))
            visible = valid & in_image(self.camera, pixels)
            visible[visible] = self._seen(pixels[visible])
            shift = noise.standard_normal((BATCH, 2))[visible]
            found.append((points[visible], self._noisy(pixels[visible], shift)))
            count += int(np.count_nonzero(visible))
            if count >= self.correspondences:
                points, pixels = (np.concatenate(parts)[: self.correspondences] for parts in zip(*found, strict=True))
                return points, pixels
        raise InputError(
            f"{self.name}: only {count} of {BATCH * MAX_BATCHES:,} random points are visible to the camera; "
            "give a wider camera, less noise, fewer correspondences or another seed."
        )

    def _noisy(self, pixels: FloatArray, shift: FloatArray) -> FloatArray:
        """Pixels (K, 2) moved by ``noise_px`` times ``shift`` (K, 2); at the border inwards, so that all stay visible.

        The points must not depend on the noise: dragging it would otherwise replace some of them.
        """
        shift = self.noise_px * shift
        for attempt in range(60):
            lost = ~self._seen(pixels + shift)
            if not lost.any():
                break
            shift[lost] *= -1.0 if attempt % 2 == 0 else -0.5
        return pixels + shift

    def _wrong_pixels(self, wrong: np.random.Generator, points: FloatArray) -> FloatArray:
        """Pixels (N, 2) of the points (N, 3) under a random pose each under which it is visible."""
        pixels = np.full((len(points), 2), np.nan)
        for _ in range(MAX_BATCHES):
            poses = _random_poses(wrong, len(points))
            missing = np.isnan(pixels[:, 0])
            rays = np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
            candidates, valid = self.camera.project(rays)
            visible = missing & valid
            visible[visible] = self._seen(candidates[visible])
            pixels[visible] = candidates[visible]
            if not np.isnan(pixels).any():
                return pixels
        raise InputError(f"{self.name}: the camera sees too little of the cube to make outliers; give a wider camera.")


def _random_poses(rng: np.random.Generator, count: int) -> FloatArray:
    """Level poses (count, 3, 4): any yaw, translation uniform in the cube."""
    yaws = rng.uniform(-np.pi, np.pi, count)
    translations = rng.uniform(-HALF_SIZE_M, HALF_SIZE_M, (count, 3))
    return np.array([pose(yaw_rotation(yaw), t) for yaw, t in zip(yaws, translations, strict=True)])


def _tilted_down(rng: np.random.Generator, sd_rad: float) -> FloatArray:
    """Gravity (3,) as a camera that is level would measure it: its pitch and roll are off by ``sd_rad`` each."""
    tilt = rng.standard_normal(2)
    while np.linalg.norm(tilt) > GRAVITY_BOUND_SD:
        tilt = rng.standard_normal(2)
    pitch, roll = sd_rad * tilt
    return so3_exp(np.array([pitch, 0.0, roll])) @ DOWN


def load(table: dict[str, Any], path: Path) -> SyntheticScene:
    """Read a scene of ``kind = "synthetic"``; raises ``InputError`` for a wrong key or value."""
    where = str(path)
    scene_file.check_keys(table, {"kind", "name", "camera", "simulation"}, {"options", "about"}, where)
    simulation = scene_file.section(table, "simulation", where)
    place = f"{where} [simulation]"
    required = {"correspondences", "outlier_rate", "noise_px", "seed"}
    scene_file.check_keys(simulation, required, {"gravity_error_deg"}, place)
    return SyntheticScene(
        name=scene_file.text(table, "name", where),
        camera=camera_from_table(scene_file.section(table, "camera", where), where),
        correspondences=scene_file.integer(simulation, "correspondences", place, 2, MOST_CORRESPONDENCES),
        outlier_rate=scene_file.number(simulation, "outlier_rate", place, 0.0, 1.0),
        noise_px=scene_file.number(simulation, "noise_px", place, 0.0, 100.0),
        seed=scene_file.integer(simulation, "seed", place, 0, 2**63 - 1),
        bound_px=scene_file.bound_px(table, where),
        gravity_error_deg=scene_file.number(
            {"gravity_error_deg": 0.0} | simulation, "gravity_error_deg", place, 0.0, MOST_GRAVITY_ERROR_DEG
        ),
    )
