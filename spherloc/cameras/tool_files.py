"""Calibrations of Kalibr, KITTI-360, Basalt, stella_vslam (OpenVSLAM), 360Loc and fisheye-calib-adapter.

All but 360Loc put the centre of the top-left pixel at (0, 0): 0.5 is added to their principal points here.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.cameras._checks import located
from spherloc.cameras._files import (
    PIXEL_CENTRE_SHIFT,
    list_of,
    numbers_of,
    parse_yaml,
    read_text,
    section_of,
    size_of,
    table_of,
    value_of,
)
from spherloc.cameras.base import Camera
from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.cameras.ocam import Ocam
from spherloc.errors import CalibrationError, show
from spherloc.types import FloatArray

STELLA_PREFIX = "Camera."
"""Prefix of OpenVSLAM's keys; stella_vslam has a section instead."""

_NO_LENS = (0.0, 0.0, 0.0, 0.0)


def kitti360(document: dict[Any, Any], name: str | None) -> Camera:
    """The camera of a KITTI-360 file: MEI with gamma1, gamma2, u0, v0. Raises ``CalibrationError`` for another file."""
    if document["model_type"] != "MEI":
        raise CalibrationError(f"the model_type {show(document['model_type'])} is not supported: give MEI.")
    own_name = document.get("camera_name")
    if name is not None and name != own_name:
        raise CalibrationError(f"describes the camera {show(own_name)} only: ask for it instead of {show(name)}.")
    (xi,) = section_of(document, "mirror_parameters", "xi")
    k1, k2, p1, p2 = section_of(document, "distortion_parameters", "k1", "k2", "p1", "p2")
    fx, fy, u0, v0 = section_of(document, "projection_parameters", "gamma1", "gamma2", "u0", "v0")
    size = value_of(document, "image_width"), value_of(document, "image_height")
    return Mei(*size, fx, fy, u0 + PIXEL_CENTRE_SHIFT, v0 + PIXEL_CENTRE_SHIFT, xi, (k1, k2, p1, p2))


def basalt(document: dict[Any, Any], name: str | None) -> Camera:
    """A camera of a Basalt JSON; they have no names there and are called cam0, cam1, ... in their order.

    Raises ``CalibrationError`` for another file.
    """
    with located("value0"):
        rig = table_of(document["value0"])
        cameras, sizes = value_of(rig, "intrinsics"), value_of(rig, "resolution")
        if not isinstance(cameras, list) or not isinstance(sizes, list) or not 1 <= len(cameras) == len(sizes):
            raise CalibrationError("keys 'intrinsics' and 'resolution' must be lists with an entry a camera: add them.")
        names = [f"cam{number}" for number in range(len(cameras))]
        if name is not None and name not in names:
            raise CalibrationError(f"has no camera {show(name)}: choose one of {', '.join(names)}.")
        chosen = names.index(name or "cam0")
        with located(names[chosen]):
            camera = table_of(cameras[chosen])
            kind = value_of(camera, "camera_type")
            if not isinstance(kind, str) or kind not in _BASALT:
                raise CalibrationError(f"the camera_type {show(kind)} is not supported: give {', '.join(_BASALT)}.")
            return _BASALT[kind](
                size_of({"resolution": sizes[chosen]}, "resolution"), table_of(value_of(camera, "intrinsics"))
            )


def basalt_names(document: Any) -> tuple[str, ...]:
    """Names of the cameras of a Basalt JSON; none for another file."""
    rig = document.get("value0") if isinstance(document, dict) else None
    cameras = rig.get("intrinsics") if isinstance(rig, dict) else None
    return tuple(f"cam{number}" for number in range(len(cameras))) if isinstance(cameras, list) else ()


def stella(document: dict[Any, Any]) -> Camera:
    """The ``Camera`` section of stella_vslam, or OpenVSLAM's keys ``Camera.model``, ``Camera.fx``, ...

    Raises ``CalibrationError`` for another file.
    """
    dotted = {
        key.removeprefix(STELLA_PREFIX): value for key, value in document.items() if str(key).startswith(STELLA_PREFIX)
    }
    with located("Camera"):
        table = dotted or table_of(document["Camera"])
        kind = value_of(table, "model")
        size = value_of(table, "cols"), value_of(table, "rows")
        if kind == "equirectangular":
            return Equirectangular(*size)
        if kind == "fisheye":
            return _kannala_brandt(size, table)
        if kind == "perspective":
            return _perspective(size, table)
        raise CalibrationError(
            f"the model {show(kind)} is not supported: give equirectangular, fisheye or perspective."
        )


