"""Writes a lens that COLMAP has no camera model for as a Kannala-Brandt camera or, if that is far off, FISHEYE624."""

from math import radians

import numpy as np

from spherloc.cameras.base import Camera, model_name
from spherloc.cameras.colmap_models import colmap_camera
from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import CalibrationError
from spherloc.types import FloatArray

MAX_OFF_PX = 0.5
"""Largest distance between a pixel of the lens and of its form in COLMAP."""
WIDEST_RAD = radians(85.0)
"""Directions farther from the optical axis do not count: COLMAP's fisheyes end at 90 degrees."""
_GRID = 40


def for_colmap(camera: Camera) -> tuple[Camera, str]:
    """The camera itself if COLMAP has its model, else one with the same pixels to half a pixel, and a remark.

    Raises ``CalibrationError`` if there is none.
    """
    try:
        colmap_camera(camera)
    except CalibrationError:
        return _fitted(camera)
    return camera, ""


def _fitted(camera: Camera) -> tuple[Camera, str]:
    from scipy.optimize import least_squares  # takes a third of a second

    u, v = np.meshgrid(*(np.linspace(0.5, size - 0.5, _GRID) for size in (camera.width, camera.height)))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    bearings, seen = camera.unproject(pixels)
    seen &= bearings[:, 2] > np.cos(WIDEST_RAD)
    pixels, bearings = pixels[seen], bearings[seen]

    def off(values: FloatArray) -> FloatArray:
        return (_projected(values, bearings) - pixels).ravel()

    half = np.array([camera.width, camera.height]) / 2
    per_rad = np.median(np.linalg.norm(pixels - half, axis=1) / np.maximum(_angle(bearings), 1e-3))
    worst = np.inf
    for terms in (4, 6):
        start, units = [per_rad, per_rad, *half, *[0.0] * terms], [100, 100, 10, 10, *[0.1] * terms]
        found = least_squares(off, start, x_scale=units).x.tolist()
        worst = float(np.linalg.norm(off(np.array(found)).reshape(-1, 2), axis=1).max())
        if worst <= MAX_OFF_PX:
            fitted = _with_terms(camera, found)
            name = model_name(fitted)
            return fitted, f"The lens ({camera.model}) is written as {name} for COLMAP, {worst:.2f} px off at most."
    raise CalibrationError(
        f"COLMAP has no camera model {camera.model}, and the nearest lens of one that it has is {worst:.1f} px off; "
        "give a calibration as kannala_brandt, fisheye624 or eucm."
    )


def _with_terms(camera: Camera, values: list[float]) -> Camera:
    """A camera of that size by fx, fy, cx, cy and four terms of the angle, of Kannala-Brandt, or six, of FISHEYE624."""
    fx, fy, cx, cy, *terms = values
    focal = camera.width, camera.height, fx, fy, cx, cy
    if len(terms) == 4:
        k1, k2, k3, k4 = terms
        return KannalaBrandt(*focal, (k1, k2, k3, k4))
    return Fisheye624(*focal, (*terms, *[0.0] * 6))


def _angle(bearings: FloatArray) -> FloatArray:
    """Angles (N,) to the optical axis, rad."""
    return np.arctan2(np.hypot(bearings[:, 0], bearings[:, 1]), bearings[:, 2])


def _projected(values: FloatArray, bearings: FloatArray) -> FloatArray:
    """Pixels (N, 2) of bearings (N, 3) by fx, fy, cx, cy, k1, k2, ... (Eq. 4)."""
    theta = _angle(bearings)
    curve = theta * (1.0 + sum(k * theta ** (2 * n) for n, k in enumerate(values[4:], start=1)))
    around = np.hypot(bearings[:, 0], bearings[:, 1])
    scale = curve / np.where(around > 0.0, around, 1.0)
    return values[:2] * bearings[:, :2] * scale[:, None] + values[2:4]
