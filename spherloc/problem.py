"""A localization problem: correspondences, camera, gravity, and the truth where it is known."""

from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.base import Camera
from spherloc.errors import ProblemError, show
from spherloc.geometry import align_to_down, pose
from spherloc.ranges import MAX_M, MAX_PX, MIN_M, MIN_PX, is_number
from spherloc.types import BoolArray, FloatArray, IntArray

MIN_STRETCH = 0.01
"""Smallest ratio of the two singular values of an unprojection's Jacobian; a smaller one is replaced by it."""

MAX_SOURCE = 200
"""Largest number of characters of ``Problem.gravity_source``."""


@dataclass(frozen=True, eq=False)
class Problem:
    """N measured 2D-3D correspondences of one query image. Arrays are copied and made read-only."""

    name: str
    """Name that users see; also the beginning of the file names of recordings."""
    camera: Camera
    """The query camera."""
    pixels: FloatArray
    """Measured pixels (N, 2)."""
    points: FloatArray
    """Matched map points (N, 3), metres, map frame."""
    gravity_camera: FloatArray
    """Unit vector (3,) pointing down in the camera frame (known roll and pitch)."""
    gravity_map: FloatArray
    """Unit vector (3,) pointing down in the map frame."""
    gravity_bound_rad: float = 0.0
    """Bound on the angular error of ``gravity_camera``."""
    gravity_sd_rad: float | None = None
    """Standard deviation of each of its two tilts; None takes a third of the bound."""
    gravity_source: str = ""
    """Source of ``gravity_camera`` in a few words, such as "the IMU"; empty if unknown."""
    bound_px: float | None = None
    """Bound that the scene asks for, px; None leaves it to the estimator."""
    truth_cam_from_map: FloatArray | None = None
    """True pose (3, 4), if known."""
    truth_inliers: BoolArray | None = None
    """True inlier mask (N,), if known."""
    image: Path | None = None
    """The query image, if there is one."""
    scene: str = field(default="")
    """Where the problem comes from: a scene file or a description."""
    reference_images: tuple[Path, ...] = ()
    """Images that the query was matched with, if its correspondences come from images."""
    reference_index: IntArray | None = None
    """(N,) index into ``reference_images`` of each correspondence."""
    reference_pixels: FloatArray | None = None
    """(N, 2) pixel of each correspondence in its reference image; NaN where it is unknown."""
    estimated_outlier_rate: float | None = None
    """Rough estimate of the outlier rate, 0 to 1, by the front end from the statistics of its matches."""
    remarks: tuple[str, ...] = ()
    """Sentences of the loader and the front end about what they skipped and why."""
    verified_without_point: int = 0
    """Number of matches between the query and its references that agree with one motion but have no map point; counted
    only if few have one. If it exceeds the number of correspondences, the map is too sparse."""
    metric: bool = True
    """Whether the map's lengths are metres. If not, all values in metres are in the map's own unit, whose length is
    unknown."""

    def __post_init__(self) -> None:
        pixels, points = _array(self, "pixels", (-1, 2)), _array(self, "points", (-1, 3))
        if len(pixels) != len(points):
            raise ProblemError(f"{self.name}: {len(pixels)} pixels but {len(points)} points; give one point a pixel.")
        for name in ("gravity_camera", "gravity_map"):
            _unit(self, name)
        below_90 = float(np.nextafter(np.pi / 2, 0.0))
        _scalar(self, "gravity_bound_rad", 0.0, below_90, "an angle from 0 to below pi / 2")
        _scalar(self, "gravity_sd_rad", 0.0, np.inf, "0 or more, or inf if nothing is known")
        if not isinstance(self.gravity_source, str) or len(self.gravity_source) > MAX_SOURCE:
            raise ProblemError(f"{self.name}: gravity_source is not a text of up to {MAX_SOURCE} characters; give one.")
        if not isinstance(self.metric, bool):
            raise ProblemError(f"{self.name}: metric is {self.metric!r}; give true or false.")
        _scalar(self, "bound_px", MIN_PX, MAX_PX, f"{MIN_PX:g} to {MAX_PX:,.0f} pixels")
        lacking = self.verified_without_point
        if isinstance(lacking, bool) or not isinstance(lacking, int) or lacking < 0:
            raise ProblemError(f"{self.name}: verified_without_point is {show(lacking)}; give a count from 0.")
        _scalar(self, "estimated_outlier_rate", 0.0, 1.0, "a share from 0 to 1")
        _check_reach(self.name, "points reach", points)
        if self.truth_cam_from_map is not None:
            truth = _array(self, "truth_cam_from_map", (3, 4))
            _check_rotation(self.name, truth)
            _check_reach(self.name, "the true position reaches", truth[:, 3:], least_m=0.0)
        if self.truth_inliers is not None:
            mask = _of_kind(self, "truth_inliers", "biu").astype(bool)
            if mask.shape != (len(pixels),):
                raise ProblemError(f"{self.name}: {mask.size} inlier labels for {len(pixels)} correspondences.")
            object.__setattr__(self, "truth_inliers", _frozen(mask))
        _check_references(self)
        usable = int(np.count_nonzero(self.usable))
        if usable < 2:
            raise ProblemError(
                f"{self.name}: {usable} usable of {len(pixels)} correspondences; "
                "two with pixels that the camera can see are the least that fix a pose."
            )

    def __len__(self) -> int:
        return len(self.pixels)

    def __repr__(self) -> str:
        width, height = self.camera.width, self.camera.height
        truth = "" if self.truth_cam_from_map is None else ", true pose known"
        return f"<Problem {show(self.name)}: {len(self)} matches, {self.camera.model} {width}x{height}{truth}>"

    @property
    def unit(self) -> str:
        """Unit of the map's lengths: "m" or "units"."""
        return "m" if self.metric else "units"

    @property
    def gravity_words(self) -> str:
        """The source of gravity and its bound in words: "from the IMU, within 3 deg"."""
        source = f"from {self.gravity_source}, " if self.gravity_source else ""
        bound_deg = np.degrees(self.gravity_bound_rad)
        return f"{source}{f'within {bound_deg:.2g} deg' if bound_deg else 'taken as exact'}"

    @property
    def gravity_error_rad(self) -> float | None:
        """Angle between ``gravity_camera`` and the true pose's gravity; None if the true pose is unknown."""
        if self.truth_cam_from_map is None:
            return None
        down = self.truth_cam_from_map[:, :3] @ self.gravity_map
        sine = np.linalg.norm(np.cross(self.gravity_camera, down))
        return float(np.arctan2(sine, self.gravity_camera @ down))

    @cached_property
    def _unprojected(self) -> tuple[FloatArray, BoolArray]:
        bearings, valid = self.camera.unproject(self.pixels)
        return _frozen(bearings), _frozen(valid)

    @property
    def bearings(self) -> FloatArray:
        """Unit bearings (N, 3), camera frame; NaN where the camera model cannot see the pixel."""
        return self._unprojected[0]

    @property
    def usable(self) -> BoolArray:
        """Mask (N,): the pixel has a bearing. Others are kept and always count as outliers."""
        return self._unprojected[1]

    @cached_property
    def _stretch(self) -> tuple[FloatArray, FloatArray]:
        """``pixel_from_bearing`` and ``radians_per_pixel``."""
        count, usable = len(self), self.usable
        inverse = np.full((count, 2, 3), np.nan)
        largest = np.full(count, np.nan)
        bearings, jacobian = self.bearings[usable], self.camera.unprojection_jacobian(self.pixels[usable])
        inverse[usable], largest[usable] = _inverted(bearings, jacobian)
        return _frozen(inverse), _frozen(largest)

    @property
    def pixel_from_bearing(self) -> FloatArray:
        """(N, 2, 3): maps a unit bearing close to the measured one to its pixel residual, to first order.

        It is the inverse of the unprojection's Jacobian on the tangent plane, so that estimators measure reprojection
        error in pixels without knowing the camera model.
        """
        return self._stretch[0]

    @property
    def radians_per_pixel(self) -> FloatArray:
        """(N,): the largest singular value of the unprojection's Jacobian, rad/px."""
        return self._stretch[1]

    @cached_property
    def aligned(self) -> "AlignedProblem":
        """The usable correspondences with gravity turned to +y in both frames: what estimators see."""
        camera_turn, map_turn = align_to_down(self.gravity_camera), align_to_down(self.gravity_map)
        index = np.flatnonzero(self.usable)
        arrays = {
            "bearings": self.bearings[index] @ camera_turn.T,
            "points": self.points[index] @ map_turn.T,
            "pixel_from_bearing": self.pixel_from_bearing[index] @ camera_turn.T,
            "radians_per_pixel": self.radians_per_pixel[index],
            "camera_turn": camera_turn,
            "map_turn": map_turn,
        }
        frozen = {name: _frozen(np.ascontiguousarray(array)) for name, array in arrays.items()}
        bound, sd = self.gravity_bound_rad, self.gravity_sd_rad
        return AlignedProblem(
            index=_frozen(index),
            count=len(self),
            gravity_bound_rad=bound,
            gravity_sd_rad=bound / 3.0 if sd is None else sd,
            estimated_outlier_rate=self.estimated_outlier_rate,
            **frozen,
        )


