"""Calibrations that OpenCV's samples, Python scripts with OpenCV, and ROS write: a camera matrix, coefficients and a
size under one of many names.

They put the centre of the top-left pixel at (0, 0): 0.5 is added to their principal points here.
"""

from collections.abc import Mapping
from math import hypot
from typing import Any

import numpy as np

from spherloc.cameras._checks import located
from spherloc.cameras._files import PIXEL_CENTRE_SHIFT, list_of, numbers_of, value_of, whole
from spherloc.cameras.base import Camera
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError, shorten, show

MATRICES = ("K", "camera_matrix", "Camera_Matrix", "cameraMatrix", "intrinsic_matrix", "mtx", "M")
"""Names of a camera matrix; of several in a file the first one here counts."""
COEFFICIENTS = ("D", "distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "dist_coeff", "distCoeffs")
"""Names of coefficients of a lens, of which the first one here counts, that nothing else has."""
_SHORT_COEFFICIENTS = ("distortion", "dist")
"""Such names that count beside a camera matrix only."""
_SIDES = (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height"))
"""Names of the width and the height, px."""
_FISHEYE_SIZES = ("DIM", "dim")
"""Names of the size (width, height), px, in the tutorial of cv2.fisheye."""
_SIZES = (*_FISHEYE_SIZES, "size", "image_size", "img_size", "resolution", "imageSize")
"""Names of the size (width, height), px."""

_FISHEYE, _RADIAL = {"equidistant", "fisheye"}, {"plumb_bob", "radtan"}
"""Values of ``distortion_model``."""
_MAX_SKEW = 1e-6
"""Largest skew of a camera matrix, as a share of the focal length."""
LARGEST_TANGENTIAL = 0.02
"""The third and fourth coefficients of a pinhole are those of a lens that is not centred; they are no larger."""
STRONGEST_BARREL = -0.2
"""First coefficient below which a curve bends more than that of any fisheye: -1/6 is orthographic, which ends at
90°."""
LEAST_SEEN = 0.75
"""Least share of an image's pixels that a calibration of it covers."""
_GRID = 21


def is_opencv(document: Any) -> bool:
    """Whether a document has coefficients by a name that OpenCV's users give, beside a camera matrix if others do."""
    keys = document.keys() if isinstance(document, dict) else set()
    return not keys.isdisjoint(COEFFICIENTS) or not (keys.isdisjoint(_SHORT_COEFFICIENTS) or keys.isdisjoint(MATRICES))


def opencv(document: dict[Any, Any], of_images: tuple[int, int] | None = None) -> Camera:
    """A pinhole, a fisheye (``fisheye_model: 1``, or ROS's ``distortion_model: equidistant``) or MEI (``xi``).

    Matrices are FileStorage's tables or lists. ``of_images`` is the size, px, if the file states none. Four
    coefficients without a model are those of a fisheye or a pinhole, where ``about_opencv`` has a reason for that.

    Raises ``CalibrationError`` for another file, and if its four coefficients may be those of a fisheye or a pinhole.
    """
    return _camera(document, of_images)[0]


def about_opencv(document: dict[Any, Any], of_images: tuple[int, int] | None = None) -> str:
    """What four coefficients without a model were taken for by ``opencv``, and why, as a sentence; empty if the file
    says what they are. Raises ``CalibrationError`` as that does."""
    return _camera(document, of_images)[1]


def opencv_arrays(document: Any) -> list[str]:
    """Names of the first arrays of OpenCV's FileStorage, and matrices of three rows, in a document."""
    tables = document.items() if isinstance(document, dict) else ()
    return [shorten(str(key)) for key, value in tables if _is_array(value)][:4]


def _is_array(value: Any) -> bool:
    if isinstance(value, dict):
        return "data" in value and not value.keys().isdisjoint({"rows", "sizes"})
    return isinstance(value, list) and len(value) == 3 and all(isinstance(row, list) and len(row) == 3 for row in value)


def _camera(document: dict[Any, Any], of_images: tuple[int, int] | None) -> tuple[Camera, str]:
    """The camera, and what was decided about it."""
    size = _size(document, of_images)
    coefficients = _first(document, (*COEFFICIENTS, *_SHORT_COEFFICIENTS)) or COEFFICIENTS[0]
    matrix = _first(document, MATRICES) or ("K" if coefficients == "D" else "camera_matrix")
    with located(matrix):
        fx, skew, cx, zero, fy, cy, *last = _matrix(value_of(document, matrix), 9)
        if abs(skew) > _MAX_SKEW * abs(fx) or (zero, *last) != (0.0, 0.0, 0.0, 1.0):
            raise CalibrationError("is not a matrix [fx 0 cx; 0 fy cy; 0 0 1]: give one without skew.")
    with located(coefficients):
        lens = _matrix(document[coefficients], None)
    focal = (*size, fx, fy, cx + PIXEL_CENTRE_SHIFT, cy + PIXEL_CENTRE_SHIFT)
    if "xi" in document:
        return Mei(*focal, _scalar(document["xi"]), _four(lens, coefficients, "k1, k2, p1, p2")), ""
    fisheye, why = _stated(document), ""
    if fisheye is None:
        fisheye, why = _is_fisheye(document, lens, focal, coefficients)
    if fisheye:
        camera: Camera = KannalaBrandt(*focal, _four(lens, coefficients, "k1, k2, k3, k4"))
    else:
        camera = Mei(*focal, 0.0, _four(lens, coefficients, "k1, k2, p1, p2"))
    kind, other = ("a fisheye (cv2.fisheye)", "plumb_bob") if fisheye else ("a pinhole", "equidistant")
    told = f"its four coefficients are taken for those of {kind}, since {why}; if not, add distortion_model: {other}."
    return camera, told if why else ""


def _first(document: Mapping[Any, Any], names: tuple[str, ...]) -> str | None:
    return next((name for name in names if name in document), None)


def _size(document: dict[Any, Any], of_images: tuple[int, int] | None) -> tuple[Any, Any]:
    """Width and height, px, for the camera to check; raises ``CalibrationError`` if they are not known."""
    for width, height in _SIDES:
        if width in document or height in document:
            return value_of(document, width), value_of(document, height)
    name = _first(document, _SIZES)
    if name is not None:
        with located(name):
            width, height = _matrix(document[name], 2)
        return whole(width), whole(height)
    if of_images is None:
        raise CalibrationError("states no size of images: add the keys image_width and image_height.")
    return of_images


def _stated(document: dict[Any, Any]) -> bool | None:
    """Whether a file says that its lens is a fisheye; None if it does not say what it is."""
    model = document.get("distortion_model")
    if isinstance(model, str) and model in _FISHEYE | _RADIAL:
        return model in _FISHEYE
    if model is not None:
        known = ", ".join(sorted(_FISHEYE | _RADIAL))
        raise CalibrationError(f"the distortion_model {show(model)} is not supported: give one of {known}.")
    return numbers_of(document, "fisheye_model") != [0.0] if "fisheye_model" in document else None


def _is_fisheye(
    document: dict[Any, Any], lens: list[float], focal: tuple[Any, Any, float, float, float, float], name: str
) -> tuple[bool, str]:
    """Whether coefficients of a lens are those of a fisheye, and how that is seen if they are four; ``focal`` are
    width, height, fx, fy, cx, cy.

    Raises ``CalibrationError`` if it is not seen.
    """
    of_tutorial = name == "D" and "K" in document and _first(document, _FISHEYE_SIZES) is not None
    if len(lens) != 4 or not (any(lens) or of_tutorial):
        return False, ""
    if of_tutorial:
        return True, f"its keys K, D and {_first(document, _FISHEYE_SIZES)} are those of cv2.fisheye's users"
    k1, k2, third, fourth = lens
    largest = max(third, fourth, key=abs)
    if abs(largest) > LARGEST_TANGENTIAL:
        return True, f"{largest:.3g} would be a tangential distortion that no pinhole has"
    pinhole = _seen(Mei, focal, (0.0, (k1, k2, 0.0, 0.0)))
    if pinhole < LEAST_SEEN <= _seen(KannalaBrandt, focal, (tuple(lens),)):
        return True, f"a pinhole with them would cover {100 * pinhole:.0f} % of the image only"
    if k1 < STRONGEST_BARREL and hypot(third, fourth) <= LARGEST_TANGENTIAL:
        return False, f"{k1:.3g} bends more than any fisheye does"
    raise CalibrationError(
        f"the four {name} may be those of a fisheye or of a pinhole: add distortion_model, equidistant or plumb_bob."
    )


def _seen(model: type[Mei] | type[KannalaBrandt], focal: tuple[Any, ...], lens: tuple[Any, ...]) -> float:
    """Share of the pixels of an image from which a camera sees; none if there is no such camera."""
    try:
        camera = model(*focal, *lens)
    except CalibrationError:
        return 0.0
    u, v = np.meshgrid(*(np.linspace(0.5, side - 0.5, _GRID) for side in (camera.width, camera.height)))
    return float(camera.unproject(np.column_stack([u.ravel(), v.ravel()]))[1].mean())


def _four(lens: list[float], key: str, names: str) -> tuple[float, float, float, float]:
    """The first four coefficients; the others must be zero, as the models have no more."""
    padded = [*lens, 0.0, 0.0, 0.0, 0.0][: max(4, len(lens))]
    if any(padded[4:]):
        raise CalibrationError(f"{key} has {len(lens)} numbers: calibrate with {names} alone.")
    k1, k2, k3, k4 = padded[:4]
    return k1, k2, k3, k4


def _scalar(value: Any) -> float:
    """``xi``, a number or a matrix of one."""
    with located("xi"):
        return _matrix(value, 1)[0] if isinstance(value, dict | list) else numbers_of({"xi": value}, "xi")[0]


def _matrix(value: Any, count: int | None) -> list[float]:
    """The numbers, row by row, of a list, of a list of rows or of a table ``rows``, ``cols``, ``data`` or ``sizes``,
    ``data``; ``count`` is how many there must be."""
    if isinstance(value, list):
        return _of_rows(value, count)
    if not isinstance(value, dict):
        raise CalibrationError(f"is {show(value)}: give a matrix, as a list of its rows.")
    sizes = list(_numbers(value, "sizes")) if "sizes" in value else numbers_of(value, "rows", "cols")
    numbers = _numbers(value, "data")
    if len(numbers) != np.prod(sizes) or (count is not None and len(numbers) != count):
        wanted = f"{count}" if count is not None else "rows x cols"
        rows, columns, *_ = *sizes, 1.0
        raise CalibrationError(f"has {len(numbers)} numbers in {rows:g} rows and {columns:g} columns: give {wanted}.")
    return np.array(numbers, dtype=np.float64).tolist()


def _of_rows(value: list[Any], count: int | None) -> list[float]:
    """The numbers of a list or of a list of rows of the same length."""
    rows = [row if isinstance(row, list) else [row] for row in value]
    if len({len(row) for row in rows}) > 1:
        raise CalibrationError(f"is {show(value)}: give rows of the same length.")
    numbers = _numbers({"data": [number for row in rows for number in row]}, "data")
    if count is not None and len(numbers) != count:
        raise CalibrationError(f"has {len(numbers)} numbers: give {count}.")
    return list(numbers)


def _numbers(table: dict[Any, Any], key: str) -> tuple[float, ...]:
    """The finite numbers in the list under ``key``, which may be empty."""
    values = value_of(table, key)
    return () if isinstance(values, list) and not values else list_of(table, key, _names(values))


def _names(data: Any) -> str:
    """Names m0, m1, ..., one for each entry of a list, for the messages of ``list_of``."""
    return ", ".join(f"m{place}" for place in range(min(len(data), 100))) if isinstance(data, list) else "m0"
