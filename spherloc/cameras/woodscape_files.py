"""Calibrations of WoodScape, a JSON an image: the fisheye of a car (``radial_poly``), and how it is fixed to the car.

They put the centre of the top-left pixel at (0, 0) and count the principal point from the middle of the image, which is
then at (width / 2 - 0.5, height / 2 - 0.5): here that is half of its size.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spherloc.cameras._checks import located, positive
from spherloc.cameras._files import list_of, numbers_of, table_of, whole
from spherloc.cameras.radial_poly import RadialPoly
from spherloc.errors import CalibrationError, show
from spherloc.types import FloatArray

_MODEL = "radial_poly"
_ORDER = 4
_UNIT = 1e-3
"""Largest difference of a quaternion's length to 1."""


def is_woodscape(document: Any) -> bool:
    """Whether a JSON has the section of WoodScape's lens."""
    section = document.get("intrinsic") if isinstance(document, dict) else None
    return isinstance(section, dict) and "model" in section


def woodscape(document: dict[Any, Any], name: str | None) -> RadialPoly:
    """The camera of a JSON of WoodScape, which has one, called FV, RV, MVL or MVR there.

    Raises ``CalibrationError`` for another model, unusable values, and another name.
    """
    if name is not None and name != woodscape_name(document):
        raise CalibrationError(
            f"describes the camera {show(woodscape_name(document))} only: ask for it instead of {show(name)}."
        )
    with located("intrinsic"):
        table = table_of(document["intrinsic"])
        if table["model"] != _MODEL or table.get("poly_order", _ORDER) != _ORDER:
            what = f"the model {show(table['model'])} with poly_order {show(table.get('poly_order', _ORDER))}"
            raise CalibrationError(f"{what} is not supported: give {_MODEL} of order {_ORDER}.")
        k1, k2, k3, k4 = numbers_of(table, "k1", "k2", "k3", "k4")
        right, down = numbers_of(table, "cx_offset", "cy_offset")
        (aspect,) = numbers_of({"aspect_ratio": 1.0} | table, "aspect_ratio")
        focal, aspect = positive("k1", k1), positive("aspect_ratio", aspect)
        width, height = numbers_of(table, "width", "height")
        middle = 0.5 * width + right, 0.5 * height + down
        return RadialPoly(
            whole(width), whole(height), focal, focal * aspect, *middle, (k2 / focal, k3 / focal, k4 / focal)
        )


def woodscape_name(document: dict[Any, Any]) -> str:
    """The name of the camera of a JSON of WoodScape; empty if it has none."""
    name = document.get("name")
    return name if isinstance(name, str) else ""


def vehicle_from_camera(document: dict[Any, Any]) -> FloatArray | None:
    """(4, 4), metres, from the axes of the camera to those of the car, x ahead, y to the left and z up; None if a JSON
    of WoodScape does not say it. Raises ``CalibrationError`` for unusable values."""
    if "extrinsic" not in document:
        return None
    with located("extrinsic"):
        table = table_of(document["extrinsic"])
        return rigid_of(list_of(table, "quaternion", "x, y, z, w"), list_of(table, "translation", "x, y, z"))


def rigid_of(quaternion: tuple[float, ...], translation: tuple[float, ...]) -> FloatArray:
    """(4, 4) of a quaternion x, y, z, w and a translation; raises ``CalibrationError`` if the first is not of length
    1."""
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _UNIT:
        raise CalibrationError(f"its quaternion is {show(length)} long: give one of length 1.")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), translation
    return matrix