@dataclass(frozen=True, eq=False)
class AlignedProblem:
    """M usable correspondences in frames whose y axes point down; the unknowns are yaw and translation."""

    index: IntArray
    """Their indices (M,) in the problem."""
    count: int
    """N, the number of correspondences in the problem."""
    camera_turn: FloatArray
    """Rotation (3, 3), aligned camera frame from camera frame."""
    map_turn: FloatArray
    """Rotation (3, 3), aligned map frame from map frame."""
    bearings: FloatArray
    """Unit bearings (M, 3)."""
    points: FloatArray
    """Map points (M, 3), metres."""
    pixel_from_bearing: FloatArray
    """(M, 2, 3), see ``Problem.pixel_from_bearing``."""
    radians_per_pixel: FloatArray
    """(M,), rad/px."""
    gravity_bound_rad: float
    """Bound on the angle between the true gravity and +y in the camera frame."""
    gravity_sd_rad: float
    """Standard deviation of each of its two tilts: 0 where gravity is exact, inf where it is unknown."""
    estimated_outlier_rate: float | None = None
    """The front end's estimate of the outlier rate, 0 to 1."""

    def __post_init__(self) -> None:
        # Kernels are compiled for read-only arrays; for writable ones numba would compile them once more.
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @cached_property
    def pixels_per_radian(self) -> FloatArray:
        """(M,) pixels per radian, in the direction in which there are most."""
        # The larger singular value of two rows a, b.
        a, b = self.pixel_from_bearing[:, 0], self.pixel_from_bearing[:, 1]
        aa, bb, ab = (np.einsum("ni,ni->n", u, v) for u, v in ((a, a), (b, b), (a, b)))
        return np.sqrt(0.5 * (aa + bb) + np.hypot(0.5 * (aa - bb), ab))

    def unalign_pose(self, cam_from_map: FloatArray) -> FloatArray:
        """The pose (3, 4) between the problem's own frames, from one between the aligned frames."""
        return self.unalign_poses(cam_from_map[None])[0]

    def unalign_poses(self, cam_from_map: FloatArray) -> FloatArray:
        """``unalign_pose`` of each of P poses (P, 3, 4): the same to the last bit, as products of stacks are."""
        turned = self.camera_turn.T @ cam_from_map
        turned[:, :, :3] = turned[:, :, :3] @ self.map_turn
        return turned

    def align_pose(self, cam_from_map: FloatArray) -> FloatArray:
        """The inverse of ``unalign_pose``."""
        rotation = self.camera_turn @ cam_from_map[:, :3] @ self.map_turn.T
        return pose(rotation, self.camera_turn @ cam_from_map[:, 3])

    def align_poses(self, cam_from_map: FloatArray) -> FloatArray:
        """``align_pose`` of each of P poses (P, 3, 4)."""
        rotations = self.camera_turn @ cam_from_map[:, :, :3] @ self.map_turn.T
        return np.concatenate([rotations, (cam_from_map[:, :, 3] @ self.camera_turn.T)[:, :, None]], axis=2)

    def full_mask(self, mask: BoolArray) -> BoolArray:
        """A mask (M,) over the usable correspondences as one (N,) over all."""
        full = np.zeros(self.count, dtype=bool)
        full[self.index[mask]] = True
        return full


