"""The paper's simulation (Sec. VI-A): map points in the cube [-5, 5]^3 seen by a level camera.

Where the paper does not say enough or contradicts itself: points and positions are uniform in the cube, or standard
normal, since it says both; points are drawn until N are visible, that is, valid for the camera model and inside the
image after noise; an outlier is the projection of its map point by a random wrong pose of its own. The paper's gravity
is exact; here it may be off. Beyond the paper, outliers may agree with each other, the field of view and the height of
the cloud may be smaller, and the position of the camera can be given.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import camera_from_table
from spherloc.datasets import scene_file
from spherloc.datasets.point_cloud import (
    DRAWS,
    HALF_SIZE_M,
    OUTLIER_KINDS,
    WHOLE_SPHERE_DEG,
    Cloud,
    Draws,
    Lens,
    OutlierKind,
    copies,
    random_pixels,
    random_poses,
    second_pose,
)
from spherloc.errors import InputError, show
from spherloc.geometry import DOWN, camera_centre, pose, so3_exp, transform, yaw_rotation
from spherloc.problem import Problem
from spherloc.types import FloatArray

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
outlier_kind = "random"           # optional: "random", "coherent" (one wrong pose) or "repeated" (a facade's copies)
field_of_view_deg = 360.0         # optional: points farther than half of it from the optical axis are not seen
cloud_height_m = 10.0             # optional: height of the cloud of points, around the camera's if less than 10
draws = "uniform"                 # optional: of coordinates, in the cube; or "normal", standard normal in metres
# true_camera = [30, 1, 0, 2]     # optional: yaw (deg) and position (m) of the camera; drawn if absent
"""

MAX_CORRESPONDENCES = 10_000
MAX_GRAVITY_ERROR_DEG = 10.0
GEOMETRY, NOISE, CHOICE, WRONG, TILT, SECOND, AHEAD = range(7)
"""Random streams, so that one setting does not change what another one draws."""
GRAVITY_BOUND_SD = 3.0
"""The bound on gravity, in standard deviations. Errors beyond it (1.1 %) are drawn again, so that the bound is true."""
LIMITS: Mapping[str, tuple[float, float]] = {
    "correspondences": (2, MAX_CORRESPONDENCES),
    "outlier_rate": (0.0, 1.0),
    "noise_px": (0.0, 100.0),
    "seed": (0, 2**63 - 1),
    "gravity_error_deg": (0.0, MAX_GRAVITY_ERROR_DEG),
    "field_of_view_deg": (10.0, WHOLE_SPHERE_DEG),
    "cloud_height_m": (0.0, 2 * HALF_SIZE_M),
}
"""Smallest and largest value of every number of a simulation."""
TRUE_CAMERA_LIMITS = (360.0, 100.0, 100.0, 100.0)
"""Largest absolute yaw (deg) and coordinates (m)."""

TrueCamera = tuple[float, float, float, float]
"""Yaw (deg) and position x, y, z (m) of the camera in the map frame."""


