"""Random map points that a camera sees, and the wrong matches of simulated problems."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from spherloc.cameras.base import Camera, in_image
from spherloc.errors import InputError
from spherloc.geometry import camera_centre, pose, transform, wrap_angle, yaw_of, yaw_rotation
from spherloc.types import BoolArray, FloatArray, IntArray

Rngs = tuple[np.random.Generator, np.random.Generator, np.random.Generator]

Draws = Literal["uniform", "normal"]
DRAWS: tuple[str, ...] = get_args(Draws)
HALF_SIZE_M = 5.0
"""Half the side of the paper's cube, m."""
WHOLE_SPHERE_DEG = 360.0
BATCH = 512
MAX_BATCHES = 400
AHEAD_M = (1.0, 10.0)
"""Least and largest distance of points that are drawn in front of a camera that sees too few points of the cube."""
AHEAD_DRAWS = 60


def sees(camera: Camera, pixels: FloatArray, field_of_view_deg: float = WHOLE_SPHERE_DEG) -> BoolArray:
    """Which pixels (N, 2) are in the image, valid for the model, and within half the field of view from its axis."""
    bearings, valid = camera.unproject(pixels)
    return in_image(camera, pixels) & valid & _within(bearings, field_of_view_deg)


def _within(rays: FloatArray, field_of_view_deg: float) -> BoolArray:
    """Which rays (N, 3) of any length are within half the field of view from the optical axis; not NaN."""
    if field_of_view_deg >= WHOLE_SPHERE_DEG:
        return np.ones(len(rays), dtype=bool)
    return np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]) <= np.radians(0.5 * field_of_view_deg)