def _inverted(bearings: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses (M, 2, 3) of unprojection Jacobians (M, 3, 2) on the tangent planes of bearings (M, 3), and the larger
    singular value (M,) of each.

    A rotation of the pixel plane makes the columns of a Jacobian orthogonal, so that they are its singular vectors.
    """
    u, v = jacobian[:, :, 0], jacobian[:, :, 1]
    angle = 0.5 * np.arctan2(2.0 * _dot(u, v), _dot(u, u) - _dot(v, v))
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along, across = cos * u + sin * v, cos * v - sin * u
    largest = np.sqrt(_dot(along, along))[:, None]
    along /= largest
    side: FloatArray = np.cross(bearings, along)
    smallest = _dot(side, across)[:, None]
    # At a panorama's pole one singular value is 0; without a lower limit, a residual in that direction would be 0.
    across = side / np.copysign(np.maximum(np.abs(smallest), MIN_STRETCH * largest), smallest)
    along /= largest
    return np.stack([cos * along - sin * across, sin * along + cos * across], axis=1), largest[:, 0]


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    """Dot products (M,) of the rows of two (M, 3)."""
    return np.einsum("ni,ni->n", first, second)


def _check_reach(name: str, what: str, places_m: FloatArray, least_m: float = MIN_M) -> None:
    reach_m = float(np.abs(places_m).max(initial=0.0))
    if reach_m and not least_m <= reach_m <= MAX_M:
        limits = f"{least_m:g} to {MAX_M:g} m"
        raise ProblemError(f"{name}: {what} {reach_m:.3g} m from the origin; give metres, {limits}.")


def _frozen(array: Any) -> Any:
    """The array, made read-only."""
    array.setflags(write=False)
    return array


def _numbers(problem: Problem, name: str) -> FloatArray:
    return _of_kind(problem, name, "fiubO").astype(np.float64)


def _of_kind(problem: Problem, name: str, kinds: str) -> NDArray[Any]:
    """A field as an array of one of numpy's ``kinds``; raises ``ProblemError`` if it cannot be one."""
    try:
        array = np.array(getattr(problem, name))
        array = array.astype(np.float64) if array.dtype.kind == "O" else array
    except (TypeError, ValueError, OverflowError):
        array = np.array("")
    if array.dtype.kind not in kinds and array.size:
        raise ProblemError(f"{problem.name}: {name} is not an array of numbers; give one with rows of the same length.")
    return array


def _array(problem: Problem, name: str, shape: tuple[int, int]) -> FloatArray:
    array = _numbers(problem, name)
    if array.ndim != 2 or array.shape[1] != shape[1] or (shape[0] >= 0 and array.shape[0] != shape[0]):
        rows = "N" if shape[0] < 0 else shape[0]
        raise ProblemError(f"{problem.name}: {name} has shape {array.shape}; give ({rows}, {shape[1]}).")
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0, 0])
        raise ProblemError(f"{problem.name}: {name} row {row} is not a finite number; correct or remove it.")
    object.__setattr__(problem, name, _frozen(array))
    return array


