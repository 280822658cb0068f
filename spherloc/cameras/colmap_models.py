"""Converts COLMAP's camera models (src/colmap/sensor/models.h) to this project's and back.

COLMAP too puts the centre of the top-left pixel at (0.5, 0.5): principal points are taken as they are.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from spherloc.cameras._checks import coefficients, located
from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.fisheye624 import Fisheye624
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError, show


def camera_from_colmap(model: str, width: int, height: int, params: Sequence[float] | np.ndarray, where: str) -> Camera:
    """The camera of a COLMAP model's name, image size in pixels and parameters in COLMAP's order.

    The perspective models become MEI with xi = 0, which is a pinhole with radial and tangential distortion, and the
    fisheye models Kannala-Brandt with the missing coefficients 0. SphereSfM's SPHERE is a panorama.

    Raises ``CalibrationError``, one sentence that starts with ``where``, for another model, a wrong number of
    parameters and unusable values.
    """
    with located(where):
        if model == "RAD_TAN_THIN_PRISM_FISHEYE" and np.shape(params) == (3,):
            model = "SPHERE"  # SphereSfM, a fork of COLMAP 3.8, gave it the number 11, which COLMAP gave to this one
        if not isinstance(model, str) or model not in _MODELS:
            raise CalibrationError(
                f"the COLMAP model {show(model)} is not supported: convert it to one of {', '.join(_MODELS)}."
            )
        names, build = _MODELS[model]
        return build(width, height, *coefficients("params", params, names))


def _perspective(width: int, height: int, fx: float, fy: float, cx: float, cy: float, *lens: float) -> Mei:
    k1, k2, p1, p2 = (*lens, 0.0, 0.0, 0.0, 0.0)[:4]
    return Mei(width, height, fx, fy, cx, cy, 0.0, (k1, k2, p1, p2))


def _fisheye(width: int, height: int, fx: float, fy: float, cx: float, cy: float, *lens: float) -> KannalaBrandt:
    k1, k2, k3, k4 = (*lens, 0.0, 0.0, 0.0, 0.0)[:4]
    return KannalaBrandt(width, height, fx, fy, cx, cy, (k1, k2, k3, k4))


def _aria(width: int, height: int, fx: float, fy: float, cx: float, cy: float, *lens: float) -> Fisheye624:
    return Fisheye624(width, height, fx, fy, cx, cy, lens)


def _one_focal_length(build: Callable[..., Camera]) -> Callable[..., Camera]:
    def with_both(width: int, height: int, f: float, cx: float, cy: float, *lens: float) -> Camera:
        return build(width, height, f, f, cx, cy, *lens)

    return with_both


def _panorama(width: int, height: int, w: float, h: float) -> Equirectangular:
    if (w, h) != (width, height):
        raise CalibrationError(
            f"the panorama has the parameters {w:g}, {h:g} and the size {width} x {height}: make them equal, "
            "a crop is not supported."
        )
    return Equirectangular(width, height)


def _sphere(width: int, height: int, _f: float, cx: float, cy: float) -> Equirectangular:
    """SphereSfM's panorama: EQUIRECTANGULAR with the principal point at the centre and square degrees."""
    if not width == 2 * height == 2 * cx == 4 * cy:
        raise CalibrationError(
            f"the panorama SPHERE has the size {width} x {height} and the centre {cx:g}, {cy:g}: give a width of "
            "twice the height and the centre in the middle, a crop is not supported."
        )
    return Equirectangular(width, height)


_MODELS: dict[str, tuple[str, Callable[..., Any]]] = {
    "SIMPLE_PINHOLE": ("f, cx, cy", _one_focal_length(_perspective)),
    "PINHOLE": ("fx, fy, cx, cy", _perspective),
    "SIMPLE_RADIAL": ("f, cx, cy, k", _one_focal_length(_perspective)),
    "RADIAL": ("f, cx, cy, k1, k2", _one_focal_length(_perspective)),
    "OPENCV": ("fx, fy, cx, cy, k1, k2, p1, p2", _perspective),
    "SIMPLE_FISHEYE": ("f, cx, cy", _one_focal_length(_fisheye)),
    "FISHEYE": ("fx, fy, cx, cy", _fisheye),
    "SIMPLE_RADIAL_FISHEYE": ("f, cx, cy, k", _one_focal_length(_fisheye)),
    "RADIAL_FISHEYE": ("f, cx, cy, k1, k2", _one_focal_length(_fisheye)),
    "OPENCV_FISHEYE": ("fx, fy, cx, cy, k1, k2, k3, k4", _fisheye),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3", _aria),
    "EUCM": ("fx, fy, cx, cy, alpha, beta", Eucm),
    "EQUIRECTANGULAR": ("w, h", _panorama),
    "SPHERE": ("f, cx, cy", _sphere),
}
"""By COLMAP's name of a model: names of the parameters, in COLMAP's order, and the function that makes the camera."""


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """Name and parameters of a camera in COLMAP.

    Raises ``CalibrationError`` if COLMAP has none.
    """
    if isinstance(camera, Equirectangular):
        return "EQUIRECTANGULAR", [camera.width, camera.height]
    if isinstance(camera, KannalaBrandt):
        return "OPENCV_FISHEYE", [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    if isinstance(camera, Fisheye624):
        return "RAD_TAN_THIN_PRISM_FISHEYE", [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    if isinstance(camera, Eucm):
        return "EUCM", [camera.fx, camera.fy, camera.cx, camera.cy, camera.alpha, camera.beta]
    if isinstance(camera, Mei) and camera.xi == 0.0:
        return "OPENCV", [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    raise CalibrationError(
        f"COLMAP has no camera model {camera.model}; give a calibration as kannala_brandt, fisheye624 or eucm."
    )
