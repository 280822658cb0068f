"""Calibrations as OpenCV's samples and ROS write them: ``camera_matrix`` and ``distortion_coefficients``.

Both count pixels from the centre of the top-left one: 0.5 is added to the principal point.
"""

from typing import Any

import numpy as np

from spherloc.cameras._checks import located
from spherloc.cameras._files import PIXEL_CENTRE_SHIFT, list_of, numbers_of, table_of, value_of
from spherloc.cameras.base import Camera
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError, show

_FISHEYE, _RADIAL = {"equidistant", "fisheye"}, {"plumb_bob", "radtan"}
"""Values of ``distortion_model``."""
_MAX_SKEW = 1e-6
"""Of the focal length."""


def opencv(document: dict[Any, Any]) -> Camera:
    """A pinhole, a fisheye (``fisheye_model: 1``, or ROS's ``distortion_model: equidistant``) or MEI (``xi``).

    Raises ``CalibrationError`` for what is no such file, and where four coefficients may be those of either lens.
    """
    size = value_of(document, "image_width"), value_of(document, "image_height")
    with located("camera_matrix"):
        fx, skew, cx, zero, fy, cy, *last = _matrix(value_of(document, "camera_matrix"), 9)
        if abs(skew) > _MAX_SKEW * abs(fx) or (zero, *last) != (0.0, 0.0, 0.0, 1.0):
            raise CalibrationError("is no matrix [fx 0 cx; 0 fy cy; 0 0 1]: give one without skew.")
    with located("distortion_coefficients"):
        lens = _matrix(document["distortion_coefficients"], None)
    middle = cx + PIXEL_CENTRE_SHIFT, cy + PIXEL_CENTRE_SHIFT
    if "xi" in document:
        k1, k2, p1, p2 = _four(lens, "k1, k2, p1, p2")
        return Mei(*size, fx, fy, *middle, _scalar(document["xi"]), (k1, k2, p1, p2))
    if _is_fisheye(document, lens):
        return KannalaBrandt(*size, fx, fy, *middle, _four(lens, "k1, k2, k3, k4"))
    return Mei(*size, fx, fy, *middle, 0.0, _four(lens, "k1, k2, p1, p2"))


def _is_fisheye(document: dict[Any, Any], lens: list[float]) -> bool:
    model = document.get("distortion_model")
    if isinstance(model, str) and model in _FISHEYE | _RADIAL:
        return model in _FISHEYE
    if model is not None:
        known = ", ".join(sorted(_FISHEYE | _RADIAL))
        raise CalibrationError(f"the distortion_model {show(model)} is not supported: give one of {known}.")
    if "fisheye_model" in document:
        return numbers_of(document, "fisheye_model") != [0.0]
    if len(lens) == 4 and any(lens):
        raise CalibrationError(
            "the four distortion_coefficients may be those of a fisheye or of a pinhole: add distortion_model, "
            "equidistant or plumb_bob."
        )
    return False


def _four(lens: list[float], names: str) -> tuple[float, float, float, float]:
    """The first four coefficients; the others must be zero, as the models have no more."""
    padded = [*lens, 0.0, 0.0, 0.0, 0.0][: max(4, len(lens))]
    if any(padded[4:]):
        raise CalibrationError(f"distortion_coefficients has {len(lens)} numbers: calibrate with {names} alone.")
    k1, k2, k3, k4 = padded[:4]
    return k1, k2, k3, k4


def _scalar(value: Any) -> float:
    """``xi``, a number or a matrix of one."""
    with located("xi"):
        if isinstance(value, dict):
            return _matrix(value, 1)[0]
        return numbers_of({"xi": value}, "xi")[0]


def _matrix(value: Any, count: int | None) -> list[float]:
    """The numbers of a table ``rows``, ``cols``, ``data``, row by row; ``count`` is how many there must be."""
    table = table_of(value)
    rows, columns = numbers_of(table, "rows", "cols")
    data = value_of(table, "data")
    numbers = [] if isinstance(data, list) and not data else list_of(table, "data", _names(data))
    if len(numbers) != rows * columns or (count is not None and len(numbers) != count):
        wanted = f"{count}" if count is not None else "rows x cols"
        raise CalibrationError(f"has {len(numbers)} numbers in {rows:g} rows and {columns:g} columns: give {wanted}.")
    return np.array(numbers, dtype=np.float64).tolist()


def _names(data: Any) -> str:
    """As many names as a list has entries, which ``list_of`` then checks one by one."""
    return ", ".join(f"m{place}" for place in range(min(len(data), 100))) if isinstance(data, list) else "m0"
