"""From arrays to a pose: the entry points for programs that have matches of their own."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from html import escape
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from spherloc.cameras._checks import MAX_SIDE_PX, rows
from spherloc.cameras.base import Camera
from spherloc.cameras.calibration import camera_from_table, load_camera
from spherloc.cameras.colmap_models import camera_from_colmap
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.diagnosis import Diagnosis, diagnose
from spherloc.errors import CalibrationError, InputError, show
from spherloc.estimators import estimate
from spherloc.geometry import camera_centre
from spherloc.metrics import AWAY, is_away
from spherloc.outcome import Judgement, Outcome, judge
from spherloc.problem import Problem
from spherloc.registry import require
from spherloc.trace import Certificate, RefinementStage, Trace
from spherloc.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from spherloc.frontend.view import Gravity

CAMERA = "the camera"
"""Name, in messages, of a camera that does not come from a file."""
BOUND_PX = 3.0
"""Approximate size, in pixels of the assumed panorama, of the bound on bearings; the same as the default bound."""
MAX_OFF_UNIT = 1e-3
"""Largest difference of the length of a bearing from 1."""


@dataclass(frozen=True, eq=False, repr=False)
class Localization:
    """The result of one query with N correspondences."""

    trace: Trace
    """The whole run: all stages with their arrays."""

    @property
    def cam_from_map(self) -> FloatArray | None:
        """Estimated pose [R | t] (3, 4): x_cam = R x_map + t, metres; None if the matches allow none."""
        return self.trace.cam_from_map

    @property
    def position(self) -> FloatArray | None:
        """The camera's position (3,) in the map frame, metres; None without a pose."""
        return None if self.cam_from_map is None else camera_centre(self.cam_from_map)

    @property
    def inliers(self) -> BoolArray:
        """(N,) correspondences that agree with the pose."""
        return self.trace.inlier_mask

    @property
    def certificate(self) -> Certificate | None:
        """What is proven about the number of inliers; None if the estimator proves nothing."""
        return self.trace.certificate

    @property
    def covariance(self) -> FloatArray | None:
        """Covariance (6, 6) of the pose's error, see ``RefinementStage.covariance``; None without a pose."""
        stage = self.trace.stage(RefinementStage)
        return None if stage is None else stage.covariance

    @cached_property
    def judgement(self) -> Judgement:
        """Whether the pose can be believed, with a score, and with reasons if it cannot."""
        return judge(self.trace)

    @property
    def outcome(self) -> Outcome:
        """Localized, doubtful or failed."""
        return self.judgement.outcome

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Why the run failed or is doubtful; runs further experiments, some tens of milliseconds."""
        return diagnose(self.trace)

    def _place(self, position: FloatArray) -> str:
        if is_away(position, self.trace.problem.points):
            return AWAY
        return f"{np.array2string(position, precision=3, suppress_small=True)} {self.trace.problem.unit}"

    def _rows(self) -> list[tuple[str, str]]:
        count, total = int(np.count_nonzero(self.inliers)), len(self.inliers)
        rows = [("outcome", f"{self.outcome} by {self.trace.estimator}")]
        if self.position is not None:
            rows += [
                ("position", self._place(self.position)),
                ("inliers", f"{count} of {total}"),
            ]
        if self.certificate is not None:
            least, most = self.certificate.lower_bound, self.certificate.upper_bound
            size = f"{most}" if least == most else f"{least} to {most}"
            rows.append(("certificate", f"the largest consensus of any pose, before refinement: {size} of {total}"))
        return rows + [("but", reason) for reason in self.judgement.reasons]

    def __repr__(self) -> str:
        return "Localization\n" + "\n".join(f"  {name:11} {value}" for name, value in self._rows())

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in self._rows())
        return f"<table>{''.join(rows)}</table>"


def localize(
    pixels: ArrayLike,
    points: ArrayLike,
    camera: Any,
    gravity: ArrayLike,
    *,
    gravity_map: ArrayLike = (0.0, 0.0, -1.0),
    gravity_bound_deg: float = 0.0,
    gravity_sd_deg: float | None = None,
    bound_px: float | None = None,
    estimator: str = "auto",
    options: Any = None,
    seed: int = 0,
    name: str = "query",
) -> Localization:
    """Localize one query image from its 2D-3D correspondences.

    Args:
        pixels: Measured pixels (N, 2); the centre of the top-left pixel is (0.5, 0.5), as in COLMAP.
        points: Matched map points (N, 3), metres.
        camera: A camera of this package, the path of a calibration file, a dict as in a scene's ``[camera]``, or a
            camera of COLMAP: a ``pycolmap.Camera``, or a dict with its model, width, height and params.
        gravity: Vector (3,) that points down in the camera frame (x right, y down, z forward), of any length.
        gravity_map: Vector (3,) that points down in the map frame.
        gravity_bound_deg: Bound on the angular error of ``gravity``, degrees.
        gravity_sd_deg: Standard deviation of each of its two tilts, degrees; None takes a third of the bound.
        bound_px: Bound on an inlier's reprojection error, pixels; None takes the estimator's own.
        estimator: Registered name, such as "auto", "mc-exact", "mc" or "ransac-2p".
        options: The estimator's options, as a dict of what differs from the defaults or as ``options_type(estimator)``.
        seed: Seed of all random draws; the same arguments give the same result.
        name: Name of the query in messages and recordings.

    Returns:
        The pose, its inliers, covariance and certificate, and whether it can be believed.

    Raises:
        InputError: For arrays of a wrong shape or with values that are not finite, a camera that cannot be used, and an
            unknown estimator or option, in one sentence.
    """
    problem = Problem(
        name=name,
        camera=as_camera(camera),
        pixels=_array("pixels", pixels),
        points=_array("points", points),
        gravity_camera=_direction("gravity", gravity),
        gravity_map=_direction("gravity_map", gravity_map),
        gravity_bound_rad=_radians("gravity_bound_deg", gravity_bound_deg),
        gravity_sd_rad=None if gravity_sd_deg is None else _radians("gravity_sd_deg", gravity_sd_deg),
        bound_px=bound_px,
    )
    return Localization(estimate(problem, estimator, options, seed))


def localize_bearings(
    bearings: ArrayLike, points: ArrayLike, gravity: ArrayLike, *, bound_deg: float, **settings: Any
) -> Localization:
    """``localize`` from bearings instead of pixels and a camera, such as those of a rig or of a camera of your own.

    The camera of the result is a panorama whose errors are angles and of which a pixel is about a third of the bound.

    Args:
        bearings: Unit vectors (N, 3) in the camera frame (x right, y down, z forward), one towards each matched point.
        points: Matched map points (N, 3), metres.
        gravity: Vector (3,) that points down in the camera frame, of any length.
        bound_deg: Bound on the angle between an inlier's bearing and its point, degrees, above 0 and below 90.
        settings: Further arguments of ``localize``, except ``bound_px``.

    Returns:
        As ``localize``.

    Raises:
        InputError: As ``localize``, and for bearings that are not unit vectors.
    """
    if "bound_px" in settings:
        raise InputError("bearings have no pixels; give bound_deg alone, without bound_px.")
    bound_rad = _radians("bound_deg", bound_deg)
    if not 0.0 < bound_rad < np.pi / 2:
        raise InputError(f"bound_deg is {show(bound_deg)}; give an angle above 0 and below 90 degrees.")
    directions = rows("bearings", bearings, 3)
    off = np.abs(np.linalg.norm(directions, axis=1) - 1.0)
    if not (off <= MAX_OFF_UNIT).all():
        row = int(np.flatnonzero(~(off <= MAX_OFF_UNIT))[0])
        raise InputError(f"bearings row {row} is {show(directions[row].tolist())}; give a unit vector.")
    half = min(max(round(np.pi / (bound_rad / BOUND_PX)), 1), MAX_SIDE_PX // 2)
    camera = Equirectangular(2 * half, half, angular=True)
    bound_px = np.sin(bound_rad) * half / np.pi  # residuals are measured in the tangent plane
    return localize(camera.project(directions)[0], points, camera, gravity, bound_px=bound_px, **settings)


def gravity_from_image(image: Any, camera: Any, near: ArrayLike = (0.0, 1.0, 0.0)) -> "Gravity":
    """Gravity in an image, from the direction in which its vertical lines meet.

    Args:
        image: The path of an image, or its pixels (H, W) or (H, W, 3), BGR bytes.
        camera: As for ``localize``.
        near: Vector (3,) that points approximately down in the camera frame, of any length; up to 45 degrees off.

    Returns:
        ``down`` (3,), a unit vector in the camera frame, with the bound ``bound_rad`` on its error and ``sd_rad``.

    Raises:
        InputError: If the image shows too few vertical lines, cannot be read, or has another size than the camera.
    """
    # OpenCV is slow to import.
    from spherloc.frontend.gravity_from_lines import gravity_of_pixels
    from spherloc.frontend.view import seen_pixels
    from spherloc.images import grey, read_image

    lens, direction = as_camera(camera), _direction("near", near)
    named = isinstance(image, str | Path)
    pixels = grey(read_image(Path(image))) if named else _array("image", image)
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise InputError(f"the image is {pixels.dtype} of shape {pixels.shape}; give bytes (H, W) or (H, W, 3).")
    if pixels.shape[:2] != (lens.height, lens.width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise InputError(f"the image has {size} pixels, its camera {lens.width} x {lens.height}; give those of one.")
    name = str(image) if named else "the image"
    return gravity_of_pixels(grey(pixels), lens, seen_pixels(lens), direction, name)


def estimate_absolute_pose(
    points2D: ArrayLike,
    points3D: ArrayLike,
    camera: Any,
    gravity: ArrayLike,
    **settings: Any,
) -> dict[str, Any] | None:
    """``localize`` as a replacement for ``pycolmap.estimate_absolute_pose``, with gravity (3,) as a further argument.

    Args:
        points2D: Pixels (N, 2); bearings (N, 3) if ``camera`` is None, see ``localize_bearings``.
        points3D: Matched map points (N, 3), metres.
        camera: As for ``localize``; None for bearings.
        gravity: Vector (3,) that points down in the camera frame, of any length.
        settings: Further arguments of ``localize``; of ``localize_bearings`` for bearings.

    Returns:
        A dict with ``cam_from_world`` (``pycolmap.Rigid3d``), ``num_inliers`` and ``inlier_mask``, and with
        ``localization``, the result of ``localize``; None if there is no pose.

    Raises:
        InputError: As ``localize``, if pycolmap is missing, and for bearings without ``bound_deg``.
    """
    pycolmap = require("pycolmap", "colmap", "estimate_absolute_pose")
    if camera is not None:
        found = localize(points2D, points3D, camera, gravity, **settings)
    elif "bound_deg" in settings:
        found = localize_bearings(points2D, points3D, gravity, **settings)
    else:
        raise InputError("bound_deg is missing; bearings, which have no camera, need it.")
    if found.cam_from_map is None:
        return None
    return {
        "cam_from_world": pycolmap.Rigid3d(np.ascontiguousarray(found.cam_from_map)),
        "num_inliers": int(np.count_nonzero(found.inliers)),
        "inlier_mask": found.inliers,
        "localization": found,
    }


def as_camera(camera: Any) -> Camera:
    """A camera from any description that ``localize`` takes.

    Raises ``InputError`` for anything else, and its subclass ``CalibrationError`` for a camera that cannot be used.
    """
    if isinstance(camera, Camera):
        return camera
    if isinstance(camera, str | Path):
        return load_camera(camera)
    if isinstance(camera, Mapping):
        if "params" not in camera:
            return camera_from_table(dict(camera), CAMERA)
        missing = [key for key in ("model", "width", "height") if key not in camera]
        if missing:
            raise CalibrationError(f"{CAMERA}: {missing[0]} is missing; give model, width, height and params.")
        return _from_colmap(camera["model"], camera["width"], camera["height"], camera["params"])
    if all(hasattr(camera, key) for key in ("model", "width", "height", "params")):
        return _from_colmap(camera.model, camera.width, camera.height, camera.params)
    raise InputError(
        f"the camera is {show(type(camera).__name__)}; give a camera, the path of a calibration file, a dict or a "
        "pycolmap.Camera."
    )


def _from_colmap(model: Any, width: Any, height: Any, params: Any) -> Camera:
    """The camera of a COLMAP model, which may be a name or a member of pycolmap's enumeration."""
    return camera_from_colmap(getattr(model, "name", model), width, height, params, CAMERA)


def _array(name: str, values: ArrayLike) -> Any:
    """An array, whose shape and kind ``Problem`` checks."""
    try:
        return np.asarray(values)
    except ValueError:
        raise InputError(f"{name} has rows of different lengths; give one row for each correspondence.") from None


def _direction(name: str, vector: ArrayLike) -> FloatArray:
    """A unit vector (3,)."""
    values = _array(name, vector)
    length = np.linalg.norm(values) if values.shape == (3,) and values.dtype.kind in "iuf" else np.nan
    if not (np.isfinite(length) and length > 0.0):
        raise InputError(f"{name} is {show(values.tolist())}; give three numbers that point down.")
    return values / length


def _radians(name: str, degrees: Any) -> float:
    if not isinstance(degrees, Real) or isinstance(degrees, bool):
        raise InputError(f"{name} is {show(degrees)}; give a number of degrees.")
    return float(np.radians(float(degrees)))