def loc360(document: dict[Any, Any]) -> Camera:
    """A camera_config of 360Loc: a double sphere, or a pinhole where xi and alpha are absent.

    Its process.py casts the ray of pixel (u, v) through u + 0.5: the principal point is taken as it is.
    """
    size = value_of(document, "imgw"), value_of(document, "imgh")
    fx, fy, cx, cy = numbers_of(document, "fx", "fy", "cx", "cy")
    if "xi" in document or "alpha" in document:
        return DoubleSphere(*size, fx, fy, cx, cy, *numbers_of(document, "xi", "alpha"))
    return Mei(*size, fx, fy, cx, cy, 0.0, _NO_LENS)


def adapter(document: dict[Any, Any]) -> Camera:
    """The camera of a file of fisheye-calib-adapter, which names no model: the model is recognised by its keys.

    Raises ``CalibrationError`` for another file.
    """
    image = value_of(document, "image")
    with located("image"):
        size = value_of(table_of(image), "width"), value_of(image, "height")
    with located("parameter"):
        table = table_of(document["parameter"])
        for keys, build in _ADAPTER:
            if all(key in table for key in keys):
                return build(size, table)
        raise CalibrationError(
            f"the keys {show(sorted(map(str, table)))} are not those of a supported model: "
            "give the Kannala-Brandt, double sphere, EUCM, OCamCalib or radtan file."
        )


Size = tuple[Any, Any]


def _focal(table: dict[Any, Any]) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy, with the shift of the principal point."""
    fx, fy, cx, cy = numbers_of(table, "fx", "fy", "cx", "cy")
    return fx, fy, cx + PIXEL_CENTRE_SHIFT, cy + PIXEL_CENTRE_SHIFT


def _kannala_brandt(size: Size, table: dict[Any, Any]) -> Camera:
    fx, fy, cx, cy = _focal(table)
    k1, k2, k3, k4 = numbers_of(table, "k1", "k2", "k3", "k4")
    return KannalaBrandt(*size, fx, fy, cx, cy, (k1, k2, k3, k4))


def _double_sphere(size: Size, table: dict[Any, Any]) -> Camera:
    return DoubleSphere(*size, *_focal(table), *numbers_of(table, "xi", "alpha"))


def _eucm(size: Size, table: dict[Any, Any]) -> Camera:
    return Eucm(*size, *_focal(table), *numbers_of(table, "alpha", "beta"))


def _unified(size: Size, table: dict[Any, Any]) -> Camera:
    """Basalt's "ucm" is the EUCM on a sphere."""
    (alpha,) = numbers_of(table, "alpha")
    return Eucm(*size, *_focal(table), alpha, 1.0)


def _pinhole(size: Size, table: dict[Any, Any]) -> Camera:
    fx, fy, cx, cy = _focal(table)
    return Mei(*size, fx, fy, cx, cy, 0.0, _NO_LENS)


def _perspective(size: Size, table: dict[Any, Any]) -> Camera:
    """Radial and tangential distortion; a third radial term is refused, since MEI has two."""
    fx, fy, cx, cy = _focal(table)
    k1, k2, p1, p2 = numbers_of(table, "k1", "k2", "p1", "p2")
    if "k3" in table and numbers_of(table, "k3") != [0.0]:
        raise CalibrationError(f"key 'k3' is {show(table['k3'])}: calibrate with k1, k2, p1, p2 alone, k3 must be 0.")
    return Mei(*size, fx, fy, cx, cy, 0.0, (k1, k2, p1, p2))


def _ocam(size: Size, table: dict[Any, Any]) -> Camera:
    """The adapter's form of OCamCalib, with the image's axes: u = c x + d y + cx, v = e x + y + cy, z forward."""
    c, d, e, cx, cy = numbers_of(table, "c", "d", "e", "cx", "cy")
    with located("coefficients"):
        polynomial = value_of(table_of(table["coefficients"]), "unprojection")
    place = cx + PIXEL_CENTRE_SHIFT, cy + PIXEL_CENTRE_SHIFT
    return Ocam(*size, *place, (c, d, e, 1.0), polynomial)