def _check_references(problem: Problem) -> None:
    count, images = len(problem.pixels), len(problem.reference_images)
    if problem.reference_index is not None:
        given = _numbers(problem, "reference_index")
        if given.shape != (count,) or not ((given >= 0) & (given < images) & (given == np.floor(given))).all():
            raise ProblemError(
                f"{problem.name}: reference_index must name one of {images} reference images for each of {count} "
                "correspondences."
            )
        object.__setattr__(problem, "reference_index", _frozen(given.astype(np.int64)))
    if problem.reference_pixels is not None:
        pixels = _numbers(problem, "reference_pixels")
        if pixels.shape != (count, 2):
            raise ProblemError(f"{problem.name}: reference_pixels has shape {pixels.shape}; give ({count}, 2).")
        object.__setattr__(problem, "reference_pixels", _frozen(pixels))


def _scalar(problem: Problem, name: str, least: float, most: float, advice: str) -> None:
    """Make a field a float within limits; None stays where that is its default."""
    value = getattr(problem, name)
    if value is None and name != "gravity_bound_rad":
        return
    try:
        number = float(value) if value is not None and is_number(value) else np.nan
    except OverflowError:  # an integer beyond all floats
        number = np.nan
    if not least <= number <= most:
        raise ProblemError(f"{problem.name}: {name} is {show(value)}; give {advice}.")
    object.__setattr__(problem, name, number)


def _unit(problem: Problem, name: str) -> None:
    vector = _numbers(problem, name)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ProblemError(f"{problem.name}: {name} must be three finite numbers.")
    length = float(np.linalg.norm(vector))
    if abs(length - 1.0) > 1e-3:
        raise ProblemError(f"{problem.name}: {name} has length {length:.4g}; give a unit vector pointing down.")
    # A unit vector is not changed in its last bits, so that a problem that is read back is the same problem.
    object.__setattr__(problem, name, _frozen(vector / length if abs(length - 1.0) > 1e-15 else vector))


def _check_rotation(name: str, cam_from_map: FloatArray) -> None:
    rotation = cam_from_map[:, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise ProblemError(f"{name}: the left 3x3 block of the true cam_from_map is not a rotation matrix; correct it.")