@dataclass(frozen=True)
class Lens:
    """A camera of which only a part of the field of view is used."""

    camera: Camera
    """The camera with its full field of view."""
    field_of_view_deg: float = WHOLE_SPHERE_DEG
    """Whatever is farther than half of it from the optical axis is not seen, degrees."""

    def sees(self, pixels: FloatArray) -> BoolArray:
        """Which pixels (N, 2) are within the used field of view: a mask (N,)."""
        return sees(self.camera, pixels, self.field_of_view_deg)

    def project(self, cam_from_map: FloatArray, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of points (N, 3) from a pose (3, 4), and which of them (N,) it sees."""
        rays = transform(cam_from_map, points)
        pixels, valid = self.camera.project(rays)
        return pixels, valid & in_image(self.camera, pixels) & _within(rays, self.field_of_view_deg)


def _coordinates(rng: np.random.Generator, count: int, draws: Draws) -> FloatArray:
    """(count, 3) in metres, uniform in the cube or standard normal."""
    if draws == "normal":
        return rng.standard_normal((count, 3))
    return rng.uniform(-HALF_SIZE_M, HALF_SIZE_M, (count, 3))


@dataclass(frozen=True)
class Cloud:
    """Random points in the paper's cube, or in a flat part of it."""

    name: str
    """Name of the scene, for messages."""
    middle_m: float
    """Height of the middle of a flat cloud (y of the map)."""
    height_m: float = 2 * HALF_SIZE_M
    """Height of the cloud, m; at most that of the cube."""
    draws: Draws = "uniform"
    """The distribution of the coordinates: uniform in the cube, or standard normal, m."""

    def draw(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Points (count, 3) anywhere in the cloud."""
        return self.flattened(_coordinates(rng, count, self.draws), 0.0)

    def flattened(self, points: FloatArray, middle_m: float) -> FloatArray:
        """The points (N, 3) of a cube around the height ``middle_m``, moved up and down into the cloud."""
        if self.height_m < 2 * HALF_SIZE_M:
            part = np.clip((points[:, 1] - middle_m) / HALF_SIZE_M, -1.0, 1.0)
            points[:, 1] = self.middle_m + 0.5 * self.height_m * part
        return points

    def seen_from(
        self, rngs: Rngs, count: int, lens: Lens, home: FloatArray, poses: Sequence[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Random points (count, 3) that are seen from all ``poses``, and the noise (count, 2) of their pixels, sd 1.

        They are the first points that the camera, with its full field of view, sees from the pose ``home`` (3, 4).
        Those that are not seen from ``poses`` are replaced by other points of the cube that are; where these are too
        few, by points in front of the camera. ``rngs`` draw points, noise, and the points in front, in this order.
        Raises ``InputError`` if too few are seen.
        """
        whole = Lens(lens.camera)
        changed = lens != whole or len(poses) > 1 or poses[0] is not home
        most = min(MAX_BATCHES, 8 + 6 * count // BATCH) if changed else MAX_BATCHES
        batches: list[tuple[FloatArray, FloatArray, BoolArray, BoolArray]] = []
        found = 0
        while found < count and len(batches) < most:
            points = self.draw(rngs[0], BATCH)
            first = whole.project(home, points)[1]
            seen = np.logical_and.reduce([lens.project(at, points)[1] for at in poses]) if changed else first
            batches.append((points, rngs[1].standard_normal((BATCH, 2)), first, seen))
            found += int(np.count_nonzero(first))
        if found < count and not changed:
            raise InputError(
                f"{self.name}: only {found} of {BATCH * MAX_BATCHES:,} random points are visible to the camera; give "
                "a wider camera, fewer correspondences or another seed."
            )
        points, shifts, first, seen = (np.concatenate(parts) for parts in zip(*batches, strict=True))
        chosen = _keep_or_replace(np.flatnonzero(first)[:count], seen, count)
        points, shifts, gaps = points[chosen], shifts[chosen], np.flatnonzero(chosen < 0)
        if len(gaps):
            more, noise = self._ahead(rngs[2], count, gaps, lens, poses)
            points[gaps], shifts[gaps] = more[gaps], noise[gaps]
        return points, shifts

    def _ahead(
        self, rng: np.random.Generator, count: int, gaps: IntArray, lens: Lens, poses: Sequence[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Points (count, 3) in front of the first of ``poses``, seen from all of them; only the rows ``gaps`` count.

        Each row has random draws of its own, so that a point stays the same when another one is no longer seen.
        """
        points, shifts = np.zeros((count, 3)), rng.standard_normal((count, 2))
        rotation, centre = poses[0][:, :3], camera_centre(poses[0])
        for _ in range(AHEAD_DRAWS):
            bearings = random_bearings(rng, count, lens.field_of_view_deg)[gaps]
            distances = rng.uniform(*AHEAD_M, (count, 1))[gaps]
            points[gaps] = self.flattened(centre + distances * bearings @ rotation, float(centre[1]))
            gaps = gaps[~np.logical_and.reduce([lens.project(at, points[gaps])[1] for at in poses])]
            if len(gaps) == 0:
                return points, shifts
        raise InputError(
            f"{self.name}: no points are visible to the camera for {len(gaps)} of the correspondences; give a wider "
            "camera or field of view, a higher cloud, another true camera or another seed."
        )


def random_bearings(rng: np.random.Generator, count: int, field_of_view_deg: float) -> FloatArray:
    """Unit vectors (count, 3), uniform within half the field of view from the optical axis."""
    z = rng.uniform(np.cos(np.radians(0.5 * field_of_view_deg)), 1.0, count)
    side, radius = rng.uniform(-np.pi, np.pi, count), np.sqrt(1.0 - z * z)
    return np.column_stack([radius * np.cos(side), radius * np.sin(side), z])


def _keep_or_replace(first: IntArray, seen: BoolArray, count: int) -> IntArray:
    """Indices (count,) of ``seen`` points: those of ``first`` stay in their rows, others fill the gaps in order.

    -1 where there are too few.
    """
    chosen = np.full(count, -1)
    chosen[: len(first)] = np.where(seen[first], first, -1)
    others = seen.copy()
    others[first] = False
    spare, gaps = np.flatnonzero(others), np.flatnonzero(chosen < 0)
    filled = min(len(spare), len(gaps))
    chosen[gaps[:filled]] = spare[:filled]
    return chosen


OutlierKind = Literal["random", "coherent", "repeated"]
OUTLIER_KINDS: tuple[str, ...] = get_args(OutlierKind)

COHERENT_YAW_DEG = (20.0, 60.0)
COHERENT_SHIFT_M = (1.5, 3.0)
"""Least and largest difference in yaw and position between the true pose and that of coherent outliers."""
REPEAT_STEP_M = 2.0
"""Distance along the map's x axis after which a repeated facade looks the same again."""
REPEATS = np.array([1, -1, 2, -2])
"""Steps between a point and the copy that it is matched with; the nearer copies are drawn twice as often."""
POSE_DRAWS = 60
"""Number of wrong poses that are drawn for a point; if none sees the point, a random pixel is drawn instead."""
NARROW_POSE_DRAWS = 8
"""The same where only a part of the camera's field of view is used: most poses then do not see the point."""
PIXEL_DRAWS = 400


def random_poses(rng: np.random.Generator, count: int, draws: Draws = "uniform") -> FloatArray:
    """Level poses (count, 3, 4): any yaw, translation uniform in the cube or standard normal (m)."""
    yaws = rng.uniform(-np.pi, np.pi, count)
    poses = np.zeros((count, 3, 4))
    poses[:, :, 3] = _coordinates(rng, count, draws)
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(yaws)
    poses[:, 0, 2] = np.sin(yaws)
    poses[:, 2, 0] = -poses[:, 0, 2]
    poses[:, 1, 1] = 1.0
    return poses


def random_pixels(
    rng: np.random.Generator, lens: Lens, points: FloatArray, name: str, draws: Draws = "uniform"
) -> FloatArray:
    """Pixels (N, 2) of the points (N, 3), each projected by a random level pose of its own that sees it.

    Where many drawn poses do not see a point, its pixel is that of a random bearing. Raises ``InputError``, with
    the scene's ``name``, if the camera sees next to nothing.
    """
    pixels = np.full((len(points), 2), np.nan)
    pose_draws = POSE_DRAWS if lens.field_of_view_deg == WHOLE_SPHERE_DEG else NARROW_POSE_DRAWS
    for draw in range(pose_draws + PIXEL_DRAWS):
        missing = np.flatnonzero(np.isnan(pixels[:, 0]))
        if len(missing) == 0:
            return pixels
        if draw < pose_draws:
            poses = random_poses(rng, len(points), draws)[missing]
            rays = np.einsum("nij,nj->ni", poses[:, :, :3], points[missing]) + poses[:, :, 3]
        else:
            rays = random_bearings(rng, len(missing), lens.field_of_view_deg)
        candidates, visible = lens.project(np.eye(3, 4), rays)
        pixels[missing[visible]] = candidates[visible]
    raise InputError(f"{name}: the camera sees too little of the cube to make outliers; give a wider camera.")


def second_pose(rng: np.random.Generator, truth: FloatArray, field_of_view_deg: float) -> FloatArray:
    """A level pose (3, 4) beside the true one (3, 4): turned by 20 to 60 degrees and 1.5 to 3 m away.

    It is drawn relative to the truth, so that it moves with the true camera. It is nearer where the field of view is
    less than 180 degrees, since both cameras must see the same points.
    """
    narrow = min(1.0, field_of_view_deg / 180.0)
    yaw_deg = narrow * rng.uniform(*COHERENT_YAW_DEG) * rng.choice([-1.0, 1.0])
    side, distance, height = rng.uniform(-np.pi, np.pi), rng.uniform(*COHERENT_SHIFT_M), rng.uniform(-0.5, 0.5)
    turn = yaw_rotation(np.radians(yaw_deg))
    shift = narrow * np.array([distance * np.cos(side), height, distance * np.sin(side)])
    return pose(turn @ truth[:, :3], turn @ truth[:, 3] + shift)


def clearly_apart(one: FloatArray, other: FloatArray) -> bool:
    """Whether two level poses (3, 4) are at least 1 m and 10 degrees of yaw apart, too far to count as the same."""
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