_Build = Callable[[Size, dict[Any, Any]], Camera]

_BASALT: dict[str, _Build] = {
    "ds": _double_sphere,
    "eucm": _eucm,
    "kb4": _kannala_brandt,
    "pinhole": _pinhole,
    "ucm": _unified,
}

_ADAPTER: tuple[tuple[tuple[str, ...], _Build], ...] = (
    (("xi", "alpha"), _double_sphere),
    (("alpha", "beta"), _eucm),
    (("k1", "k2", "k3", "k4"), _kannala_brandt),
    (("k1", "k2", "p1", "p2"), _perspective),
    (("c", "d", "e", "coefficients"), _ocam),
)


_ROTATION_TOLERANCE = 1e-3
"""Largest error of R R^T: matrices rounded to four digits pass, a scale or a wrong matrix does not."""


@dataclass(frozen=True)
class KalibrCamera:
    """One camera of a chain."""

    camera: Camera
    """Its model, with the principal point in this project's convention."""
    cam_from_imu: FloatArray | None
    """``T_cam_imu``, or the inverse of ``T_imu_cam`` (4, 4), metres; None if the file has none."""
    cam_from_previous: FloatArray | None
    """``T_cn_cnm1`` (4, 4), metres, from the camera before it in the chain; None if the file has none."""
    timeshift_s: float = 0.0
    """``timeshift_cam_imu``: what is added to a time of the camera to get the same moment by the IMU's clock."""


def read_kalibr_chain(path: str | Path) -> dict[str, KalibrCamera]:
    """The cameras of a camchain by name ("cam0"), in the order of the file.

    Raises ``CalibrationError``, naming the file and the camera, for whatever cannot be used.
    """
    with located(str(path)):
        document = parse_yaml(read_text(Path(path)))
        if not chain_tables(document):
            raise CalibrationError("has no 'cam0' at its top: give a camchain YAML of Kalibr.")
        return kalibr_chain(document)


def kalibr_chain(document: Any) -> dict[str, KalibrCamera]:
    """The cameras of a camchain that is read, as ``read_kalibr_chain``; raises ``CalibrationError``."""
    chain = {}
    for name, table in chain_tables(document).items():
        camera = camera_of(name, table)
        with located(name):
            (shift_s,) = numbers_of({"timeshift_cam_imu": 0.0} | table, "timeshift_cam_imu")
            cam_from_imu, imu_from_cam = rigid(table, "T_cam_imu"), rigid(table, "T_imu_cam")
            if cam_from_imu is None and imu_from_cam is not None:
                cam_from_imu = np.asarray(np.linalg.inv(imu_from_cam), np.float64)
            chain[name] = KalibrCamera(camera, cam_from_imu, rigid(table, "T_cn_cnm1"), shift_s)
    return chain


def read_body_from_sensor(path: Path) -> FloatArray | None:
    """``T_BS`` (4, 4), metres, of a ``sensor.yaml``: p_body = T_BS p_sensor; None if the file has none.

    Raises ``CalibrationError``, naming the file, if it cannot be read or its ``T_BS`` is no rigid transform.
    """
    with located(str(path)):
        table = parse_yaml(read_text(path))
        if not isinstance(table, dict) or "T_BS" not in table:
            return None
        matrix = table["T_BS"]
        if isinstance(matrix, dict):  # OpenCV's form
            numbers = list(list_of(matrix, "data", ", ".join(f"m{k}" for k in range(16))))
            matrix = [numbers[row : row + 4] for row in range(0, 16, 4)]
        return rigid({"T_BS": matrix}, "T_BS")


def chain_tables(document: Any) -> dict[str, Any]:
    """The cameras of a camchain in the order of the file; empty for another file."""
    if not isinstance(document, dict):
        return {}
    return {key: table for key, table in document.items() if isinstance(key, str) and re.fullmatch(r"cam\d+", key)}


def camera_of(name: str, table: Any) -> Camera:
    """The camera ``name`` of a chain; raises ``CalibrationError`` for an unknown model and unusable values."""
    with located(name):
        lens = (value_of(table_of(table), "camera_model"), value_of(table, "distortion_model"))
        build = _LENSES.get(lens) if all(isinstance(part, str) for part in lens) else None
        if build is None:
            known = ", ".join(" with ".join(lens) for lens in _LENSES)
            raise CalibrationError(
                f"the camera_model {show(lens[0])} with the distortion_model {show(lens[1])} is not supported: "
                f"give one of {known}."
            )
        return build(table, *size_of(table, "resolution"))


