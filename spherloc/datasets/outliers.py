"""Wrong matches of simulated problems: of every one's own, all of one wrong pose, or of repeated structure."""

from typing import Literal, get_args

import numpy as np

from spherloc.datasets.point_cloud import HALF_SIZE_M, WHOLE_SPHERE_DEG, Lens, random_bearings
from spherloc.errors import InputError
from spherloc.geometry import camera_centre, pose, wrap_angle, yaw_of, yaw_rotation
from spherloc.types import FloatArray

OutlierKind = Literal["random", "coherent", "repeated"]
OUTLIER_KINDS: tuple[str, ...] = get_args(OutlierKind)

COHERENT_YAW_DEG = (20.0, 60.0)
COHERENT_SHIFT_M = (1.5, 3.0)
"""Yaw and distance between the true camera and the one that coherent outliers agree with, least and most."""
REPEAT_STEP_M = 2.0
"""Distance along the map's x axis after which a repeated facade looks the same again."""
REPEATS = np.array([1, -1, 2, -2])
"""How many steps away a match may land; the nearer copies twice as often."""
POSE_DRAWS = 60
"""Wrong poses that are drawn for each point before its wrong pixel is drawn itself."""
NARROW_POSE_DRAWS = 8
"""As many where the field of view is not the camera's whole one, where most poses do not see the point."""
PIXEL_DRAWS = 400


def random_poses(rng: np.random.Generator, count: int) -> FloatArray:
    """Level poses (count, 3, 4): any yaw, translation uniform in the cube."""
    yaws = rng.uniform(-np.pi, np.pi, count)
    poses = np.zeros((count, 3, 4))
    poses[:, :, 3] = rng.uniform(-HALF_SIZE_M, HALF_SIZE_M, (count, 3))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(yaws)
    poses[:, 0, 2] = np.sin(yaws)
    poses[:, 2, 0] = -poses[:, 0, 2]
    poses[:, 1, 1] = 1.0
    return poses


def random_pixels(rng: np.random.Generator, lens: Lens, points: FloatArray, name: str) -> FloatArray:
    """Pixels (N, 2) of the points (N, 3) under a random level pose each under which it is visible.

    Where many poses in turn do not see a point, its pixel is that of a random bearing. Raises ``InputError``, with
    the scene's ``name``, if the camera sees next to nothing.
    """
    pixels = np.full((len(points), 2), np.nan)
    pose_draws = POSE_DRAWS if lens.field_of_view_deg == WHOLE_SPHERE_DEG else NARROW_POSE_DRAWS
    for draw in range(pose_draws + PIXEL_DRAWS):
        missing = np.flatnonzero(np.isnan(pixels[:, 0]))
        if len(missing) == 0:
            return pixels
        if draw < pose_draws:
            poses = random_poses(rng, len(points))[missing]
            rays = np.einsum("nij,nj->ni", poses[:, :, :3], points[missing]) + poses[:, :, 3]
        else:
            rays = random_bearings(rng, len(missing), lens.field_of_view_deg)
        candidates, visible = lens.project(np.eye(3, 4), rays)
        pixels[missing[visible]] = candidates[visible]
    raise InputError(f"{name}: the camera sees too little of the cube to make outliers; give a wider camera.")


def second_pose(rng: np.random.Generator, truth: FloatArray, field_of_view_deg: float) -> FloatArray:
    """A level pose (3, 4) beside the true one (3, 4): turned by 20 to 60 degrees and 1.5 to 3 m away.

    It is drawn relative to the truth, so that it goes along where the true camera is moved, and is nearer where the
    field of view is less than 180 degrees, since both cameras must see the same points.
    """
    narrow = min(1.0, field_of_view_deg / 180.0)
    yaw_deg = narrow * rng.uniform(*COHERENT_YAW_DEG) * rng.choice([-1.0, 1.0])
    side, distance, height = rng.uniform(-np.pi, np.pi), rng.uniform(*COHERENT_SHIFT_M), rng.uniform(-0.5, 0.5)
    turn = yaw_rotation(np.radians(yaw_deg))
    shift = narrow * np.array([distance * np.cos(side), height, distance * np.sin(side)])
    return pose(turn @ truth[:, :3], turn @ truth[:, 3] + shift)


def clearly_apart(one: FloatArray, other: FloatArray) -> bool:
    """Whether two level poses (3, 4) are at least 1 m and 10 degrees of yaw apart: none passes for the other."""
    apart_m = np.linalg.norm(camera_centre(one) - camera_centre(other))
    return bool(apart_m >= 1.0 and abs(wrap_angle(yaw_of(one[:, :3] @ other[:, :3].T))) >= np.radians(10.0))


def copies(rng: np.random.Generator, lens: Lens, truth: FloatArray, points: FloatArray) -> FloatArray:
    """Where points (N, 3) are found again in repeated structure (N, 3): one or two steps along x away.

    If possible a copy that the camera sees from the true pose (3, 4) and that lies in the cube.
    """
    order = rng.exponential(np.abs(REPEATS), (len(points), len(REPEATS)))
    for number, steps in enumerate(REPEATS):
        copy = points + np.array([REPEAT_STEP_M * steps, 0.0, 0.0])
        order[:, number] += 1e3 * ~lens.project(truth, copy)[1] + 1e6 * (np.abs(copy[:, 0]) > HALF_SIZE_M)
    found = points.copy()
    found[:, 0] += REPEAT_STEP_M * REPEATS[np.argmin(order, axis=1)]
    return found
