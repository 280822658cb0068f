"""Kalibr camera chains (kalibr_common/ConfigReader.py): every camera with its place at the IMU and beside the others.

Kalibr puts the centre of the top-left pixel at (0, 0): 0.5 is added to the principal point.
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
    size_of,
    table_of,
    value_of,
)
from spherloc.cameras.base import Camera
from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.eucm import Eucm
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError, show
from spherloc.types import FloatArray

_ROTATION_TOLERANCE = 1e-3
"""Largest error of R R^T: matrices rounded to four digits pass, a scale or a wrong matrix does not."""


@dataclass(frozen=True)
class KalibrCamera:
    """One camera of a chain."""

    camera: Camera
    """Its model, with the principal point in this project's convention."""
    cam_from_imu: FloatArray | None
    """``T_cam_imu`` (4, 4), metres; None if the file has none."""
    cam_from_previous: FloatArray | None
    """``T_cn_cnm1`` (4, 4), metres, from the camera before it in the chain; None if the file has none."""
    timeshift_s: float = 0.0
    """``timeshift_cam_imu``: what is added to a time of the camera to get the same moment by the IMU's clock."""


def read_kalibr_chain(path: str | Path) -> dict[str, KalibrCamera]:
    """The cameras of a camchain by name ("cam0"), in the order of the file.

    Raises ``CalibrationError``, naming the file and the camera, for whatever cannot be used.
    """
    with located(str(path)):
        tables = chain_tables(parse_yaml(read_text(Path(path))))
        if not tables:
            raise CalibrationError("has no 'cam0' at its top: give a camchain YAML of Kalibr.")
        chain = {}
        for name, table in tables.items():
            camera = camera_of(name, table)
            with located(name):
                (shift_s,) = numbers_of({"timeshift_cam_imu": 0.0} | table, "timeshift_cam_imu")
                chain[name] = KalibrCamera(camera, _rigid(table, "T_cam_imu"), _rigid(table, "T_cn_cnm1"), shift_s)
        return chain


def chain_tables(document: Any) -> dict[str, Any]:
    """The cameras of a camchain in the order of the file; empty if it is none."""
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


def _fisheye(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    fx, fy, cx, cy = _intrinsics(table, "fu, fv, pu, pv")
    k1, k2, k3, k4 = list_of(table, "distortion_coeffs", "k1, k2, k3, k4")
    return KannalaBrandt(width, height, fx, fy, cx, cy, (k1, k2, k3, k4))


def _pinhole(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    fx, fy, cx, cy = _intrinsics(table, "fu, fv, pu, pv")
    return Mei(width, height, fx, fy, cx, cy, 0.0, _radial_tangential(table))


def _omni(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    xi, fx, fy, cx, cy = _intrinsics(table, "xi, fu, fv, pu, pv")
    return Mei(width, height, fx, fy, cx, cy, xi, _radial_tangential(table))


def _double_sphere(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    xi, alpha, fx, fy, cx, cy = _intrinsics(table, "xi, alpha, fu, fv, pu, pv")
    return DoubleSphere(width, height, fx, fy, cx, cy, xi, alpha)


def _eucm(table: dict[Any, Any], width: Any, height: Any) -> Camera:
    alpha, beta, fx, fy, cx, cy = _intrinsics(table, "alpha, beta, fu, fv, pu, pv")
    return Eucm(width, height, fx, fy, cx, cy, alpha, beta)


_LENSES: dict[tuple[str, str], Callable[[dict[Any, Any], Any, Any], Camera]] = {
    ("pinhole", "radtan"): _pinhole,
    ("pinhole", "equidistant"): _fisheye,
    ("pinhole", "none"): _pinhole,
    ("omni", "radtan"): _omni,
    ("omni", "none"): _omni,
    ("ds", "none"): _double_sphere,
    ("eucm", "none"): _eucm,
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


def _rigid(table: dict[Any, Any], key: str) -> FloatArray | None:
    """The rigid transform (4, 4) under ``key``, or None if there is none."""
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
        raise CalibrationError(f"key '{key}' is no rotation with a translation: give a rigid 4 x 4 matrix.")
    return matrix