_EUROC_LENSES = {"radial-tangential": "radtan"}
"""Names of ``distortion_model`` in EuRoC's files that Kalibr calls otherwise."""


def euroc(document: dict[Any, Any]) -> Camera:
    """The camera of a ``sensor.yaml`` of EuRoC, TUM-VI or alike; raises ``CalibrationError`` for an unknown model and
    unusable values."""
    lens = value_of(document, "distortion_model")
    table = {**document, "distortion_model": _EUROC_LENSES.get(lens, lens) if isinstance(lens, str) else lens}
    return camera_of("sensor.yaml", table | {"distortion_coeffs": document.get("distortion_coefficients")})


def _kalibr_fisheye(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    fx, fy, cx, cy = _intrinsics(table, "fu, fv, pu, pv")
    k1, k2, k3, k4 = list_of(table, "distortion_coeffs", "k1, k2, k3, k4")
    return KannalaBrandt(width, height, fx, fy, cx, cy, (k1, k2, k3, k4))


def _kalibr_pinhole(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    fx, fy, cx, cy = _intrinsics(table, "fu, fv, pu, pv")
    return Mei(width, height, fx, fy, cx, cy, 0.0, _radial_tangential(table))


def _kalibr_omni(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    xi, fx, fy, cx, cy = _intrinsics(table, "xi, fu, fv, pu, pv")
    return Mei(width, height, fx, fy, cx, cy, xi, _radial_tangential(table))


def _kalibr_double_sphere(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    xi, alpha, fx, fy, cx, cy = _intrinsics(table, "xi, alpha, fu, fv, pu, pv")
    return DoubleSphere(width, height, fx, fy, cx, cy, xi, alpha)


def _kalibr_eucm(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    alpha, beta, fx, fy, cx, cy = _intrinsics(table, "alpha, beta, fu, fv, pu, pv")
    return Eucm(width, height, fx, fy, cx, cy, alpha, beta)


_LENSES: dict[tuple[str, str], Callable[[dict[Any, Any], Any, Any], Camera]] = {
    ("pinhole", "radtan"): _kalibr_pinhole,
    ("pinhole", "equidistant"): _kalibr_fisheye,
    ("pinhole", "none"): _kalibr_pinhole,
    ("omni", "radtan"): _kalibr_omni,
    ("omni", "none"): _kalibr_omni,
    ("ds", "none"): _kalibr_double_sphere,
    ("eucm", "none"): _kalibr_eucm,
}


def _intrinsics(table: dict[Any, Any], names: str) -> list[float]:
    """The numbers under ``intrinsics``, with the shift of the principal point, the last two."""
    *others, pu, pv = list_of(table, "intrinsics", names)
    return [*others, pu + PIXEL_CENTRE_SHIFT, pv + PIXEL_CENTRE_SHIFT]


def _radial_tangential(table: dict[Any, Any]) -> tuple[float, float, float, float]:
    """k1, k2, p1, p2; zeros for the distortion_model none."""
    if table["distortion_model"] == "none":
        return 0.0, 0.0, 0.0, 0.0
    k1, k2, p1, p2 = list_of(table, "distortion_coeffs", "k1, k2, p1, p2")
    return k1, k2, p1, p2


def rigid(table: dict[Any, Any], key: str) -> FloatArray | None:
    """The rigid transform (4, 4) under ``key``, or None if there is none; raises ``CalibrationError`` for another
    matrix."""
    if key not in table:
        return None
    rows = table[key]
    if not isinstance(rows, list) or len(rows) != 4:
        raise CalibrationError(f"key '{key}' is {show(rows)}: give a 4 x 4 matrix.")
    matrix = np.array([list_of({key: row}, key, "r1, r2, r3, t") for row in rows])
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        right_handed = np.linalg.det(rotation) > 0.0
    if not (error < _ROTATION_TOLERANCE and right_handed and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all()):
        raise CalibrationError(f"key '{key}' is not a rotation with a translation: give a rigid 4 x 4 matrix.")
    return matrix