@dataclass(frozen=True)
class SyntheticScene:
    """A random problem with known truth.

    The same seed keeps points and pose while noise or outliers change. Where the true camera, the field of view or
    the kind of outliers change, a point keeps its number, noise and label for as long as it is seen; else another
    takes its place, if need be one outside the cube, 1 to 10 m in front of the camera.
    """

    name: str
    """Name that users see."""
    camera: Camera
    """The query camera."""
    correspondences: int
    """Number of correspondences, N."""
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
    outlier_kind: OutlierKind = "random"
    """"random": each outlier agrees with a wrong pose of its own. "coherent": all with one wrong level pose, up to
    noise; all points are then seen from both poses. "repeated": the pixel is right, but matched with a copy of its
    point one or two steps of 2 m along x away, so that the outliers agree with poses shifted along it."""
    field_of_view_deg: float = WHOLE_SPHERE_DEG
    """Whatever is farther than half of it from the optical axis is not seen, degrees."""
    cloud_height_m: float = 2 * HALF_SIZE_M
    """Height of the cloud of points, m. Less than the cube's 10 m flattens it to the height of the drawn camera:
    near 0 all right bearings are horizontal."""
    true_camera: TrueCamera | None = None
    """Yaw (deg) and position (m) of the true camera in the map frame; None for the one that is drawn."""
    draws: Draws = "uniform"
    """Distribution of the coordinates of points and of all poses' translations: "uniform" in the cube, or "normal",
    standard normal in metres. Sec. VI-A says both."""

    def __post_init__(self) -> None:
        for name, (lowest, highest) in LIMITS.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise InputError(f"{self.name}: {name} is {value}; give a number from {lowest:g} to {highest:g}.")
        if self.outlier_kind not in OUTLIER_KINDS:
            raise InputError(
                f"{self.name}: outlier_kind is {show(self.outlier_kind)}; give one of {', '.join(OUTLIER_KINDS)}."
            )
        if self.draws not in DRAWS:
            raise InputError(f"{self.name}: draws is {show(self.draws)}; give one of {', '.join(DRAWS)}.")
        placed = self.true_camera
        if placed is not None and not (
            len(placed) == len(TRUE_CAMERA_LIMITS)
            and all(abs(value) <= most for value, most in zip(placed, TRUE_CAMERA_LIMITS, strict=True))
        ):
            raise InputError(
                f"{self.name}: true_camera is {show(placed)}; give its yaw from -360 to 360 degrees and its position "
                "x, y, z, each from -100 to 100 metres."
            )

    def problem(self, seed: int | None = None) -> Problem:
        """Draw the problem; ``seed`` replaces the scene's own.

        Raises ``InputError`` for a negative seed or if the camera sees too little of the cube.
        """
        if seed is not None and seed != self.seed:
            return replace(self, seed=seed).problem()
        geometry, noise, choice, ahead = map(self._rng, (GEOMETRY, NOISE, CHOICE, AHEAD))
        drawn, lens = random_poses(geometry, 1, self.draws)[0], Lens(self.camera, self.field_of_view_deg)
        truth = drawn if self.true_camera is None else _placed(self.true_camera)
        is_coherent = self.outlier_kind == "coherent"
        other = second_pose(self._rng(SECOND), truth, self.field_of_view_deg) if is_coherent else None
        poses = [truth] if other is None else [truth, other]
        cloud = Cloud(self.name, float(camera_centre(drawn)[1]), self.cloud_height_m, self.draws)
        points, shift = cloud.seen_from((geometry, noise, ahead), self.correspondences, lens, drawn, poses)
        outliers = np.zeros(self.correspondences, dtype=bool)
        outliers[choice.permutation(self.correspondences)[: round(self.outlier_rate * self.correspondences)]] = True
        pixels = self._noisy_pixels(lens, truth, points, shift)
        if other is not None:
            pixels[outliers] = self._noisy_pixels(lens, other, points, shift)[outliers]
        elif self.outlier_kind == "repeated":
            points[outliers] = copies(self._rng(SECOND), lens, truth, points)[outliers]
        else:
            pixels[outliers] = random_pixels(self._rng(WRONG), lens, points, self.name, self.draws)[outliers]
        gravity_sd_rad = float(np.radians(self.gravity_error_deg))
        return Problem(
            name=self.name,
            camera=self.camera,
            pixels=pixels,
            points=points,
            gravity_camera=_tilted_down(self._rng(TILT), gravity_sd_rad) if gravity_sd_rad else DOWN,
            gravity_map=DOWN,
            gravity_bound_rad=GRAVITY_BOUND_SD * gravity_sd_rad,
            gravity_sd_rad=gravity_sd_rad or None,
            bound_px=self.bound_px,
            truth_cam_from_map=truth,
            truth_inliers=~outliers,
            scene=self._description(),
        )

    def _rng(self, stream: int) -> np.random.Generator:
        """The random numbers of one of the streams of the seed."""
        return np.random.default_rng([self.seed, stream])

    def _description(self) -> str:
        """The settings of a problem in one line."""
        kind = "" if self.outlier_kind == "random" else f" {self.outlier_kind}"
        parts = [
            f"N {self.correspondences}, outliers {self.outlier_rate:g}{kind}, noise {self.noise_px:g} px",
            f"gravity error {self.gravity_error_deg:g} deg" if self.gravity_error_deg else "",
            f"field of view {self.field_of_view_deg:g} deg" if self.field_of_view_deg < WHOLE_SPHERE_DEG else "",
            f"cloud {self.cloud_height_m:g} m high" if self.cloud_height_m < 2 * HALF_SIZE_M else "",
            "normal draws" if self.draws == "normal" else "",
            "camera placed" if self.true_camera is not None else "",
            f"seed {self.seed}",
        ]
        return f"synthetic: {', '.join(filter(None, parts))}"

    def _noisy_pixels(self, lens: Lens, cam_from_map: FloatArray, points: FloatArray, shift: FloatArray) -> FloatArray:
        """Pixels (N, 2) of the points (N, 3), moved by ``noise_px`` times ``shift`` (N, 2).

        At the border they are moved inwards, so that all stay visible: the points must not depend on the noise, since
        moving its slider would otherwise replace some of them.
        """
        pixels = self.camera.project(transform(cam_from_map, points))[0]
        shift = self.noise_px * shift
        for attempt in range(60):
            lost = ~lens.sees(pixels + shift)
            if not lost.any():
                break
            shift[lost] *= -1.0 if attempt % 2 == 0 else -0.5
        return pixels + shift


def _placed(true_camera: TrueCamera) -> FloatArray:
    """The level pose (3, 4) of a camera with that yaw (deg) and position (m)."""
    yaw_deg, *position = true_camera
    rotation = yaw_rotation(float(np.radians(yaw_deg)))
    return pose(rotation, -rotation @ np.array(position, dtype=np.float64))


def _tilted_down(rng: np.random.Generator, sd_rad: float) -> FloatArray:
    """Gravity (3,) as a level camera measures it, with errors of pitch and roll of standard deviation ``sd_rad``."""
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
    numbers = {"gravity_error_deg", "field_of_view_deg", "cloud_height_m"}
    scene_file.check_keys(simulation, required, numbers | {"outlier_kind", "true_camera", "draws"}, place)
    given: dict[str, Any] = {
        key: scene_file.number(simulation, key, place, *LIMITS[key])
        for key in ("outlier_rate", "noise_px", *sorted(numbers & simulation.keys()))
    }
    for key, most in (("correspondences", MAX_CORRESPONDENCES), ("seed", 2**63 - 1)):
        given[key] = scene_file.integer(simulation, key, place, int(LIMITS[key][0]), most)
    for key in ("outlier_kind", "draws"):
        if key in simulation:
            given[key] = scene_file.text(simulation, key, place)
    if "true_camera" in simulation:
        given["true_camera"] = tuple(scene_file.numbers(simulation["true_camera"], (4,), "true_camera", place).tolist())
    name, bound_px = scene_file.text(table, "name", where), scene_file.bound_px(table, where)
    camera = camera_from_table(scene_file.section(table, "camera", where), where)
    try:
        return SyntheticScene(name=name, camera=camera, bound_px=bound_px, **given)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
